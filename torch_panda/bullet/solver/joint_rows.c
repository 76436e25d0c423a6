/*
 * Rows of joint motors and joint limits.
 *
 * Functions here, and their counterparts in Bullet
 * ------------------------------------------------
 * fill_row          btMultiBodyConstraint::fillMultiBodyConstraint, for a Jacobian with
 *                   one entry.
 * create_motor_rows btMultiBodyJointMotor::createConstraintRows
 * create_limit_rows btMultiBodyJointLimitConstraint::createConstraintRows
 * world_axis        quatRotate(btMatrix3x3::getRotation, axis)
 *
 * Why the results are the same bits
 * ---------------------------------
 * A row has two bodies, A and B. In the row of a joint, both are the body of the joint.
 * For A, Bullet computes the response to a unit impulse at the joint. For B, it computes
 * the response to no impulse, which is zero. Here, responses.c computes the responses to
 * unit impulses at all joints once per group. This is the same, because nothing that the
 * responses depend on changes while rows are created.
 *
 * In the row of an upper limit, the unit impulse is negative and acts on body B. The
 * response to it is the negative of the response to a positive unit impulse, because
 * every operation rounds a number and its negative alike.
 *
 * The other numbers of a row are computed as Bullet computes them, except that sums
 * leave out the zeros of the Jacobian. This changes no bit while all numbers are finite.
 *
 * If an array has no room for another row, Bullet's function creates the row and makes
 * room. Code here never allocates or frees Bullet's memory.
 */
#if defined(__x86_64__) && defined(__linux__)
#include "rows.h"
#include "solver.h"
#include "vectors.h"

/* Whether a constraint belongs to a joint with one degree of freedom, and has the sizes
   that this file assumes. */
static int is_simple_joint(const struct constraint *constraint, int num_rows) {
    const struct multi_body *body = constraint->body_a;
    if (body == NULL || body != constraint->body_b ||
        constraint->num_rows != num_rows || constraint->link_a < 0 ||
        constraint->link_a >= body->links.size)
        return 0;
    const struct link *link = (const struct link *)body->links.data + constraint->link_a;
    const int size = body->num_dofs + 6;
    return constraint->num_dofs_finalized == constraint->jac_size_both &&
           constraint->jac_size_a == size && constraint->jac_size_both == 2 * size &&
           constraint->position_offset == (1 + 2 * size) * num_rows &&
           constraint->data.size == (2 + 2 * size) * num_rows && link->num_dofs == 1 &&
           (link->joint_type == REVOLUTE || link->joint_type == PRISMATIC);
}

static int has_room_for(const struct array *rows, const struct jacobian_data *data,
                        const struct multi_body *body, int num_rows) {
    const int size = body->num_dofs + 6;
    return data->jacobians.size == data->unit_impulses.size &&
           has_room(rows, num_rows) && has_room(&data->jacobians, 2 * size * num_rows) &&
           has_room(&data->unit_impulses, 2 * size * num_rows) &&
           (body->companion_id >= 0 || has_room(&data->delta_velocities, size));
}

/*
 * Appends a row whose Jacobian has a single nonzero entry, `sign`, at a joint.
 *
 * The entry is in the part of body A if it is positive, and in that of B otherwise.
 * Returns the joint's velocity in the direction of the row.
 */
static double fill_row(struct constraint_row *row, struct jacobian_data *data,
                       const struct constraint *constraint, const double *columns,
                       double sign, double lower, double upper, double desired_velocity,
                       const struct solver_info *info) {
    struct multi_body *body = constraint->body_a;
    const int num_dofs = body->num_dofs, size = num_dofs + 6;
    const int dof = ((const struct link *)body->links.data)[constraint->link_a].dof_offset;
    row->multi_body_a = row->multi_body_b = body;
    row->link_a = constraint->link_a;
    row->link_b = constraint->link_b;
    row->delta_vel_a = row->delta_vel_b = velocity_index(body, data);
    row->jac_a = data->jacobians.size;
    row->jac_b = row->jac_a + size;
    const int part = sign > 0.0 ? 0 : size;
    append(&data->jacobians, 2 * size)[part + 6 + dof] = sign;
    double *unit = append(&data->unit_impulses, 2 * size) + part + 6;
    const double *column = columns + dof * num_dofs;
    for (int i = 0; i < num_dofs; i++) unit[i] = sign * column[i];
    const double d = sign * unit[dof];
    row->jac_diag_inv = d > EPSILON ? 1.0 / d : 0.0;

    const double velocity = 0.0 + ((const double *)body->real_buffer.data)[6 + dof] * sign;
    row->friction = 0.0;
    row->applied_impulse = 0.0;
    row->applied_push_impulse = 0.0;
    const double position_impulse = -0.0 * info->erp / info->time_step * row->jac_diag_inv;
    row->rhs = position_impulse + (desired_velocity - velocity) * row->jac_diag_inv;
    row->rhs_penetration = 0.0;
    row->cfm = 0.0;
    row->lower_limit = lower;
    row->upper_limit = upper;
    return velocity;
}

static struct vector3 world_axis(const struct link *link, const struct vector3 *axis) {
    const struct vector3 q = get_rotation(&link->world_basis);
    /* operator*(btQuaternion, btVector3) */
    const double x = q.w * axis->x + q.y * axis->z - q.z * axis->y;
    const double y = q.w * axis->y + q.z * axis->x - q.x * axis->z;
    const double z = q.w * axis->z + q.x * axis->y - q.y * axis->x;
    const double w = -q.x * axis->x - q.y * axis->y - q.z * axis->z;
    /* btQuaternion::operator*=, with the inverse */
    const double ix = -q.x, iy = -q.y, iz = -q.z, iw = q.w;
    return (struct vector3){w * ix + x * iw + y * iz - z * iy,
                            w * iy + y * iw + z * ix - x * iz,
                            w * iz + z * iw + x * iy - y * ix, 0.0};
}

static void set_axis(struct constraint_row *row, const struct constraint *constraint,
                     double direction) {
    const struct link *link =
        (const struct link *)constraint->body_a->links.data + constraint->link_a;
    const struct vector3 zero = {0.0, 0.0, 0.0, 0.0};
    const int is_revolute = link->joint_type == REVOLUTE;
    struct vector3 axis = world_axis(
        link, is_revolute ? &link->axes[0].top : &link->axes[0].bottom);
    axis = (struct vector3){axis.x * direction, axis.y * direction, axis.z * direction,
                            0.0};
    const struct vector3 opposite = {-axis.x, -axis.y, -axis.z, 0.0};
    row->contact_normal1 = is_revolute ? zero : axis;
    row->contact_normal2 = is_revolute ? zero : opposite;
    row->relpos1_cross_normal = is_revolute ? axis : zero;
    row->relpos2_cross_normal = is_revolute ? opposite : zero;
}

int create_motor_rows(struct responses **responses, struct motor *motor,
                      struct array *rows, struct jacobian_data *data,
                      const struct solver_info *info) {
    const struct constraint *base = &motor->base;
    if (!is_simple_joint(base, 1)) return 0;
    const struct multi_body *body = base->body_a;
    if (base->max_impulse == 0.0) return 1;
    if (!has_room_for(rows, data, body, 1)) return 0;
    const struct responses *known = get_responses(responses, body);
    if (known == NULL) return 0;

    const struct link *link = (const struct link *)body->links.data + base->link_a;
    const double position = link->joint_position[0];
    const double velocity = ((const double *)body->real_buffer.data)[6 + link->dof_offset];
    const double position_term =
        motor->erp * (motor->desired_position - position) / info->time_step;
    double target = motor->kp * position_term + velocity +
                    motor->kd * (motor->desired_velocity - velocity);
    if (target > motor->rhs_clamp) target = motor->rhs_clamp;
    if (target < -motor->rhs_clamp) target = -motor->rhs_clamp;

    struct constraint_row *row = expand(rows);
    fill_row(row, data, base, known->columns, 1.0, -base->max_impulse, base->max_impulse,
             target, info);
    row->constraint = &motor->base;
    row->constraint_row = 0;
    set_axis(row, base, 1.0);
    return 1;
}

int create_limit_rows(struct responses **responses, struct limit *limit,
                      struct array *rows, struct jacobian_data *data,
                      const struct solver_info *info) {
    const struct constraint *base = &limit->base;
    if (!is_simple_joint(base, 2)) return 0;
    const struct multi_body *body = base->body_a;
    const struct link *link = (const struct link *)body->links.data + base->link_a;
    const double position = link->joint_position[0];
    const double penetrations[2] = {position - limit->lower, limit->upper - position};
    double *positions = (double *)base->data.data + base->position_offset;
    const struct responses *known = NULL;
    if (!(penetrations[0] > 0.0) || !(penetrations[1] > 0.0)) {
        if (!has_room_for(rows, data, body, 2)) return 0;
        known = get_responses(responses, body);
        if (known == NULL) return 0;
    }
    for (int i = 0; i < 2; i++) {
        const double penetration = penetrations[i];
        positions[i] = penetration;
        if (penetration > 0.0) continue;
        const double direction = i ? -1.0 : 1.0;
        struct constraint_row *row = expand(rows);
        row->constraint = &limit->base;
        row->constraint_row = i;
        const double velocity = fill_row(row, data, base, known->columns, direction, 0.0,
                                         base->max_impulse, 0.0, info);
        set_axis(row, base, direction);
        const int is_combined =
            !info->split_impulse || penetration > info->split_impulse_threshold;
        const double erp = is_combined ? info->erp : info->erp2;
        const double position_impulse =
            -penetration * erp / info->time_step * row->jac_diag_inv;
        const double velocity_impulse = -velocity * row->jac_diag_inv;
        row->rhs = is_combined ? position_impulse + velocity_impulse : velocity_impulse;
        row->rhs_penetration = is_combined ? 0.0 : position_impulse;
    }
    return 1;
}
#endif
