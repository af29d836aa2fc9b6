/* SPDX-License-Identifier: Apache-2.0 */
/* Fits the corners of a small marker to the grey levels of all its cells. Method:
 * chaserdock_agents.chaser.perception.pattern. */
#include "lens.h"

/* Capacity: pixels of a marker with what is used of its white border: 64 x 64. */
#define PATTERN_PIXELS 4096
/* Capacity: cells along a side; OpenCV's dictionaries have up to 10. */
#define CELLS_MOST 16
/* Unknowns: levels of white and of black below it; then the blur. */
#define LEVELS 2
/* Unknowns of the displacement: those of a homography. */
#define SHAPES 8
/* Unknowns of the ends of the border: the rise beyond each side. */
#define ENDS 4
/* Terms of the series of a blurred corner; with five, 0.004 is left at a correlation of 0.8. */
#define ORDERS 5
#define PATTERN_UNKNOWNS (LEVELS + 1 + SHAPES + ENDS)
#define PATTERN_NORMAL (PATTERN_UNKNOWNS * PATTERN_UNKNOWNS)

/* Settings, in the order of the Python caller; see pattern.py for each. */
typedef struct {
    double log_sigma, sigma_spread, clear_px, reach_px, least_explained, max_move_px, min_contrast,
        settled_px, iterations;
} PatternSettings;
LAYOUT(PatternSettings, log_sigma, sigma_spread, clear_px, reach_px, least_explained, max_move_px,
       min_contrast, settled_px, iterations)

/* Pixels of a marker: coordinates of the marker in work, grey level. */
typedef struct {
    int count;
    double x[PATTERN_PIXELS], y[PATTERN_PIXELS], level[PATTERN_PIXELS];
} Patch;

/* A place on a marker by a pixel: coordinates, 0 to 1 from side to side, and their gradients. */
typedef struct {
    double at[2], by[2][2];
} Place;

/* Inverse, up to a factor, of the homography of the unit square to corners. */
static void to_square(const double *c, double *inverse) {
    double h[9], column[3][3];
    square_homography(c, h);
    for (int i = 0; i < 9; i++) column[i % 3][i / 3] = h[i];
    for (int i = 0; i < 3; i++) cross3(column[(i + 1) % 3], column[(i + 2) % 3], inverse + 3 * i);
}

static Place place_of(const double *inverse, double x, double y) {
    double pixel[3] = {x, y, 1.0}, q[3];
    Place p;
    multiply3(inverse, pixel, q);
    for (int k = 0; k < 2; k++) {
        p.at[k] = q[k] / q[2];
        for (int j = 0; j < 2; j++)
            p.by[k][j] = (inverse[3 * k + j] - p.at[k] * inverse[6 + j]) / q[2];
    }
    return p;
}

/* How far beyond the sides pixels are used, as a share of the side, at a gradient by pixels. */
static double used_share(const PatternSettings *set, double margin, int outlined, double gradient) {
    double share = min_of(margin - set->clear_px * gradient, set->reach_px * gradient);
    return outlined ? margin : max_of(share, 0.0);
}

static double steepness(const Place *p, int k) {
    return sqrt_of(p->by[k][0] * p->by[k][0] + p->by[k][1] * p->by[k][1]);
}

/* Collects the pixels of a marker. Returns whether there is room for all. */
static int collect_patch(const Image *p, const PatternSettings *set, const double *corners,
                         double margin, int outlined, Patch *patch) {
    double inverse[9], h[9], low[2] = {1e300, 1e300}, high[2] = {-1e300, -1e300};
    int64_t sizes[2] = {p->width, p->height}, from[2], to[2];
    double share = min_of(margin, 0.5);
    double shift[2] = {0.0};
    square_homography(corners, h);
    to_square(corners, inverse);
    if (p->lens) {
        double centre[2], seen[2];
        on_square(h, 0.5, 0.5, centre);
        copy(centre, seen, 2);
        distort(p, seen, seen + 1);
        for (int k = 0; k < 2; k++) shift[k] = seen[k] - centre[k];
    }
    for (int i = 0; i < 4; i++) { /* of the marker with its border, in the image */
        double seen[2];
        on_square(h, i == 1 || i == 2 ? 1.0 + share : -share, i >= 2 ? 1.0 + share : -share, seen);
        if (p->lens) distort(p, seen, seen + 1);
        for (int k = 0; k < 2; k++) {
            if (!finite(seen[k])) return 0;
            low[k] = min_of(low[k], seen[k]), high[k] = max_of(high[k], seen[k]);
        }
    }
    for (int k = 0; k < 2; k++) {
        from[k] = (int64_t)min_of(max_of(low[k], 0.0), 1e6);
        to[k] = (int64_t)min_of(max_of(high[k] + 1.0, 0.0), (double)sizes[k]);
    }
    patch->count = 0;
    for (int64_t row = from[1]; row < to[1]; row++)
        for (int64_t column = from[0]; column < to[0]; column++) {
            double pixel[2] = {(double)column, (double)row}, q[2];
            undistort_near(p, pixel, shift, 6, q);
            Place at = place_of(inverse, q[0], q[1]);
            int inside = 1;
            for (int k = 0; k < 2; k++) {
                double most = used_share(set, margin, outlined, steepness(&at, k));
                inside &= at.at[k] >= -most && at.at[k] <= 1.0 + most;
            }
            if (!inside) continue;
            if (patch->count == PATTERN_PIXELS) return 0;
            int n = patch->count++;
            patch->x[n] = q[0], patch->y[n] = q[1];
            patch->level[n] = (double)p->image[row * p->width + column];
        }
    return 1;
}

/* What strips along one axis are, blurred by `sigma`, at a place: their share of the blur, and its
 * derivatives by it, as the terms of `add_product`. They begin at `first + i * width`, i <
 * `count`. */
static void strips_at(const Edge *edge, double at, double sigma, double first, double width,
                      int count, double (*share)[ORDERS]) {
    double last[ORDERS] = {0.0}, next[ORDERS];
    for (int i = 0; i <= count; i++) {
        double z = (at - (first + i * width)) / sigma;
        edge_at(edge, z, next, next + 1);
        next[2] = z * next[1];
        for (int n = 3; n < ORDERS; n++) next[n] = z * next[n - 1] - (n - 2) * next[n - 2];
        for (int n = 0; n < ORDERS && i > 0; n++) share[i - 1][n] = last[n] - next[n];
        copy(next, last, ORDERS);
    }
}

/* Adds what a strip along one axis and one along the other have in common, blurred with a
 * `correlation` between the axes, as the marker is seen askew: value, derivatives by both places in
 * sigmas, and by the logarithm of the blur. The series is that of the normal distribution of two
 * variables (M. G. Kendall, Biometrika, 1941), derivatives are to first order. */
static void add_product(const double *a, const double *b, double correlation, double *out) {
    double factor = 1.0;
    for (int n = 0; n < ORDERS; n++) {
        out[0] += factor * a[n] * b[n];
        factor *= correlation / (n + 1.0);
    }
    out[1] += a[1] * b[0] - correlation * a[2] * b[1];
    out[2] += a[0] * b[1] - correlation * a[1] * b[2];
    out[3] += 2.0 * correlation * a[1] * b[1] - a[2] * b[0] - a[0] * b[2];
}

/* The pattern of a marker at a place: share of black, and with a border that ends (`outlined`) of
 * what is beyond its four ends, each with derivatives by both coordinates and by the logarithm of
 * the blur. */
static void pattern_at(const Edge *edge, const Place *p, double sigma, double margin, int outlined,
                       const uint8_t *white, int cells, double *black, double (*beyond)[4]) {
    double share[2][CELLS_MOST][ORDERS], blurs[2], steep[2] = {steepness(p, 0), steepness(p, 1)};
    int from[2], to[2];
    zero(black, 4);
    for (int k = 0; k < 2; k++) {
        double blur = blurs[k] = sigma * steep[k], reach = LAST * blur;
        /* Strips within reach of the blur: others have no share. */
        from[k] = (int)min_of(max_of((p->at[k] - reach) * cells, 0.0), cells);
        to[k] = (int)min_of(max_of((p->at[k] + reach) * cells + 1.0, 0.0), cells);
        strips_at(edge, p->at[k], blur, (double)from[k] / cells, 1.0 / cells, to[k] - from[k],
                  share[k]);
    }
    double askew = (p->by[0][0] * p->by[1][0] + p->by[0][1] * p->by[1][1]) /
                   (steep[0] * steep[1]);
    for (int j = from[1]; j < to[1]; j++) {
        double row[ORDERS] = {0.0};
        for (int i = from[0]; i < to[0]; i++) {
            double dark = white[j * cells + i] ? 0.0 : 1.0;
            for (int n = 0; n < ORDERS; n++) row[n] += dark * share[0][i - from[0]][n];
        }
        add_product(row, share[1][j - from[1]], askew, black);
    }
    for (int k = 0; k < 2; k++) black[1 + k] /= blurs[k];
    if (!outlined) return;
    const double every[ORDERS] = {1.0};
    double end[1][ORDERS], within[1][ORDERS];
    strips_at(edge, p->at[0], blurs[0], -margin, 1.0 + 2.0 * margin, 1, within);
    zero(beyond[0], 4 * ENDS);
    for (int i = 0; i < ENDS; i++) {
        int k = i / 2;
        strips_at(edge, p->at[k], blurs[k], i % 2 ? 1.0 + margin : -margin - 100.0, 100.0, 1, end);
        add_product(k ? within[0] : end[0], k ? end[0] : every, askew, beyond[i]);
        for (int j = 0; j < 2; j++) beyond[i][1 + j] /= blurs[j];
    }
}

/* Displacement of the image by infinitesimal homographies, at a place relative to a marker's centre
 * in units of half its size. */
static void displacements(double x, double y, double (*by)[2]) {
    const double one[SHAPES][2] = {{1.0, 0.0}, {x, 0.0}, {y, 0.0}, {0.0, 1.0},
                                   {0.0, x},   {0.0, y}, {x * x, x * y}, {x * y, y * y}};
    for (int i = 0; i < SHAPES; i++)
        for (int k = 0; k < 2; k++) by[i][k] = one[i][k];
}

/* Fits the corners of a marker to its pixels: white - depth * black, and, if the border ends on all
 * sides (`outlined`), a level of its own beyond each end. Returns the share of the pixels' variance
 * that is explained, 0 if it cannot be fitted; `covariance` (8, 8) of the corners for independent
 * pixels. */
static double fit_patch(const PatternSettings *set, const Edge *edge, const Patch *patch,
                        double margin, int outlined, const uint8_t *white, int cells,
                        double *corners, double *covariance) {
    double levels[PATTERN_UNKNOWNS] = {0.0}, log_sigma = set->log_sigma, normal[PATTERN_NORMAL];
    double prior = (2.0 / set->sigma_spread) * (2.0 / set->sigma_spread), explained = 0.0;
    double centre[2], half = 0.0, variance = 0.0;
    const int ends = outlined ? ENDS : 0, beyond_at = PATTERN_UNKNOWNS - ENDS, n = beyond_at + ends;
    for (int k = 0; k < 2; k++)
        centre[k] = 0.25 * ((corners[k] + corners[2 + k]) + (corners[4 + k] + corners[6 + k]));
    for (int i = 0; i < 8; i++) half = max_of(half, abs_of(corners[i] - centre[i & 1]));
    if (!(half > 0.5) || patch->count <= 2 * n) return 0.0;
    double at_corner[4][SHAPES][2];
    for (int i = 0; i < 4; i++)
        displacements((corners[2 * i] - centre[0]) / half, (corners[2 * i + 1] - centre[1]) / half,
                      at_corner[i]);
    double least = 255.0, sum = 0.0, square = 0.0, settled = 0.0;
    for (int i = 0; i < patch->count; i++) {
        levels[0] = max_of(levels[0], patch->level[i]), least = min_of(least, patch->level[i]);
        sum += patch->level[i], square += patch->level[i] * patch->level[i];
    }
    levels[1] = levels[0] - least;
    double total = square - sum * sum / patch->count;
    for (int step = 0; step < (int)set->iterations && settled == 0.0; step++) {
        double inverse[9], a[PATTERN_NORMAL] = {0.0}, b[PATTERN_UNKNOWNS] = {0.0};
        double right[PATTERN_UNKNOWNS], left = 0.0, sigma = exponential(log_sigma);
        to_square(corners, inverse);
        for (int i = 0; i < patch->count; i++) {
            double black[4], beyond[ENDS][4], row[PATTERN_UNKNOWNS], by[SHAPES][2], slope[2];
            double gradient[3], residual = patch->level[i] - levels[0];
            Place p = place_of(inverse, patch->x[i], patch->y[i]);
            pattern_at(edge, &p, sigma, margin, outlined, white, cells, black, beyond);
            row[0] = 1.0, row[1] = -black[0];
            residual += levels[1] * black[0];
            for (int k = 0; k < 3; k++) gradient[k] = -levels[1] * black[1 + k];
            for (int e = 0; e < ends; e++) {
                row[beyond_at + e] = beyond[e][0];
                residual -= levels[beyond_at + e] * beyond[e][0];
                for (int k = 0; k < 3; k++) gradient[k] += levels[beyond_at + e] * beyond[e][1 + k];
            }
            for (int k = 0; k < 2; k++)
                slope[k] = -(gradient[0] * p.by[0][k] + gradient[1] * p.by[1][k]);
            row[LEVELS] = gradient[2];
            displacements((patch->x[i] - centre[0]) / half, (patch->y[i] - centre[1]) / half, by);
            for (int k = 0; k < SHAPES; k++)
                row[LEVELS + 1 + k] = slope[0] * by[k][0] + slope[1] * by[k][1];
            if (ends) add_row(row, residual, 1.0, PATTERN_UNKNOWNS, a, b);
            else add_row(row, residual, 1.0, PATTERN_UNKNOWNS - ENDS, a, b);
            left += residual * residual;
        }
        a[(n + 1) * LEVELS] += prior;
        b[LEVELS] += prior * (set->log_sigma - log_sigma);
        copy(a, normal, n * n);
        copy(b, right, n);
        if (!solve_normal(a, b, n)) return 0.0;
        for (int k = 0; k < n; k++) left -= right[k] * b[k]; /* after the step, as far as linear */
        left = max_of(left, 0.0);
        explained = total > 0.0 ? 1.0 - left / total : 0.0;
        variance = left / (patch->count - n);
        for (int k = 0; k < n; k++) levels[k] += k < LEVELS || k >= beyond_at ? b[k] : 0.0;
        log_sigma += limited(b[LEVELS], 0.2);
        log_sigma = set->log_sigma + limited(log_sigma - set->log_sigma, 1.0);
        double most = 1e-300;
        for (int k = 0; k < SHAPES; k++) most = max_of(most, abs_of(b[LEVELS + 1 + k]));
        double share = min_of(1.0 / most, 1.0);
        for (int i = 0; i < 8; i++)
            for (int k = 0; k < SHAPES; k++)
                corners[i] += share * b[LEVELS + 1 + k] * at_corner[i / 2][k][i & 1];
        settled = most < set->settled_px ? 1.0 : 0.0;
    }
    if (settled == 0.0 || !(levels[1] >= set->min_contrast) || !all_finite(corners, 8)) return 0.0;
    double inverse[SHAPES][SHAPES];
    for (int k = 0; k < SHAPES; k++) {
        double a[PATTERN_NORMAL], b[PATTERN_UNKNOWNS] = {0.0};
        copy(normal, a, n * n);
        b[LEVELS + 1 + k] = 1.0;
        if (!solve_normal(a, b, n)) return 0.0;
        copy(b + LEVELS + 1, inverse[k], SHAPES);
    }
    for (int i = 0; i < 8; i++)
        for (int j = 0; j < 8; j++) {
            sum = 0.0;
            for (int k = 0; k < SHAPES; k++)
                for (int l = 0; l < SHAPES; l++)
                    sum += at_corner[i / 2][k][i & 1] * inverse[k][l] * at_corner[j / 2][l][j & 1];
            covariance[8 * i + j] = variance * sum;
        }
    for (int i = 0; i < 8; i++) /* as good as unknown */
        if (!(covariance[9 * i] < set->max_move_px * set->max_move_px)) return 0.0;
    return all_finite(covariance, 64) ? explained : 0.0;
}

/* Fits the corners (n, 4, 2) of markers in place, in their frames as for `refine_corners`, to the
 * grey levels of their cells: `white` (n, cells, cells), 1 for white ones. `margin`, `outlined`: as
 * there. `explained` (n): share of the variance of the pixels that the pattern explains; 0, with
 * corners and covariance unchanged, for those that are not found. `covariance` (n, 8, 8): of found
 * corners, px^2, for independent pixels. */
EXPORT void NAME(fit_patterns)(const uint8_t *image, int64_t height, int64_t width,
                               const double *camera, const Lens *lens, const double *frames,
                               const uint8_t *framed, const PatternSettings *set, int64_t cells,
                               int64_t n, const double *margin, const uint8_t *outlined,
                               const uint8_t *white, double *corners, double *explained,
                               double *covariance) {
    Image p = {image, height, width, camera, lens, NULL};
    Edge edge;
    Patch patch;
    tabulate(&edge);
    for (int64_t m = 0; m < n; m++) {
        double *given = corners + 8 * m, fitted[8], errors[64], found = 0.0;
        p.frame = framed[m] ? frames + 9 * m : NULL;
        copy(given, fitted, 8);
        if (cells <= CELLS_MOST && all_finite(fitted, 8) &&
            collect_patch(&p, set, fitted, margin[m], outlined[m], &patch))
            found = fit_patch(set, &edge, &patch, margin[m], outlined[m], white + m * cells * cells,
                              (int)cells, fitted, errors);
        for (int i = 0; i < 8 && found > 0.0; i++)
            if (!(abs_of(fitted[i] - given[i]) < set->max_move_px)) found = 0.0;
        explained[m] = found >= set->least_explained ? found : 0.0;
        if (explained[m] > 0.0) copy(fitted, given, 8), copy(errors, covariance + 64 * m, 64);
    }
}
