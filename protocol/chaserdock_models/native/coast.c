/* SPDX-License-Identifier: Apache-2.0 */
/* Lower bounds on the distance of coasts from the target (passive_safety.py). */
#include "base.h"

/* out (6) = drift (6) plus the state after a transition of Clohessy-Wiltshire or of free motion,
 * both of which decouple the motion out of the orbital plane from that within it. */
static inline void coasted(const double *phi, const double *drift, const v4 *x, v4 *out) {
    static const int plane[4] = {0, 1, 3, 4};
    for (int i = 0; i < 4; i++) {
        const double *row = phi + 6 * plane[i];
        v4 s = splat(drift[plane[i]]);
        for (int j = 0; j < 4; j++) s = madd4(splat(row[plane[j]]), x[plane[j]], s);
        out[plane[i]] = s;
    }
    for (int i = 2; i < 6; i += 3)
        out[i] = madd4(splat(phi[6 * i + 5]), x[5],
                       madd4(splat(phi[6 * i + 2]), x[2], splat(drift[i])));
}

static inline v4 square_of(const v4 *a) {
    return madd4(a[2], a[2], madd4(a[1], a[1], a[0] * a[0]));
}
static inline double greatest4(v4 a) { return max_of(max_of(a[0], a[1]), max_of(a[2], a[3])); }

/* Compute lower bounds room (T,), m, on the distance of all coasts from the origin in each step
 * between the T + 1 transitions (T + 1, 6, 6): the nearest end of a step, less half of the longest
 * step and `bulge_s` times the greatest change of velocity. drift (T + 1, 6): what disturbances add
 * to every coast. states (6, M): M a multiple of four; work: 6 M doubles. */
EXPORT void NAME(coast_room)(int64_t steps, const double *transitions, const double *drift,
                             int64_t m, const double *states, double bulge_s, double *room,
                             double *work) {
    double nearest_before = 0.0;
    zero(work, 6 * m);
    for (int64_t k = 0; k <= steps; k++) {
        v4 far = splat(-1e300), step = splat(0.0), change = splat(0.0);
        for (int64_t n = 0; n < m; n += 4) {
            v4 x[6], now[6], moved[6];
            for (int i = 0; i < 6; i++) x[i] = load(states + m * i + n);
            coasted(transitions + 36 * k, drift + 6 * k, x, now);
            for (int i = 0; i < 6; i++) {
                moved[i] = now[i] - load(work + m * i + n);
                store(work + m * i + n, now[i]);
            }
            far = max4(far, -square_of(now));
            step = max4(step, square_of(moved));
            change = max4(change, square_of(moved + 3));
        }
        double nearest = sqrt_of(-greatest4(far));
        if (k)
            room[k - 1] = min_of(nearest_before, nearest) - 0.5 * sqrt_of(greatest4(step)) -
                          bulge_s * sqrt_of(greatest4(change));
        nearest_before = nearest;
    }
}

static double variance_along(const double *line, const double *covariance) {
    double along[3];
    multiply3(covariance, line, along);
    return dot3(line, along);
}

typedef struct {
    double *margin, *away,
        *moment; /* each (M,): smallest margin, distance there (m), and its moment in steps */
} Approaches;

/* Replace margin, distance and moment of one coast if it comes closer in step k, between the states
 * begin and end (6). `covariances` (2, 9): of the positions there. */
static void approach(int64_t k, const double *begin, const double *end, const double *covariances,
                     double keep_out, double bulge_s, double *margin, double *away,
                     double *moment) {
    double step[3], change[3], nearest[3], line[3];
    subtract3(end, begin, step);
    subtract3(end + 3, begin + 3, change);
    double share = min_of(max_of(-dot3(begin, step) / max_of(dot3(step, step), 1e-30), 0.0), 1.0);
    for (int i = 0; i < 3; i++) nearest[i] = madd(share, step[i], begin[i]);
    double chord = sqrt_of(dot3(nearest, nearest));
    for (int i = 0; i < 3; i++) line[i] = nearest[i] / max_of(chord, 1e-9);
    double variance =
        max_of(variance_along(line, covariances), variance_along(line, covariances + 9));
    double distance = chord - bulge_s * sqrt_of(dot3(change, change));
    distance = distance < 0.0 ? 0.0 : distance;
    double found = (distance - keep_out) / sqrt_of(max_of(variance, 1e-18));
    if (*margin != *margin || found >= *margin) return; /* NaN stays */
    *margin = found;
    *away = distance;
    *moment = (double)k + share;
}

/* Find the closest approach, by the margin in standard deviations, of the coasts from states (6, M)
 * within `count` steps (columns). transitions, drift, states and bulge_s: as in `coast_room`;
 * covariances (count, 2, 9): of the positions at both ends of these steps. NaN in a state gives a
 * margin of NaN. */
EXPORT void NAME(coast_closest)(int64_t count, const int64_t *columns, const double *transitions,
                                const double *drift, int64_t m, const double *states,
                                const double *covariances, double keep_out, double bulge_s,
                                const Approaches *found) {
    for (int64_t n = 0; n < m; n++) {
        found->margin[n] = 1e300;
        found->away[n] = found->moment[n] = 0.0;
    }
    for (int64_t c = 0; c < count; c++) {
        const double *phi = transitions + 36 * columns[c], *shift = drift + 6 * columns[c];
        for (int64_t n = 0; n < m; n += 4) {
            v4 x[6], begin[6], end[6];
            for (int i = 0; i < 6; i++) x[i] = load(states + m * i + n);
            coasted(phi, shift, x, begin);
            coasted(phi + 36, shift + 6, x, end);
            for (int lane = 0; lane < 4; lane++) {
                double from[6], to[6];
                for (int i = 0; i < 6; i++) {
                    from[i] = begin[i][lane];
                    to[i] = end[i][lane];
                }
                approach(columns[c], from, to, covariances + 18 * c, keep_out, bulge_s,
                         found->margin + n + lane, found->away + n + lane,
                         found->moment + n + lane);
            }
        }
    }
}
