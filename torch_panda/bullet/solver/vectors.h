/* Functions of vectors that two files share, in the order of Bullet's operations. */
#ifndef TORCH_PANDA_VECTORS_H
#define TORCH_PANDA_VECTORS_H

#include "bullet_types.h"

/* btVector3::cross */
static inline struct vector3 cross(const struct vector3 *a, const struct vector3 *b) {
    return (struct vector3){a->y * b->z - a->z * b->y, a->z * b->x - a->x * b->z,
                            a->x * b->y - a->y * b->x, 0.0};
}

/* The matrix of a quaternion, as btMatrix3x3::setRotation computes it. */
static inline struct matrix3 rotation_matrix(const struct vector3 *q) {
    const double d = q->x * q->x + q->y * q->y + q->z * q->z + q->w * q->w;
    const double s = 2.0 / d;
    const double xs = q->x * s, ys = q->y * s, zs = q->z * s;
    const double wx = q->w * xs, wy = q->w * ys, wz = q->w * zs;
    const double xx = q->x * xs, xy = q->x * ys, xz = q->x * zs;
    const double yy = q->y * ys, yz = q->y * zs, zz = q->z * zs;
    return (struct matrix3){{{1.0 - (yy + zz), xy - wz, xz + wy, 0.0},
                             {xy + wz, 1.0 - (xx + zz), yz - wx, 0.0},
                             {xz - wy, yz + wx, 1.0 - (xx + yy), 0.0}}};
}

#endif
