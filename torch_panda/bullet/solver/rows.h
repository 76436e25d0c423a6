/* Append rows to Bullet's arrays, without allocating memory. */
#ifndef TORCH_PANDA_ROWS_H
#define TORCH_PANDA_ROWS_H

#include "bullet_types.h"

#include <string.h>

static const double EPSILON = 2.2204460492503131e-16; /* SIMD_EPSILON */

static inline int has_room(const struct array *array, int count) {
    return array->capacity - array->size >= count;
}

/* Appends zeros to an array of doubles that has room for them. */
static inline double *append(struct array *array, int count) {
    double *end = (double *)array->data + array->size;
    memset(end, 0, count * sizeof(double));
    array->size += count;
    return end;
}

/* Appends a row, which the caller has to fill, to an array that has room for it. */
static inline struct constraint_row *expand(struct array *rows) {
    return (struct constraint_row *)rows->data + rows->size++;
}

/* Index of the body's velocities in the group's array. If the body is not in the array
   yet, it is appended. */
static inline int velocity_index(struct multi_body *body, struct jacobian_data *data) {
    if (body->companion_id < 0) {
        body->companion_id = data->delta_velocities.size;
        append(&data->delta_velocities, body->num_dofs + 6);
    }
    return body->companion_id;
}

/* Returns 0 if all numbers are finite, else NaN: infinity times 0 is NaN. */
static inline double finite_zero(const double *numbers, int count) {
    double even = 0.0, odd = 0.0;
    int i = 0;
    for (; i + 2 <= count; i += 2) {
        even += numbers[i] * 0.0;
        odd += numbers[i + 1] * 0.0;
    }
    if (i < count) even += numbers[i] * 0.0;
    return even + odd;
}

#endif
