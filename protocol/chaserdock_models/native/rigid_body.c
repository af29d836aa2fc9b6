/* SPDX-License-Identifier: Apache-2.0 */
/* Motion of a rigid body. */
#include "base.h"

/* Derivative (13) of position, velocity (WRF), attitude and rate (body axes) under force and torque
 * in body axes. */
static void newton_euler(const double *y, const double *wrench, double mass, const double *inertia,
                         double *out) {
    const double w = y[6], i = y[7], j = y[8], k = y[9], a = y[10], b = y[11], c = y[12];
    const double fx = wrench[0], fy = wrench[1], fz = wrench[2], ia = inertia[0], ib = inertia[1],
                 ic = inertia[2];
    const double cx = 2.0 * (j * fz - k * fy), cy = 2.0 * (k * fx - i * fz),
                 cz = 2.0 * (i * fy - j * fx);
    copy(y + 3, out, 3);
    out[3] = (fx + w * cx + (j * cz - k * cy)) / mass;
    out[4] = (fy + w * cy + (k * cx - i * cz)) / mass;
    out[5] = (fz + w * cz + (i * cy - j * cx)) / mass;
    out[6] = 0.5 * (-i * a - j * b - k * c);
    out[7] = 0.5 * (w * a + j * c - k * b);
    out[8] = 0.5 * (w * b + k * a - i * c);
    out[9] = 0.5 * (w * c + i * b - j * a);
    out[10] = (wrench[3] - (b * ic * c - c * ib * b)) / ia;
    out[11] = (wrench[4] - (c * ia * a - a * ic * c)) / ib;
    out[12] = (wrench[5] - (a * ib * b - b * ia * a)) / ic;
}

/* Step of ``h`` by RK4 of a state (13), in place, without normalization of its attitude. */
EXPORT void NAME(rigid_step)(double *y, const double *wrench, double mass, const double *inertia,
                             double h) {
    double k[4][13], at[13];
    newton_euler(y, wrench, mass, inertia, k[0]);
    for (int s = 1; s < 4; s++) {
        const double c = s == 3 ? h : 0.5 * h;
        for (int n = 0; n < 13; n++) at[n] = y[n] + c * k[s - 1][n];
        newton_euler(at, wrench, mass, inertia, k[s]);
    }
    for (int n = 0; n < 13; n++)
        y[n] += h / 6.0 * (k[0][n] + 2.0 * k[1][n] + 2.0 * k[2][n] + k[3][n]);
}

/* q' = 1/2 q (0, w) and Euler's equations I w' = (I w) x w. */
static void derivative(const double *q, const double *w, const double *inertia,
                       const double *inverse, double *dq, double *dw) {
    double momentum[3], torque[3], cross[3];
    multiply3(inertia, w, momentum);
    cross3(momentum, w, torque);
    multiply3(inverse, torque, dw);
    dq[0] = -0.5 * dot3(q + 1, w);
    cross3(q + 1, w, cross);
    for (int i = 0; i < 3; i++) dq[1 + i] = 0.5 * madd(q[0], w[i], cross[i]);
}

/* Attitudes (count, 4), rates and angular accelerations (count, 3) in body axes at 0, h, 2 h, ...
 * from q (4) and omega (3), by RK4 with step h. inertia and its inverse: (3, 3). */
EXPORT void NAME(free_rotation)(const double *q, const double *omega, const double *inertia,
                                const double *inverse, double h, int64_t count, double *attitudes,
                                double *rates, double *accelerations) {
    double y[7], k[4][7], at[7];
    copy(q, y, 4);
    copy(omega, y + 4, 3);
    for (int64_t i = 0; i < count; i++) {
        for (int s = 0; s < 4; s++) {
            double c = s == 0 ? 0.0 : (s == 3 ? h : 0.5 * h);
            for (int n = 0; n < 7; n++) at[n] = s == 0 ? y[n] : madd(c, k[s - 1][n], y[n]);
            derivative(at, at + 4, inertia, inverse, k[s], k[s] + 4);
        }
        copy(y, attitudes + 4 * i, 4);
        copy(y + 4, rates + 3 * i, 3);
        copy(k[0] + 4, accelerations + 3 * i, 3);
        for (int n = 0; n < 7; n++)
            y[n] = madd(h / 6.0, (k[0][n] + k[3][n]) + 2.0 * (k[1][n] + k[2][n]), y[n]);
        double f = 1.0 / sqrt_of((y[0] * y[0] + y[2] * y[2]) + (y[1] * y[1] + y[3] * y[3]));
        for (int n = 0; n < 4; n++) y[n] *= f;
    }
}
