/*
 * The layout probe: are Bullet's structs laid out as bullet_types.h says?
 *
 * It looks at a scene whose numbers are known, while Bullet itself solves it. It goes
 * from what is sure to what depends on it: numbers of the settings first, sizes of
 * arrays next, and what pointers point to last.
 */
#if defined(__x86_64__) && defined(__linux__)
#include "solver.h"

#include <stdint.h>

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
    const char *wrong = probe_body(solver, row->multi_body_a, row->delta_vel_a,
                                   row->jac_a, expected);
    if (wrong == NULL)
        wrong = probe_body(solver, row->multi_body_b, row->delta_vel_b, row->jac_b,
                           expected);
    if (wrong != NULL) return wrong;
    CHECK("a row's m_appliedImpulse", row->applied_impulse == 0.0);
    CHECK("a row's m_jacDiagABInv", row->jac_diag_inv >= 0.0);
    CHECK("a row's m_lowerLimit", row->lower_limit <= 0.0 && row->upper_limit >= 0.0);
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
        const char *wrong = probe_row(solver, row, expected);
        if (wrong != NULL) return wrong;
        CHECK("a joint's bodies", row->multi_body_a == row->multi_body_b &&
                                      row->multi_body_a->num_dofs > 0);
        num_motors += row->upper_limit == expected->motor_impulse &&
                      row->lower_limit == -expected->motor_impulse;
    }
    CHECK("limits of motors", num_joint_rows == 0 || num_motors == expected->num_dofs);

    row = solver->multi_body_normal_rows.data;
    for (int i = 0; i < num_contacts; i++, row++) {
        const char *wrong = probe_row(solver, row, expected);
        if (wrong != NULL) return wrong;
        CHECK("a contact's m_friction", row->friction == expected->friction);
        CHECK("a contact's m_upperLimit", row->upper_limit == 1e10f);
        CHECK("a contact's m_frictionIndex", row->friction_index == 2 * i);
    }
    row = solver->multi_body_friction_rows.data;
    for (int i = 0; i < 2 * num_contacts; i++, row++) {
        const char *wrong = probe_row(solver, row, expected);
        if (wrong != NULL) return wrong;
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
#endif
