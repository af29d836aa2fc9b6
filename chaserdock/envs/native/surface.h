/* SPDX-License-Identifier: Apache-2.0 */
/* The target's surface as chasers see it. */
#ifndef CHASERDOCK_SURFACE_H
#define CHASERDOCK_SURFACE_H

#include "observe.h"
#include "probe.h"

/* Whether a cuboid of the target, but not `own`, meets the segment between two points (TRF). */
static int hidden(const Task *t, const double *from, const double *to, int64_t own) {
    for (int64_t i = 0; i < t->boxes; i++) {
        const double *box = t->solids + 16 * i, *turn = box + 6;
        double middle[3], half[3], centre[3], extent[3];
        if (i == own) continue;
        for (int k = 0; k < 3; k++) {
            middle[k] = 0.5 * (from[k] + to[k]) - box[3 + k];
            half[k] = 0.5 * (to[k] - from[k]);
        }
        for (int r = 0; r < 3; r++) {
            const double column[3] = {turn[r], turn[3 + r], turn[6 + r]};
            centre[r] = dot3(column, middle);
            extent[r] = dot3(column, half);
        }
        if (segment_meets(centre, extent, box)) return 1;
    }
    return 0;
}

/* Mark the points that a chaser sees and none has seen before. ``sun``: direction, TRF. Return their
 * number. NaN sees nothing. */
static int64_t look(const Task *t, Batch *b, int64_t e, const Relative *s, const double *sun) {
    const Surface *f = &t->surface;
    uint8_t *seen = b->seen + e * f->points;
    double *unseen = b->unseen + 4 * e * f->faces, camera[3];
    int64_t found = 0;
    q_rotate(s->q, t->camera_m, camera);
    for (int i = 0; i < 3; i++) camera[i] += s->r[i];
    for (int64_t k = 0; k < f->faces; k++) {
        const double *plane = f->planes + 4 * k, height = dot3(plane, camera) - plane[3];
        double *rest = unseen + 4 * k;
        if (!(rest[3] > 0.5) || !(height > 0.0)) continue;
        if (f->sunlit && !(dot3(plane, sun) > 0.0)) continue;
        for (int64_t p = f->first[k]; p < f->first[k + 1]; p++) {
            const double *point = f->points_m + 3 * p;
            double sight[3], towards[3];
            if (seen[p]) continue;
            subtract3(camera, point, sight);
            const double distance = sqrt_of(dot3(sight, sight));
            if (!(distance <= f->range_m) || !(height >= f->least_cosine * distance)) continue;
            if (!in_image(t, s, point) || hidden(t, point, camera, f->box[k])) continue;
            for (int i = 0; i < 3; i++) towards[i] = point[i] + f->extent_m * sun[i];
            if (f->sunlit && hidden(t, point, towards, f->box[k])) continue;
            seen[p] = 1, found++;
            subtract3(rest, point, rest);
            rest[3] -= 1.0;
        }
    }
    return found;
}

/* Let all chasers look, in the order of their numbers. ``gained``: share of all points that each is
 * the first to see. Return whether enough are seen. */
static int inspect(const Task *t, Batch *b, int64_t e, const Relative *states, const Motion *target,
                   double *gained) {
    const Surface *f = &t->surface;
    double sun[3], left = 0.0;
    q_rotate_inverse(target->q, f->to_sun, sun);
    for (int64_t i = 0; i < t->chasers; i++) {
        gained[i] = 0.0;
        if (b->age[e] % t->image_ticks == 0)
            gained[i] = (double)look(t, b, e, states + i, sun) / (double)f->points;
    }
    for (int64_t k = 0; k < f->faces; k++) left += b->unseen[4 * (e * f->faces + k) + 3];
    return (double)f->points - left > (double)f->needed - 0.5;
}

/* Begin with nothing seen. */
static void forget_surface(const Task *t, Batch *b, int64_t e) {
    const Surface *f = &t->surface;
    for (int64_t p = 0; p < f->points; p++) b->seen[e * f->points + p] = 0;
    copy(f->totals, b->unseen + 4 * e * f->faces, 4 * f->faces);
}

#endif
