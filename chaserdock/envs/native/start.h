/* SPDX-License-Identifier: Apache-2.0 */
/* The start of an episode. */
#ifndef CHASERDOCK_START_H
#define CHASERDOCK_START_H

#include "latched.h"
#include "observe.h"
#include "probe.h"
#include "surface.h"

static inline void spread3(uint64_t *random, double half_width, double *out) {
    for (int i = 0; i < 3; i++) out[i] = half_width * next_uniform(random);
}

/* Write a body's properties, and its motion in the frame of its principal axes. */
static void place_body(const Motion *m, const double *plant, int64_t pitch, double *rows) {
    for (int i = MASS; i < BODY_ROWS; i++) rows[i * pitch] = plant[i - MASS];
    write_motion(m, plant + FRAME - MASS, plant + OFFSET - MASS, pitch, rows);
}

static void start(const Task *t, Batch *b, int64_t e) {
    uint64_t *random = b->random + e;
    const int64_t plant = (int64_t)(next_bits(random) % (uint64_t)t->plants), pitch = t->pitch;
    b->plant[e] = plant, b->age[e] = 0, b->done[e] = 0, b->rejected[e] = 0;
    Motion target;
    double spread[3], others[3 * MAX_CHASERS];
    copy(t->target_start, target.x, MOTION_ROWS);
    spread3(random, t->target_spread_rad_s, spread);
    for (int i = 0; i < 3; i++) target.w[i] += spread[i];
    place_body(&target, t->target_plants + plant * (BODY_ROWS - MASS), t->target_pitch,
               b->targets + e);
    for (int i = 0; i < 6 && t->task == DETUMBLE; i++)
        b->wrench[i * pitch + e] = b->targets[(DISTURBANCE + i) * t->target_pitch + e];
    for (int64_t number = 0; number < t->chasers; number++) {
        const int64_t chaser = e * t->chasers + number;
        const Place *place = t->places + number;
        const double *body = t->chaser_plants +
                             (plant * t->chasers + number) * (BODY_ROWS - MASS + 6 * t->actuators);
        Motion m;
        double turn[4];
        for (int i = 0; i < 3; i++) m.x[i] = place->start_m[i] + t->spread_m[i] * next_uniform(random);
        spread3(random, t->spread_rad, spread);
        q_exp(spread, turn);
        q_multiply(place->start_wxyz, turn, m.q);
        spread3(random, t->spread_m_s, m.v);
        for (int i = 0; i < 3; i++) m.v[i] += place->start_velocity_m_s[i];
        spread3(random, t->spread_rad_s, m.w);
        if (t->task == DETUMBLE) fixed_motion(place->goal_m, place->goal_wxyz, &target, &m);
        place_body(&m, body, pitch, b->bodies + chaser);
        if (t->task == DETUMBLE) fix_to_target(t, b, chaser, &target);
        for (int i = 0; i < 6 && t->task != DETUMBLE; i++)
            b->wrench[i * pitch + chaser] = body[DISTURBANCE - MASS + i];
        for (int64_t j = 0; j < t->actuators; j++)
            b->pulse[chaser * t->actuators + j] = b->opened[chaser * t->actuators + j] = 0;
    }
    read_motion(b->targets + e, t->target_pitch, &target);
    if (t->task == INSPECT) forget_surface(t, b, e);
    Relative states[MAX_CHASERS];
    for (int64_t number = 0; number < t->chasers; number++) {
        Motion m;
        read_motion(b->bodies + e * t->chasers + number, pitch, &m);
        relative_motion(&m, &target, states + number);
        copy(states[number].r, others + 3 * number, 3);
    }
    for (int64_t number = 0; number < t->chasers; number++) {
        const int64_t chaser = e * t->chasers + number;
        ProbeState now;
        probe_state(t, t->places + number, states + number, &now);
        remember(t, b, chaser, &now);
        b->memory[WITHIN * pitch + chaser] = 0.0;
        if (t->task == DETUMBLE)
            stack_rates(t, b, e, b->memory + AWAY * pitch + chaser,
                        b->memory + TURNED * pitch + chaser);
        if (t->statistical) draw_errors(t, b, e, chaser, states + number);
        observe(t, b, chaser, number, states + number, &target, others);
        b->rewards[chaser] = 0.0, b->outcome[chaser] = FLYING;
        b->terminated[chaser] = b->truncated[chaser] = 0;
    }
}

#endif
