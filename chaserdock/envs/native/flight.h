/* SPDX-License-Identifier: Apache-2.0 */
/* Flight of rigid bodies, four at a time.
 *
 * The steps are those of the world's engines (chaserdock_world/physics/engine.py, gyroscopic.py):
 * a load acts for one step on the state at its beginning; the gyroscopic torque is that of the
 * midpoint rule; the step moves a body with the velocity and rate at its end, the attitude by the
 * rotation of a constant rate. */
#ifndef CHASERDOCK_FLIGHT_H
#define CHASERDOCK_FLIGHT_H

#include "base.h"

enum { LANES = 4 };

/* Rows of a body's state: of the frame of its principal axes at its centre of mass. POSITION and
 * VELOCITY in WRF, ATTITUDE scalar first, RATE in that frame. Then what a flight does not change:
 * mass and principal moments, the constant disturbance (6) in that frame, and the frame itself in
 * the body: rotation (4) principal to body axes, centre of mass (3) in body axes. */
enum {
    POSITION = 0,
    VELOCITY = 3,
    ATTITUDE = 6,
    RATE = 10,
    MASS = 13,
    MOMENTS = 14,
    DISTURBANCE = 17,
    FRAME = 23,
    OFFSET = 27,
    BODY_ROWS = 30
};

typedef struct {
    v4 x[3], v[3], q[4], w[3];
} Bodies4;

static inline void load_bodies(const double *rows, int64_t pitch, Bodies4 *b) {
    for (int i = 0; i < 3; i++) {
        b->x[i] = load(rows + (POSITION + i) * pitch), b->v[i] = load(rows + (VELOCITY + i) * pitch);
        b->w[i] = load(rows + (RATE + i) * pitch);
    }
    for (int i = 0; i < 4; i++) b->q[i] = load(rows + (ATTITUDE + i) * pitch);
}

static inline v4 root4(v4 a) {
    for (int i = 0; i < LANES; i++) a[i] = sqrt_of(a[i]);
    return a;
}

/* Store the states with attitudes of unit length. */
static inline void store_bodies(const Bodies4 *b, int64_t pitch, double *rows) {
    const v4 *q = b->q;
    v4 scale = 1.0 / root4((q[0] * q[0] + q[2] * q[2]) + (q[1] * q[1] + q[3] * q[3]));
    for (int i = 0; i < 3; i++) {
        store(rows + (POSITION + i) * pitch, b->x[i]), store(rows + (VELOCITY + i) * pitch, b->v[i]);
        store(rows + (RATE + i) * pitch, b->w[i]);
    }
    for (int i = 0; i < 4; i++) store(rows + (ATTITUDE + i) * pitch, scale * q[i]);
}

/* Make ``steps`` steps of ``step_s``. ``rows``: masses and moments of the four bodies. ``wrench``
 * (6): force and torque in the bodies' frames; null for none. ``changes`` (steps, 6): what is added
 * to it before each step, null for nothing. */
static inline __attribute__((always_inline)) void fly_steps(Bodies4 *bodies, const double *rows,
                                                            int64_t pitch, v4 *wrench,
                                                            const v4 *changes, int64_t steps,
                                                            double step_s) {
    Bodies4 s = *bodies;
    const v4 h = splat(step_s), half = splat(0.5 * step_s);
    v4 per_moment[3], load6[6] = {0};
    for (int i = 0; i < 3; i++) per_moment[i] = 1.0 / load(rows + (MOMENTS + i) * pitch);
    const v4 i0 = load(rows + MOMENTS * pitch), i1 = load(rows + (MOMENTS + 1) * pitch),
             i2 = load(rows + (MOMENTS + 2) * pitch);
    const v4 ab = i1 - i0, bc = i2 - i1, ca = i0 - i2;
    const v4 push = h / load(rows + MASS * pitch);
    v4 turn[3], turn_half[3];
    for (int i = 0; i < 3; i++) turn[i] = h * per_moment[i], turn_half[i] = half * per_moment[i];
    if (wrench)
        for (int i = 0; i < 6; i++) load6[i] = wrench[i];
    for (int64_t step = 0; step < steps; step++) {
        if (wrench) {
            if (changes)
                for (int i = 0; i < 6; i++) load6[i] += changes[6 * step + i];
            const v4 c0 = 2.0 * (s.q[2] * load6[2] - s.q[3] * load6[1]),
                     c1 = 2.0 * (s.q[3] * load6[0] - s.q[1] * load6[2]),
                     c2 = 2.0 * (s.q[1] * load6[1] - s.q[2] * load6[0]);
            s.v[0] += push * (load6[0] + s.q[0] * c0 + (s.q[2] * c2 - s.q[3] * c1));
            s.v[1] += push * (load6[1] + s.q[0] * c1 + (s.q[3] * c0 - s.q[1] * c2));
            s.v[2] += push * (load6[2] + s.q[0] * c2 + (s.q[1] * c1 - s.q[2] * c0));
        }
        for (int i = 0; i < 3; i++) s.x[i] += h * s.v[i];
        /* Rates at the middle of the step, and at its end. */
        const v4 a = s.w[0], b = s.w[1], c = s.w[2];
        const v4 ma = a + turn_half[0] * (load6[3] - b * c * bc),
                 mb = b + turn_half[1] * (load6[4] - c * a * ca),
                 mc = c + turn_half[2] * (load6[5] - a * b * ab);
        s.w[0] = a + turn[0] * (load6[3] - mb * mc * bc);
        s.w[1] = b + turn[1] * (load6[4] - mc * ma * ca);
        s.w[2] = c + turn[2] * (load6[5] - ma * mb * ab);
        /* Half of the rotation vector; cosine, and sine over angle, by series: exact to rounding up
         * to 0.2 rad in a step. */
        const v4 x = half * s.w[0], y = half * s.w[1], z = half * s.w[2];
        const v4 n = (x * x + y * y) + z * z;
        const v4 cosine = 1.0 - n * (0.5 - n * (1.0 / 24 - n * (1.0 / 720 - n * (1.0 / 40320))));
        const v4 share = 1.0 - n * (1.0 / 6 - n * (1.0 / 120 - n * (1.0 / 5040)));
        const v4 ex = share * x, ey = share * y, ez = share * z;
        const v4 q0 = s.q[0], q1 = s.q[1], q2 = s.q[2], q3 = s.q[3];
        s.q[0] = (q0 * cosine - q1 * ex) - (q2 * ey + q3 * ez);
        s.q[1] = (q0 * ex + q1 * cosine) + (q2 * ez - q3 * ey);
        s.q[2] = (q0 * ey - q1 * ez) + (q2 * cosine + q3 * ex);
        s.q[3] = (q0 * ez + q1 * ey) + (q3 * cosine - q2 * ex);
    }
    if (wrench)
        for (int i = 0; i < 6; i++) wrench[i] = load6[i];
    *bodies = s;
}

#endif
