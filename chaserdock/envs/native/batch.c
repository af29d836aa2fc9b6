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

/* Convert levels (actuators) to pulses of whole steps, none below the shortest; a pulse that would
 * end during the fall before the next tick lasts until it. Returns the impulse, N s. */
static double set_pulses(const Task *t, Batch *b, int64_t chaser, const float *levels, int valid) {
    double impulse = 0.0;
    for (int64_t j = 0; j < t->actuators; j++) {
        int64_t *pulse = b->pulse + chaser * t->actuators + j;
        int64_t *opened = b->opened + chaser * t->actuators + j;
        *opened = *pulse == t->steps;
        double level = valid ? (double)levels[j] : 0.0;
        level = level > 0.0 ? min_of(level, 1.0) : 0.0;
        int64_t width = (int64_t)(level * (double)t->steps + 0.5);
        if (width < t->shortest[j]) width = 0;
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

/* Fly four chasers for a tick under their last actions until these end, and then under the new
 * ones. The impulse of each is left in the reward. */
static void fly_chasers(const Task *t, Batch *b, int64_t first) {
    const int64_t pitch = t->pitch, all = t->environments * t->chasers, late = t->latency_steps;
    const int64_t lanes = all - first < LANES ? all - first : LANES;
    double *rows = b->bodies + first, *wrench = b->wrench + first;
    Bodies4 bodies;
    v4 load6[6], *changes = (v4 *)b->work;
    load_bodies(rows, pitch, &bodies);
    for (int i = 0; i < 6; i++) load6[i] = load(wrench + i * pitch);
    if (t->pulsed) {
        for (int64_t i = 0; i < 6 * t->steps; i++) changes[i] = splat(0.0);
        for (int64_t lane = 0; lane < lanes; lane++) {
            const int64_t chaser = first + lane, actuators = t->actuators;
            const double *columns = plant_of(t, b, chaser) + BODY_ROWS - MASS;
            double *out = b->work + lane;
            add_pulses(t, b, chaser, t->steps - late, t->steps, 0, columns, out);
            b->rewards[chaser] = set_pulses(t, b, chaser, b->actions + chaser * actuators,
                                            !b->idle[chaser / t->chasers]);
            add_pulses(t, b, chaser, 0, t->steps - late, late, columns, out);
        }
        fly_steps(&bodies, rows, pitch, load6, changes, t->steps, t->step_s);
    } else {
        fly_steps(&bodies, rows, pitch, load6, NULL, late, t->step_s);
        for (int i = 0; i < 6; i++) load6[i] = load(rows + (DISTURBANCE + i) * pitch);
        for (int64_t lane = 0; lane < lanes; lane++) {
            const int64_t chaser = first + lane;
            const double *columns = plant_of(t, b, chaser) + BODY_ROWS - MASS;
            const float *levels = b->actions + chaser * t->actuators;
            double impulse = 0.0;
            for (int64_t j = 0; j < t->actuators; j++) {
                double level = b->idle[chaser / t->chasers] ? 0.0 : (double)levels[j];
                level = level > 1.0 ? 1.0 : level < -1.0 ? -1.0 : level;
                for (int i = 0; i < 6; i++) load6[i][lane] += level * columns[6 * j + i];
                impulse += t->effort_N_s[j] * abs_of(level);
            }
            b->rewards[chaser] = impulse;
        }
        fly_steps(&bodies, rows, pitch, load6, NULL, t->steps - late, t->step_s);
    }
    for (int i = 0; i < 6; i++) store(wrench + i * pitch, load6[i]);
    store_bodies(&bodies, pitch, rows);
}

/* Fly all environments for a tick; what is done starts anew instead. An environment with an action
 * that is not finite flies without thrust and is `rejected`. */
EXPORT void NAME(step_batch)(const Task *t, Batch *b) {
    for (int64_t e = 0; e < t->environments; e++) {
        b->idle[e] = b->done[e] || !valid_actions(t, b, e);
        b->rejected[e] += !b->done[e] && b->idle[e];
    }
    for (int64_t i = 0; i < t->target_pitch; i += LANES) {
        Bodies4 bodies;
        load_bodies(b->targets + i, t->target_pitch, &bodies);
        fly_steps(&bodies, b->targets + i, t->target_pitch, NULL, NULL, t->steps, t->step_s);
        store_bodies(&bodies, t->target_pitch, b->targets + i);
    }
    for (int64_t i = 0; i < t->pitch; i += LANES) fly_chasers(t, b, i);
    for (int64_t e = 0; e < t->environments; e++)
        if (b->done[e])
            start(t, b, e);
        else
            judge(t, b, e);
}

/* Start the environments whose `done` is set. */
EXPORT void NAME(start_batch)(const Task *t, Batch *b) {
    for (int64_t e = 0; e < t->environments; e++)
        if (b->done[e]) start(t, b, e);
}
