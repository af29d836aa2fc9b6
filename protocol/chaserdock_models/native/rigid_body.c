/* SPDX-License-Identifier: Apache-2.0 */
/* Rotation of a free rigid body. */
#include "base.h"

/* q' = 1/2 q (0, w) and Euler's equations I w' = (I w) x w. */
static void derivative(const double *q, const double *w, const double *inertia, const double *inverse, double *dq,
                       double *dw) {
    double momentum[3], torque[3], cross[3];
    multiply3(inertia, w, momentum);
    cross3(momentum, w, torque);
    multiply3(inverse, torque, dw);
    dq[0] = -0.5 * dot3(q + 1, w);
    cross3(q + 1, w, cross);
    for (int i = 0; i < 3; i++) dq[1 + i] = 0.5 * madd(q[0], w[i], cross[i]);
}

/* Attitudes (count, 4), rates and angular accelerations (count, 3) in body axes at 0, h, 2 h, ... from q (4) and
 * omega (3), by RK4 with step h. inertia and its inverse: (3, 3). */
EXPORT void NAME(free_rotation)(const double *q, const double *omega, const double *inertia, const double *inverse,
                    double h, int64_t count, double *attitudes, double *rates, double *accelerations) {
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
