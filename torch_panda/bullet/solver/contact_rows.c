/*
 * Rows of contacts between bodies without joints: boxes, the table, the ground.
 *
 * Which part of Bullet each function stands for
 * ---------------------------------------------
 * convert_manifold  btMultiBodyConstraintSolver::convertMultiBodyContact
 * fill_contact_row  btMultiBodyConstraintSolver::setupMultiBodyContactConstraint, and
 *                   addMultiBodyFrictionConstraint for friction
 * fill_spinning_row btMultiBodyConstraintSolver::
 *                   setupMultiBodyTorsionalFrictionConstraint
 * add_body          btMultiBody::fillConstraintJacobianMultiDof
 * respond           btMultiBody::calcAccelerationDeltasMultiDof
 * set_directions    btPlaneSpace1 and btVector3::normalize
 *
 * Why the results are the same bits
 * ---------------------------------
 * Bullet's functions serve bodies with any number of links. For a body without links
 * nearly all of their work is to prepare loops that end at once. Here are the
 * operations that remain, in Bullet's order. None is left out. Manifolds of other
 * bodies, and of contacts with settings of their own, are Bullet's.
 */
#if defined(__x86_64__) && defined(__linux__)
#include "rows.h"
#include "solver.h"

#include <math.h>

static inline double dot(const struct vector3 *a, const struct vector3 *b) {
    return a->x * b->x + a->y * b->y + a->z * b->z;
}

static inline struct vector3 cross(const struct vector3 *a, const struct vector3 *b) {
    return (struct vector3){a->y * b->z - a->z * b->y, a->z * b->x - a->x * b->z,
                            a->x * b->y - a->y * b->x, 0.0};
}

static inline struct vector3 minus(const struct vector3 *a, const struct vector3 *b) {
    return (struct vector3){a->x - b->x, a->y - b->y, a->z - b->z, 0.0};
}

static inline struct vector3 negative(const struct vector3 *a) {
    return (struct vector3){-a->x, -a->y, -a->z, 0.0};
}

static inline struct vector3 rotate(const struct matrix3 *m, const struct vector3 *a) {
    return (struct vector3){dot(&m->row[0], a), dot(&m->row[1], a), dot(&m->row[2], a),
                            0.0};
}

static inline struct vector3 rotate_back(const struct matrix3 *m,
                                         const struct vector3 *a) {
    const struct vector3 *r = m->row;
    return (struct vector3){r[0].x * a->x + r[1].x * a->y + r[2].x * a->z,
                            r[0].y * a->x + r[1].y * a->y + r[2].y * a->z,
                            r[0].z * a->x + r[1].z * a->y + r[2].z * a->z, 0.0};
}

static void set_directions(const struct vector3 *n, struct vector3 *p,
                           struct vector3 *q) {
    if (fabs(n->z) > 0.7071067811865475244008443621048490) { /* SIMDSQRT12 */
        const double a = n->y * n->y + n->z * n->z, k = 1.0 / sqrt(a);
        p->x = 0.0;
        p->y = -n->z * k;
        p->z = n->y * k;
        q->x = a * k;
        q->y = -n->x * p->z;
        q->z = n->x * p->y;
    } else {
        const double a = n->x * n->x + n->y * n->y, k = 1.0 / sqrt(a);
        p->x = -n->y * k;
        p->y = n->x * k;
        p->z = 0.0;
        q->x = -n->z * p->y;
        q->y = n->z * p->x;
        q->z = a * k;
    }
    struct vector3 *const both[] = {p, q};
    for (int i = 0; i < 2; i++) {
        struct vector3 *direction = both[i];
        const double scale = 1.0 / sqrt(dot(direction, direction));
        direction->x *= scale;
        direction->y *= scale;
        direction->z *= scale;
    }
}

static int is_static(const struct multi_body *body) {
    return body->fixed_base || (body->base_collider != NULL &&
                                body->base_collider->flags & (STATIC | KINEMATIC));
}

/* What a unit impulse along a Jacobian does to the velocities of a body. */
static void respond(const struct multi_body *body, const double *jacobian,
                    double *unit) {
    const struct matrix3 *rotation = body->matrix_buffer.data;
    struct vector3 angular = {0.0, 0.0, 0.0, 0.0}, linear = {0.0, 0.0, 0.0, 0.0};
    if (!is_static(body)) {
        const struct vector3 torque = {-jacobian[0], -jacobian[1], -jacobian[2], 0.0};
        const struct vector3 force = {-jacobian[3], -jacobian[4], -jacobian[5], 0.0};
        const struct vector3 local_force = rotate(rotation, &force);
        const struct vector3 local_torque = rotate(rotation, &torque);
        const struct vector3 *inertia = &body->base_inertia;
        if (inertia->x >= EPSILON && inertia->y >= EPSILON && inertia->z >= EPSILON)
            angular = (struct vector3){local_torque.x / inertia->x,
                                       local_torque.y / inertia->y,
                                       local_torque.z / inertia->z, 0.0};
        if (body->base_mass >= EPSILON) {
            const double scale = 1.0 / body->base_mass;
            linear = (struct vector3){local_force.x * scale, local_force.y * scale,
                                      local_force.z * scale, 0.0};
        }
        angular = negative(&angular);
        linear = negative(&linear);
    }
    const struct vector3 world_angular = rotate_back(rotation, &angular);
    const struct vector3 world_linear = rotate_back(rotation, &linear);
    unit[0] = world_angular.x;
    unit[1] = world_angular.y;
    unit[2] = world_angular.z;
    unit[3] = world_linear.x;
    unit[4] = world_linear.y;
    unit[5] = world_linear.z;
}

/* Appends a body's part of a row; returns Jacobian times response. */
static double add_body(struct jacobian_data *data, struct multi_body *body,
                       const struct vector3 *arm, const struct vector3 *angular,
                       const struct vector3 *linear, int *velocities, int *jac) {
    *velocities = velocity_index(body, data);
    *jac = data->jacobians.size;
    double *jacobian = append(&data->jacobians, 6);
    double *unit = append(&data->unit_impulses, 6);
    const struct vector3 turn = cross(arm, linear);
    jacobian[0] = turn.x + angular->x;
    jacobian[1] = turn.y + angular->y;
    jacobian[2] = turn.z + angular->z;
    jacobian[3] = linear->x;
    jacobian[4] = linear->y;
    jacobian[5] = linear->z;
    respond(body, jacobian, unit);
    double sum = 0.0;
    for (int i = 0; i < 6; i++) sum += jacobian[i] * unit[i];
    return sum;
}

/* Sets everything of a row that contacts and friction have in common. */
static double begin_row(struct solver *solver, struct constraint_row *row,
                        const struct manifold *manifold, struct contact_point *point,
                        const struct vector3 *angular_a, const struct vector3 *linear_a,
                        const struct vector3 *angular_b, const struct vector3 *linear_b,
                        double cfm, const struct solver_info *info) {
    struct multi_body *a = manifold->body_a->body, *b = manifold->body_b->body;
    row->constraint = NULL;
    row->constraint_row = -1;
    row->solver_body_a = row->solver_body_b = -1;
    row->multi_body_a = a;
    row->multi_body_b = b;
    row->link_a = row->link_b = -1;
    row->contact_point = point;
    const struct vector3 arm_a = minus(&point->position_a, &a->base_position);
    const struct vector3 arm_b = minus(&point->position_b, &b->base_position);
    struct jacobian_data *data = &solver->data;
    const double denominator_a =
        add_body(data, a, &arm_a, angular_a, linear_a, &row->delta_vel_a, &row->jac_a);
    const double denominator_b =
        add_body(data, b, &arm_b, angular_b, linear_b, &row->delta_vel_b, &row->jac_b);
    const double d = denominator_a + denominator_b + cfm;
    row->jac_diag_inv = d > EPSILON ? info->relaxation / d : 0.0;
    row->applied_impulse = 0.0;
    row->applied_push_impulse = 0.0;
    row->rhs_penetration = 0.0;
    const double *jacobians = data->jacobians.data;
    const double *velocity_a = a->real_buffer.data, *velocity_b = b->real_buffer.data;
    double velocity = 0.0;
    for (int i = 0; i < 6; i++) velocity += velocity_a[i] * jacobians[row->jac_a + i];
    for (int i = 0; i < 6; i++) velocity += velocity_b[i] * jacobians[row->jac_b + i];
    return velocity;
}

static const struct vector3 ZERO = {0.0, 0.0, 0.0, 0.0};

static void fill_contact_row(struct solver *solver, struct constraint_row *row,
                             const struct manifold *manifold,
                             struct contact_point *point, const struct vector3 *normal,
                             int is_friction, const struct solver_info *info) {
    const double inverse_time_step = 1.0 / info->time_step;
    const double cfm =
        (is_friction ? info->friction_cfm : info->cfm) * inverse_time_step;
    const double erp = is_friction ? info->friction_erp : info->erp2;
    const struct vector3 opposite = negative(normal);
    const double velocity = begin_row(solver, row, manifold, point, &ZERO, normal, &ZERO,
                                      &opposite, cfm, info);
    /* The arms once more: torques of the row, at the bodies' centres. */
    const struct vector3 arm_a =
        minus(&point->position_a, &row->multi_body_a->base_position);
    const struct vector3 arm_b =
        minus(&point->position_b, &row->multi_body_b->base_position);
    const struct vector3 turn_b = cross(&arm_b, normal);
    row->relpos1_cross_normal = cross(&arm_a, normal);
    row->contact_normal1 = *normal;
    row->relpos2_cross_normal = negative(&turn_b);
    row->contact_normal2 = opposite;
    row->friction = point->friction;

    double velocity_error, position_error;
    if (is_friction) {
        velocity_error = 0.0 - velocity;
        position_error = -0.0 * erp / info->time_step;
        row->lower_limit = -row->friction;
        row->upper_limit = row->friction;
    } else {
        double restitution = fabs(velocity) < info->restitution_threshold
                                 ? 0.0
                                 : point->restitution * -velocity;
        if (restitution <= 0.0) restitution = 0.0;
        velocity_error = restitution - velocity;
        const double distance = point->distance + info->linear_slop;
        if (distance > 0.0) {
            position_error = 0.0;
            velocity_error -= distance / info->time_step;
        } else {
            position_error = -distance * erp / info->time_step;
        }
        row->lower_limit = 0.0;
        row->upper_limit = 1e10f;
    }
    row->rhs = position_error * row->jac_diag_inv + velocity_error * row->jac_diag_inv;
    row->cfm = cfm * row->jac_diag_inv;
}

static void fill_spinning_row(struct solver *solver, struct constraint_row *row,
                              const struct manifold *manifold,
                              struct contact_point *point,
                              const struct solver_info *info) {
    const struct vector3 *normal = &point->normal_b;
    const struct vector3 opposite = negative(normal);
    const double velocity = begin_row(solver, row, manifold, point, normal, &ZERO,
                                      &opposite, &ZERO, info->cfm, info);
    row->relpos1_cross_normal = *normal;
    row->contact_normal1 = ZERO;
    row->relpos2_cross_normal = opposite;
    row->contact_normal2 = negative(&ZERO);
    row->friction = point->spinning_friction;
    row->rhs = (0.0 - velocity) * row->jac_diag_inv;
    row->lower_limit = -row->friction;
    row->upper_limit = row->friction;
    row->cfm = info->cfm * row->jac_diag_inv;
}

/* ---- a manifold ---------------------------------------------------------------- */

static int is_simple_body(const struct link_collider *collider) {
    if (!(collider->base.internal_type & LINK_COLLIDER) ||
        collider->base.has_anisotropic_friction || collider->link != -1)
        return 0;
    const struct multi_body *body = collider->body;
    return body->links.size == 0 && body->num_dofs == 0 &&
           body->matrix_buffer.size == 1 && body->real_buffer.size >= 6 &&
           finite_zero(body->matrix_buffer.data, 12) +
                   finite_zero(body->real_buffer.data, 6) +
                   finite_zero(&body->base_position.x, 3) ==
               0.0;
}

static int is_simple_point(const struct contact_point *point) {
    return !(point->flags & ~LATERAL_FRICTION_INITIALIZED) &&
           !(point->rolling_friction > 0.0) &&
           finite_zero(&point->position_b.x, 3) + finite_zero(&point->position_a.x, 3) +
                   finite_zero(&point->normal_b.x, 3) +
                   finite_zero(&point->distance, 5) ==
               0.0;
}

int convert_manifold(struct solver *solver, struct manifold *manifold,
                     const struct solver_info *info) {
    if (info->mode & (CACHED_FRICTION_DIRECTIONS | ARTICULATED_WARMSTARTING) ||
        !is_simple_body(manifold->body_a) || !is_simple_body(manifold->body_b))
        return 0;
    const int num_points = manifold->num_points;
    const int num_directions = info->mode & TWO_FRICTION_DIRECTIONS ? 2 : 1;
    int num_normal = 0, num_spinning = 0;
    for (int i = 0; i < num_points; i++) {
        const struct contact_point *point = &manifold->points[i];
        if (!is_simple_point(point)) return 0;
        if (!(point->distance <= manifold->processing_threshold)) continue;
        num_normal++;
        num_spinning += point->spinning_friction > 0.0;
    }
    struct jacobian_data *data = &solver->data;
    const int num_friction = num_normal * num_directions;
    const int num_entries = 12 * (num_normal + num_spinning + num_friction);
    if (data->jacobians.size != data->unit_impulses.size ||
        !has_room(&solver->multi_body_normal_rows, num_normal) ||
        !has_room(&solver->multi_body_spinning_rows, num_spinning) ||
        !has_room(&solver->multi_body_friction_rows, num_friction) ||
        !has_room(&data->jacobians, num_entries) ||
        !has_room(&data->unit_impulses, num_entries) ||
        !has_room(&data->delta_velocities, 12))
        return 0;

    for (int i = 0; i < num_points; i++) {
        struct contact_point *point = &manifold->points[i];
        if (!(point->distance <= manifold->processing_threshold)) {
            point->impulse = 0.0;
            point->previous_rhs = 0.0;
            continue;
        }
        const int index = solver->multi_body_normal_rows.size;
        struct constraint_row *row = expand(&solver->multi_body_normal_rows);
        fill_contact_row(solver, row, manifold, point, &point->normal_b, 0, info);
        row->friction_index = solver->multi_body_friction_rows.size;
        set_directions(&point->normal_b, &point->lateral_1, &point->lateral_2);
        if (point->spinning_friction > 0.0) {
            row = expand(&solver->multi_body_spinning_rows);
            fill_spinning_row(solver, row, manifold, point, info);
            row->friction_index = index;
        }
        for (int k = 0; k < num_directions; k++) {
            row = expand(&solver->multi_body_friction_rows);
            fill_contact_row(solver, row, manifold, point,
                             k ? &point->lateral_2 : &point->lateral_1, 1, info);
            row->friction_index = index;
        }
        if (num_directions == 2 && info->mode & FIXED_FRICTION_DIRECTIONS)
            point->flags |= LATERAL_FRICTION_INITIALIZED;
    }
    return 1;
}
#endif
