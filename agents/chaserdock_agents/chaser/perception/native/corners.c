/* SPDX-License-Identifier: Apache-2.0 */
/* Refines marker corners as intersections of lines fitted to the sides. Method: chaserdock_agents.chaser.perception.corners. */
#include "base.h"

#define ROWS_MOST 20
#define TAPS_MOST 15

typedef struct {
    const uint8_t *image;
    int64_t height, width, distorted;
    /* fx, fy, cx, cy, k1, k2, p1, p2, k3 */
    const double *lens;
} Image;

/* Settings, in the order of the Python caller. `first` and `last` exclude the ends of a side, where the gradient of the
 * adjacent side interferes. */
typedef struct {
    double first, last, reach_cells, reach_least_px, min_contrast, min_rows_share, max_move_px;
    double strip_px, log_edge_sigma, edge_sigma_spread, strip_beyond_px, uncertain_px;
    /* Per pass: samples along and across a side, maximum half length across, number of reweighting iterations. */
    double rows[2], taps[2], reach_px[2], reweighted[2];
    double strip_rows, strip_taps, strip_steps;
} Settings;

typedef struct {
    double start[2], vector[2], normal[2], extent;
} Side;

static void sides_of(const double *corners, Side *sides) {
    double middle[2];
    for (int k = 0; k < 2; k++)
        middle[k] = 0.25 * ((corners[k] + corners[2 + k]) + (corners[4 + k] + corners[6 + k]));
    for (int i = 0; i < 4; i++) {
        Side *s = sides + i;
        const double *a = corners + 2 * i, *b = corners + 2 * ((i + 1) % 4);
        for (int k = 0; k < 2; k++) s->start[k] = a[k], s->vector[k] = b[k] - a[k];
        double length = max_of(sqrt_of(s->vector[0] * s->vector[0] + s->vector[1] * s->vector[1]), 1e-6);
        s->normal[0] = s->vector[1] / length;
        s->normal[1] = -s->vector[0] / length;
        double across = 0.0;
        for (int k = 0; k < 2; k++) across += (a[k] + 0.5 * s->vector[k] - middle[k]) * s->normal[k];
        s->extent = 2.0 * abs_of(across);
    }
}

/* Bilinear grey level; pixels outside the image have the level of the nearest border pixel. */
static double level_at(const Image *p, double x, double y) {
    x = x > 0.0 ? min_of(x, (double)(p->width - 1)) : 0.0;
    y = y > 0.0 ? min_of(y, (double)(p->height - 1)) : 0.0;
    int64_t column = (int64_t)x, row = (int64_t)y;
    if (column > p->width - 2) column = p->width - 2;
    if (row > p->height - 2) row = p->height - 2;
    x -= (double)column;
    y -= (double)row;
    const uint8_t *at = p->image + row * p->width + column;
    double upper = (double)at[0] * (1.0 - x) + (double)at[1] * x;
    at += p->width;
    double lower = (double)at[0] * (1.0 - x) + (double)at[1] * x;
    return upper + (lower - upper) * y;
}

/* Converts an ideal to a distorted pixel (Brown-Conrady). */
static void distort(const Image *p, double *x, double *y) {
    const double *l = p->lens;
    double a = (*x - l[2]) / l[0], b = (*y - l[3]) / l[1], r2 = a * a + b * b;
    double radial = 1.0 + r2 * (l[4] + r2 * (l[5] + r2 * l[8]));
    *x = ((a * radial + 2.0 * l[6] * a * b) + l[7] * (r2 + 2.0 * a * a)) * l[0] + l[2];
    *y = ((b * radial + l[6] * (r2 + 2.0 * b * b)) + 2.0 * l[7] * a * b) * l[1] + l[3];
}

/* Samples a row across a side: position `along` it (-0.5 to 0.5), offsets `across` (taps), pixels, positive outwards. Returns
 * whether both ends of the row, and thus all of it, lie inside the image. */
static int row_of(const Image *p, const Side *s, double along, const double *across, int taps, double *levels) {
    double base[2];
    int inside = 1;
    for (int k = 0; k < 2; k++) base[k] = (s->start[k] + 0.5 * s->vector[k]) + along * s->vector[k];
    for (int t = 0; t < taps; t++) {
        double x = base[0] + s->normal[0] * across[t], y = base[1] + s->normal[1] * across[t];
        if (p->distorted) distort(p, &x, &y);
        if (t == 0 || t == taps - 1)
            inside &= x >= 0.0 && x <= (double)(p->width - 1) && y >= 0.0 && y <= (double)(p->height - 1);
        levels[t] = level_at(p, x, y);
    }
    return inside;
}

static double reach_of(const Settings *set, const Side *s, double cells, double most_px) {
    return min_of(max_of(set->reach_cells / cells * s->extent, set->reach_least_px), most_px);
}

/* Weighted least squares of offset = level + slope * along. */
static void fit_line(const double *along, const double *offset, const double *weight, int rows, double *level, double *slope) {
    double s0 = 0.0, s1 = 0.0, s2 = 0.0, t0 = 0.0, t1 = 0.0;
    for (int i = 0; i < rows; i++) {
        double w = weight[i], wa = w * along[i];
        s0 += w, s1 += wa, s2 += wa * along[i], t0 += w * offset[i], t1 += wa * offset[i];
    }
    s0 = max_of(s0, 1e-9);
    double mean = s1 / s0;
    *slope = (t1 - mean * t0) / max_of(s2 - mean * s1, 1e-9);
    *level = t0 / s0 - *slope * mean;
}

/* Upper median of `values` with nonzero `weight`; 0 if there are none. */
static double median_of(const double *values, const double *weight, int rows) {
    double ordered[ROWS_MOST];
    int count = 0;
    for (int i = 0; i < rows; i++) {
        if (weight[i] == 0.0) continue;
        int k = count++;
        for (; k > 0 && ordered[k - 1] > values[i]; k--) ordered[k] = ordered[k - 1];
        ordered[k] = values[i];
    }
    return count ? ordered[count / 2] : 0.0;
}

/* Fits a side's line to the centroids of the grey-level gradient across it: outward offsets of its two ends, pixels.
 * Returns whether enough rows are usable. */
static int centroid_line(const Image *p, const Settings *set, int pass, const Side *s, double cells, double *at_start,
                         double *at_end) {
    int rows = (int)set->rows[pass], taps = (int)set->taps[pass], count = 0;
    double reach = reach_of(set, s, cells, set->reach_px[pass]);
    double along[ROWS_MOST], offset[ROWS_MOST], usable[ROWS_MOST], weight[ROWS_MOST], across[TAPS_MOST], levels[TAPS_MOST];
    for (int t = 0; t < taps; t++) across[t] = (2.0 * t / (taps - 1) - 1.0) * reach;
    for (int i = 0; i < rows; i++) {
        double total = 0.0, first = 0.0;
        along[i] = set->first + (set->last - set->first) * i / (rows - 1) - 0.5;
        int inside = row_of(p, s, along[i], across, taps, levels);
        for (int t = 0; t + 1 < taps; t++) {
            double rise = max_of(levels[t + 1] - levels[t], 0.0);
            total += rise;
            first += rise * ((2.0 * t + 1.0) / (taps - 1) - 1.0);
        }
        offset[i] = first / max_of(total, 1e-6) * reach;
        usable[i] = inside && total > set->min_contrast ? 1.0 : 0.0;
        count += usable[i] != 0.0;
    }
    double level, slope;
    fit_line(along, offset, usable, rows, &level, &slope);
    for (int k = 0; k < (int)set->reweighted[pass]; k++) {
        double residual[ROWS_MOST];
        for (int i = 0; i < rows; i++) residual[i] = abs_of(offset[i] - (level + slope * along[i]));
        double scale = 4.0 * max_of(1.4826 * median_of(residual, usable, rows), 0.02);
        for (int i = 0; i < rows; i++) { /* Tukey */
            double share = residual[i] / scale, left = max_of(1.0 - share * share, 0.0);
            weight[i] = left * left * usable[i];
        }
        fit_line(along, offset, weight, rows, &level, &slope);
    }
    *at_start = level - 0.5 * slope;
    *at_end = level + 0.5 * slope;
    return (double)count >= set->min_rows_share * rows;
}

/* Intersects adjacent sides after moving their ends outwards. Returns 0, with nothing written, if two are nearly parallel. */
static int crossings(const Side *sides, const double *at_start, const double *at_end, double *corners) {
    double low[4][2], vector[4][2], found[8];
    for (int i = 0; i < 4; i++)
        for (int k = 0; k < 2; k++) {
            low[i][k] = sides[i].start[k] + sides[i].normal[k] * at_start[i];
            vector[i][k] = sides[i].vector[k] + sides[i].normal[k] * (at_end[i] - at_start[i]);
        }
    for (int i = 0; i < 4; i++) {
        const double *a = vector[(i + 3) % 4], *b = vector[i], *from = low[(i + 3) % 4];
        double d[2] = {low[i][0] - from[0], low[i][1] - from[1]};
        double cross = a[0] * b[1] - a[1] * b[0];
        double lengths = sqrt_of(a[0] * a[0] + a[1] * a[1]) * sqrt_of(b[0] * b[0] + b[1] * b[1]);
        if (!(abs_of(cross) > 0.05 * lengths)) return 0;
        double t = (d[0] * b[1] - d[1] * b[0]) / cross;
        for (int k = 0; k < 2; k++) {
            found[2 * i + k] = from[k] + t * a[k];
            if (!finite(found[2 * i + k])) return 0;
        }
    }
    copy(found, corners, 8);
    return 1;
}

/* Normal density and, to 1e-7 (Abramowitz and Stegun 26.2.17), distribution function. */
static double density_of(double z) { return exponential(-0.5 * z * z) * 0.3989422804014327; }
static double distribution_of(double z, double density) {
    double t = 1.0 / (1.0 + 0.2316419 * abs_of(z));
    double poly = t * 1.330274429;
    poly = (poly + -1.821255978) * t;
    poly = (poly + 1.781477937) * t;
    poly = (poly + -0.356563782) * t;
    poly = (poly + 0.319381530) * t * density;
    return z >= 0.0 ? 1.0 - poly : poly;
}

static double limited(double value, double limit) { return min_of(max_of(value, -limit), limit); }

/* Outward offset of a side from the mean profile of a blurred strip that is `border` pixels wide:
 * b + a Phi((s - e) / sigma) - d Phi((s - e - m) / sigma), with b, a, d, e by least squares and sigma with a prior. */
static double strip_shift(const Image *p, const Settings *set, const Side *side, double cells, double border) {
    int rows = (int)set->strip_rows, taps = (int)set->strip_taps, count = 0;
    double inner = reach_of(set, side, cells, set->reach_px[1]);
    double outer = min_of(border + set->strip_beyond_px, set->reach_px[1]);
    double s[TAPS_MOST], profile[TAPS_MOST] = {0.0}, line[6][TAPS_MOST], z_density[2][TAPS_MOST];
    for (int t = 0; t < taps; t++) s[t] = (outer + inner) * ((double)t / (taps - 1)) - inner;
    for (int i = 0; i < rows; i++) {
        double levels[TAPS_MOST], along = set->first + (set->last - set->first) * i / (rows - 1) - 0.5;
        if (!row_of(p, side, along, s, taps, levels)) continue;
        count++;
        for (int t = 0; t < taps; t++) profile[t] += levels[t];
    }
    for (int t = 0; t < taps; t++) profile[t] /= count ? count : 1;
    double shift = 0.0, log_sigma = set->log_edge_sigma;
    /* An assumed error of 2 grey levels sets the weight of the prior of sigma. */
    double prior = (2.0 / set->edge_sigma_spread) * (2.0 / set->edge_sigma_spread);
    /* Rows: 1, Phi at both edges, derivatives of the model by e and log sigma, residual of the profile after fitting the
     * first three. */
    for (int step = 0; step < (int)set->strip_steps; step++) {
        double sigma = exponential(log_sigma), a[25], b[5];
        for (int t = 0; t < taps; t++) {
            line[0][t] = 1.0;
            line[5][t] = profile[t];
            for (int k = 0; k < 2; k++) {
                double z = (s[t] - (k ? border : 0.0) - shift) / sigma, density = density_of(z);
                line[1 + k][t] = distribution_of(z, density);
                line[3 + k][t] = density;
                z_density[k][t] = density * z;
            }
        }
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 4; j++) {
                double sum = i == j ? 1e-6 : 0.0;
                const double *other = line[j < 3 ? j : 5];
                for (int t = 0; t < taps; t++) sum += line[i][t] * other[t];
                if (j < 3) a[3 * i + j] = sum;
                else b[i] = sum;
            }
        if (!solve_rows(a, b, 3)) return 0.0;
        for (int t = 0; t < taps; t++) {
            line[5][t] -= (b[0] * line[0][t] + b[1] * line[1][t]) + b[2] * line[2][t];
            double by_e = -(b[1] * line[3][t] + b[2] * line[4][t]) / sigma;
            line[4][t] = -(b[1] * z_density[0][t] + b[2] * z_density[1][t]);
            line[3][t] = by_e;
        }
        for (int i = 0; i < 5; i++)
            for (int j = 0; j < 6; j++) {
                double sum = i == j ? 1e-6 : 0.0;
                for (int t = 0; t < taps; t++) sum += line[i][t] * line[j][t];
                if (j < 5) a[5 * i + j] = sum;
                else b[i] = sum;
            }
        a[24] += prior;
        b[4] += prior * (set->log_edge_sigma - log_sigma);
        if (!solve_rows(a, b, 5)) return 0.0;
        shift = limited(shift + limited(b[3], 0.4), 1.0);
        log_sigma += limited(b[4], 0.2);
    }
    return shift;
}

/* Refines corners (n, 4, 2), ideal pixels, in place. `good` (n): whether all four sides are usable; otherwise the corners
 * are unchanged, as for corners that are not finite. `sigma` (n): uncertainty relative to that of a large marker. `margin`
 * (n): width of the white border over the marker's side. `cells`: cells along a side, including the black border. */
EXPORT void NAME(refine_corners)(const uint8_t *image, int64_t height, int64_t width, const double *lens, int64_t distorted,
                                const Settings *set, double cells, int64_t n, const double *margin, double *corners,
                                uint8_t *good, double *sigma) {
    Image p = {image, height, width, distorted, lens};
    for (int64_t m = 0; m < n; m++) {
        double *given = corners + 8 * m, refined[8], at_start[4], at_end[4];
        Side sides[4];
        int fine = 1, narrow = 0;
        copy(given, refined, 8);
        for (int pass = 0; pass < 2 && fine; pass++) {
            sides_of(refined, sides);
            for (int i = 0; i < 4; i++) fine &= centroid_line(&p, set, pass, sides + i, cells, at_start + i, at_end + i);
            fine = fine && crossings(sides, at_start, at_end, refined);
        }
        for (int i = 0; i < 8; i++) fine &= abs_of(refined[i] - given[i]) < set->max_move_px;
        if (!fine) copy(given, refined, 8);
        sides_of(refined, sides);
        double finest = sides[0].extent;
        for (int i = 1; i < 4; i++) finest = min_of(finest, sides[i].extent);
        finest = max_of(finest * min_of(margin[m], 1.0 / cells), 0.1);
        sigma[m] = sqrt_of(1.0 + (set->uncertain_px / finest) * (set->uncertain_px / finest));
        for (int i = 0; i < 4 && fine; i++) {
            double border = sides[i].extent * margin[m];
            at_start[i] = border < set->strip_px ? strip_shift(&p, set, sides + i, cells, border) : 0.0;
            narrow |= border < set->strip_px;
        }
        if (narrow) fine = crossings(sides, at_start, at_start, refined);
        copy(refined, given, 8);
        good[m] = (uint8_t)fine;
    }
}
