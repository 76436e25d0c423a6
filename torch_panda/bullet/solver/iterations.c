/*
 * The solver's iterations, on packed rows.
 *
 * Functions here, and their counterparts in Bullet
 * ------------------------------------------------
 * solve_group       btSequentialImpulseConstraintSolver::
 *                   solveGroupCacheFriendlyIterations, as a btMultiBodyConstraintSolver
 *                   runs it: iterations until the residual is small enough, and the
 *                   analytics of the last one.
 * iterate           btMultiBodyConstraintSolver::solveSingleIteration: one sweep over
 *                   the rows of joints, contacts and friction.
 * resolve_row       btMultiBodyConstraintSolver::resolveSingleConstraintRowGeneric
 * resolve_cone      btMultiBodyConstraintSolver::resolveConeFrictionConstraintRows
 * apply             applyDeltaVee of the solver and applyDeltaVeeMultiDof2 of the body,
 *                   two functions that add the same numbers to two accumulators
 *
 * Why the results are the same bits
 * ---------------------------------
 * A sum of doubles depends on the order of its terms. Every sum here therefore has the
 * terms of Bullet's sum in Bullet's order, and the rows are visited in Bullet's order:
 * rows of joints backwards and forwards in turn, then contacts, spinning, rolling and
 * sliding friction. The file is compiled without fused multiply-adds, which round once
 * where Bullet rounds twice. Four things are left out because they change no bit:
 *
 * 1. Terms whose Jacobian is exactly zero. Such a term is +0 or -0 while velocities
 *    are finite. The sum starts at +0, a sum that starts at +0 never becomes -0, and
 *    adding a zero of either sign to any other number returns this number.
 * 2. Velocities whose unit response is exactly zero, for the same reason. Velocities
 *    start at +0 or as sums, so none should be -0. If one is, Bullet solves the group.
 * 3. The second accumulator. The solver's m_deltaVelocities and the body's m_deltaV
 *    begin equal and receive the same additions, so one is computed and copied to the
 *    other. If they do not begin equal, Bullet solves the group.
 * 4. atan2, sin and cos where the friction limit is 0. They only scale this zero.
 *
 * These reasons hold for finite numbers only. It is enough to check the numbers after
 * the last iteration. Limits are finite, so an impulse is finite or NaN. An impulse that
 * is NaN stays NaN, and a velocity that is infinite or NaN never becomes finite again.
 * If a number is not finite, the result is thrown away, and Bullet's function solves the
 * group from the start.
 *
 * Bullet also solves every group with something that is not implemented here: rows or
 * constraints of rigid bodies, rows between a body and the world, and numbers that
 * Bullet itself would not have written.
 */
#if defined(__x86_64__) && defined(__linux__)
#define _GNU_SOURCE /* sincos, posix_memalign */
#include "solver.h"

#include <emmintrin.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

/* One factor of a Jacobian, and the velocity that it multiplies. */
struct term {
    double factor;
    const double *velocity;
};

/* The effect of an impulse on the velocities of a body; both arrays are aligned. */
struct response {
    const double *unit;
    double *velocity;
    int num_pairs;
};

/* One row, ready for the iterations. */
struct row {
    double rhs, cfm, jac_diag_inv;
    double impulse, lower_limit, upper_limit, friction;
    int contact; /* index of the normal row, for friction */
    const struct term *terms_a, *terms_b, *terms_end;
    struct response a, b;
    struct constraint_row *source;
};

/* A body of the group: where its velocities are packed. */
struct body {
    struct multi_body *source;
    double *velocity;
    int first; /* its first velocity in m_deltaVelocities */
};

struct rows {
    struct row *begin;
    int size;
};

struct group {
    struct rows joints, normals, spinning, torsional, friction;
    struct row *rows;
    int num_rows;
    struct body *bodies;
    int num_bodies;
    double *velocities;
    int num_velocities;
    int num_terms, num_units; /* upper bounds, for the allocation */
    /* The next free places while rows are packed: */
    struct term *term;
    double *unit;
};

static inline double max_residual(double a, double b) {
    return a > b ? a : b; /* like btMax, also for NaN */
}

/* ---- one row ------------------------------------------------------------------- */

static inline double dot(const struct term *term, const struct term *end) {
    double sum = 0.0;
    for (; term != end; term++) sum += term->factor * *term->velocity;
    return sum;
}

static inline void apply(const struct response *response, double impulse) {
    const __m128d factor = _mm_set1_pd(impulse);
    const double *unit = response->unit;
    double *velocity = response->velocity;
    /* Load and store whole pairs only: a load of a pair that was stored as two separate
       numbers would stall the processor. */
    for (int i = 0; i < response->num_pairs; i++) {
        __m128d change = _mm_mul_pd(_mm_load_pd(unit + 2 * i), factor);
        _mm_store_pd(velocity + 2 * i,
                     _mm_add_pd(_mm_load_pd(velocity + 2 * i), change));
    }
}

/* The change of impulse that gives the row its target velocity, before limits. */
static inline double wanted(const struct row *row) {
    double delta = row->rhs - row->impulse * row->cfm;
    delta -= dot(row->terms_a, row->terms_b) * row->jac_diag_inv;
    /* If B has no terms, Bullet subtracts 0 * jac_diag_inv. This is +0 and changes
       nothing, because jac_diag_inv is not negative. */
    if (row->terms_b != row->terms_end)
        delta -= dot(row->terms_b, row->terms_end) * row->jac_diag_inv;
    return delta;
}

/* Applies the impulse; returns the change of velocity in the row's direction. */
static inline double resolve_row(struct row *row) {
    double delta = wanted(row);
    const double sum = row->impulse + delta;
    if (sum < row->lower_limit) {
        delta = row->lower_limit - row->impulse;
        row->impulse = row->lower_limit;
    } else if (sum > row->upper_limit) {
        delta = row->upper_limit - row->impulse;
        row->impulse = row->upper_limit;
    } else {
        row->impulse = sum;
    }
    apply(&row->a, delta);
    apply(&row->b, delta);
    return delta / row->jac_diag_inv;
}

static inline void set_friction_limits(struct row *row, double normal_impulse) {
    row->lower_limit = -(row->friction * normal_impulse);
    row->upper_limit = row->friction * normal_impulse;
}

static inline void clip_to(struct row *row, double sum, double limit, double *delta) {
    if (sum < -limit) {
        *delta = -limit - row->impulse;
        row->impulse = -limit;
    } else if (sum > limit) {
        *delta = limit - row->impulse;
        row->impulse = limit;
    } else {
        row->impulse = sum;
    }
}

/* Two friction rows of one contact, clipped to a cone together. */
static inline double resolve_cone(struct row *a, struct row *b) {
    double delta_b = wanted(b);
    double delta_a = wanted(a);
    const double sum_a = a->impulse + delta_a, sum_b = b->impulse + delta_b;
    if (sum_a * sum_a + sum_b * sum_b >= a->lower_limit * b->lower_limit) {
        double limit_a = 0.0, limit_b = 0.0;
        if (a->lower_limit != 0.0 || b->lower_limit != 0.0) {
            double sine, cosine;
            sincos(atan2(sum_a, sum_b), &sine, &cosine);
            limit_a = fabs(a->lower_limit * sine);
            limit_b = fabs(b->lower_limit * cosine);
        }
        clip_to(a, sum_a, limit_a, &delta_a);
        clip_to(b, sum_b, limit_b, &delta_b);
    } else {
        a->impulse = sum_a;
        b->impulse = sum_b;
    }
    apply(&a->a, delta_a);
    apply(&a->b, delta_a);
    apply(&b->a, delta_b);
    apply(&b->b, delta_b);
    return delta_a / a->jac_diag_inv + delta_b / b->jac_diag_inv;
}

/* ---- all rows ------------------------------------------------------------------ */

/* Solves friction rows in pairs. With pressed_only, skips contacts that do not press. */
static double iterate_cones(const struct group *group, const struct rows *rows,
                            int pressed_only, double residual) {
    for (int i = 0; i < rows->size; i += 2) {
        struct row *a = &rows->begin[i], *b = &rows->begin[i + 1];
        const double normal_impulse = group->normals.begin[a->contact].impulse;
        if (a->contact != b->contact || (pressed_only && !(normal_impulse > 0.0)))
            continue;
        set_friction_limits(a, normal_impulse);
        set_friction_limits(b, normal_impulse);
        const double change = resolve_cone(a, b);
        residual = max_residual(residual, change * change);
    }
    return residual;
}

/* Solves friction rows one by one. Skips contacts that do not press. */
static double iterate_friction(const struct group *group, const struct rows *rows,
                               double residual) {
    for (int i = 0; i < rows->size; i++) {
        struct row *row = &rows->begin[i];
        const double normal_impulse = group->normals.begin[row->contact].impulse;
        if (!(normal_impulse > 0.0)) continue;
        set_friction_limits(row, normal_impulse);
        const double change = resolve_row(row);
        residual = max_residual(residual, change * change);
    }
    return residual;
}

static double iterate(const struct group *group, const struct solver_info *info,
                      int iteration) {
    double joint_residual = 0.0;
    const int num_joints = group->joints.size;
    for (int inner = 0; inner < info->num_inner_iterations; inner++) {
        joint_residual = 0.0;
        for (int i = 0; i < num_joints; i++) {
            const int index = iteration & 1 ? i : num_joints - 1 - i;
            const double change = resolve_row(&group->joints.begin[index]);
            joint_residual = max_residual(joint_residual, change * change);
        }
    }
    double residual = max_residual(0.0, joint_residual);
    for (int i = 0; i < group->normals.size; i++) {
        const double change = resolve_row(&group->normals.begin[i]);
        residual = max_residual(residual, change * change);
    }
    if ((info->mode & TWO_FRICTION_DIRECTIONS) && !(info->mode & NO_FRICTION_CONE)) {
        residual = iterate_friction(group, &group->spinning, residual);
        residual = iterate_cones(group, &group->torsional, 1, residual);
        return iterate_cones(group, &group->friction, 0, residual);
    }
    return iterate_friction(group, &group->friction, residual);
}

/* ---- packing ------------------------------------------------------------------- */

static inline int is_moderate(double number) {
    return fabs(number) < 1e300; /* false for NaN */
}

/* Registers a row's body; returns 0 if Bullet has to solve the group. */
static int add_body(struct group *group, const struct solver *solver,
                    struct multi_body *body, int first, int jacobian, int *body_at) {
    const struct jacobian_data *data = &solver->data;
    if (body == NULL) return 0;
    const int num_dofs = body->num_dofs + 6;
    if (first < 0 || first > data->delta_velocities.size - num_dofs) return 0;
    if (jacobian < 0 || jacobian > data->jacobians.size - num_dofs) return 0;
    group->num_terms += num_dofs;
    group->num_units += num_dofs + 2;
    if (body_at[first] >= 0)
        return group->bodies[body_at[first]].source == body &&
               group->bodies[body_at[first]].first == first;
    if (body->companion_id != first || body->delta_v.size < num_dofs) return 0;
    const double *start = (const double *)data->delta_velocities.data + first;
    if (memcmp(start, body->delta_v.data, num_dofs * sizeof(double)) != 0) return 0;
    for (int i = 0; i < num_dofs; i++) {
        if (body_at[first + i] >= 0) return 0;
        if (!is_moderate(start[i]) || (start[i] == 0.0 && signbit(start[i]))) return 0;
        body_at[first + i] = group->num_bodies;
    }
    group->bodies[group->num_bodies++] = (struct body){body, NULL, first};
    group->num_velocities += (num_dofs + 1) & ~1;
    return 1;
}

static int add_rows(struct group *group, const struct solver *solver,
                    const struct array *source, struct rows *rows, int *body_at) {
    struct constraint_row *row = source->data;
    rows->size = source->size;
    for (int i = 0; i < source->size; i++, row++) {
        if (!add_body(group, solver, row->multi_body_a, row->delta_vel_a, row->jac_a,
                      body_at) ||
            !add_body(group, solver, row->multi_body_b, row->delta_vel_b, row->jac_b,
                      body_at))
            return 0;
        if (!is_moderate(row->rhs) || !is_moderate(row->cfm) ||
            !is_moderate(row->jac_diag_inv) || signbit(row->jac_diag_inv) ||
            !is_moderate(row->applied_impulse) || !is_moderate(row->friction) ||
            !is_moderate(row->lower_limit) || !is_moderate(row->upper_limit))
            return 0;
    }
    group->num_rows += source->size;
    return 1;
}

static const struct term *pack_terms(struct group *group, const double *jacobian,
                                     const double *velocity, int num_dofs) {
    for (int i = 0; i < num_dofs; i++)
        if (jacobian[i] != 0.0)
            *group->term++ = (struct term){jacobian[i], velocity + i};
    return group->term;
}

static struct response pack_response(struct group *group, const double *unit,
                                     double *velocity, int num_dofs) {
    int first = 0, end = num_dofs;
    while (first < end && unit[first] == 0.0) first++;
    while (first < end && unit[end - 1] == 0.0) end--;
    if (first == end) return (struct response){group->unit, velocity, 0};
    first &= ~1;
    const struct response response = {group->unit, velocity + first,
                                      (end - first + 1) / 2};
    for (int i = first; i < end; i++) *group->unit++ = unit[i];
    if ((end - first) & 1) *group->unit++ = 0.0;
    return response;
}

static void pack_rows(struct group *group, const struct solver *solver,
                      const struct array *source, struct rows *rows,
                      const int *body_at) {
    const double *jacobians = solver->data.jacobians.data;
    const double *units = solver->data.unit_impulses.data;
    struct constraint_row *from = source->data;
    rows->begin = group->rows + group->num_rows;
    group->num_rows += rows->size;
    for (struct row *row = rows->begin; row != rows->begin + rows->size; row++) {
        double *velocity_a = group->bodies[body_at[from->delta_vel_a]].velocity;
        double *velocity_b = group->bodies[body_at[from->delta_vel_b]].velocity;
        const int num_dofs_a = from->multi_body_a->num_dofs + 6;
        const int num_dofs_b = from->multi_body_b->num_dofs + 6;
        row->rhs = from->rhs;
        row->cfm = from->cfm;
        row->jac_diag_inv = from->jac_diag_inv;
        row->impulse = from->applied_impulse;
        row->lower_limit = from->lower_limit;
        row->upper_limit = from->upper_limit;
        row->friction = from->friction;
        row->contact = from->friction_index;
        row->source = from;
        row->terms_a = group->term;
        row->terms_b =
            pack_terms(group, jacobians + from->jac_a, velocity_a, num_dofs_a);
        row->terms_end =
            pack_terms(group, jacobians + from->jac_b, velocity_b, num_dofs_b);
        row->a = pack_response(group, units + from->jac_a, velocity_a, num_dofs_a);
        row->b = pack_response(group, units + from->jac_b, velocity_b, num_dofs_b);
        from++;
    }
}

/* ---- memory of a group --------------------------------------------------------- */

/* The unused rest of a block on the caller's stack, and the blocks on the heap for
   everything that did not fit into it. */
struct memory {
    char *rest;
    size_t size;
    void *blocks[2];
    int num_blocks;
};

/* A block aligned to 16 bytes, or NULL. */
static void *allocate(struct memory *memory, size_t size) {
    size = (size + 15) & ~(size_t)15;
    if (size <= memory->size) {
        void *block = memory->rest;
        memory->rest += size;
        memory->size -= size;
        return block;
    }
    void *block = NULL;
    if (posix_memalign(&block, 16, size) != 0) return NULL;
    return memory->blocks[memory->num_blocks++] = block;
}

/* ---- a group ------------------------------------------------------------------- */

static int contacts_exist(const struct rows *rows, int num_normals) {
    for (int i = 0; i < rows->size; i++)
        if (rows->begin[i].contact < 0 || rows->begin[i].contact >= num_normals)
            return 0;
    return 1;
}

static int is_finite(const struct group *group) {
    for (int i = 0; i < group->num_rows; i++)
        if (!isfinite(group->rows[i].impulse)) return 0;
    for (int i = 0; i < group->num_velocities; i++)
        if (!isfinite(group->velocities[i])) return 0;
    return 1;
}

static void write_back(const struct group *group, struct solver *solver) {
    for (int i = 0; i < group->num_rows; i++) {
        const struct row *row = &group->rows[i];
        row->source->applied_impulse = row->impulse;
        row->source->lower_limit = row->lower_limit;
        row->source->upper_limit = row->upper_limit;
    }
    double *velocities = solver->data.delta_velocities.data;
    for (int i = 0; i < group->num_bodies; i++) {
        const struct body *body = &group->bodies[i];
        const size_t bytes = (body->source->num_dofs + 6) * sizeof(double);
        memcpy(velocities + body->first, body->velocity, bytes);
        memcpy(body->source->delta_v.data, body->velocity, bytes);
        body->source->pos_updated = 0;
    }
}

static void set_analytics(struct solver *solver, struct collision_object **bodies,
                          int num_bodies, int num_manifolds, int num_iterations) {
    solver->analytics.num_calls++;
    solver->analytics.num_iterations = num_iterations;
    solver->analytics.island = num_bodies > 0 ? bodies[0]->companion_id : -2;
    solver->analytics.num_bodies = num_bodies;
    solver->analytics.num_manifolds = num_manifolds;
    solver->analytics.residual = solver->residual;
}

/* Runs all iterations; returns how many. */
static int run(const struct group *group, const struct solver_info *info,
               double *residual) {
    for (int iteration = 0;; iteration++) {
        *residual = iterate(group, info, iteration);
        if (*residual <= info->residual_threshold ||
            iteration >= info->num_iterations - 1)
            return iteration + 1;
    }
}

int solve_group(struct solver *solver, struct collision_object **bodies, int num_bodies,
                int num_manifolds, int num_constraints,
                const struct solver_info *info) {
    if (solver->contact_rows.size || solver->joint_rows.size ||
        solver->friction_rows.size || solver->rolling_rows.size || num_constraints ||
        info->num_iterations < 1 || info->num_inner_iterations < 1 ||
        solver->max_override_iterations > info->num_iterations ||
        solver->data.unit_impulses.size != solver->data.jacobians.size)
        return 0;
    const struct array *const sources[] = {
        &solver->multi_body_joint_rows, &solver->multi_body_normal_rows,
        &solver->multi_body_spinning_rows, &solver->multi_body_torsional_rows,
        &solver->multi_body_friction_rows};
    struct group group = {.num_rows = 0};
    struct rows *const targets[] = {&group.joints, &group.normals, &group.spinning,
                                    &group.torsional, &group.friction};
    if (solver->multi_body_joint_rows.size + solver->multi_body_normal_rows.size == 0) {
        /* Nothing to solve: one iteration, in which nothing happens. */
        if (solver->multi_body_spinning_rows.size +
            solver->multi_body_torsional_rows.size +
            solver->multi_body_friction_rows.size)
            return 0;
        const int num_iterations = run(&group, info, &solver->residual);
        set_analytics(solver, bodies, num_bodies, num_manifolds, num_iterations);
        return 1;
    }

    /* Large enough for the groups of most scenes. Larger groups use the heap. */
    char stack[49152] __attribute__((aligned(16)));
    struct memory memory = {stack, sizeof(stack), {NULL, NULL}, 0};
    const int size = solver->data.delta_velocities.size;
    int solved = 0;
    /* Two arrays: the bodies, of which there are fewer than velocities; and the index of
       the body to which each velocity belongs. */
    group.bodies = allocate(&memory, size * (sizeof(struct body) + sizeof(int)));
    if (group.bodies == NULL) return 0;
    int *body_at = (int *)(group.bodies + size);
    memset(body_at, -1, size * sizeof(int));
    for (int i = 0; i < 5; i++)
        if (!add_rows(&group, solver, sources[i], targets[i], body_at)) goto done;
    if (group.torsional.size % 2) goto done;
    if ((info->mode & TWO_FRICTION_DIRECTIONS) && !(info->mode & NO_FRICTION_CONE) &&
        group.friction.size % 2)
        goto done;

    const size_t row_bytes = (group.num_rows * sizeof(struct row) + 15) & ~15;
    const size_t term_bytes = group.num_terms * sizeof(struct term);
    const size_t velocity_bytes = group.num_velocities * sizeof(double);
    group.velocities =
        allocate(&memory, velocity_bytes + group.num_units * sizeof(double) + row_bytes +
                              term_bytes);
    if (group.velocities == NULL) goto done;
    group.rows = (struct row *)((char *)group.velocities + velocity_bytes);
    group.term = (struct term *)((char *)group.rows + row_bytes);
    group.unit = (double *)((char *)group.term + term_bytes);
    double *velocity = group.velocities;
    for (int i = 0; i < group.num_bodies; i++) {
        struct body *body = &group.bodies[i];
        const int num_dofs = body->source->num_dofs + 6;
        body->velocity = velocity;
        memcpy(velocity, body->source->delta_v.data, num_dofs * sizeof(double));
        if (num_dofs & 1) velocity[num_dofs] = 0.0;
        velocity += (num_dofs + 1) & ~1;
    }
    group.num_rows = 0;
    for (int i = 0; i < 5; i++)
        pack_rows(&group, solver, sources[i], targets[i], body_at);
    if (!contacts_exist(&group.spinning, group.normals.size) ||
        !contacts_exist(&group.torsional, group.normals.size) ||
        !contacts_exist(&group.friction, group.normals.size))
        goto done;

    double residual;
    const int num_iterations = run(&group, info, &residual);
    if (!is_finite(&group)) goto done;
    write_back(&group, solver);
    solver->residual = residual;
    set_analytics(solver, bodies, num_bodies, num_manifolds, num_iterations);
    solved = 1;
done:
    for (int i = 0; i < memory.num_blocks; i++) free(memory.blocks[i]);
    return solved;
}
#endif
