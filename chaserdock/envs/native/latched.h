/* SPDX-License-Identifier: Apache-2.0 */
/* Chasers that are fixed to their target. */
#ifndef CHASERDOCK_LATCHED_H
#define CHASERDOCK_LATCHED_H

#include "observe.h"

/* Fix a chaser that docks to its target, where it is. */
static void fix_to_target(const Task *t, Batch *b, int64_t chaser, const Motion *target) {
    double y[MOTION_ROWS], apart[3], place[3], back[4], q[4];
    for (int i = 0; i < MOTION_ROWS; i++) y[i] = b->bodies[i * t->pitch + chaser];
    subtract3(y, target->x, apart);
    q_rotate_inverse(target->q, apart, place);
    q_conjugate(target->q, back);
    q_multiply(back, y + ATTITUDE, q);
    for (int i = 0; i < 3; i++) b->docked[i * t->pitch + chaser] = place[i];
    for (int i = 0; i < 4; i++) b->docked[(3 + i) * t->pitch + chaser] = q[i];
}

/* Motion of a frame that is fixed to its target, at a place (3) and with an attitude (4) in TRF. */
static inline void fixed_motion(const double *place, const double *turn, const Motion *target,
                                Motion *out) {
    double arm[3], turning[3];
    q_rotate(target->q, place, arm);
    cross3(target->w, place, turning);
    q_rotate(target->q, turning, turning);
    for (int i = 0; i < 3; i++) {
        out->x[i] = target->x[i] + arm[i];
        out->v[i] = target->v[i] + turning[i];
    }
    q_multiply(target->q, turn, out->q);
    q_rotate_inverse(turn, target->w, out->w);
}

/* Move a docked chaser with its target. */
static void carry(const Task *t, Batch *b, int64_t chaser, const Motion *target) {
    double fixed[DOCKED_ROWS], *rows = b->bodies + chaser;
    Motion m;
    for (int i = 0; i < DOCKED_ROWS; i++) fixed[i] = b->docked[i * t->pitch + chaser];
    fixed_motion(fixed, fixed + 3, target, &m);
    for (int i = 0; i < 3; i++) {
        rows[(POSITION + i) * t->pitch] = m.x[i];
        rows[(VELOCITY + i) * t->pitch] = m.v[i];
        rows[(RATE + i) * t->pitch] = m.w[i];
    }
    for (int i = 0; i < 4; i++) rows[(ATTITUDE + i) * t->pitch] = m.q[i];
}

/* Speed of a stack's centre of mass (WRF), and its angular rate. */
static inline void stack_rates(const Task *t, const Batch *b, int64_t e, double *speed,
                               double *rate) {
    double v[3], w[3];
    for (int i = 0; i < 3; i++) {
        v[i] = b->targets[(VELOCITY + i) * t->target_pitch + e];
        w[i] = b->targets[(RATE + i) * t->target_pitch + e];
    }
    *speed = sqrt_of(dot3(v, v));
    *rate = sqrt_of(dot3(w, w));
}

#endif
