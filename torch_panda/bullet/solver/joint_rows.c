/*
 * Rows of joint motors and joint limits, with all unit responses of a body at once.
 *
 * Which part of Bullet each function stands for
 * ---------------------------------------------
 * solve_pair, get_responses
 *                   btMultiBody::calcAccelerationDeltasMultiDof: what a unit impulse at
 *                   each joint does to all joints of the body.
 * fill_row          btMultiBodyConstraint::fillMultiBodyConstraint, for a Jacobian with
 *                   one entry.
 * create_motor_rows btMultiBodyJointMotor::createConstraintRows
 * create_limit_rows btMultiBodyJointLimitConstraint::createConstraintRows
 * world_axis        quatRotate(btMatrix3x3::getRotation, axis)
 *
 * Why the results are the same bits
 * ---------------------------------
 * A motor's row has its body twice, as A and as B. Bullet computes the response to the
 * unit impulse for A, and for B the response to no impulse, which is zero. It passes
 * over all links for each. Here, the responses to unit impulses at all joints are
 * computed in the same operations, in the same order, two impulses side by side in the
 * lanes of a register. They are computed once per group, because nothing that they
 * depend on changes while rows are created. Left out is what only adds zeros:
 *
 * 1. On the way to the base, links that carry no impulse: neither the joint of the
 *    impulse nor a link that moves it.
 * 2. On the way back, links that carry no joint and no link with a joint.
 * 3. The base, which is fixed.
 *
 * Such zeros may differ from Bullet's in their sign. This reaches no other bit: a zero
 * added to another number returns this number, and zeros in a response change no
 * velocity, as iterations.c explains. All numbers must be finite for this. If one is
 * not, or if the body is not as simple as assumed, the rows are Bullet's.
 *
 * Where an array has no room for another row, Bullet's function creates this row, and
 * makes room with it. So no memory of Bullet's is allocated or freed here.
 */
#if defined(__x86_64__) && defined(__linux__)
#include "rows.h"
#include "solver.h"

#include <math.h>
#include <stdlib.h>

typedef double pair __attribute__((vector_size(16)));

struct pair3 {
    pair x, y, z;
};

struct pair_spatial {
    struct pair3 top, bottom;
};

/* A body's responses: (num_dofs, num_dofs), a row for the impulse at each joint. */
struct responses {
    struct responses *next;
    const struct multi_body *body;
    int is_known; /* 0: Bullet computes them */
    double columns[];
};

/* ---- responses ----------------------------------------------------------------- */

static inline pair dot(const struct vector3 *a, const struct pair3 *b) {
    return a->x * b->x + a->y * b->y + a->z * b->z;
}

/* btSpatialMotionVector::dot(btSpatialForceVector), the axis first. */
static inline pair spatial_dot(const struct spatial *a, const struct pair_spatial *b) {
    return dot(&a->bottom, &b->top) + dot(&a->top, &b->bottom);
}

static inline struct pair3 cross(const struct vector3 *a, const struct pair3 *b) {
    return (struct pair3){a->y * b->z - a->z * b->y, a->z * b->x - a->x * b->z,
                          a->x * b->y - a->y * b->x};
}

static inline struct pair3 add(struct pair3 a, struct pair3 b) {
    return (struct pair3){a.x + b.x, a.y + b.y, a.z + b.z};
}

static inline struct pair3 scale(const struct vector3 *a, pair factor) {
    return (struct pair3){a->x * factor, a->y * factor, a->z * factor};
}

static inline struct pair3 rotate(const struct matrix3 *m, const struct pair3 *a) {
    return (struct pair3){dot(&m->row[0], a), dot(&m->row[1], a), dot(&m->row[2], a)};
}

static inline struct pair3 rotate_back(const struct matrix3 *m, const struct pair3 *a) {
    const struct vector3 *r = m->row;
    return (struct pair3){r[0].x * a->x + r[1].x * a->y + r[2].x * a->z,
                          r[0].y * a->x + r[1].y * a->y + r[2].y * a->z,
                          r[0].z * a->x + r[1].z * a->y + r[2].z * a->z};
}

/*
 * The responses to unit impulses at two joints, one in each lane.
 *
 * Args:
 *     body: The body.
 *     first: The first joint. The second one follows it; there need not be one.
 *     force: Scratch, a struct pair_spatial for the base and each link, zero. It is
 *         zero again in the end.
 *     acceleration: Scratch, as force.
 *     is_needed: For each link, whether it or a link that it moves has a joint.
 *     columns: Receives two rows of the responses.
 */
static void solve_pair(const struct multi_body *body, int first,
                       struct pair_spatial *force, struct pair_spatial *acceleration,
                       pair *y, const char *is_needed, char *is_active,
                       double *columns) {
    const struct link *links = body->links.data;
    const int num_links = body->links.size, num_dofs = body->num_dofs;
    const struct matrix3 *rotations = (const struct matrix3 *)body->matrix_buffer.data + 1;
    const struct spatial *h = body->vector_buffer.data;
    const double *inverse_d = (const double *)body->real_buffer.data + 6 + num_dofs;
    memset(y, 0, num_dofs * sizeof(pair));
    memset(is_active, 0, num_links + 1);

    for (int i = num_links - 1; i >= 0; i--) {
        const struct link *link = &links[i];
        const int dof = link->dof_offset;
        const int has_impulse =
            link->num_dofs && (dof == first || dof == first + 1);
        if (!has_impulse && !is_active[i + 1]) continue;
        struct pair_spatial total = force[i + 1];
        if (link->num_dofs) {
            const pair impulse = {dof == first, dof == first + 1};
            y[dof] = impulse - spatial_dot(&link->axes[0], &total);
            const pair scaled = inverse_d[dof * dof] * y[dof];
            total.top = add(total.top, scale(&h[dof].top, scaled));
            total.bottom = add(total.bottom, scale(&h[dof].bottom, scaled));
        }
        force[i + 1] = (struct pair_spatial){0};
        if (link->parent < 0) continue; /* the base is fixed */
        struct pair_spatial *parent = &force[link->parent + 1];
        total.bottom = add(total.bottom, cross(&link->r_vector, &total.top));
        parent->top = add(parent->top, rotate_back(&rotations[i], &total.top));
        parent->bottom = add(parent->bottom, rotate_back(&rotations[i], &total.bottom));
        is_active[link->parent + 1] = 1;
    }

    double *column = columns + first * num_dofs;
    for (int i = 0; i < num_links; i++) {
        if (!is_needed[i]) continue;
        const struct link *link = &links[i];
        struct pair_spatial *own = &acceleration[i + 1];
        const struct pair_spatial *parent = &acceleration[link->parent + 1];
        own->top = rotate(&rotations[i], &parent->top);
        const struct pair3 arm = cross(&link->r_vector, &own->top);
        const struct pair3 turned = rotate(&rotations[i], &parent->bottom);
        own->bottom = (struct pair3){-arm.x + turned.x, -arm.y + turned.y,
                                     -arm.z + turned.z};
        if (!link->num_dofs) continue;
        const int dof = link->dof_offset;
        const pair rest = y[dof] - spatial_dot(&h[dof], own);
        const pair result = inverse_d[dof * dof] * rest;
        column[dof] = result[0];
        if (first + 1 < num_dofs) column[num_dofs + dof] = result[1];
        own->top = add(own->top, scale(&link->axes[0].top, result));
        own->bottom = add(own->bottom, scale(&link->axes[0].bottom, result));
    }
}

static int is_simple(const struct multi_body *body) {
    const int num_links = body->links.size, num_dofs = body->num_dofs;
    if (!body->fixed_base || num_dofs < 1 || num_links < num_dofs || num_links > 64 ||
        (body->base_collider != NULL && body->base_collider->flags & KINEMATIC) ||
        body->matrix_buffer.size != num_links + 1 ||
        body->vector_buffer.size != 2 * num_dofs ||
        body->real_buffer.size < 6 + num_dofs + num_dofs * num_dofs)
        return 0;
    const struct link *link = body->links.data;
    int num_seen = 0;
    for (int i = 0; i < num_links; i++, link++) {
        if (link->num_dofs < 0 || link->num_dofs > 1 || link->parent < -1 ||
            link->parent >= i)
            return 0;
        if (link->num_dofs && link->dof_offset != num_seen++) return 0;
    }
    return num_seen == num_dofs;
}

static int is_finite(const struct multi_body *body, const double *columns) {
    const int num_links = body->links.size, num_dofs = body->num_dofs;
    const double *real = body->real_buffer.data;
    double zero = finite_zero(real, 6 + num_dofs + num_dofs * num_dofs);
    zero += finite_zero(body->vector_buffer.data, 8 * num_dofs);
    zero += finite_zero((const double *)body->matrix_buffer.data + 12, 12 * num_links);
    zero += finite_zero(columns, num_dofs * num_dofs);
    const struct link *link = body->links.data;
    for (int i = 0; i < num_links; i++, link++) {
        zero += finite_zero(&link->r_vector.x, 3);
        if (link->num_dofs) zero += finite_zero(&link->axes[0].top.x, 8);
    }
    return zero == 0.0;
}

static int compute_responses(const struct multi_body *body, double *columns) {
    if (!is_simple(body)) return 0;
    const int num_links = body->links.size, num_dofs = body->num_dofs;
    struct pair_spatial force[65], acceleration[65];
    pair y[64];
    char is_needed[65], is_active[65];
    memset(force, 0, (num_links + 1) * sizeof(force[0]));
    memset(&acceleration[0], 0, sizeof(acceleration[0]));
    memset(is_needed, 0, num_links + 1);
    const struct link *links = body->links.data;
    for (int i = num_links - 1; i >= 0; i--) {
        is_needed[i] |= links[i].num_dofs > 0;
        if (is_needed[i] && links[i].parent >= 0) is_needed[links[i].parent] = 1;
    }
    for (int first = 0; first < num_dofs; first += 2)
        solve_pair(body, first, force, acceleration, y, is_needed, is_active, columns);
    return is_finite(body, columns);
}

/* The responses of a body, or NULL if Bullet has to compute them. */
static const double *get_responses(struct responses **list,
                                   const struct multi_body *body) {
    for (struct responses *known = *list; known != NULL; known = known->next)
        if (known->body == body) return known->is_known ? known->columns : NULL;
    const int num_dofs = body->num_dofs;
    if (num_dofs < 1 || num_dofs > 64) return NULL;
    struct responses *new = malloc(sizeof(*new) + num_dofs * num_dofs * sizeof(double));
    if (new == NULL) return NULL;
    new->next = *list;
    new->body = body;
    new->is_known = compute_responses(body, new->columns);
    *list = new;
    return new->is_known ? new->columns : NULL;
}

void free_responses(struct responses *list) {
    while (list != NULL) {
        struct responses *next = list->next;
        free(list);
        list = next;
    }
}

/* ---- rows ---------------------------------------------------------------------- */

/* Whether a constraint is one of a joint with one degree of freedom, as assumed. */
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
 * Appends a row whose Jacobian has one entry, sign, at the joint of a link.
 *
 * The entry is in the part of A if it is positive, and in that of B if it is negative.
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
    /* btMatrix3x3::getRotation */
    const double(*m)[4] = (const double(*)[4])link->world_basis.row;
    double q[4];
    const double trace = m[0][0] + m[1][1] + m[2][2];
    if (trace > 0.0) {
        double s = sqrt(trace + 1.0);
        q[3] = s * 0.5;
        s = 0.5 / s;
        q[0] = (m[2][1] - m[1][2]) * s;
        q[1] = (m[0][2] - m[2][0]) * s;
        q[2] = (m[1][0] - m[0][1]) * s;
    } else {
        const int i = m[0][0] < m[1][1] ? (m[1][1] < m[2][2] ? 2 : 1)
                                        : (m[0][0] < m[2][2] ? 2 : 0);
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        double s = sqrt(m[i][i] - m[j][j] - m[k][k] + 1.0);
        q[i] = s * 0.5;
        s = 0.5 / s;
        q[3] = (m[k][j] - m[j][k]) * s;
        q[j] = (m[j][i] + m[i][j]) * s;
        q[k] = (m[k][i] + m[i][k]) * s;
    }
    /* operator*(btQuaternion, btVector3) */
    const double x = q[3] * axis->x + q[1] * axis->z - q[2] * axis->y;
    const double y = q[3] * axis->y + q[2] * axis->x - q[0] * axis->z;
    const double z = q[3] * axis->z + q[0] * axis->y - q[1] * axis->x;
    const double w = -q[0] * axis->x - q[1] * axis->y - q[2] * axis->z;
    /* btQuaternion::operator*=, with the inverse */
    const double ix = -q[0], iy = -q[1], iz = -q[2], iw = q[3];
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
    const double *columns = get_responses(responses, body);
    if (columns == NULL) return 0;

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
    fill_row(row, data, base, columns, 1.0, -base->max_impulse, base->max_impulse,
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
    const double *columns = NULL;
    if (!(penetrations[0] > 0.0) || !(penetrations[1] > 0.0)) {
        if (!has_room_for(rows, data, body, 2)) return 0;
        columns = get_responses(responses, body);
        if (columns == NULL) return 0;
    }
    for (int i = 0; i < 2; i++) {
        const double penetration = penetrations[i];
        positions[i] = penetration;
        if (penetration > 0.0) continue;
        const double direction = i ? -1.0 : 1.0;
        struct constraint_row *row = expand(rows);
        row->constraint = &limit->base;
        row->constraint_row = i;
        const double velocity = fill_row(row, data, base, columns, direction, 0.0,
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
