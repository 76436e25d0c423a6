/* Functions of vectors and rotations that several files share. They do Bullet's
   operations in Bullet's order. */
#ifndef TORCH_PANDA_VECTORS_H
#define TORCH_PANDA_VECTORS_H

#include "bullet_types.h"

#include <math.h>

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

/* The quaternion of a matrix, as btMatrix3x3::getRotation computes it. */
static inline struct vector3 get_rotation(const struct matrix3 *matrix) {
    const double(*m)[4] = (const double(*)[4])matrix->row;
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
    return (struct vector3){q[0], q[1], q[2], q[3]};
}

#endif
