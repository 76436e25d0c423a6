/*
 * Responses of a body with joints: changes of joint velocities by impulses at joints.
 *
 * Functions here, and their counterparts in Bullet
 * ------------------------------------------------
 * solve_pair        btMultiBody::calcAccelerationDeltasMultiDof, for two rows
 *
 * Why the results are the same bits
 * ---------------------------------
 * Bullet's function goes through all links twice: from the tips to the base, adding up
 * impulses, and back from the base to the tips, computing the changes of velocity.
 * solve_pair does the same operations in the same order, for two rows at once in the two
 * lanes of a register. It skips three parts, because they only add zeros:
 *
 * 1. On the way to the base, a link if there is no impulse at its own joint and none at
 *    the joint of a descendant.
 * 2. On the way back, a link if neither it nor a descendant has a joint.
 * 3. The base, which is fixed.
 *
 * The sign of a zero may therefore differ from Bullet's. No other bit differs: adding a
 * zero of either sign to another number does not change the number, and zeros in a
 * response change no velocity, as iterations.c explains. This holds for finite numbers.
 * If a number is not finite, or if is_simple refuses the body, Bullet creates the rows.
 */
#if defined(__x86_64__) && defined(__linux__)
#include "rows.h"
#include "solver.h"

#include <stdlib.h>
#include <string.h>

typedef double pair __attribute__((vector_size(16)));

struct pair3 {
    pair x, y, z;
};

struct pair_spatial {
    struct pair3 top, bottom;
};

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

void solve_pair(const struct responses *responses, const double *const impulses[2],
                double *const results[2]) {
    const struct multi_body *body = responses->body;
    const struct link *links = body->links.data;
    const int num_links = body->links.size, num_dofs = body->num_dofs;
    const struct matrix3 *rotations = (const struct matrix3 *)body->matrix_buffer.data + 1;
    const struct spatial *h = body->vector_buffer.data;
    const double *inverse_d = (const double *)body->real_buffer.data + 6 + num_dofs;
    /* Of the base and of each link. */
    struct pair_spatial force[MAX_LINKS + 1], acceleration[MAX_LINKS + 1];
    char is_active[MAX_LINKS + 1];
    pair y[MAX_LINKS];
    memset(force, 0, (num_links + 1) * sizeof(force[0]));
    memset(&acceleration[0], 0, sizeof(acceleration[0]));
    memset(is_active, 0, num_links + 1);
    memset(y, 0, num_dofs * sizeof(pair));

    for (int i = num_links - 1; i >= 0; i--) {
        const struct link *link = &links[i];
        const int dof = link->dof_offset;
        pair impulse = {0.0, 0.0};
        if (link->num_dofs) impulse = (pair){impulses[0][dof], impulses[1][dof]};
        if (impulse[0] == 0.0 && impulse[1] == 0.0 && !is_active[i + 1]) continue;
        struct pair_spatial total = force[i + 1];
        if (link->num_dofs) {
            y[dof] = impulse - spatial_dot(&link->axes[0], &total);
            const pair scaled = inverse_d[dof * dof] * y[dof];
            total.top = add(total.top, scale(&h[dof].top, scaled));
            total.bottom = add(total.bottom, scale(&h[dof].bottom, scaled));
        }
        if (link->parent < 0) continue; /* the base is fixed */
        struct pair_spatial *parent = &force[link->parent + 1];
        total.bottom = add(total.bottom, cross(&link->r_vector, &total.top));
        parent->top = add(parent->top, rotate_back(&rotations[i], &total.top));
        parent->bottom = add(parent->bottom, rotate_back(&rotations[i], &total.bottom));
        is_active[link->parent + 1] = 1;
    }

    for (int i = 0; i < num_links; i++) {
        if (!responses->is_needed[i]) continue;
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
        results[0][dof] = result[0];
        results[1][dof] = result[1];
        own->top = add(own->top, scale(&link->axes[0].top, result));
        own->bottom = add(own->bottom, scale(&link->axes[0].bottom, result));
    }
}

static int is_simple(const struct multi_body *body) {
    const int num_links = body->links.size, num_dofs = body->num_dofs;
    if (!body->fixed_base || num_dofs < 1 || num_links < num_dofs || num_links > MAX_LINKS ||
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

static int compute_responses(struct responses *responses) {
    const struct multi_body *body = responses->body;
    if (!is_simple(body)) return 0;
    const int num_links = body->links.size, num_dofs = body->num_dofs;
    const struct link *links = body->links.data;
    memset(responses->is_needed, 0, num_links);
    for (int i = num_links - 1; i >= 0; i--) {
        responses->is_needed[i] |= links[i].num_dofs > 0;
        if (responses->is_needed[i] && links[i].parent >= 0)
            responses->is_needed[links[i].parent] = 1;
    }
    double impulses[2][MAX_LINKS] = {{0.0}}, unused[MAX_LINKS];
    for (int first = 0; first < num_dofs; first += 2) {
        const int has_second = first + 1 < num_dofs;
        double *column = responses->columns + first * num_dofs;
        const double *const both[2] = {impulses[0], impulses[1]};
        double *const results[2] = {column, has_second ? column + num_dofs : unused};
        impulses[0][first] = 1.0;
        if (has_second) impulses[1][first + 1] = 1.0;
        solve_pair(responses, both, results);
        impulses[0][first] = 0.0;
        if (has_second) impulses[1][first + 1] = 0.0;
    }
    return is_finite(body, responses->columns);
}

const struct responses *get_responses(struct responses **list,
                                      const struct multi_body *body) {
    for (struct responses *known = *list; known != NULL; known = known->next)
        if (known->body == body) return known->is_known ? known : NULL;
    const int num_dofs = body->num_dofs;
    if (num_dofs < 1 || num_dofs > MAX_LINKS) return NULL;
    struct responses *new = malloc(sizeof(*new) + num_dofs * num_dofs * sizeof(double));
    if (new == NULL) return NULL;
    new->next = *list;
    new->body = body;
    new->is_known = compute_responses(new);
    *list = new;
    return new->is_known ? new : NULL;
}

void free_responses(struct responses *list) {
    while (list != NULL) {
        struct responses *next = list->next;
        free(list);
        list = next;
    }
}
#endif
