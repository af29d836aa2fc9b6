/* SPDX-License-Identifier: Apache-2.0 */
/* A batch of environments: chasers and their target in free flight, contacts as events, rewards and
 * observations. */
#include "batch.h"
#include "observe.h"
#include "start.h"
#include "judge.h"

/* Add to ``out`` (steps, 6, LANES), from its step ``at``, the changes of an actuator's wrench
 * ``column`` (6) of which the first comes in step ``begin`` of a tick: those in its steps ``from``
 * to before ``to``. ``shares`` (count): changes of the thrust. */
static void add_changes(const double *shares, int64_t count, double sign, int64_t begin,
                        int64_t from, int64_t to, int64_t at, const double *column, double *out) {
    int64_t first = from > begin ? from : begin, last = begin + count < to ? begin + count : to;
    for (int64_t i = first; i < last; i++) {
        const double share = sign * shares[i - begin];
        for (int k = 0; k < 6; k++) out[LANES * (6 * (at + i - from) + k)] += share * column[k];
    }
}

/* Add to ``out`` (steps, 6, LANES), from its step ``at``, what the last pulses of a chaser change in
 * the steps ``from`` to before ``to`` of their tick. ``columns`` (actuators, 6). */
static void add_pulses(const Task *t, const Batch *b, int64_t chaser, int64_t from, int64_t to,
                       int64_t at, const double *columns, double *out) {
    for (int64_t j = 0; j < t->actuators; j++) {
        const int64_t width = b->pulse[chaser * t->actuators + j];
        const int64_t opened = b->opened[chaser * t->actuators + j];
        if (width > 0 && !opened)
            add_changes(t->rise + j * t->steps, t->rise_steps[j], 1.0, 0, from, to, at,
                        columns + 6 * j, out);
        if (width > 0 || opened)
            add_changes(t->fall + j * t->steps, t->fall_steps[j], -1.0, width, from, to, at,
                        columns + 6 * j, out);
    }
}

/* Convert levels (actuators) to pulses of whole steps, none below the shortest, and none of a closed
 * thruster; a pulse that would end during the fall before the next tick lasts until it. Returns the
 * impulse, N s. */
static double set_pulses(const Task *t, Batch *b, int64_t chaser, const float *levels, int valid) {
    const int64_t number = chaser % t->chasers, *closed = t->stack.closed;
    double impulse = 0.0;
    if (closed) closed += number * t->actuators;
    for (int64_t j = 0; j < t->actuators; j++) {
        int64_t *pulse = b->pulse + chaser * t->actuators + j;
        int64_t *opened = b->opened + chaser * t->actuators + j;
        *opened = *pulse == t->steps;
        double level = valid ? (double)levels[j] : 0.0;
        level = level > 0.0 ? min_of(level, 1.0) : 0.0;
        int64_t width = (int64_t)(level * (double)t->steps + 0.5);
        if (width < t->shortest[j]) width = 0;
        if (closed && closed[j]) width = 0;
        if (width > t->longest[j]) width = t->steps;
        *pulse = width;
        impulse += t->effort_N_s[j] * (double)width;
    }
    return impulse / (double)t->steps;
}

static inline const double *plant_of(const Task *t, const Batch *b, int64_t chaser) {
    int64_t environment = chaser / t->chasers, number = chaser % t->chasers;
    return t->chaser_plants + (b->plant[environment] * t->chasers + number) *
                                  (BODY_ROWS - MASS + 6 * t->actuators);
}

static int valid_actions(const Task *t, const Batch *b, int64_t environment) {
    const int64_t count = t->chasers * t->actuators;
    const float *actions = b->actions + environment * count;
    for (int64_t i = 0; i < count; i++)
        if (!finite((double)actions[i])) return 0;
    return 1;
}

/* Fly four bodies for a tick under the last actions until these end, and then under the new ones:
 * chasers, or the stacks of ``per`` chasers each. ``rows`` (BODY_ROWS, pitch); ``count``: number of
 * bodies, of which the first is ``first``. The impulse of each chaser is left in its reward. */
static inline __attribute__((always_inline)) void fly_four(const Task *t, Batch *b, double *rows,
                                                           int64_t pitch, int64_t count,
                                                           int64_t first, int64_t per) {
    const int64_t late = t->latency_steps, actuators = t->actuators;
    const int64_t lanes = count - first < LANES ? count - first : LANES;
    double *wrench = b->wrench + first;
    Bodies4 bodies;
    v4 load6[6], *changes = (v4 *)b->work;
    rows += first;
    load_bodies(rows, pitch, &bodies);
    for (int i = 0; i < 6; i++) load6[i] = load(wrench + i * t->pitch);
    if (t->pulsed) {
        for (int64_t i = 0; i < 6 * t->steps; i++) changes[i] = splat(0.0);
        for (int64_t k = 0; k < lanes * per; k++) {
            const int64_t chaser = first * per + k;
            const double *columns = plant_of(t, b, chaser) + BODY_ROWS - MASS;
            double *out = b->work + k / per;
            add_pulses(t, b, chaser, t->steps - late, t->steps, 0, columns, out);
            b->rewards[chaser] = set_pulses(t, b, chaser, b->actions + chaser * actuators,
                                            !b->idle[chaser / t->chasers]);
            add_pulses(t, b, chaser, 0, t->steps - late, late, columns, out);
        }
        fly_steps(&bodies, rows, pitch, load6, changes, t->steps, t->step_s);
    } else {
        fly_steps(&bodies, rows, pitch, load6, NULL, late, t->step_s);
        for (int i = 0; i < 6; i++) load6[i] = load(rows + (DISTURBANCE + i) * pitch);
        for (int64_t k = 0; k < lanes * per; k++) {
            const int64_t chaser = first * per + k, lane = k / per;
            const double *columns = plant_of(t, b, chaser) + BODY_ROWS - MASS;
            const float *levels = b->actions + chaser * actuators;
            double impulse = 0.0;
            for (int64_t j = 0; j < actuators; j++) {
                double level = b->idle[chaser / t->chasers] ? 0.0 : (double)levels[j];
                level = level > 1.0 ? 1.0 : level < -1.0 ? -1.0 : level;
                for (int i = 0; i < 6; i++) load6[i][lane] += level * columns[6 * j + i];
                impulse += t->effort_N_s[j] * abs_of(level);
            }
            b->rewards[chaser] = impulse;
        }
        fly_steps(&bodies, rows, pitch, load6, NULL, t->steps - late, t->step_s);
    }
    for (int i = 0; i < 6; i++) store(wrench + i * t->pitch, load6[i]);
    store_bodies(&bodies, pitch, rows);
}

/* Fly targets and chasers for a tick. */
static void fly_free(const Task *t, Batch *b) {
    for (int64_t i = 0; i < t->target_pitch; i += LANES) {
        Bodies4 bodies;
        load_bodies(b->targets + i, t->target_pitch, &bodies);
        fly_steps(&bodies, b->targets + i, t->target_pitch, NULL, NULL, t->steps, t->step_s);
        store_bodies(&bodies, t->target_pitch, b->targets + i);
    }
    for (int64_t i = 0; i < t->pitch; i += LANES)
        fly_four(t, b, b->bodies, t->pitch, t->environments * t->chasers, i, 1);
}

/* Fly stacks for a tick; the wrench of each is in the column of its environment. */
static void fly_stacks(const Task *t, Batch *b) {
    for (int64_t i = 0; i < t->target_pitch; i += LANES)
        fly_four(t, b, b->targets, t->target_pitch, t->environments, i, t->chasers);
}

/* Fly all environments for a tick; what is done starts anew instead. An environment with an action
 * that is not finite flies without thrust and is `rejected`. */
EXPORT void NAME(step_batch)(const Task *t, Batch *b) {
    for (int64_t e = 0; e < t->environments; e++) {
        b->idle[e] = b->done[e] || !valid_actions(t, b, e);
        b->rejected[e] += !b->done[e] && b->idle[e];
    }
    if (t->task == DETUMBLE)
        fly_stacks(t, b);
    else
        fly_free(t, b);
    for (int64_t e = 0; e < t->environments; e++)
        if (b->done[e])
            start(t, b, e);
        else if (t->task == DETUMBLE)
            judge_stack(t, b, e);
        else
            judge(t, b, e);
}

/* Start the environments whose `done` is set. */
EXPORT void NAME(start_batch)(const Task *t, Batch *b) {
    for (int64_t e = 0; e < t->environments; e++)
        if (b->done[e]) start(t, b, e);
}
