/* SPDX-License-Identifier: Apache-2.0 */
/* Rate how well light from each of many directions explains the grey levels of points on a mesh.
 *
 * The grey level of a point is reflectance (a + d max(n's, 0) v) + gloss d v (n'h)^m: ambient level
 * a, level d of the sun in the direction s, visibility v from the sun, Blinn's half vector h. For a
 * given s it is linear in a and d, which follow by iteratively reweighted least squares with
 * Cauchy's weights. */
#include "base.h"

/* Rounds of reweighting, each of which costs as much as the first. More: outliers weigh less. */
#define LIGHT_ROUNDS 3
#define POINT_DOUBLES 14 /* size of a LitPoint */

/* A point: position, unit normal, unit vector to the camera, all in TRF; reflectance, gloss,
 * Blinn's exponent; grey level and its standard deviation. */
typedef struct {
    double at[3], normal[3], to_camera[3], reflectance, gloss, exponent, grey, sigma;
} LitPoint;

/* Solve for the levels a >= a_least d and d >= 0 of weighted sums. */
static void solve_levels(double aa, double ab, double bb, double ag, double bg, double least,
                         double *a, double *d) {
    double det = aa * bb - ab * ab;
    *a = 0.0, *d = -1.0;
    if (det > 1e-9 * aa * bb) *a = (bb * ag - ab * bg) / det, *d = (aa * bg - ab * ag) / det;
    if (*d >= 0.0 && *a >= least * *d) return;
    if (*d >= 0.0) { /* too dark in the shade */
        double both = aa * least * least + 2.0 * ab * least + bb;
        *d = both > 0.0 ? max_of((least * ag + bg) / both, 0.0) : 0.0;
        *a = least * *d;
    } else {
        *d = 0.0, *a = aa > 0.0 ? max_of(ag / aa, 0.0) : 0.0;
    }
}

/* Light of level 1 from the sun in the direction ``sun`` that a point reflects to the camera; 0 in
 * the shade. */
static inline double reflected(const LitPoint *p, const double *sun, const ShadowMap *map,
                               const float *depth) {
    double cosine = dot3(p->normal, sun);
    if (!(cosine > 0.0) || (map->size > 0.0 && in_shadow(map, depth, p->at))) return 0.0;
    double shine =
        p->gloss > 0.0 ? p->gloss * gloss_factor(p->normal, p->to_camera, sun, p->exponent) : 0.0;
    return p->reflectance * cosine + shine;
}

/* Compute the light of level 1 from the sun in the direction ``sun`` that each of ``n`` points
 * reflects, ``out`` (n), float. */
EXPORT void NAME(direct_light)(const LitPoint *points, int64_t n, const double *sun,
                               const ShadowMap *map, const float *depth, float *out) {
    for (int64_t i = 0; i < n; i++) out[i] = (float)reflected(points + i, sun, map, depth);
}

/* Rate ``k`` directions of the sun. ``points``: n LitPoint; ``directions``: k unit vectors in TRF;
 * ``maps``: k ShadowMap of equal size with ``depths`` (k, size, size). Output, (k, 3): mean robust
 * squared residual, a and d. ``work``: 2 n doubles. */
EXPORT void NAME(rate_suns)(const LitPoint *points, int64_t n, const double *directions,
                            const ShadowMap *maps, const float *depths, int64_t k, double least,
                            double *out, double *work) {
    double *direct = work, *weight = work + n;
    for (int64_t j = 0; j < k; j++) {
        const double *sun = directions + 3 * j;
        int64_t texels = (int64_t)maps[j].size * (int64_t)maps[j].size;
        const float *depth = depths + j * texels;
        for (int64_t i = 0; i < n; i++) {
            direct[i] = reflected(points + i, sun, maps + j, depth);
            weight[i] = 1.0 / (points[i].sigma * points[i].sigma);
        }
        double a = 0.0, d = 0.0, cost = 0.0;
        for (int round = 0; round < LIGHT_ROUNDS; round++) {
            double aa = 0.0, ab = 0.0, bb = 0.0, ag = 0.0, bg = 0.0;
            for (int64_t i = 0; i < n; i++) {
                double w = weight[i], r = points[i].reflectance, b = direct[i], g = points[i].grey;
                aa += w * r * r, ab += w * r * b, bb += w * b * b, ag += w * r * g, bg += w * b * g;
            }
            solve_levels(aa, ab, bb, ag, bg, least, &a, &d);
            cost = 0.0;
            for (int64_t i = 0; i < n; i++) {
                double residual =
                    (points[i].grey - points[i].reflectance * a - direct[i] * d) / points[i].sigma;
                double square = residual * residual, share = 1.0 / (1.0 + 0.25 * square);
                weight[i] = share / (points[i].sigma * points[i].sigma);
                cost += square * share;
            }
        }
        out[3 * j] = cost / (double)(n > 0 ? n : 1), out[3 * j + 1] = a, out[3 * j + 2] = d;
    }
}
