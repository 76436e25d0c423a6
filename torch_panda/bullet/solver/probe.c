/*
 * The layout probe: do Bullet's structs have the layout that bullet_types.h declares?
 *
 * It reads the structs of a scene whose numbers are known, while Bullet itself steps the
 * scene. Settings come first, then the sizes of arrays, and pointers last. Every check
 * relies on the checks before it, so the probe never follows a pointer that is wrong.
 */
#if defined(__x86_64__) && defined(__linux__)
#include "solver.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#define CHECK(name, condition)                                                         \
    if (!(condition)) return name

static int is_array(const struct array *array) {
    return array->size >= 0 && array->size <= array->capacity &&
           array->capacity < 100000 &&
           (array->capacity == 0 || (array->data != NULL && array->owns_memory == 1 &&
                                     (uintptr_t)array->data % 16 == 0));
}

static const char *probe_body(const struct solver *solver,
                              const struct multi_body *body, int first, int jacobian,
                              const struct expectation *expected) {
    CHECK("a row's body", body != NULL && (uintptr_t)body % 16 == 0);
    CHECK("btMultiBody.m_dofCount",
          body->num_dofs == 0 || body->num_dofs == expected->num_dofs);
    CHECK("btMultiBody.m_companionId", body->companion_id == first);
    CHECK("btMultiBody.m_deltaV",
          is_array(&body->delta_v) && body->delta_v.size == body->num_dofs + 6);
    CHECK("a row's m_deltaVelAindex",
          first >= 0 &&
              first + body->num_dofs + 6 <= solver->data.delta_velocities.size);
    CHECK("a row's m_jacAindex",
          jacobian >= 0 &&
              jacobian + body->num_dofs + 6 <= solver->data.jacobians.size);
    return NULL;
}

static const char *probe_row(const struct solver *solver,
                             const struct constraint_row *row,
                             const struct expectation *expected) {
    const char *mismatch = probe_body(solver, row->multi_body_a, row->delta_vel_a,
                                   row->jac_a, expected);
    if (mismatch == NULL)
        mismatch = probe_body(solver, row->multi_body_b, row->delta_vel_b, row->jac_b,
                           expected);
    if (mismatch != NULL) return mismatch;
    CHECK("a row's m_appliedImpulse", row->applied_impulse == 0.0);
    CHECK("a row's m_jacDiagABInv", row->jac_diag_inv >= 0.0);
    CHECK("a row's m_lowerLimit", row->lower_limit <= 0.0 && row->upper_limit >= 0.0);
    return NULL;
}

static int is_unit(const struct vector3 *a) {
    return fabs(a->x * a->x + a->y * a->y + a->z * a->z - 1.0) < 1e-9;
}

static int is_same(const struct vector3 *a, const struct vector3 *b) {
    return a->x == b->x && a->y == b->y && a->z == b->z;
}

/* A contact, and the first of its two rows of friction. */
static const char *probe_point(const struct contact_point *point,
                               const struct constraint_row *friction,
                               const struct expectation *expected) {
    CHECK("a row's m_originalContactPoint", point != NULL);
    CHECK("btManifoldPoint.m_combinedFriction", point->friction == expected->friction);
    CHECK("btManifoldPoint.m_combinedRestitution",
          point->restitution == expected->restitution);
    CHECK("btManifoldPoint.m_combinedRollingFriction", point->rolling_friction == 0.0);
    CHECK("btManifoldPoint.m_combinedSpinningFriction", point->spinning_friction > 0.0);
    CHECK("btManifoldPoint.m_contactPointFlags", point->flags == 0);
    CHECK("btManifoldPoint.m_distance1", fabs(point->distance) < 0.1);
    CHECK("btManifoldPoint.m_normalWorldOnB", is_unit(&point->normal_b));
    const struct vector3 *a = &point->position_a, *b = &point->position_b;
    const struct vector3 *normal = &point->normal_b;
    const double gap = (a->x - b->x) * normal->x + (a->y - b->y) * normal->y +
                       (a->z - b->z) * normal->z;
    CHECK("btManifoldPoint.m_positionWorldOnA", fabs(gap - point->distance) < 1e-9);
    CHECK("btManifoldPoint.m_lateralFrictionDir1",
          is_same(&friction[0].contact_normal1, &point->lateral_1));
    CHECK("btManifoldPoint.m_lateralFrictionDir2",
          is_same(&friction[1].contact_normal1, &point->lateral_2));
    return NULL;
}

/* A body without joints. */
static const char *probe_base(const struct multi_body *body,
                              const struct expectation *expected) {
    if (body->num_dofs != 0) return NULL;
    CHECK("btMultiBody.m_links", is_array(&body->links) && body->links.size == 0);
    CHECK("btMultiBody.m_matrixBuf",
          is_array(&body->matrix_buffer) && body->matrix_buffer.size == 1);
    CHECK("btMultiBody.m_realBuf",
          is_array(&body->real_buffer) && body->real_buffer.size >= 6);
    const double mass = body->base_mass;
    CHECK("btMultiBody.m_baseMass",
          mass == 0.0 || mass == expected->masses[0] || mass == expected->masses[1]);
    CHECK("btMultiBody.m_baseInertia",
          mass == 0.0 ||
              (body->base_inertia.x > 0.0 && body->base_inertia.x < 0.01 * mass));
    CHECK("btMultiBody.m_fixedBase", body->fixed_base == (mass == 0.0));
    const struct link_collider *collider =
        (const struct link_collider *)body->base_collider;
    CHECK("btMultiBodyLinkCollider", collider->body == body && collider->link == -1);
    CHECK("btCollisionObject.m_collisionFlags",
          !(collider->base.flags & STATIC) == (mass != 0.0));
    return NULL;
}

/* The body that has joints, before Bullet accelerates it. */
static const char *probe_forces(const struct multi_body *body,
                                const struct expectation *expected) {
    CHECK("btMultiBody.m_links",
          is_array(&body->links) && body->links.size == expected->num_links);
    CHECK("btMultiBody.m_realBuf",
          is_array(&body->real_buffer) &&
              body->real_buffer.size >= 6 + expected->num_dofs);
    const double *velocities = (const double *)body->real_buffer.data + 6;
    const struct link *link = body->links.data;
    for (int i = 0; i < expected->num_links; i++, link++) {
        const double mass = expected->link_masses[i];
        const struct vector3 *inertia = &link->inertia;
        CHECK("btMultibodyLink.m_mass", link->mass == mass);
        CHECK("btMultibodyLink.m_inertiaLocal",
              inertia->x >= 0.0 && inertia->y >= 0.0 && inertia->z >= 0.0 &&
                  inertia->x + inertia->y + inertia->z < mass);
        const struct vector3 weight = {0.0, 0.0, expected->gravity * mass, 0.0};
        const struct vector3 none = {0.0, 0.0, 0.0, 0.0};
        CHECK("btMultibodyLink.m_appliedForce", is_same(&link->applied_force, &weight));
        CHECK("btMultibodyLink.m_appliedTorque", is_same(&link->applied_torque, &none));
        CHECK("btMultibodyLink.m_jointFeedback", link->joint_feedback == NULL);
        if (expected->joint_types[i] == FIXED) continue;
        CHECK("btMultibodyLink.m_dofOffset",
              link->dof_offset >= 0 && link->dof_offset < expected->num_dofs);
        CHECK("btMultibodyLink.m_jointTorque",
              link->joint_torque[0] ==
                  -expected->joint_damping * velocities[link->dof_offset]);
    }
    return NULL;
}

static int is_inside(const struct vector3 *a, const struct vector3 *min,
                     const struct vector3 *max) {
    return min->x <= a->x && a->x <= max->x && min->y <= a->y && a->y <= max->y &&
           min->z <= a->z && a->z <= max->z;
}

/* A leaf of the tree of AABBs, and its ancestors. */
static const char *probe_leaf(const struct proxy *proxy, const struct aabb_tree *tree) {
    const struct node *node = proxy->leaf;
    CHECK("btDbvtProxy.leaf", node != NULL && (uintptr_t)node % 16 == 0);
    CHECK("btDbvtNode.data", node->proxy == proxy && node->children[1] == NULL);
    const struct vector3 *min = &node->aabb.min, *max = &node->aabb.max;
    CHECK("btDbvtNode.volume", is_inside(&proxy->aabb.min, min, max) &&
                                   is_inside(&proxy->aabb.max, min, max));
    for (int depth = 0; node->parent != NULL; depth++) {
        const struct node *parent = node->parent;
        CHECK("btDbvtNode.parent", depth < MAX_OBJECTS && (uintptr_t)parent % 16 == 0);
        CHECK("btDbvtNode.childs",
              parent->children[0] == node || parent->children[1] == node);
        min = &parent->aabb.min, max = &parent->aabb.max;
        CHECK("btDbvtNode.volume", is_inside(&node->aabb.min, min, max) &&
                                       is_inside(&node->aabb.max, min, max));
        node = parent;
    }
    CHECK("btDbvt.m_root", tree->root == node);
    return NULL;
}

static const char *probe_broad_phase(const struct world *world,
                                     const struct expectation *expected) {
    CHECK("btCollisionWorld.m_collisionObjects",
          world->objects.size >= expected->num_bodies &&
              world->objects.size <= MAX_OBJECTS &&
              world->objects.capacity == 128 * 1024 && world->objects.data != NULL);
    const struct broad_phase *broad_phase = world->broad_phase;
    CHECK("btCollisionWorld.m_broadphasePairCache",
          broad_phase != NULL && (uintptr_t)broad_phase % 16 == 0);
    const struct aabb_tree *trees = broad_phase->trees;
    CHECK("btDbvt.m_leaves", trees[0].num_leaves > 0 && trees[1].num_leaves >= 0 &&
                                 trees[0].num_leaves + trees[1].num_leaves ==
                                     world->objects.size);
    CHECK("btDbvt.m_lkhd", trees[0].lookahead == -1);
    CHECK("btDbvtBroadphase.m_prediction", broad_phase->prediction == 0.0);
    CHECK("btDbvtBroadphase.m_stageCurrent",
          broad_phase->stage >= 0 && broad_phase->stage < FIXED_STAGE);
    CHECK("btDbvtBroadphase.m_newpairs", broad_phase->num_new_pairs == 1);
    CHECK("btDbvtBroadphase.m_updates_call",
          broad_phase->num_updates > 0 &&
              broad_phase->num_updates <= broad_phase->num_calls);
    CHECK("btDbvtBroadphase.m_deferedcollide", broad_phase->defers_collisions == 0);
    CHECK("btDbvtBroadphase.m_needcleanup", broad_phase->needs_cleanup == 0);
    struct collision_object *const *objects = world->objects.data;
    for (int i = 0; i < world->objects.size; i++) {
        const struct collision_object *object = objects[i];
        CHECK("btCollisionWorld.m_collisionObjects",
              object != NULL && (uintptr_t)object % 16 == 0);
        CHECK("btCollisionObject.m_worldArrayIndex", object->world_index == i);
        const struct proxy *proxy = object->proxy;
        CHECK("btCollisionObject.m_broadphaseHandle", proxy != NULL);
        CHECK("btBroadphaseProxy.m_clientObject", proxy->object == object);
        CHECK("btDbvtProxy.stage", proxy->stage >= 0 && proxy->stage <= FIXED_STAGE);
        CHECK("btDbvtProxy.links",
              proxy->previous == NULL ? broad_phase->stages[proxy->stage] == proxy
                                      : proxy->previous->next == proxy);
        const char *mismatch =
            probe_leaf(proxy, &trees[proxy->stage == FIXED_STAGE ? 1 : 0]);
        if (mismatch != NULL) return mismatch;
    }
    const struct multi_body *table = ((struct multi_body *const *)world->bodies.data)[1];
    const struct aabb *aabb = &table->base_collider->proxy->aabb;
    CHECK("btBroadphaseProxy.m_aabbMax",
          fabs(aabb->max.x - aabb->min.x - 2.0 * (expected->table_size + 0.02)) < 1e-9);
    const struct pair_cache *cache = broad_phase->pair_cache;
    CHECK("btDbvtBroadphase.m_paircache", cache != NULL && (uintptr_t)cache % 16 == 0);
    CHECK("btHashedOverlappingPairCache.m_overlappingPairArray",
          is_array(&cache->pairs) && cache->pairs.size > 0);
    const struct overlapping_pair *pair = cache->pairs.data;
    for (int i = 0; i < cache->pairs.size; i++, pair++) {
        const struct proxy *const proxies[] = {pair->a, pair->b};
        for (int k = 0; k < 2; k++) {
            int index = 0;
            while (index < world->objects.size && objects[index]->proxy != proxies[k])
                index++;
            CHECK("btBroadphasePair.m_pProxy0", index < world->objects.size);
        }
    }
    return NULL;
}

const char *probe_world(const struct world *world, const struct solver_info *info,
                        const struct expectation *expected) {
    CHECK("m_timeStep", info->time_step == expected->time_step);
    CHECK("btMultiBodyDynamicsWorld.m_multiBodies",
          is_array(&world->bodies) && world->bodies.size == expected->num_bodies);
    struct multi_body *const *bodies = world->bodies.data;
    for (int i = 0; i < world->bodies.size; i++) {
        const struct multi_body *body = bodies[i];
        CHECK("btMultiBodyDynamicsWorld.m_multiBodies",
              body != NULL && (uintptr_t)body % 16 == 0);
        CHECK("btMultiBody.m_linearDamping",
              body->linear_damping == expected->damping &&
                  body->angular_damping == expected->damping);
        CHECK("btMultiBody.m_maxCoordinateVelocity",
              body->max_velocity == expected->max_velocity);
        CHECK("btMultiBody.m_useGyroTerm", body->use_gyro_term == 1);
        CHECK("btMultiBody.m_useRK4", body->use_rk4 == 0);
        CHECK("btMultiBody.m_useGlobalVelocities", body->use_global_velocities == 0);
        CHECK("btMultiBody.m_internalNeedsJointFeedback",
              body->needs_joint_feedback == 0);
        CHECK("btMultiBody.m_baseCollider", body->base_collider != NULL);
        CHECK("btMultiBodyLinkCollider.m_multiBody",
              ((const struct link_collider *)body->base_collider)->body == body);
        const int state = body->base_collider->activation_state;
        CHECK("btCollisionObject.m_activationState1", state == ACTIVE);
        const char *mismatch = body->num_dofs ? probe_forces(body, expected) : NULL;
        if (mismatch != NULL) return mismatch;
    }
    return probe_broad_phase(world, expected);
}

const char *probe_manifolds(const struct solver *solver,
                            struct manifold *const *manifolds, int num_manifolds,
                            const struct solver_info *info,
                            const struct expectation *expected) {
    CHECK("m_timeStep", info->time_step == expected->time_step);
    CHECK("m_sor", info->relaxation == 1.0);
    CHECK("m_solverMode", info->mode == (4 | TWO_FRICTION_DIRECTIONS | 256));
    CHECK("m_tmpNumMultiBodyConstraints",
          solver->num_constraints >= 0 &&
              solver->num_constraints <= 2 * expected->num_dofs &&
              (solver->num_constraints == 0 || solver->constraints != NULL));
    for (int i = 0; i < num_manifolds; i++) {
        const struct manifold *manifold = manifolds[i];
        CHECK("btPersistentManifold.m_cachedPoints",
              manifold->num_points >= 0 && manifold->num_points <= 4);
        CHECK("btPersistentManifold.m_contactProcessingThreshold",
              manifold->processing_threshold > 0.0);
        const struct link_collider *const colliders[] = {manifold->body_a,
                                                         manifold->body_b};
        for (int k = 0; k < 2; k++) {
            CHECK("btPersistentManifold.m_body0", colliders[k] != NULL);
            CHECK("btCollisionObject.m_internalType",
                  colliders[k]->base.internal_type == LINK_COLLIDER);
            CHECK("btCollisionObject.m_hasAnisotropicFriction",
                  colliders[k]->base.has_anisotropic_friction == 0);
            CHECK("btMultiBodyLinkCollider.m_link",
                  colliders[k]->link >= -1 &&
                      colliders[k]->link < expected->num_links);
            CHECK("btMultiBodyLinkCollider.m_multiBody", colliders[k]->body != NULL);
            const char *mismatch = probe_base(colliders[k]->body, expected);
            if (mismatch != NULL) return mismatch;
        }
    }
    return NULL;
}

/* The body that has joints, link by link. */
static const char *probe_links(const struct multi_body *body,
                               const struct expectation *expected) {
    const int num_dofs = body->num_dofs;
    CHECK("btMultiBody.m_links",
          is_array(&body->links) && body->links.size == expected->num_links);
    CHECK("btMultiBody.m_matrixBuf", is_array(&body->matrix_buffer) &&
                                         body->matrix_buffer.size ==
                                             expected->num_links + 1);
    CHECK("btMultiBody.m_vectorBuf", is_array(&body->vector_buffer) &&
                                         body->vector_buffer.size == 2 * num_dofs);
    CHECK("btMultiBody.m_realBuf",
          is_array(&body->real_buffer) &&
              body->real_buffer.size ==
                  6 + num_dofs + num_dofs * num_dofs + 6 + num_dofs);
    CHECK("btMultiBody.m_fixedBase", body->fixed_base == 1);
    const struct link *link = body->links.data;
    int dof = 0;
    for (int i = 0; i < expected->num_links; i++, link++) {
        const int type = expected->joint_types[i];
        CHECK("btMultibodyLink.m_jointType", link->joint_type == type);
        CHECK("btMultibodyLink.m_dofCount", link->num_dofs == (type != FIXED));
        CHECK("btMultibodyLink.m_parent", link->parent == (i < 4 ? i - 1 : 2));
        CHECK("btMultibodyLink.m_dofOffset", link->dof_offset == dof);
        CHECK("btMultibodyLink.m_jointPos",
              type == FIXED || fabs(link->joint_position[0]) < 1.0);
        const struct vector3 *axis =
            type == REVOLUTE ? &link->axes[0].top : &link->axes[0].bottom;
        CHECK("btMultibodyLink.m_axes",
              type == FIXED ||
                  fabs(axis->x * axis->x + axis->y * axis->y + axis->z * axis->z -
                       1.0) < 1e-12);
        const struct vector3 *row = link->world_basis.row;
        CHECK("btMultibodyLink.m_cachedWorldTransform",
              fabs(row[0].x * row[0].x + row[0].y * row[0].y + row[0].z * row[0].z -
                   1.0) < 1e-9);
        dof += link->num_dofs;
    }
    return NULL;
}

static const char *probe_constraint(const struct constraint_row *row,
                                    const struct expectation *expected) {
    const struct constraint *constraint = row->constraint;
    CHECK("a row's m_orgConstraint", constraint != NULL);
    const int is_motor = constraint->vtable == expected->motor_table;
    CHECK("btMultiBodyConstraint", is_motor || constraint->vtable ==
                                                   expected->limit_table);
    const int size = row->multi_body_a->num_dofs + 6, num_rows = is_motor ? 1 : 2;
    CHECK("btMultiBodyConstraint.m_bodyA", constraint->body_a == row->multi_body_a &&
                                               constraint->body_b == row->multi_body_b);
    CHECK("btMultiBodyConstraint.m_linkA", constraint->link_a == row->link_a &&
                                               constraint->link_b == row->link_b);
    CHECK("btMultiBodyConstraint.m_numRows", constraint->num_rows == num_rows);
    CHECK("a row's m_orgDofIndex",
          row->constraint_row >= 0 && row->constraint_row < num_rows);
    CHECK("btMultiBodyConstraint.m_jacSizeA",
          constraint->jac_size_a == size && constraint->jac_size_both == 2 * size &&
              constraint->num_dofs_finalized == 2 * size);
    CHECK("btMultiBodyConstraint.m_posOffset",
          constraint->position_offset == (1 + 2 * size) * num_rows);
    CHECK("btMultiBodyConstraint.m_data",
          is_array(&constraint->data) &&
              constraint->data.size == (2 + 2 * size) * num_rows);
    CHECK("btMultiBodyConstraint.m_maxAppliedImpulse",
          constraint->max_impulse == row->upper_limit);
    if (is_motor) {
        const struct motor *motor = (const struct motor *)constraint;
        CHECK("limits of motors", row->upper_limit == expected->motor_impulse);
        CHECK("btMultiBodyJointMotor.m_kp", motor->kp == expected->kp);
        CHECK("btMultiBodyJointMotor.m_kd", motor->kd == expected->kd);
        CHECK("btMultiBodyJointMotor.m_desiredVelocity", motor->desired_velocity == 0.0);
    } else {
        const struct limit *limit = (const struct limit *)constraint;
        const struct link *link =
            (const struct link *)row->multi_body_a->links.data + row->link_a;
        CHECK("btMultiBodyJointLimitConstraint",
              link->joint_position[0] <= limit->lower ||
                  link->joint_position[0] >= limit->upper);
    }
    return NULL;
}

const char *probe_rows(const struct solver *solver, const struct solver_info *info,
                       const struct expectation *expected) {
    CHECK("m_timeStep", info->time_step == expected->time_step);
    CHECK("m_numIterations", info->num_iterations == expected->num_iterations);
    CHECK("m_leastSquaresResidualThreshold",
          info->residual_threshold == expected->residual_threshold);
    CHECK("m_numNonContactInnerIterations", info->num_inner_iterations == 1);
    const struct array *const empty[] = {&solver->contact_rows, &solver->joint_rows,
                                         &solver->friction_rows,
                                         &solver->rolling_rows};
    for (int i = 0; i < 4; i++)
        CHECK("rows of rigid bodies", is_array(empty[i]) && empty[i]->size == 0);
    CHECK("m_maxOverrideNumSolverIterations", solver->max_override_iterations == 0);
    const struct array *const arrays[] = {
        &solver->multi_body_joint_rows,    &solver->multi_body_normal_rows,
        &solver->multi_body_friction_rows, &solver->multi_body_torsional_rows,
        &solver->multi_body_spinning_rows, &solver->data.jacobians,
        &solver->data.unit_impulses,       &solver->data.delta_velocities,
        &solver->data.scratch_r,           &solver->data.scratch_v,
        &solver->data.scratch_m};
    for (int i = 0; i < 11; i++) CHECK("rows of bodies", is_array(arrays[i]));
    CHECK("m_deltaVelocitiesUnitImpulse",
          solver->data.unit_impulses.size == solver->data.jacobians.size);
    const int num_joint_rows = solver->multi_body_joint_rows.size;
    const int num_contacts = solver->multi_body_normal_rows.size;
    CHECK("number of rows of motors and limits",
          num_joint_rows == 0 || (num_joint_rows >= expected->num_dofs &&
                                  num_joint_rows <= 2 * expected->num_dofs));
    CHECK("number of rows of friction",
          solver->multi_body_friction_rows.size == 2 * num_contacts);

    const struct constraint_row *row = solver->multi_body_joint_rows.data;
    int num_motors = 0;
    for (int i = 0; i < num_joint_rows; i++, row++) {
        const char *mismatch = probe_row(solver, row, expected);
        if (mismatch != NULL) return mismatch;
        CHECK("a joint's bodies", row->multi_body_a == row->multi_body_b &&
                                      row->multi_body_a->num_dofs > 0);
        if (i == 0) mismatch = probe_links(row->multi_body_a, expected);
        if (mismatch == NULL) mismatch = probe_constraint(row, expected);
        if (mismatch != NULL) return mismatch;
        num_motors += row->constraint->vtable == expected->motor_table;
    }
    CHECK("number of motors", num_joint_rows == 0 || num_motors == expected->num_dofs);

    row = solver->multi_body_normal_rows.data;
    for (int i = 0; i < num_contacts; i++, row++) {
        const char *mismatch = probe_row(solver, row, expected);
        if (mismatch != NULL) return mismatch;
        CHECK("a contact's m_friction", row->friction == expected->friction);
        CHECK("a contact's m_upperLimit", row->upper_limit == 1e10f);
        CHECK("a contact's m_frictionIndex", row->friction_index == 2 * i);
        mismatch = probe_point(row->contact_point,
                            (const struct constraint_row *)
                                    solver->multi_body_friction_rows.data +
                                2 * i,
                            expected);
        if (mismatch != NULL) return mismatch;
    }
    row = solver->multi_body_friction_rows.data;
    for (int i = 0; i < 2 * num_contacts; i++, row++) {
        const char *mismatch = probe_row(solver, row, expected);
        if (mismatch != NULL) return mismatch;
        CHECK("a friction row's m_friction", row->friction == expected->friction);
        CHECK("a friction row's m_frictionIndex", row->friction_index == i / 2);
    }
    return NULL;
}

const char *probe_result(const struct solver *solver,
                         struct collision_object *const *bodies, int num_bodies,
                         int num_manifolds, const struct solver_info *info) {
    CHECK("m_analyticsData.m_numBodies", solver->analytics.num_bodies == num_bodies);
    CHECK("m_analyticsData.m_numContactManifolds",
          solver->analytics.num_manifolds == num_manifolds);
    CHECK("m_analyticsData.m_numSolverCalls", solver->analytics.num_calls > 0);
    CHECK("m_analyticsData.m_numIterationsUsed",
          solver->analytics.num_iterations >= 1 &&
              solver->analytics.num_iterations <= info->num_iterations);
    CHECK("m_leastSquaresResidual", solver->analytics.residual == solver->residual);
    CHECK("btCollisionObject.m_companionId",
          solver->analytics.island ==
              (num_bodies > 0 ? bodies[0]->companion_id : -2));
    return NULL;
}

static const char *probe_tree(const struct tree *tree, const struct multi_body *body,
                              const struct expectation *expected) {
    const int num_links = expected->num_links + 1;
    CHECK("MultiBodyTree", tree != NULL && tree->is_finalized == 1);
    const struct tree_data *data = tree->data;
    CHECK("MultiBodyTree.m_impl", data != NULL && (uintptr_t)data % 16 == 0);
    CHECK("MultiBodyImpl.m_num_dofs",
          data->num_links == num_links && data->num_dofs == expected->num_dofs);
    CHECK("MultiBodyImpl.m_body_list",
          is_array(&data->links) && data->links.size == num_links);
    CHECK("MultiBodyImpl.m_parent_index",
          is_array(&data->parents) && data->parents.size == num_links);
    const struct tree_link *own = data->links.data;
    const int *parents = data->parents.data;
    CHECK("RigidBody.m_joint_type", own->joint_type == TREE_FIXED);
    const struct link *link = body->links.data;
    for (int i = 1, dof = 0; i < num_links; i++, link++) {
        own++;
        const int type = expected->joint_types[i - 1];
        CHECK("RigidBody.m_mass", own->mass == expected->link_masses[i - 1]);
        CHECK("RigidBody.m_joint_type", own->joint_type == tree_joint_type(type));
        CHECK("MultiBodyImpl.m_parent_index", parents[i] == link->parent + 1);
        CHECK("RigidBody.m_q_index", own->dof == (type == FIXED ? -1 : dof));
        CHECK("RigidBody.m_body_T_parent_ref",
              is_unit(&own->rotation.row[0]) && is_unit(&own->rotation.row[2]));
        CHECK("RigidBody.m_parent_pos_parent_body_ref",
              fabs(own->position.x) + fabs(own->position.y) < 1.0);
        const struct vector3 none = {0.0, 0.0, 0.0, 0.0};
        if (type == REVOLUTE)
            CHECK("RigidBody.m_Jac_JR", is_same(&own->axis, &link->axes[0].top));
        if (type == PRISMATIC) {
            CHECK("RigidBody.m_Jac_JR", is_same(&own->axis, &none));
            CHECK("RigidBody.m_parent_Jac_JT", is_unit(&own->slide));
        }
        dof += type != FIXED;
    }
    return NULL;
}

const char *probe_command(const struct server *server, const struct command *command,
                          const struct status *status, const struct world *world,
                          const struct expectation *expected) {
    const double *target = expected->target;
    CHECK("SharedMemoryCommand.m_updateFlags",
          command->flags == (HAS_TARGET_POSITION | HAS_TARGET_ORIENTATION |
                             HAS_JOINT_DAMPING | HAS_MAX_ITERATIONS));
    CHECK("m_targetPositions", !memcmp(command->target_position, target, 24));
    CHECK("m_targetOrientation", !memcmp(command->target_orientation, target + 3, 32));
    CHECK("m_numEndEffectorLinkIndices", command->num_targets == 1);
    CHECK("m_endEffectorLinkIndices", command->target_links[0] >= 0 &&
                                          command->target_links[0] < expected->num_links);
    for (int i = 0; i < expected->num_dofs; i++)
        CHECK("m_jointDamping", command->damping[i] == expected->ik_damping);
    CHECK("m_maxNumIterations", command->num_iterations == expected->ik_iterations);
    CHECK("SharedMemoryStatus.m_type", status->type == INVERSE_KINEMATICS_COMPLETED);
    CHECK("SharedMemoryStatus.m_dataStream",
          status->num_stream_bytes == 0 && status->stream == NULL);
    CHECK("m_inverseKinematicsResultArgs", status->body == command->body &&
                                               status->num_dofs == expected->num_dofs);

    const struct server_data *data = server->data;
    CHECK("PhysicsServerCommandProcessor.m_data",
          data != NULL && (uintptr_t)data % 8 == 0);
    CHECK("m_commandLogger", data->logger == NULL);
    CHECK("m_bodyHandles", is_array(&data->body_handles) && command->body >= 0 &&
                               command->body < data->body_handles.size);
    const struct body_handle *handle =
        (const struct body_handle *)data->body_handles.data + command->body;
    CHECK("b3PoolBodyHandle.m_nextFreeHandle", handle->next_free == USED);
    const struct multi_body *body = NULL;
    for (int i = 0; world != NULL && i < world->bodies.size; i++)
        if (((struct multi_body *const *)world->bodies.data)[i] == handle->body)
            body = handle->body;
    CHECK("InternalBodyData.m_multiBody",
          body != NULL && body->num_dofs == expected->num_dofs);
    CHECK("m_inverseDynamicsBodies",
          is_array(&data->trees) && data->trees.size == 1 &&
              is_array(&data->tree_bodies) && data->tree_bodies.size == 1 &&
              *(const struct multi_body *const *)data->tree_bodies.data == body);
    return probe_tree(*(const struct tree *const *)data->trees.data, body, expected);
}
#endif
