/* SPDX-License-Identifier: Apache-2.0 */
/* Refines marker corners as intersections of lines fitted to the sides. Method:
 * chaserdock_agents.chaser.perception.corners. */
#include "lens.h"

/* Capacity: lines across a side; the settings have 8. */
#define ROWS_MOST 20
/* Capacity: samples on a line; the settings have 11. */
#define TAPS_MOST 15
/* Capacity: lines of pixels across a side; the settings have 48. */
#define COLUMNS_MOST 64
/* Capacity: pixels beside a side: 48 lines of 42. */
#define PIXELS_MOST 2048
/* Tabulated normal distribution: steps of 1 / STEPS up to LAST sigma on either side. */
#define STEPS 32
#define LAST 5 /* beyond, the distribution is 0 or 1 to 3e-7 */

typedef struct {
    const uint8_t *image;
    int64_t height, width;
    /* fx, fy, cx, cy */
    const double *camera;
    /* Null without distortion. */
    const Lens *lens;
    /* Frame (3, 3) of the marker in work: from its coordinates (x, y, 1), in which one unit is about
     * a pixel of the image, to rays; null: they are ideal pixels. */
    const double *frame;
} Image;

/* Settings, in the order of the Python caller. */
typedef struct {
    /* Both steps: share of a cell and least pixels to look inwards; least contrast and share of
     * usable rows; largest move. */
    double reach_cells, reach_least_px, min_contrast, min_rows_share, max_move_px;
    /* Coarse step. `first` and `last` exclude the ends of a side, where the gradient of the
     * adjacent side interferes. */
    double first, last, rows, taps, coarse_reach_px, border_share;
    /* Fit to pixels: lines along a side, lengths left out at its ends, reach across the edge, when
     * the outer edge of a border is fitted; prior of the logarithm of the edge's sigma; rounds and
     * iterations per round. See corners.py for each. */
    double columns, end_px, end_share, reach_px, clear_px, beyond_px, strip_px, partial_px,
        least_fall, agreement_px, agreement_sigmas;
    double log_edge_sigma, edge_sigma_spread, fade_spread, alike_columns, rounds, iterations,
        strip_iterations;
    /* What noise does not explain of a line's place; see corners.py for each. */
    double least_sigma_px, aligned_sigma_px, fine_sigma_px, border_sigma_px, outer_sigma_px,
        cut_sigma_px, cut_spread_px, common_share, free_blur, blur_sigma_px, adjoining_sigma_px;
} Settings;
LAYOUT(Settings, reach_cells, reach_least_px, min_contrast, min_rows_share, max_move_px, first,
       last, rows, taps, coarse_reach_px, border_share, columns, end_px, end_share, reach_px,
       clear_px, beyond_px, strip_px, partial_px, least_fall, agreement_px, agreement_sigmas,
       log_edge_sigma, edge_sigma_spread, fade_spread, alike_columns, rounds, iterations,
       strip_iterations, least_sigma_px, aligned_sigma_px, fine_sigma_px, border_sigma_px,
       outer_sigma_px, cut_sigma_px, cut_spread_px, common_share, free_blur, blur_sigma_px,
       adjoining_sigma_px)

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
        double length =
            max_of(sqrt_of(s->vector[0] * s->vector[0] + s->vector[1] * s->vector[1]), 1e-6);
        s->normal[0] = s->vector[1] / length;
        s->normal[1] = -s->vector[0] / length;
        double across = 0.0;
        for (int k = 0; k < 2; k++)
            across += (a[k] + 0.5 * s->vector[k] - middle[k]) * s->normal[k];
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

/* Converts coordinates of the marker in work to a distorted pixel; NaN beyond the lens. */
static void distort(const Image *p, double *x, double *y) {
    const double *l = p->camera;
    double ideal[2] = {(*x - l[2]) / l[0], (*y - l[3]) / l[1]}, seen[2];
    if (p->frame) {
        double at[3] = {*x, *y, 1.0}, ray[3];
        multiply3(p->frame, at, ray);
        double ahead = ray[2] > 0.0 ? ray[2] : __builtin_nan("");
        for (int k = 0; k < 2; k++) ideal[k] = ray[k] / ahead;
    }
    distort_ray(p->lens, ideal[0], ideal[1], seen);
    *x = seen[0] * l[0] + l[2];
    *y = seen[1] * l[1] + l[3];
}

/* Converts a pixel to coordinates of the marker in work. `shift`: by how much the lens moves points
 * near it; each step leaves what that changes by over the distance, at most 0.3 of it. */
static void undistort_near(const Image *p, const double *pixel, const double *shift, int steps,
                           double *q) {
    for (int j = 0; j < 2; j++) q[j] = pixel[j] - shift[j];
    for (int i = 0; i < steps && p->lens; i++) {
        double d[2] = {q[0], q[1]};
        distort(p, d, d + 1);
        for (int j = 0; j < 2; j++) q[j] += pixel[j] - d[j];
    }
}

/* Samples a row across a side: position `along` it (-0.5 to 0.5), offsets `across` (taps), pixels,
 * positive outwards. Returns whether both ends of the row, and thus all of it, lie inside the
 * image. */
static int row_of(const Image *p, const Side *s, double along, const double *across, int taps,
                  double *levels) {
    double base[2];
    int inside = 1;
    for (int k = 0; k < 2; k++) base[k] = (s->start[k] + 0.5 * s->vector[k]) + along * s->vector[k];
    for (int t = 0; t < taps; t++) {
        double x = base[0] + s->normal[0] * across[t], y = base[1] + s->normal[1] * across[t];
        if (p->lens) distort(p, &x, &y);
        if (t == 0 || t == taps - 1)
            inside &=
                x >= 0.0 && x <= (double)(p->width - 1) && y >= 0.0 && y <= (double)(p->height - 1);
        levels[t] = level_at(p, x, y);
    }
    return inside;
}

static double reach_of(const Settings *set, const Side *s, double cells, double most_px) {
    return min_of(max_of(set->reach_cells / cells * s->extent, set->reach_least_px), most_px);
}

/* Weighted least squares of offset = level + slope * along. */
static void fit_line(const double *along, const double *offset, const double *weight, int rows,
                     double *level, double *slope) {
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
    double ordered[COLUMNS_MOST];
    int count = 0;
    for (int i = 0; i < rows; i++) {
        if (weight[i] == 0.0) continue;
        int k = count++;
        for (; k > 0 && ordered[k - 1] > values[i]; k--) ordered[k] = ordered[k - 1];
        ordered[k] = values[i];
    }
    return count ? ordered[count / 2] : 0.0;
}

/* Fits a side's line to the centroids of the grey-level gradient across it: outward offsets of its
 * two ends, pixels. Returns whether enough rows are usable. */
static int centroid_line(const Image *p, const Settings *set, const Side *s, double cells,
                         double margin, double *at_start, double *at_end) {
    int rows = (int)set->rows, taps = (int)set->taps, count = 0;
    double border = max_of(set->border_share * margin * s->extent, set->reach_least_px);
    double reach = reach_of(set, s, cells, min_of(set->coarse_reach_px, border));
    double along[ROWS_MOST], offset[ROWS_MOST], usable[ROWS_MOST], weight[ROWS_MOST],
        across[TAPS_MOST], levels[TAPS_MOST];
    double residual[ROWS_MOST], level, slope;
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
    fit_line(along, offset, usable, rows, &level, &slope);
    for (int i = 0; i < rows; i++) residual[i] = abs_of(offset[i] - (level + slope * along[i]));
    double scale = 4.0 * max_of(1.4826 * median_of(residual, usable, rows), 0.02);
    for (int i = 0; i < rows; i++) { /* Tukey */
        double share = residual[i] / scale, left = max_of(1.0 - share * share, 0.0);
        weight[i] = left * left * usable[i];
    }
    fit_line(along, offset, weight, rows, &level, &slope);
    *at_start = level - 0.5 * slope;
    *at_end = level + 0.5 * slope;
    return (double)count >= set->min_rows_share * rows;
}

/* Intersects adjacent sides after moving their ends outwards. Returns 0, with nothing written, if
 * two are nearly parallel. */
static int crossings(const Side *sides, const double *at_start, const double *at_end,
                     double *corners) {
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

/* The normal distribution function, to 1e-7 (Abramowitz and Stegun 26.2.17), and density,
 * tabulated. */
typedef struct {
    double distribution[2 * LAST * STEPS + 2], density[2 * LAST * STEPS + 2];
} Edge;

static void tabulate(Edge *edge) {
    for (int i = 0; i < 2 * LAST * STEPS + 2; i++) {
        double z = (double)i / STEPS - LAST, t = 1.0 / (1.0 + 0.2316419 * abs_of(z));
        double density = exponential(-0.5 * z * z) * 0.3989422804014327;
        double poly = t * 1.330274429;
        poly = (poly + -1.821255978) * t;
        poly = (poly + 1.781477937) * t;
        poly = (poly + -0.356563782) * t;
        poly = (poly + 0.319381530) * t * density;
        edge->distribution[i] = z >= 0.0 ? 1.0 - poly : poly;
        edge->density[i] = density;
    }
}

static void edge_at(const Edge *edge, double z, double *distribution, double *density) {
    *density = 0.0;
    *distribution = z > 0.0 ? 1.0 : 0.0;
    if (!(abs_of(z) < LAST)) return;
    double at = (z + LAST) * STEPS;
    int i = (int)at;
    at -= i;
    *distribution =
        edge->distribution[i] + at * (edge->distribution[i + 1] - edge->distribution[i]);
    *density = edge->density[i] + at * (edge->density[i + 1] - edge->density[i]);
}

/* Width of the white border beyond a side, pixels: `at` its start, and `rise` per pixel along
 * it. */
typedef struct {
    double at, rise;
} Border;

/* Homography (3, 3) of the unit square to corners (P. S. Heckbert, "Fundamentals of Texture Mapping
 * and Image Warping", 1989). */
static void square_homography(const double *c, double *h) {
    double dx1 = c[2] - c[4], dx2 = c[6] - c[4], sx = ((c[0] - c[2]) + c[4]) - c[6];
    double dy1 = c[3] - c[5], dy2 = c[7] - c[5], sy = ((c[1] - c[3]) + c[5]) - c[7];
    double det = dx1 * dy2 - dx2 * dy1;
    h[6] = (sx * dy2 - dx2 * sy) / det, h[7] = (dx1 * sy - sx * dy1) / det, h[8] = 1.0;
    for (int k = 0; k < 2; k++) {
        h[3 * k] = (c[2 + k] - c[k]) + h[6] * c[2 + k];
        h[3 * k + 1] = (c[6 + k] - c[k]) + h[7] * c[6 + k];
        h[3 * k + 2] = c[k];
    }
}

/* Where a homography puts a point of the unit square. */
static void on_square(const double *h, double u, double v, double *out) {
    double scale = 1.0 / ((h[6] * u + h[7] * v) + h[8]);
    for (int k = 0; k < 2; k++)
        out[k] = ((h[3 * k] * u + h[3 * k + 1] * v) + h[3 * k + 2]) * scale;
}

/* Borders of the four sides from the corners and the border's share of the marker's side. */
static void borders_of(const double *c, const Side *sides, double share, Border *borders) {
    double h[9], outer[8];
    square_homography(c, h);
    for (int i = 0; i < 4; i++)
        on_square(h, i == 1 || i == 2 ? 1.0 + share : -share, i >= 2 ? 1.0 + share : -share,
                  outer + 2 * i);
    for (int i = 0; i < 4; i++) {
        const Side *s = sides + i;
        double along[2], across[2],
            length = sqrt_of(s->vector[0] * s->vector[0] + s->vector[1] * s->vector[1]);
        for (int k = 0; k < 2; k++) {
            const double *corner = outer + 2 * ((i + k) % 4);
            double x = corner[0] - s->start[0], y = corner[1] - s->start[1];
            along[k] = (x * s->vector[0] + y * s->vector[1]) / length;
            across[k] = x * s->normal[0] + y * s->normal[1];
        }
        borders[i].rise = (across[1] - across[0]) / (along[1] - along[0]);
        borders[i].at = across[0] - borders[i].rise * along[0];
    }
}

/* The pixels near a side: offsets outwards from its line, pixels; place along it, -0.5 to 0.5;
 * width of the border there; grey level; column, of `columns` lines of pixels across the side, of
 * which those not `inside` the image are not used. */
typedef struct {
    int count, columns, column[PIXELS_MOST];
    double inside[COLUMNS_MOST], offset[PIXELS_MOST], along[PIXELS_MOST], border[PIXELS_MOST],
        level[PIXELS_MOST];
    /* Of the edge in work, and of a border's outer edge: place in sigmas, distribution, density. */
    double z[2][PIXELS_MOST], distribution[2][PIXELS_MOST], density[2][PIXELS_MOST];
} Band;

/* Return up to which offset from a side, pixels, its surroundings are used at `at` pixels along it:
 * beyond the border's outer edge if that is fitted (`outer`), else clear of it. */
static double outward_limit(const Settings *set, const Border *border, int outer, double at) {
    double edge = border->at + border->rise * at;
    return outer ? edge + set->beyond_px : min_of(set->reach_px, edge - set->clear_px);
}

/* Collects the pixels near a side, from `inner` pixels inside its line to `outward_limit`. Those
 * between the side and a border's outer edge, far from both, are left out. */
static void collect(const Image *p, const Settings *set, const Side *s, const Border *border,
                    int outer, double inner, Band *band) {
    double length = sqrt_of(s->vector[0] * s->vector[0] + s->vector[1] * s->vector[1]);
    double end = min_of(set->end_px, set->end_share * length), reach = set->reach_px;
    int k = abs_of(s->vector[0]) >= abs_of(s->vector[1]) ? 0 : 1, o = 1 - k;
    int64_t sizes[2] = {p->width, p->height};
    band->count = 0;
    band->columns =
        (int)min_of(set->columns, max_of(abs_of(s->vector[k]) * (1.0 - 2.0 * end / length), 1.0));
    for (int c = 0; c < band->columns; c++) {
        double at = end + (length - 2.0 * end) * (c + 0.5) / band->columns, ideal[2], shift[2],
               seen[2];
        for (int j = 0; j < 2; j++) seen[j] = ideal[j] = s->start[j] + at / length * s->vector[j];
        if (p->lens) distort(p, seen, seen + 1);
        for (int j = 0; j < 2; j++) shift[j] = seen[j] - ideal[j];
        double most = outward_limit(set, border, outer, at);
        double low = seen[o] - inner / s->normal[o], high = seen[o] + most / s->normal[o];
        double from = min_of(low, high), to = max_of(low, high),
               line = __builtin_floor(seen[k] + 0.5);
        band->inside[c] =
            line >= 0.0 && line < (double)sizes[k] && from >= 0.0 && to <= (double)(sizes[o] - 1)
                ? 1.0
                : 0.0;
        if (band->inside[c] == 0.0) continue;
        for (double row = __builtin_ceil(from); row <= to && band->count < PIXELS_MOST;
             row += 1.0) {
            double pixel[2], q[2];
            pixel[k] = line, pixel[o] = row;
            undistort_near(p, pixel, shift, 2, q);
            double x = q[0] - s->start[0], y = q[1] - s->start[1];
            double offset = x * s->normal[0] + y * s->normal[1],
                   along = (x * s->vector[0] + y * s->vector[1]) / length;
            double width = border->at + border->rise * along;
            if (!(offset >= -inner && offset <= outward_limit(set, border, outer, along))) continue;
            if (offset > reach && offset < width - reach) continue;
            int n = band->count++;
            band->offset[n] = offset;
            band->along[n] = along / length - 0.5;
            band->border[n] = width;
            band->level[n] = (double)p->image[(int64_t)pixel[1] * p->width + (int64_t)pixel[0]];
            band->column[n] = c;
        }
    }
}

static double limited(double value, double limit) { return min_of(max_of(value, -limit), limit); }

/* Adds one row of a least-squares problem with n unknowns to its normal equations. */
static inline __attribute__((always_inline)) void add_row(const double *row, double value,
                                                          double weight, int n, double *a,
                                                          double *b) {
    for (int i = 0; i < n; i++) {
        double w = weight * row[i];
        for (int j = i; j < n; j++) a[n * i + j] += w * row[j];
        b[i] += w * value;
    }
}

static int solve_normal(double *a, double *b, int n) {
    for (int i = 0; i < n; i++) {
        a[n * i + i] += 1e-6;
        for (int j = 0; j < i; j++) a[n * i + j] = a[n * j + i];
    }
    return solve_rows(a, b, n);
}

/* A line fitted to a side: outward offsets of its two ends, pixels, and their covariance (start;
 * both; end), without the `common` error, outwards, standard deviation, that all lines of an image
 * share; rise and fall at the side and at its border's outer edge, grey levels; logarithm of the
 * blur. `columns` that tell of correlated pixels, and `alike`, the sum over them of the variance of
 * a column over that of independent pixels. `width` of the border, pixels; whether its `outer` edge
 * is fitted, only so (`narrow`), and `cut` by neighbours. */
typedef struct {
    double ends[2], covariance[3], common, rise, fall, log_sigma, columns, alike, width;
    int outer, narrow, cut;
} Line;

/* Places across an edge, half a sigma of its blur each, whose mean residuals are no noise but the
 * shape of the blur. */
#define SHAPE 16
/* Unknowns of a side at most: black, rise, fall; offset, slope, light, blur. */
#define UNKNOWNS 7

/* Covariance of a line's ends from the normal equations (n, n) of all unknowns, of which its offset
 * and slope are those from `first` on, and the variance of a pixel. */
static int line_covariance(const double *normal, int n, int first, double variance, Line *line) {
    double block[3];
    for (int k = 0; k < 2; k++) {
        double a[UNKNOWNS * UNKNOWNS], b[UNKNOWNS] = {0.0};
        copy(normal, a, n * n);
        b[first + k] = 1.0;
        if (!solve_normal(a, b, n)) return 0;
        block[k] = b[first], block[2] = b[first + 1];
    }
    line->covariance[0] = variance * (block[0] - block[1] + 0.25 * block[2]);
    line->covariance[1] = variance * (block[0] - 0.25 * block[2]);
    line->covariance[2] = variance * (block[0] + block[1] + 0.25 * block[2]);
    return 1;
}

/* Fits a side's line to the grey levels of its pixels, with a border `outer` of known width or
 * none: light (black + rise Phi((s - e) / sigma) + fall Phi((s - e - border) / sigma)), where e =
 * offset + slope * along and light = 1 + fade * along. The levels are by least squares, sigma and
 * fade have priors. Columns that do not fit, as where something hides the side, are left out.
 * Returns whether the side is usable. */
static inline __attribute__((always_inline)) int fit_band_of(const Settings *set, const Edge *edge,
                                                             Band *band, int outer, int iterations,
                                                             Line *line) {
    double offset = 0.0, slope = 0.0, fade = 0.0, log_sigma = set->log_edge_sigma;
    double weight[COLUMNS_MOST], levels[3] = {0.0}, normal[UNKNOWNS * UNKNOWNS];
    double variance = 0.0;
    /* An assumed error of 2 grey levels sets the weight of the prior of sigma. */
    double prior = (2.0 / set->edge_sigma_spread) * (2.0 / set->edge_sigma_spread);
    double even = (2.0 / set->fade_spread) * (2.0 / set->fade_spread);
    int count = outer ? 3 : 2, n = count + 4;
    copy(band->inside, weight, band->columns);
    for (int step = 0; step < iterations; step++) {
        double sigma = exponential(log_sigma), a[UNKNOWNS * UNKNOWNS] = {0.0}, b[UNKNOWNS] = {0.0};
        double row[UNKNOWNS] = {0.0}, scaled[3];
        for (int i = 0; i < band->count; i++) {
            double s = band->offset[i] - (offset + slope * band->along[i]);
            double light = 1.0 + fade * band->along[i];
            scaled[0] = light;
            for (int k = 0; k < count - 1; k++) {
                double z = (k ? s - band->border[i] : s) / sigma;
                edge_at(edge, z, band->distribution[k] + i, band->density[k] + i);
                band->z[k][i] = z;
                scaled[1 + k] = light * band->distribution[k][i];
            }
            add_row(scaled, band->level[i], weight[band->column[i]], count, a, b);
        }
        if (!solve_normal(a, b, count)) return 0;
        copy(b, levels, count);
        double square[COLUMNS_MOST] = {0.0}, pixels[COLUMNS_MOST] = {0.0};
        double score[COLUMNS_MOST] = {0.0}, expected = 0.0;
        double shape[2 * SHAPE] = {0.0}, *at_shape = shape + SHAPE;
        zero(a, UNKNOWNS * UNKNOWNS);
        zero(b, UNKNOWNS);
        for (int i = 0; i < band->count; i++) {
            double z[2] = {0.0}, density[2] = {0.0}, light = 1.0 + fade * band->along[i];
            double model = levels[0];
            row[0] = light;
            for (int k = 0; k < count - 1; k++) {
                z[k] = band->z[k][i];
                density[k] = band->density[k][i];
                row[1 + k] = light * band->distribution[k][i];
                model += levels[1 + k] * band->distribution[k][i];
            }
            double rise = light * levels[1] * density[0], fall = light * levels[2] * density[1];
            double residual = band->level[i] - light * model;
            row[count] = -(rise + fall) / sigma;
            row[count + 1] = row[count] * band->along[i];
            row[count + 2] = model * band->along[i];
            row[count + 3] = -(rise * z[0] + fall * z[1]);
            add_row(row, residual, weight[band->column[i]], n, a, b);
            square[band->column[i]] += residual * residual;
            pixels[band->column[i]] += 1.0;
            int place = (int)min_of(max_of(2.0 * z[0] + 0.5 * SHAPE, 0.0), SHAPE - 1.0);
            score[band->column[i]] += weight[band->column[i]] * residual * row[count];
            expected += weight[band->column[i]] * row[count] * row[count];
            shape[place] += weight[band->column[i]] * residual;
            at_shape[place] += weight[band->column[i]];
        }
        double sum = 0.0, used = 0.0, scores = 0.0, columns = 0.0;
        for (int c = 0; c < band->columns; c++) {
            sum += weight[c] * square[c], used += weight[c] * pixels[c];
            scores += score[c] * score[c], columns += weight[c];
        }
        for (int k = 0; k < SHAPE; k++)
            if (at_shape[k] > 0.0) sum -= shape[k] * shape[k] / at_shape[k], used -= 1.0;
        variance = max_of(sum, 0.0) / max_of(used - n, 1.0);
        line->columns = max_of(columns - 2.0, 0.0); /* two are lost to offset and slope */
        line->alike = columns * scores / max_of(expected * variance, 1e-9);
        a[(n + 1) * (n - 2)] += even;
        b[n - 2] -= even * fade;
        a[n * n - 1] += prior;
        b[n - 1] += prior * (set->log_edge_sigma - log_sigma);
        copy(a, normal, n * n);
        if (!solve_normal(a, b, n)) return 0;
        offset = limited(offset + limited(b[count], 1.0), 2.0);
        slope = limited(slope + limited(b[count + 1], 2.0), 4.0);
        fade = limited(fade + limited(b[count + 2], 0.1), 0.5);
        log_sigma += limited(b[count + 3], 0.2);
        for (int c = 0; c < band->columns; c++) square[c] /= max_of(pixels[c], 1.0);
        double limit = 9.0 * median_of(square, band->inside, band->columns) + 4.0;
        for (int c = 0; c < band->columns; c++)
            weight[c] = square[c] < limit ? band->inside[c] : 0.0;
    }
    double used = 0.0;
    for (int c = 0; c < band->columns; c++) used += weight[c];
    line->ends[0] = offset - 0.5 * slope;
    line->ends[1] = offset + 0.5 * slope;
    line->rise = levels[1];
    line->fall = -levels[2];
    line->log_sigma = log_sigma;
    return levels[1] >= set->min_contrast && used >= set->min_rows_share * band->columns &&
           finite(line->ends[0]) && finite(line->ends[1]) &&
           line_covariance(normal, n, count, variance, line);
}

/* `fit_band_of` in two copies, whose sizes the compiler knows. */
static int fit_band(const Settings *set, const Edge *edge, Band *band, int outer, int iterations,
                    Line *line) {
    return outer ? fit_band_of(set, edge, band, 1, iterations, line)
                 : fit_band_of(set, edge, band, 0, iterations, line);
}

/* Scales the covariances of a marker's lines by what their columns tell: compression correlates
 * pixels, so that columns scatter more or less than those of independent pixels. */
static void scale_noise(const Settings *set, Line *lines) {
    double columns = set->alike_columns, alike = set->alike_columns;
    for (int i = 0; i < 4; i++) columns += lines[i].columns, alike += lines[i].alike;
    for (int i = 0; i < 4; i++)
        for (int k = 0; k < 3; k++) lines[i].covariance[k] *= alike / columns;
}

/* Adds to a line's covariance what the noise of pixels does not explain: width of a `cell` across
 * the side, and of the `finest` cell of the marker, pixels. */
static void add_model_error(const Settings *set, const Side *side, double cell, double finest,
                            Line *line) {
    double fine = set->fine_sigma_px / (cell * finest);
    double border = (line->outer ? set->outer_sigma_px : set->border_sigma_px) /
                    (line->width * line->width);
    double crossed = min_of(abs_of(side->vector[0]), abs_of(side->vector[1]));
    double aligned = set->aligned_sigma_px / (1.0 + 2.0 * crossed);
    double at_end = 2.0 * (set->least_sigma_px * set->least_sigma_px + aligned * aligned);
    double blur = line->log_sigma - set->log_edge_sigma;
    double unlike = max_of(abs_of(blur) - set->free_blur, 0.0) * set->blur_sigma_px;
    double adjoining = max_of(blur - set->free_blur, 0.0) * set->adjoining_sigma_px;
    double whole = fine * fine + border * border + unlike * unlike;
    if (line->narrow) whole += adjoining * adjoining;
    double common = set->common_share * whole;
    whole -= common;
    if (line->cut) {
        common += set->cut_sigma_px * set->cut_sigma_px;
        whole += set->cut_spread_px * set->cut_spread_px;
    }
    line->common = sqrt_of(common);
    line->covariance[0] += whole + at_end;
    line->covariance[1] += whole;
    line->covariance[2] += whole + at_end;
}

/* Fits a side's line. The outer edge of a border, used in the last round if `outlined`, must be a
 * fall in brightness and agree with the side itself: otherwise another face adjoins it. A border
 * that ends at neighbours beside parts of the side only is not fitted with its outer edge, as long
 * as enough of it is clear. */
static int fit_side(const Image *p, const Settings *set, const Edge *edge, const Side *side,
                    const Border *border, int outlined, int last, double inner, Band *band,
                    Line *line) {
    double width = border->at + 0.5 * border->rise * side->extent;
    int fine = 0, outer = 0, narrow = width < (outlined ? set->strip_px : set->partial_px);
    if (!narrow) {
        collect(p, set, side, border, 0, inner, band);
        fine = fit_band(set, edge, band, 0, (int)set->iterations, line);
    }
    if (narrow || (fine && outlined && last)) {
        Line both;
        collect(p, set, side, border, 1, inner, band);
        int fits = fit_band(set, edge, band, 1,
                            (int)(narrow ? set->strip_iterations : set->iterations), &both);
        if (narrow) fine = fits;
        else fits = fits && both.fall >= set->least_fall * both.rise;
        for (int k = 0; k < 2 && fits && !narrow; k++) {
            double sigma = sqrt_of(line->covariance[2 * k]);
            double limit = min_of(set->agreement_px, set->agreement_sigmas * sigma);
            fits = abs_of(both.ends[k] - line->ends[k]) < limit;
        }
        if (fits) *line = both, outer = 1;
    }
    line->width = max_of(width, 0.5);
    line->outer = outer, line->narrow = narrow, line->cut = narrow && !outlined;
    return fine;
}

/* Writes the matrix (8, 8) that turns errors of a marker's corners into independent ones of unit
 * variance: those of the lines of its sides, by the covariance of their ends; and what the `common`
 * error (8) is by that. Returns whether both are finite. */
static int whiten(const Side *sides, const Line *lines, double *whitening, double *common) {
    zero(whitening, 64);
    for (int i = 0; i < 4; i++) {
        const double *c = lines[i].covariance, *normal = sides[i].normal;
        double first = sqrt_of(c[0]), cross = c[1] / first, second = sqrt_of(c[2] - cross * cross);
        int at[2] = {2 * i, 2 * ((i + 1) % 4)};
        for (int k = 0; k < 2; k++) {
            whitening[8 * (2 * i) + at[0] + k] = normal[k] / first;
            whitening[8 * (2 * i + 1) + at[0] + k] = -normal[k] * cross / (first * second);
            whitening[8 * (2 * i + 1) + at[1] + k] = normal[k] / second;
        }
        common[2 * i] = lines[i].common / first;
        common[2 * i + 1] = lines[i].common * (1.0 - cross / first) / second;
    }
    return all_finite(whitening, 64) && all_finite(common, 8);
}

/* Refines corners (n, 4, 2) in place, in the frame (n, 3, 3) of a marker if it is `framed` (n),
 * else in ideal pixels. `lens`: null without distortion. `good` (n): whether all four sides are
 * usable; otherwise the corners are unchanged, as for corners that are not finite. `whitening`
 * (n, 8, 8) and `common` (n, 8): of the errors of good corners, as `whiten`. `margin` (n): width of
 * the white border over the marker's side; `outlined` (n): whether it ends there on all sides.
 * `cells`: cells along a side, including the black border. */
EXPORT void NAME(refine_corners)(const uint8_t *image, int64_t height, int64_t width,
                                 const double *camera, const Lens *lens, const double *frames,
                                 const uint8_t *framed, const Settings *set, double cells,
                                 int64_t n, const double *margin, const uint8_t *outlined,
                                 double *corners, uint8_t *good, double *whitening,
                                 double *common) {
    Image p = {image, height, width, camera, lens, NULL};
    Edge edge;
    Band band;
    tabulate(&edge);
    for (int64_t m = 0; m < n; m++) {
        double *given = corners + 8 * m, refined[8], at_start[4], at_end[4];
        Side sides[4];
        Border borders[4];
        Line lines[4];
        int fine = 1;
        p.frame = framed[m] ? frames + 9 * m : NULL;
        copy(given, refined, 8);
        sides_of(refined, sides);
        for (int i = 0; i < 4; i++)
            fine &= centroid_line(&p, set, sides + i, cells, margin[m], at_start + i, at_end + i);
        fine = fine && crossings(sides, at_start, at_end, refined);
        for (int round = 0; round < (int)set->rounds && fine; round++) {
            sides_of(refined, sides);
            borders_of(refined, sides, margin[m], borders);
            int last = round + 1 == (int)set->rounds;
            for (int i = 0; i < 4 && fine; i++) {
                double inner = reach_of(set, sides + i, cells, set->reach_px);
                fine = fit_side(&p, set, &edge, sides + i, borders + i, outlined[m], last, inner,
                                &band, lines + i);
                at_start[i] = lines[i].ends[0], at_end[i] = lines[i].ends[1];
            }
            fine = fine && crossings(sides, at_start, at_end, refined);
        }
        for (int i = 0; i < 8; i++) fine &= abs_of(refined[i] - given[i]) < set->max_move_px;
        double finest = 1e300;
        for (int i = 0; i < 4; i++) finest = min_of(finest, sides[i].extent / cells);
        if (fine) {
            scale_noise(set, lines);
            for (int i = 0; i < 4; i++)
                add_model_error(set, sides + i, sides[i].extent / cells, finest, lines + i);
        }
        fine = fine && whiten(sides, lines, whitening + 64 * m, common + 8 * m);
        if (fine) copy(refined, given, 8);
        good[m] = (uint8_t)fine;
    }
}
