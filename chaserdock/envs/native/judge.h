/* SPDX-License-Identifier: Apache-2.0 */
/* The end of a tick: events, rewards, observations. */
#ifndef CHASERDOCK_JUDGE_H
#define CHASERDOCK_JUDGE_H

#include "latched.h"
#include "observe.h"
#include "probe.h"
#include "surface.h"

/* Whether a chaser is nearer to the target than allowed: nearer than the criterion of missions, or
 * nearer than the keep-out distance outside of its cone. */
static int too_near(const Task *t, const Place *place, const Relative *s) {
    double square = dot3(s->r, s->r), near = place->nearest_m, keep = t->keep_target_m;
    if (square < near * near) return 1;
    if (!(square < keep * keep)) return 0;
    double along = dot3(s->r, place->cone_axis), aside[3];
    for (int i = 0; i < 3; i++) aside[i] = s->r[i] - along * place->cone_axis[i];
    double room = place->cone_sine * (along - place->cone_apex_m) -
                  place->cone_cosine * sqrt_of(dot3(aside, aside));
    return !(room >= 0.0);
}

/* Return the event of a chaser in this tick. ``before``, ``now``: at its ends. */
static int event_of(const Task *t, const Place *place, const Relative *s, const ProbeState *before,
                    const ProbeState *now, double within_ticks) {
    if (!(dot3(s->r, s->r) <= t->farthest_m * t->farthest_m) || !(now->turning <= t->fastest_rad_s))
        return LOST;
    if (t->task == LATCH && before->gap > 0.0 && now->gap <= 0.0) {
        ProbeState contact;
        between(before, now, before->gap / (before->gap - now->gap), &contact);
        if (contact.lateral <= t->contact.lateral_m)
            return within(&contact, &t->contact) ? DOCKED : COLLIDED;
    }
    if (collides(t, s)) return COLLIDED;
    if (too_near(t, place, s)) return TOO_NEAR;
    if (t->task == COME && within_ticks >= (double)t->held_ticks) return DOCKED;
    return FLYING;
}

/* Judge a stack after a tick, as `judge` does free chasers: all chasers have one outcome. */
static void judge_stack(const Task *t, Batch *b, int64_t e) {
    const int64_t first = e * t->chasers, pitch = t->pitch;
    const Weights *w = &t->weights;
    Motion target;
    Relative states[MAX_CHASERS];
    double others[3 * MAX_CHASERS], speed, rate;
    read_motion(b->targets + e, t->target_pitch, &target);
    stack_rates(t, b, e, &speed, &rate);
    b->age[e]++;
    const int good = speed <= t->stack.speed_m_s && rate <= t->stack.rate_rad_s;
    double *memory = b->memory + first, *ticks = memory + WITHIN * pitch;
    const double slower = memory[AWAY * pitch] - speed, calmer = memory[TURNED * pitch] - rate;
    memory[AWAY * pitch] = speed, memory[TURNED * pitch] = rate;
    *ticks = good ? *ticks + 1.0 : 0.0;
    int event = !(rate <= t->fastest_rad_s)                ? LOST
                : *ticks >= (double)t->held_ticks          ? STOPPED
                : b->age[e] >= t->episode_ticks            ? TIME_OUT
                                                           : FLYING;
    for (int64_t i = 0; i < t->chasers; i++) {
        Motion m;
        carry(t, b, first + i, &target);
        read_motion(b->bodies + first + i, pitch, &m);
        relative_motion(&m, &target, states + i);
        copy(states[i].r, others + 3 * i, 3);
    }
    for (int64_t i = 0; i < t->chasers; i++) {
        double *reward = b->rewards + first + i;
        *reward = w->drift_per_m_s * slower + w->spin_per_rad_s * calmer -
                  w->impulse_per_N_s * *reward -
                  t->tick_s * (w->time_per_s - (good ? w->within_per_s : 0.0)) +
                  (event == STOPPED ? w->success : 0.0) - (event == LOST ? w->failure : 0.0);
        b->outcome[first + i] = event;
        b->terminated[first + i] = event == STOPPED || event == LOST;
        b->truncated[first + i] = event == TIME_OUT;
        observe(t, b, first + i, i, states + i, &target, others);
    }
    b->done[e] = event != FLYING;
}

/* Judge an environment after a tick: outcome, reward and observation of each chaser. `rewards` holds
 * the impulse of each. */
static void judge(const Task *t, Batch *b, int64_t e) {
    const int64_t first = e * t->chasers, pitch = t->pitch, count = t->chasers;
    const Weights *w = &t->weights;
    Motion target;
    Relative states[MAX_CHASERS];
    double others[3 * MAX_CHASERS], gained[MAX_CHASERS];
    int failed = 0, flying = 0, complete = 0;
    read_motion(b->targets + e, t->target_pitch, &target);
    b->age[e]++;
    for (int64_t i = 0; i < count; i++) {
        Motion m;
        if (b->outcome[first + i] == DOCKED) carry(t, b, first + i, &target);
        read_motion(b->bodies + first + i, pitch, &m);
        relative_motion(&m, &target, states + i);
        copy(states[i].r, others + 3 * i, 3);
    }
    if (t->task == INSPECT) complete = inspect(t, b, e, states, &target, gained);
    for (int64_t i = 0; i < count; i++) {
        const int64_t chaser = first + i;
        double *reward = b->rewards + chaser;
        const double impulse = *reward;
        b->terminated[chaser] = b->truncated[chaser] = 0;
        *reward = 0.0;
        if (b->outcome[chaser] == DOCKED) continue;
        ProbeState before, now;
        recall(t, b, chaser, &before);
        probe_state(t, t->places + i, states + i, &now);
        remember(t, b, chaser, &now);
        double *ticks = b->memory + WITHIN * pitch + chaser;
        const int good = now.away <= t->held_m && now.turned <= t->held_rad;
        *ticks = good ? *ticks + 1.0 : 0.0;
        int event = event_of(t, t->places + i, states + i, &before, &now, *ticks);
        for (int64_t k = 0; k < count && event == FLYING; k++) {
            double apart[3];
            subtract3(states[i].r, states[k].r, apart);
            if (k != i && dot3(apart, apart) < t->keep_chasers_m * t->keep_chasers_m)
                event = TOO_NEAR;
        }
        if (event == FLYING && complete) event = INSPECTED;
        if (event == FLYING && b->age[e] >= t->episode_ticks)
            event = t->task == HOLD && *ticks >= (double)t->held_ticks ? HELD : TIME_OUT;
        const ProbeLimits *limits = now.gap < t->final_m ? &t->final : &t->corridor;
        const int outside = t->task == LATCH && now.gap < t->entry_m && !within(&now, limits);
        *reward = w->progress_per_m * (before.away - now.away) +
                  w->turn_per_rad * (before.turned - now.turned) - w->impulse_per_N_s * impulse -
                  t->tick_s * (w->distance_per_m_s * now.away + w->angle_per_rad_s * now.turned +
                               w->time_per_s + (outside ? w->corridor_per_s : 0.0) -
                               (good ? w->within_per_s : 0.0));
        if (t->task == INSPECT) *reward += w->seen * gained[i];
        if (event == DOCKED || event == HELD || event == INSPECTED) *reward += w->success;
        b->outcome[chaser] = event;
        if (event == DOCKED) fix_to_target(t, b, chaser, &target);
        b->terminated[chaser] = event == DOCKED || event == COLLIDED || event == TOO_NEAR ||
                                event == LOST || event == INSPECTED;
        b->truncated[chaser] = event == HELD || event == TIME_OUT;
        failed |= event == COLLIDED || event == TOO_NEAR || event == LOST;
        flying |= event == FLYING;
        if (t->statistical) advance_errors(t, b, e, chaser, states + i);
        observe(t, b, chaser, i, states + i, &target, others);
    }
    for (int64_t chaser = first; failed && chaser < first + count; chaser++) {
        const int64_t outcome = b->outcome[chaser];
        if (outcome == DOCKED) continue;
        b->rewards[chaser] -= w->failure;
        if (outcome == FLYING) b->outcome[chaser] = AFTER_OTHERS, b->terminated[chaser] = 1;
    }
    b->done[e] = failed || !flying;
}

#endif
