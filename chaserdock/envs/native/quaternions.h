/* SPDX-License-Identifier: Apache-2.0 */
/* Quaternions, scalar first, body to world, as in chaserdock_models.rotations. */
#ifndef CHASERDOCK_QUATERNIONS_H
#define CHASERDOCK_QUATERNIONS_H

#include "elementary.h"

/* out (4) = a b, the rotation b followed by a; out may be neither operand. */
static inline void q_multiply(const double *a, const double *b, double *out) {
    out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
    out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
    out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
    out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
}

static inline void q_conjugate(const double *q, double *out) {
    out[0] = q[0];
    for (int i = 1; i < 4; i++) out[i] = -q[i];
}

/* out (3) = the body-axes vector v in world axes. */
static inline void q_rotate(const double *q, const double *v, double *out) {
    double t[3], u[3];
    cross3(q + 1, v, t);
    for (int i = 0; i < 3; i++) t[i] *= 2.0;
    cross3(q + 1, t, u);
    for (int i = 0; i < 3; i++) out[i] = v[i] + q[0] * t[i] + u[i];
}

/* out (3) = the world-axes vector v in body axes. */
static inline void q_rotate_inverse(const double *q, const double *v, double *out) {
    double inverse[4];
    q_conjugate(q, inverse);
    q_rotate(inverse, v, out);
}

/* Quaternion of a rotation vector (3). */
static inline void q_exp(const double *v, double *out) {
    double angle = sqrt_of(dot3(v, v)), sine, cosine;
    sine_cosine(0.5 * angle, &sine, &cosine);
    double share = angle > 1e-9 ? sine / angle : 0.5;
    out[0] = cosine;
    for (int i = 0; i < 3; i++) out[1 + i] = share * v[i];
}

/* Angle (rad) of the rotation q, 0 to pi. */
static inline double q_angle(const double *q) {
    double part = sqrt_of(dot3(q + 1, q + 1)), rest = abs_of(q[0]);
    return rest > 0.0 ? 2.0 * arctangent(part / rest) : 3.141592653589793;
}

#endif
