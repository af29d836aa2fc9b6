/* SPDX-License-Identifier: Apache-2.0 */
/* Where a lens images a ray: the models of chaserdock_models/lenses.py. */
#ifndef CHASERDOCK_LENS_H
#define CHASERDOCK_LENS_H

#include "elementary.h"

/* `kind`: 0 ideal, 1 perspective with k1, k2, p1, p2, k3 at most, 2 perspective with all
 * coefficients, 3 equidistant. `valid_square`: squared distance from the axis, in ideal
 * coordinates, beyond which there is no image. `k`: coefficients; `tilt` (3, 3): onto a tilted
 * sensor. */
typedef struct {
    double kind, valid_square, k[14], tilt[9];
} Lens;
LAYOUT(Lens, kind, valid_square, k, tilt)

static inline void distort_equidistant(const double *k, double x, double y, double r2,
                                       double *out) {
    double r = sqrt_of(r2), theta = arctangent(r), t2 = theta * theta;
    double image = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
    double scale = r > 1e-8 ? image / r : 1.0;
    out[0] = x * scale, out[1] = y * scale;
}

/* Convert ideal coordinates (x / z, y / z) of a ray to distorted ones; NaN beyond the lens. */
static inline void distort_ray(const Lens *lens, double x, double y, double *out) {
    const double *k = lens->k;
    double r2 = x * x + y * y;
    if (!(r2 < lens->valid_square)) {
        out[0] = out[1] = __builtin_nan("");
        return;
    }
    if (lens->kind == 3.0) {
        distort_equidistant(k, x, y, r2, out);
        return;
    }
    double radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]));
    if (lens->kind == 2.0) radial = radial / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])));
    out[0] = x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x);
    out[1] = y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y;
    if (lens->kind != 2.0) return;
    double flat[3] = {out[0] + r2 * (k[8] + r2 * k[9]), out[1] + r2 * (k[10] + r2 * k[11]), 1.0},
           seen[3];
    multiply3(lens->tilt, flat, seen);
    out[0] = seen[0] / seen[2], out[1] = seen[1] / seen[2];
}

#endif
