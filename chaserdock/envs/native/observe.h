/* SPDX-License-Identifier: Apache-2.0 */
/* The motion of a chaser relative to its target, and what is observed of it. */
#ifndef CHASERDOCK_OBSERVE_H
#define CHASERDOCK_OBSERVE_H

#include "batch.h"

/* Elements that the tasks INSPECT and DETUMBLE add to an observation. */
enum { SURFACE_ELEMENTS = 10, STACK_ELEMENTS = 3 };

/* State of a body: origin and axes of the body. */
typedef struct {
    double x[3], v[3], q[4], w[3];
} Motion;

static inline void read_motion(const double *rows, int64_t pitch, Motion *m) {
    double y[BODY_ROWS], back[4], arm[3], turning[3];
    for (int i = 0; i < MOTION_ROWS; i++) y[i] = rows[i * pitch];
    for (int i = FRAME; i < BODY_ROWS; i++) y[i] = rows[i * pitch];
    q_conjugate(y + FRAME, back);
    q_multiply(y + ATTITUDE, back, m->q);
    q_rotate(y + FRAME, y + RATE, m->w);
    q_rotate(m->q, y + OFFSET, arm);
    cross3(m->w, y + OFFSET, turning);
    q_rotate(m->q, turning, turning);
    for (int i = 0; i < 3; i++) m->x[i] = y[i] - arm[i], m->v[i] = y[VELOCITY + i] - turning[i];
}

static inline void write_motion(const Motion *m, const double *frame, const double *offset,
                                int64_t pitch, double *rows) {
    double q[4], w[3], arm[3], turning[3];
    q_rotate(m->q, offset, arm);
    cross3(m->w, offset, turning);
    q_rotate(m->q, turning, turning);
    q_multiply(m->q, frame, q);
    q_rotate_inverse(frame, m->w, w);
    for (int i = 0; i < 3; i++) {
        rows[(POSITION + i) * pitch] = m->x[i] + arm[i];
        rows[(VELOCITY + i) * pitch] = m->v[i] + turning[i];
        rows[(RATE + i) * pitch] = w[i];
    }
    for (int i = 0; i < 4; i++) rows[(ATTITUDE + i) * pitch] = q[i];
}

/* A chaser in its target's rotating frame (TRF): position and velocity, rotation CRF to TRF, and
 * rate relative to the target in CRF. */
typedef struct {
    double r[3], v[3], q[4], w[3];
} Relative;

static inline void relative_motion(const Motion *chaser, const Motion *target, Relative *out) {
    double apart[3], closing[3], turning[3], back[4], rate[3];
    subtract3(chaser->x, target->x, apart);
    subtract3(chaser->v, target->v, closing);
    q_rotate_inverse(target->q, apart, out->r);
    q_rotate_inverse(target->q, closing, out->v);
    cross3(target->w, out->r, turning);
    subtract3(out->v, turning, out->v);
    q_conjugate(target->q, back);
    q_multiply(back, chaser->q, out->q);
    q_rotate_inverse(out->q, target->w, rate);
    subtract3(chaser->w, rate, out->w);
}

/* Whether a place (TRF) is within the image's borders. */
static inline int in_image(const Task *t, const Relative *s, const double *place) {
    double apart[3], ahead[3];
    subtract3(place, s->r, apart);
    q_rotate_inverse(s->q, apart, apart);
    subtract3(apart, t->camera_m, apart);
    q_rotate_inverse(t->camera_wxyz, apart, ahead);
    return ahead[2] > 0.0 && ahead[0] > -t->view[0] * ahead[2] && ahead[1] > -t->view[1] * ahead[2] &&
           ahead[0] < t->view[2] * ahead[2] && ahead[1] < t->view[3] * ahead[2];
}

/* Interpolate the sensor's table at a distance; out (6, SENSOR_COLUMNS). Return whether markers are
 * seen there. */
static inline int sense_at(const Task *t, double distance_m, double *out) {
    double place = (distance_m - t->bin_first_m) / t->bin_m, last = (double)(t->bins - 1);
    place = place > 0.0 ? min_of(place, last) : 0.0;
    int64_t bin = (int64_t)place;
    if (bin > t->bins - 2) bin = t->bins - 2;
    const double share = place - (double)bin;
    const double *low = t->sensor + bin * 6 * SENSOR_COLUMNS, *high = low + 6 * SENSOR_COLUMNS;
    for (int i = 0; i < 6 * SENSOR_COLUMNS; i++) out[i] = low[i] + share * (high[i] - low[i]);
    return low[SEEN] > 0.5 && high[SEEN] > 0.5;
}

/* Draw the errors of the first observation. */
static void draw_errors(const Task *t, Batch *b, int64_t e, int64_t chaser, const Relative *s) {
    double table[6 * SENSOR_COLUMNS], white[ERROR_ROWS];
    sense_at(t, sqrt_of(dot3(s->r, s->r)), table);
    next_normal(b->random + e, white, ERROR_ROWS);
    for (int i = 0; i < 6; i++) {
        const double *row = table + i * SENSOR_COLUMNS;
        b->errors[i * t->pitch + chaser] = row[ERROR] * white[i];
        b->errors[(6 + i) * t->pitch + chaser] =
            row[RATE_ERROR] * white[i] + row[RATE_ERROR_ALONE] * white[6 + i];
    }
}

/* Advance the errors of the observed pose by a tick: those of a filter that predicts with a constant
 * rate, and corrects by a measurement where an image shows the target. */
static void advance_errors(const Task *t, Batch *b, int64_t e, int64_t chaser, const Relative *s) {
    double table[6 * SENSOR_COLUMNS], white[ERROR_ROWS];
    static const double centre[3] = {0.0, 0.0, 0.0};
    int seen = b->age[e] % t->image_ticks == 0 && in_image(t, s, centre) &&
               sense_at(t, sqrt_of(dot3(s->r, s->r)), table);
    if (seen) next_normal(b->random + e, white, ERROR_ROWS);
    for (int i = 0; i < 6; i++) {
        double *error = b->errors + i * t->pitch + chaser, *rate = error + 6 * t->pitch;
        *error += t->tick_s * *rate;
        if (!seen) continue;
        const double *row = table + i * SENSOR_COLUMNS;
        *rate += row[RATE_NOISE] * white[i] + row[RATE_NOISE_ALONE] * white[6 + i] -
                 row[RATE_GAIN] * *error;
        *error += row[NOISE] * white[i] - row[GAIN] * *error;
    }
}

/* Turn a relative state into the observed one by the errors of the target's pose as seen from the
 * chaser: the target is displaced by e in CRF, and turned by d in TRF, and with it the direction to the
 * sun, unless that is null. */
static void disturb(const Task *t, const Batch *b, int64_t chaser, Relative *s, double *target_rate,
                    double *sun) {
    double e[ERROR_ROWS], shift[3], drift[3], turn[4], back[4], q[4], turning[3], rate[3];
    for (int i = 0; i < ERROR_ROWS; i++) e[i] = b->errors[i * t->pitch + chaser];
    q_rotate(s->q, e, shift);
    q_rotate(s->q, e + 6, drift);
    subtract3(s->r, shift, s->r);
    subtract3(s->v, drift, s->v);
    q_exp(e + 3, turn);
    q_conjugate(turn, back);
    q_rotate(back, s->r, s->r);
    q_rotate(back, s->v, s->v);
    if (sun) q_rotate(back, sun, sun);
    cross3(e + 9, s->r, turning);
    subtract3(s->v, turning, s->v);
    q_multiply(back, s->q, q);
    copy(q, s->q, 4);
    q_rotate_inverse(s->q, e + 9, rate);
    subtract3(s->w, rate, s->w);
    for (int i = 0; i < 3; i++) target_rate[i] += e[9 + i];
}

/* Error of the attitude against the goal, with a scalar part of at least 0. */
static inline void attitude_error(const Place *place, const double *q, double *out) {
    double back[4];
    q_conjugate(place->goal_wxyz, back);
    q_multiply(back, q, out);
    if (out[0] < 0.0)
        for (int i = 0; i < 4; i++) out[i] = -out[i];
}

/* Write what a chaser observes of the surface, all in TRF: the middle of the unseen points of a face
 * relative to it, the face's normal, the share of all points that is seen, and the direction to the
 * sun. The face is the nearest one that the sun lights, or without any such the nearest one; zeros
 * where all is seen. */
static void observe_surface(const Surface *f, const double *unseen, const Relative *s,
                            const double *sun, float *out) {
    double left = 0.0, least = 0.0;
    int64_t best = -1, best_lit = 0;
    for (int64_t k = 0; k < f->faces; k++) {
        const double *rest = unseen + 4 * k;
        if (!(rest[3] > 0.5)) continue;
        left += rest[3];
        double apart[3];
        for (int i = 0; i < 3; i++) apart[i] = rest[i] / rest[3] - s->r[i];
        const double square = dot3(apart, apart);
        const int64_t lit = !f->sunlit || dot3(f->planes + 4 * k, sun) > 0.0;
        if (best >= 0 && (lit < best_lit || (lit == best_lit && !(square < least)))) continue;
        best = k, best_lit = lit, least = square;
    }
    for (int i = 0; i < 3; i++) {
        out[i] = out[3 + i] = 0.0f;
        out[7 + i] = (float)sun[i];
    }
    out[6] = (float)(1.0 - left / (double)f->points);
    if (best < 0) return;
    const double *rest = unseen + 4 * best;
    for (int i = 0; i < 3; i++) {
        out[i] = (float)(rest[i] / rest[3] - s->r[i]);
        out[3 + i] = (float)f->planes[4 * best + i];
    }
}

/* Write the observation of a chaser: position relative to the goal and velocity (TRF), attitude
 * relative to the goal's, relative rate (CRF), the target's rate (TRF), what the task adds, and the
 * places of the other chasers relative to it (TRF), which `others` (chasers, 3) has in WRF relative to
 * the target. */
static void observe(const Task *t, Batch *b, int64_t chaser, int64_t number, const Relative *truth,
                    const Motion *target, const double *others) {
    float *out = b->observations + chaser * t->width;
    Relative s = *truth;
    double rate[3], error[4], sun[3] = {0.0, 0.0, 0.0};
    copy(target->w, rate, 3);
    if (t->task == INSPECT) q_rotate_inverse(target->q, t->surface.to_sun, sun);
    if (t->statistical) disturb(t, b, chaser, &s, rate, t->task == INSPECT ? sun : NULL);
    attitude_error(t->places + number, s.q, error);
    for (int i = 0; i < 3; i++) {
        out[i] = (float)(s.r[i] - t->places[number].goal_m[i]);
        out[3 + i] = (float)s.v[i];
        out[10 + i] = (float)s.w[i];
        out[13 + i] = (float)rate[i];
    }
    for (int i = 0; i < 4; i++) out[6 + i] = (float)error[i];
    out += 16;
    if (t->task == INSPECT) {
        const int64_t e = chaser / t->chasers;
        observe_surface(&t->surface, b->unseen + 4 * t->surface.faces * e, &s, sun, out);
        out += SURFACE_ELEMENTS;
    }
    if (t->task == DETUMBLE) {
        double centre[3], turning[3];
        q_rotate_inverse(target->q, target->v, centre);
        cross3(target->w, t->stack.centre_m, turning);
        for (int i = 0; i < 3; i++) out[i] = (float)(centre[i] + turning[i]);
        out += STACK_ELEMENTS;
    }
    for (int64_t other = 0; other < t->chasers; other++) {
        if (other == number) continue;
        for (int i = 0; i < 3; i++) *out++ = (float)(others[3 * other + i] - truth->r[i]);
    }
}

#endif
