/*
 * Forward dynamics of a robot: the joint accelerations that forces and gravity cause.
 *
 * Functions here, and their counterparts in Bullet
 * ------------------------------------------------
 * accelerate        btMultiBody::computeAccelerationsArticulatedBodyAlgorithmMultiDof
 * safe_norm         btVector3::safeNorm
 * move_motion       btSpatialTransformationMatrix::transform
 * add_moved_inertia btSpatialTransformationMatrix::transformInverse, for a dyad
 * force_of          btSymmetricSpatialDyad::operator*
 *
 * This is Featherstone's articulated-body algorithm. It visits all links three times:
 * 1. from the base to the tips: velocities, and the forces on each link alone;
 * 2. back to the base: inertias and forces of each link with its descendants;
 * 3. to the tips again: accelerations.
 *
 * Why the results are the same bits
 * ---------------------------------
 * Every number is the result of Bullet's operations in Bullet's order. The code is
 * faster because two numbers share a register. It leaves out three parts:
 *
 * 1. The inertia of the base and the force on it. The base is fixed, so Bullet does not
 *    use them.
 * 2. The acceleration of a link if neither it nor a descendant has a joint. Bullet uses
 *    it only for sensors at joints, and can_accelerate refuses bodies with sensors.
 * 3. The addition of a fixed joint's velocity, which is zero. The sign of a zero may
 *    therefore differ from Bullet's, as in responses.c.
 *
 * If a result is not finite, the velocities stay as they are, and Bullet's function
 * computes everything again.
 */
#if defined(__x86_64__) && defined(__linux__)
#include "rows.h"
#include "solver.h"
#include "vectors.h"

#include <emmintrin.h>

typedef double pair __attribute__((vector_size(16)));

/*
 * A velocity, an acceleration or a force, with its angular and its linear part.
 *
 * Each pair holds a component of both parts. (Bullet's structs hold one part after the
 * other: the angular part of a motion is on top, but that of a force at the bottom.)
 */
struct spatial_pair {
    pair x, y, z;
};
enum { ANGULAR, LINEAR }; /* indices in a pair */

/* A row of a matrix. The last number is 0. */
struct matrix_row {
    pair xy, zw;
};

/* Has the layout of struct matrix3. */
struct matrix {
    struct matrix_row row[3];
};

/* btSymmetricSpatialDyad */
struct inertia {
    struct matrix top_left, top_right, bottom_left;
};

/* Results of the three visits of each link. Arrays of MAX_LINKS + 1 entries begin with
   the base, so that entry i + 1 belongs to link i. */
struct work {
    struct matrix rotation[MAX_LINKS + 1];   /* from the parent */
    struct matrix from_world[MAX_LINKS + 1]; /* rotation */
    struct spatial_pair velocity[MAX_LINKS + 1];
    struct spatial_pair coriolis[MAX_LINKS]; /* acceleration */
    struct spatial_pair force[MAX_LINKS + 1];
    struct inertia inertia[MAX_LINKS + 1];
    struct spatial_pair response[MAX_LINKS]; /* force that accelerates the joint by 1 */
    double y[MAX_LINKS];                     /* Bullet's Y: torque that moves the joint */
    struct spatial_pair acceleration[MAX_LINKS + 1];
    double joint_acceleration[MAX_LINKS];
    char is_needed[MAX_LINKS]; /* whether the link or a descendant has a joint */
};

static const struct spatial_pair ZERO;

static inline pair both(double number) { return (pair){number, number}; }

static inline struct spatial_pair motion(const struct spatial *a) {
    return (struct spatial_pair){{a->top.x, a->bottom.x},
                                 {a->top.y, a->bottom.y},
                                 {a->top.z, a->bottom.z}};
}

static inline struct vector3 part(struct spatial_pair a, int which) {
    return (struct vector3){a.x[which], a.y[which], a.z[which], 0.0};
}

static inline struct spatial_pair join(struct vector3 angular, struct vector3 linear) {
    return (struct spatial_pair){
        {angular.x, linear.x}, {angular.y, linear.y}, {angular.z, linear.z}};
}

static inline struct spatial_pair add(struct spatial_pair a, struct spatial_pair b) {
    return (struct spatial_pair){a.x + b.x, a.y + b.y, a.z + b.z};
}

static inline struct spatial_pair scale(struct spatial_pair a, pair factor) {
    return (struct spatial_pair){a.x * factor, a.y * factor, a.z * factor};
}

/* btSpatialMotionVector::dot(btSpatialForceVector) */
static inline double dot(struct spatial_pair motion, struct spatial_pair force) {
    const pair sum = motion.x * force.x + motion.y * force.y + motion.z * force.z;
    return sum[LINEAR] + sum[ANGULAR];
}

/* The cross products of a vector with both parts. */
static inline struct spatial_pair cross_both(struct vector3 a, struct spatial_pair b) {
    return (struct spatial_pair){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z,
                                 a.x * b.y - a.y * b.x};
}

static inline pair row_times(struct matrix_row row, struct spatial_pair a) {
    return row.xy[0] * a.x + row.xy[1] * a.y + row.zw[0] * a.z;
}

static inline struct spatial_pair rotate(const struct matrix *m, struct spatial_pair a) {
    return (struct spatial_pair){row_times(m->row[0], a), row_times(m->row[1], a),
                                 row_times(m->row[2], a)};
}

static inline struct spatial_pair rotate_back(const struct matrix *m,
                                              struct spatial_pair a) {
    const struct matrix_row *r = m->row;
    return (struct spatial_pair){
        r[0].xy[0] * a.x + r[1].xy[0] * a.y + r[2].xy[0] * a.z,
        r[0].xy[1] * a.x + r[1].xy[1] * a.y + r[2].xy[1] * a.z,
        r[0].zw[0] * a.x + r[1].zw[0] * a.y + r[2].zw[0] * a.z};
}

/* The motion of a link whose joint does not move, from the motion of its parent. `arm`
   leads from the parent to the link. */
static inline struct spatial_pair move_motion(const struct matrix *rotation,
                                              struct vector3 arm,
                                              struct spatial_pair parent) {
    const struct spatial_pair own = rotate(rotation, parent);
    const struct vector3 angular = part(own, ANGULAR);
    const struct vector3 turned = cross(&arm, &angular);
    const struct vector3 linear = {-turned.x + own.x[LINEAR], -turned.y + own.y[LINEAR],
                                   -turned.z + own.z[LINEAR], 0.0};
    return join(angular, linear);
}

/* btSpatialMotionVector::cross */
static inline struct spatial_pair cross_motion(struct spatial_pair a,
                                               struct spatial_pair b) {
    const struct spatial_pair first = cross_both(part(a, ANGULAR), b);
    const struct vector3 linear = part(a, LINEAR), angular = part(b, ANGULAR);
    const struct vector3 second = cross(&linear, &angular);
    return (struct spatial_pair){{first.x[ANGULAR], second.x + first.x[LINEAR]},
                                 {first.y[ANGULAR], second.y + first.y[LINEAR]},
                                 {first.z[ANGULAR], second.z + first.z[LINEAR]}};
}

/* The first row of a matrix times x, plus the second times y, plus the third times z. */
static inline struct matrix_row combine(double x, double y, double z,
                                        const struct matrix *m) {
    const struct matrix_row *r = m->row;
    return (struct matrix_row){x * r[0].xy + y * r[1].xy + z * r[2].xy,
                               x * r[0].zw + y * r[1].zw + z * r[2].zw};
}

static inline struct matrix multiply(const struct matrix *a, const struct matrix *b) {
    struct matrix result;
    for (int i = 0; i < 3; i++)
        result.row[i] = combine(a->row[i].xy[0], a->row[i].xy[1], a->row[i].zw[0], b);
    return result;
}

/* The transpose of matrix a, times matrix b. */
static inline struct matrix multiply_back(const struct matrix *a,
                                          const struct matrix *b) {
    const struct matrix_row *r = a->row;
    return (struct matrix){{combine(r[0].xy[0], r[1].xy[0], r[2].xy[0], b),
                            combine(r[0].xy[1], r[1].xy[1], r[2].xy[1], b),
                            combine(r[0].zw[0], r[1].zw[0], r[2].zw[0], b)}};
}

static inline struct matrix plus(struct matrix a, const struct matrix *b) {
    for (int i = 0; i < 3; i++) a.row[i].xy += b->row[i].xy, a.row[i].zw += b->row[i].zw;
    return a;
}

static inline struct matrix minus(struct matrix a, const struct matrix *b) {
    for (int i = 0; i < 3; i++) a.row[i].xy -= b->row[i].xy, a.row[i].zw -= b->row[i].zw;
    return a;
}

/* Converts a matrix from the link's frame to the parent's, and adds it to `sum`. */
static inline void add_turned(struct matrix *sum, const struct matrix *rotation,
                              const struct matrix *m) {
    const struct matrix half = multiply_back(rotation, m);
    const struct matrix turned = multiply(&half, rotation);
    *sum = plus(*sum, &turned);
}

/* Adds the inertia of a link at `arm` to that of its parent. */
static inline void add_moved_inertia(struct inertia *parent,
                                     const struct matrix *rotation, struct vector3 arm,
                                     const struct inertia *own) {
    const struct matrix arm_cross = {{{{0.0, -arm.z}, {arm.y, 0.0}},
                                      {{arm.z, 0.0}, {-arm.x, 0.0}},
                                      {{-arm.y, arm.x}, {0.0, 0.0}}}};
    struct matrix product = multiply(&own->top_right, &arm_cross);
    const struct matrix top_left = minus(own->top_left, &product);
    product = multiply(&arm_cross, &top_left);
    struct matrix bottom_left = plus(product, &own->bottom_left);
    product = multiply_back(&own->top_left, &arm_cross);
    bottom_left = minus(bottom_left, &product);
    add_turned(&parent->top_left, rotation, &top_left);
    add_turned(&parent->top_right, rotation, &own->top_right);
    add_turned(&parent->bottom_left, rotation, &bottom_left);
}

/* The force that gives an inertia an acceleration. */
static inline struct spatial_pair force_of(const struct inertia *inertia,
                                           struct spatial_pair a) {
    const struct vector3 angular = part(a, ANGULAR), linear = part(a, LINEAR);
    const struct matrix_row turned =
        combine(linear.x, linear.y, linear.z, &inertia->top_left);
    const double transposed[3] = {turned.xy[0], turned.xy[1], turned.zw[0]};
    pair result[3];
    for (int i = 0; i < 3; i++) {
        const struct matrix_row bottom_left = inertia->bottom_left.row[i];
        const struct matrix_row top_left = inertia->top_left.row[i];
        const struct matrix_row top_right = inertia->top_right.row[i];
        const pair by_angular = (pair){bottom_left.xy[0], top_left.xy[0]} * angular.x +
                                (pair){bottom_left.xy[1], top_left.xy[1]} * angular.y +
                                (pair){bottom_left.zw[0], top_left.zw[0]} * angular.z;
        const double by_linear = top_right.xy[0] * linear.x +
                                 top_right.xy[1] * linear.y + top_right.zw[0] * linear.z;
        result[i] = by_angular + (pair){transposed[i], by_linear};
    }
    return (struct spatial_pair){result[0], result[1], result[2]};
}

/* Subtracts the outer product of two vectors. */
static inline void subtract_outer(struct matrix *m, struct vector3 a, struct vector3 b) {
    const pair xy = {b.x, b.y}, zw = {b.z, 0.0};
    const double factors[3] = {a.x, a.y, a.z};
    for (int i = 0; i < 3; i++)
        m->row[i].xy -= factors[i] * xy, m->row[i].zw -= factors[i] * zw;
}

static inline struct matrix packed_rotation(const struct vector3 *quaternion) {
    const struct matrix3 rotation = rotation_matrix(quaternion);
    const struct vector3 *r = rotation.row;
    return (struct matrix){{{{r[0].x, r[0].y}, {r[0].z, 0.0}},
                            {{r[1].x, r[1].y}, {r[1].z, 0.0}},
                            {{r[2].x, r[2].y}, {r[2].z, 0.0}}}};
}

/* The lengths of both parts. A tiny length counts as 0. */
static inline pair safe_norm(struct spatial_pair a) {
    const pair square = a.x * a.x + a.y * a.y + a.z * a.z;
    const __m128d is_large = _mm_cmpgt_pd((__m128d)square, _mm_set1_pd(EPSILON));
    return (pair)_mm_and_pd(_mm_sqrt_pd((__m128d)square), is_large);
}

/* The force of one link without its descendants, from outside forces, from damping and
   from its rotation. */
static inline struct spatial_pair own_force(const struct link *link, pair damping,
                                            const struct matrix *from_world,
                                            struct spatial_pair velocity) {
    const struct spatial_pair applied =
        rotate(from_world, join(link->applied_torque, link->applied_force));
    const struct vector3 inertia = link->inertia;
    const double mass = link->mass;
    const struct spatial_pair momentum = {velocity.x * (pair){inertia.x, mass},
                                          velocity.y * (pair){inertia.y, mass},
                                          velocity.z * (pair){inertia.z, mass}};
    const struct spatial_pair damped =
        scale(momentum, damping + damping * safe_norm(velocity));
    /* Bullet multiplies by the mass after the cross product. */
    const struct spatial_pair factors =
        join(part(momentum, ANGULAR), part(velocity, LINEAR));
    const struct spatial_pair turning =
        scale(cross_both(part(velocity, ANGULAR), factors), (pair){1.0, mass});
    return (struct spatial_pair){-applied.x + damped.x + turning.x,
                                 -applied.y + damped.y + turning.y,
                                 -applied.z + damped.z + turning.z};
}

static inline void set_diagonal(struct matrix *m, double x, double y, double z) {
    m->row[0] = (struct matrix_row){{x, 0.0}, {0.0, 0.0}};
    m->row[1] = (struct matrix_row){{0.0, y}, {0.0, 0.0}};
    m->row[2] = (struct matrix_row){{0.0, 0.0}, {z, 0.0}};
}

/* Visits the links from the base to the tips. */
static void compute_velocities(struct work *work, const struct multi_body *body) {
    const struct link *link = body->links.data;
    const double *joint_velocity = (const double *)body->real_buffer.data + 6;
    const pair damping = {body->angular_damping, body->linear_damping};
    work->rotation[0] = work->from_world[0] = packed_rotation(&body->base_rotation);
    work->velocity[0] = ZERO;
    for (int i = 0; i < body->links.size; i++, link++) {
        const struct matrix rotation = packed_rotation(&link->rotation);
        const struct matrix from_world =
            multiply(&rotation, &work->from_world[link->parent + 1]);
        struct spatial_pair velocity =
            move_motion(&rotation, link->r_vector, work->velocity[link->parent + 1]);
        work->coriolis[i] = ZERO;
        if (link->num_dofs) {
            const struct spatial_pair own =
                scale(motion(&link->axes[0]), both(joint_velocity[link->dof_offset]));
            velocity = add(velocity, own);
            work->coriolis[i] = cross_motion(velocity, own);
        }
        work->rotation[i + 1] = rotation;
        work->from_world[i + 1] = from_world;
        work->velocity[i + 1] = velocity;
        work->force[i + 1] = own_force(link, damping, &from_world, velocity);
        struct inertia *inertia = &work->inertia[i + 1];
        set_diagonal(&inertia->top_left, 0.0, 0.0, 0.0);
        set_diagonal(&inertia->top_right, link->mass, link->mass, link->mass);
        set_diagonal(&inertia->bottom_left, link->inertia.x, link->inertia.y,
                     link->inertia.z);
    }
}

/* Visits the links from the tips to the base. */
static void compute_inertias(struct work *work, const struct multi_body *body,
                             double *inverse_d) {
    for (int i = body->links.size - 1; i >= 0; i--) {
        const struct link *link = (const struct link *)body->links.data + i;
        const struct spatial_pair coriolis = work->coriolis[i];
        struct inertia *inertia = &work->inertia[i + 1];
        struct spatial_pair force = work->force[i + 1];
        work->is_needed[i] |= link->num_dofs;
        if (link->num_dofs) {
            const int dof = link->dof_offset;
            const struct spatial_pair axis = motion(&link->axes[0]);
            const struct spatial_pair response = force_of(inertia, axis);
            const double y =
                link->joint_torque[0] - dot(axis, force) - dot(coriolis, response);
            const double d = dot(axis, response);
            const double inverse = d >= EPSILON ? 1.0 / d : 0.0;
            force = add(force, force_of(inertia, coriolis));
            force = add(force, scale(response, both(inverse * y)));
            const struct spatial_pair scaled = scale(response, both(inverse));
            const struct vector3 angular = part(response, ANGULAR);
            const struct vector3 linear = part(response, LINEAR);
            subtract_outer(&inertia->top_left, linear, part(scaled, ANGULAR));
            subtract_outer(&inertia->top_right, linear, part(scaled, LINEAR));
            subtract_outer(&inertia->bottom_left, angular, part(scaled, ANGULAR));
            work->response[dof] = response;
            work->y[dof] = y;
            inverse_d[dof * dof] = inverse;
        }
        if (link->parent < 0) continue; /* the base is fixed */
        const struct matrix *rotation = &work->rotation[i + 1];
        work->is_needed[link->parent] |= work->is_needed[i];
        add_moved_inertia(&work->inertia[link->parent + 1], rotation, link->r_vector,
                          inertia);
        const struct vector3 linear = part(force, LINEAR);
        force = add(force, join(cross(&link->r_vector, &linear), (struct vector3){0}));
        work->force[link->parent + 1] =
            add(work->force[link->parent + 1], rotate_back(rotation, force));
    }
}

/* Visits the links from the base to the tips again. */
static void compute_accelerations(struct work *work, const struct multi_body *body,
                                  const double *inverse_d) {
    const struct link *link = body->links.data;
    work->acceleration[0] = ZERO;
    for (int i = 0; i < body->links.size; i++, link++) {
        if (!work->is_needed[i]) continue;
        struct spatial_pair acceleration =
            move_motion(&work->rotation[i + 1], link->r_vector,
                        work->acceleration[link->parent + 1]);
        if (link->num_dofs) {
            const int dof = link->dof_offset;
            const double rest = work->y[dof] - dot(acceleration, work->response[dof]);
            const double own = inverse_d[dof * dof] * rest;
            acceleration = add(acceleration, work->coriolis[i]);
            acceleration = add(acceleration, scale(motion(&link->axes[0]), both(own)));
            work->joint_acceleration[dof] = own;
        }
        work->acceleration[i + 1] = acceleration;
    }
}

static int is_asleep(const struct collision_object *collider) {
    return collider != NULL && collider->activation_state == ASLEEP;
}

int can_accelerate(const struct multi_body *body) {
    const int num_links = body->links.size, num_dofs = body->num_dofs;
    if (!body->fixed_base || body->use_rk4 || body->use_global_velocities ||
        !body->use_gyro_term || num_dofs < 1 || num_links < num_dofs ||
        num_links > MAX_LINKS || body->base_collider == NULL ||
        body->base_collider->flags & KINEMATIC || is_asleep(body->base_collider) ||
        body->matrix_buffer.size != num_links + 1 ||
        body->vector_buffer.size != 2 * num_dofs ||
        body->real_buffer.size < 6 + num_dofs + num_dofs * num_dofs)
        return 0;
    const double *base_velocity = body->real_buffer.data;
    for (int k = 0; k < 6; k++)
        if (base_velocity[k] != 0.0) return 0;
    const struct link *link = body->links.data;
    int num_seen = 0;
    for (int i = 0; i < num_links; i++, link++) {
        const int has_joint =
            link->joint_type == REVOLUTE || link->joint_type == PRISMATIC;
        if ((!has_joint && link->joint_type != FIXED) || link->num_dofs != has_joint ||
            link->parent < -1 || link->parent >= i || link->joint_feedback != NULL ||
            is_asleep(link->collider))
            return 0;
        if (has_joint && link->dof_offset != num_seen++) return 0;
    }
    return num_seen == num_dofs;
}

int accelerate(struct multi_body *body, double time_step) {
    const int num_dofs = body->num_dofs;
    double *joint_velocity = (double *)body->real_buffer.data + 6;
    double *inverse_d = joint_velocity + num_dofs;
    struct spatial *h = body->vector_buffer.data;
    struct work work;
    memset(work.is_needed, 0, body->links.size);
    compute_velocities(&work, body);
    compute_inertias(&work, body, inverse_d);
    compute_accelerations(&work, body, inverse_d);

    /* Bullet reads these two arrays later, when it computes responses to impulses. */
    memcpy(body->matrix_buffer.data, work.rotation,
           (body->links.size + 1) * sizeof(struct matrix));
    for (int dof = 0; dof < num_dofs; dof++)
        h[dof] = (struct spatial){part(work.response[dof], LINEAR),
                                  part(work.response[dof], ANGULAR)};

    double zero = finite_zero(work.joint_acceleration, num_dofs);
    zero += finite_zero(work.y, num_dofs) + finite_zero(&h[0].top.x, 8 * num_dofs);
    for (int dof = 0; dof < num_dofs; dof++) zero += inverse_d[dof * dof] * 0.0;
    if (zero != 0.0) return 0; /* it is NaN */
    body->needs_joint_feedback = 0;
    const double limit = body->max_velocity;
    for (int dof = 0; dof < num_dofs; dof++) {
        const double sum = joint_velocity[dof] + work.joint_acceleration[dof] * time_step;
        joint_velocity[dof] = sum < -limit ? -limit : limit < sum ? limit : sum;
    }
    return 1;
}
#endif
