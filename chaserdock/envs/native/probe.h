/* SPDX-License-Identifier: Apache-2.0 */
/* A chaser at its goal and its port, as chaserdock_models.docking_geometry.view_of has it, and
 * contact of its body with the target's. */
#ifndef CHASERDOCK_PROBE_H
#define CHASERDOCK_PROBE_H

#include "observe.h"

enum { MAX_CHASERS = 16 };

/* Distance (m) and angle (rad) from the goal; the probe's tip in the port's rotating frame. */
typedef struct {
    double away, turned, gap, lateral, lateral_speed, closing, turning;
} ProbeState;

static inline void probe_state(const Task *t, const Place *place, const Relative *s,
                               ProbeState *out) {
    double off[3], error[4], arm[3] = {t->reach_m, 0.0, 0.0}, tip[3], turning[3], speed[3];
    subtract3(s->r, place->goal_m, off);
    attitude_error(place, s->q, error);
    out->away = sqrt_of(dot3(off, off));
    out->turned = q_angle(error);
    out->turning = sqrt_of(dot3(s->w, s->w));
    cross3(s->w, arm, turning);
    q_rotate(s->q, arm, tip);
    q_rotate(s->q, turning, speed);
    for (int i = 0; i < 3; i++) tip[i] += s->r[i] - place->port_m[i], speed[i] += s->v[i];
    out->gap = dot3(tip, place->port_axis);
    out->closing = -dot3(speed, place->port_axis);
    for (int i = 0; i < 3; i++) {
        tip[i] -= out->gap * place->port_axis[i];
        speed[i] += out->closing * place->port_axis[i];
    }
    out->lateral = sqrt_of(dot3(tip, tip));
    out->lateral_speed = sqrt_of(dot3(speed, speed));
}

static inline void remember(const Task *t, Batch *b, int64_t chaser, const ProbeState *s) {
    double *memory = b->memory + chaser;
    memory[AWAY * t->pitch] = s->away, memory[TURNED * t->pitch] = s->turned;
    memory[GAP * t->pitch] = s->gap, memory[LATERAL * t->pitch] = s->lateral;
    memory[LATERAL_SPEED * t->pitch] = s->lateral_speed, memory[CLOSING * t->pitch] = s->closing;
    memory[TURNING * t->pitch] = s->turning;
}

static inline void recall(const Task *t, const Batch *b, int64_t chaser, ProbeState *s) {
    const double *memory = b->memory + chaser;
    s->away = memory[AWAY * t->pitch], s->turned = memory[TURNED * t->pitch];
    s->gap = memory[GAP * t->pitch], s->lateral = memory[LATERAL * t->pitch];
    s->lateral_speed = memory[LATERAL_SPEED * t->pitch], s->closing = memory[CLOSING * t->pitch];
    s->turning = memory[TURNING * t->pitch];
}

/* State between two ticks, after this share of the tick. */
static inline void between(const ProbeState *from, const ProbeState *to, double share,
                           ProbeState *out) {
    out->away = from->away + share * (to->away - from->away);
    out->turned = from->turned + share * (to->turned - from->turned);
    out->gap = from->gap + share * (to->gap - from->gap);
    out->lateral = from->lateral + share * (to->lateral - from->lateral);
    out->lateral_speed =
        from->lateral_speed + share * (to->lateral_speed - from->lateral_speed);
    out->closing = from->closing + share * (to->closing - from->closing);
    out->turning = from->turning + share * (to->turning - from->turning);
}

/* Whether all limits hold; NaN violates them. */
static inline int within(const ProbeState *s, const ProbeLimits *limits) {
    return s->lateral <= limits->lateral_m && s->turned <= limits->angle_rad &&
           s->lateral_speed <= limits->lateral_speed_m_s && s->closing <= limits->closing_m_s &&
           s->turning <= limits->rate_rad_s;
}

/* Whether two boxes overlap: half edges a and b, b's centre and axes (columns) in the axes of a. No
 * axis that is normal to faces or to two edges separates them (S. Gottschalk et al., 1996). */
static int boxes_overlap(const double *a, const double *b, const double *centre, const double *axes) {
    double size[9];
    for (int i = 0; i < 9; i++) size[i] = abs_of(axes[i]) + 1e-12;
    for (int i = 0; i < 3; i++)
        if (abs_of(centre[i]) > a[i] + dot3(b, size + 3 * i)) return 0;
    for (int j = 0; j < 3; j++) {
        double along = centre[0] * axes[j] + centre[1] * axes[3 + j] + centre[2] * axes[6 + j];
        if (abs_of(along) > b[j] + a[0] * size[j] + a[1] * size[3 + j] + a[2] * size[6 + j]) return 0;
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
            double along = centre[i2] * axes[3 * i1 + j] - centre[i1] * axes[3 * i2 + j];
            double reach = a[i1] * size[3 * i2 + j] + a[i2] * size[3 * i1 + j] +
                           b[j1] * size[3 * i + j2] + b[j2] * size[3 * i + j1];
            if (abs_of(along) > reach) return 0;
        }
    return 1;
}

/* Whether the segment of this middle and half extent (3) meets the box with these half edges (C.
 * Ericson, "Real-Time Collision Detection", 2005, section 5.3.3). */
static int segment_meets(const double *middle, const double *extent, const double *half) {
    double size[3];
    for (int i = 0; i < 3; i++) {
        size[i] = abs_of(extent[i]);
        if (abs_of(middle[i]) > half[i] + size[i]) return 0;
    }
    for (int i = 0; i < 3; i++) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        double along = abs_of(middle[j] * extent[k] - middle[k] * extent[j]);
        if (along > half[j] * size[k] + half[k] * size[j] + 1e-12) return 0;
    }
    return 1;
}

/* Whether a chaser's cuboid or probe meets one of the target's. */
static int collides(const Task *t, const Relative *s) {
    const double radius = sqrt_of(dot3(t->half_m, t->half_m)), front = t->half_m[0];
    for (int64_t i = 0; i < t->boxes; i++) {
        const double *box = t->solids + 16 * i, *turn = box + 6;
        double apart[3], centre[3], axes[9], unit[3][3];
        subtract3(s->r, box + 3, apart);
        double reach = max_of(radius, t->reach_m) + box[15];
        if (dot3(apart, apart) > reach * reach) continue;
        for (int j = 0; j < 3; j++) {
            double own[3] = {0.0, 0.0, 0.0};
            own[j] = 1.0;
            q_rotate(s->q, own, unit[j]);
        }
        for (int r = 0; r < 3; r++) {
            const double column[3] = {turn[r], turn[3 + r], turn[6 + r]};
            centre[r] = dot3(column, apart);
            for (int j = 0; j < 3; j++) axes[3 * r + j] = dot3(column, unit[j]);
        }
        if (boxes_overlap(box, t->half_m, centre, axes)) return 1;
        if (t->task != LATCH) continue;
        double middle[3], extent[3];
        for (int r = 0; r < 3; r++) {
            middle[r] = centre[r] + 0.5 * (front + t->reach_m) * axes[3 * r];
            extent[r] = 0.5 * (t->reach_m - front) * axes[3 * r];
        }
        if (segment_meets(middle, extent, box)) return 1;
    }
    return 0;
}

#endif
