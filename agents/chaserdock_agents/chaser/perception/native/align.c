/* SPDX-License-Identifier: Apache-2.0 */
/* Control points of a synthetic view, and the pose that aligns their profiles with an image.
 *
 * Control points are maxima of the gradient of the synthetic view. Across each, a profile of
 * PROFILE samples is searched in the image by normalized correlation, with sign, and refined by
 * least squares over shift, gain and offset (B. D. Lucas, T. Kanade, 1981, in one dimension). The
 * pose follows from the shifts along the gradients by iteratively reweighted least squares on SE(3)
 * with Tukey's biweight, as in C. Harris, C. Stennett, "RAPID", BMVC 1990, and later model-based
 * trackers. */
#include "lens.h"

/* Samples to either side of a control point, a pixel apart: an edge, its spread, and some of both
 * surfaces. */
#define HALF 4
#define PROFILE (2 * HALF + 1) /* samples of a profile */
/* Capacity: pixels to either side in which a profile is searched; callers ask for at most 10. */
#define REACH_MOST 24
#define TAPS_OF_REACH (2 * (REACH_MOST + HALF) + 1) /* samples across the largest search */
#define PER_CELL_MOST 4 /* capacity: control points of a cell; callers ask for 2 */
/* Standard deviation of a match that contrast does not explain. */
#define FLOOR_PX 0.1

/* Selection of control points. */
typedef struct {
    double cell_px, per_cell, min_gradient;
} PointChoice;

/* A camera on the grid of one image level. */
typedef struct {
    double fx, fy, cx, cy, height, width;
    Lens lens;
} LevelCamera;
LAYOUT(LevelCamera, fx, fy, cx, cy, height, width, lens)

/* ``reach_px``: searched at first on both sides; ``iterations``; ``min_correlation`` of a match;
 * ``noise``: grey levels;
 * ``inlier_px``: largest residual of an inlier. */
typedef struct {
    double reach_px, iterations, min_correlation, noise, inlier_px;
} AlignSettings;

static inline double gradient_at(const float *image, int64_t width, int64_t at, double *g) {
    g[0] = 0.5 * ((double)image[at + 1] - (double)image[at - 1]);
    g[1] = 0.5 * ((double)image[at + width] - (double)image[at - width]);
    return g[0] * g[0] + g[1] * g[1];
}

/* Bilinear interpolation at (x, y); return 0 outside the image. */
static inline int interpolate(const float *image, int64_t height, int64_t width, double x, double y,
                              double *value) {
    if (!(x >= 0.0 && y >= 0.0 && x < (double)(width - 1) && y < (double)(height - 1))) return 0;
    int64_t column = (int64_t)x, row = (int64_t)y;
    double u = x - (double)column, v = y - (double)row;
    const float *p = image + row * width + column;
    double top = (double)p[0] + u * ((double)p[1] - (double)p[0]);
    double bottom = (double)p[width] + u * ((double)p[width + 1] - (double)p[width]);
    *value = top + v * (bottom - top);
    return 1;
}

/* Inverse depth at a pixel of the triangle's plane; ``near`` if that differs by more than 3 %, as
 * at grazing incidence. */
static double plane_depth(const double *pose, const double *vertices, const int64_t *triangle,
                          const double *ray, double near) {
    double at[3][3], ab[3], ac[3], normal[3];
    for (int i = 0; i < 3; i++) {
        multiply3(pose + 3, vertices + 3 * triangle[i], at[i]);
        for (int k = 0; k < 3; k++) at[i][k] += pose[k];
    }
    subtract3(at[1], at[0], ab), subtract3(at[2], at[0], ac);
    cross3(ab, ac, normal);
    double depth = dot3(normal, ray) / dot3(normal, at[0]);
    return abs_of(depth - near) <= 0.03 * near ? depth : near;
}

/* Find the control points of a synthetic view; return their number m. ``view`` (height, width)
 * float; ``nearest``, ``owner``: see render_mesh; ``lens``, ``pose``, ``vertices``, ``triangles``:
 * of that rendering. Each cell of cell_px x cell_px keeps the per_cell strongest (at most
 * PER_CELL_MOST). Output: ``points`` (m, 3) and ``ahead`` (m, 3), one pixel along the gradient at
 * the same depth, TRF; ``profiles`` (m, PROFILE); ``owners`` (m) int64: triangle. ``work``: height
 * width + cells 5 PER_CELL_MOST doubles. */
EXPORT int64_t NAME(control_points)(const float *view, const float *nearest, const int32_t *owner,
                                    int64_t height, int64_t width, const double *lens,
                                    const double *pose, const double *vertices,
                                    const int64_t *triangles, const PointChoice *choice,
                                    double *points, double *ahead, double *profiles,
                                    int64_t *owners, double *work) {
    int64_t cell = (int64_t)choice->cell_px, per_cell = (int64_t)choice->per_cell,
            border = HALF + 2, count = 0;
    int64_t across = (width + cell - 1) / cell, cells = across * ((height + cell - 1) / cell);
    double *square = work, *best = work + height * width,
           limit = choice->min_gradient * choice->min_gradient;
    zero(square, height * width);
    for (int64_t i = 0; i < cells * PER_CELL_MOST; i++) best[5 * i] = 0.0;
    for (int64_t y = 1; y < height - 1; y++)
        for (int64_t x = 1; x < width - 1; x++) {
            double g[2];
            square[y * width + x] = gradient_at(view, width, y * width + x, g);
        }
    for (int64_t y = border; y < height - border; y++)
        for (int64_t x = border; x < width - border; x++) {
            int64_t at = y * width + x;
            double here = square[at], g[2];
            if (!(here > limit)) continue;
            gradient_at(view, width, at, g);
            double ax = abs_of(g[0]), ay = abs_of(g[1]);
            /* Neighbour along the gradient, of eight. */
            int64_t sx = ax > 0.41421356 * ay ? (g[0] > 0.0 ? 1 : -1) : 0,
                    sy = ay > 0.41421356 * ax ? (g[1] > 0.0 ? 1 : -1) : 0;
            double next = square[at + sy * width + sx], last = square[at - sy * width - sx];
            if (!(here > last && here >= next)) continue;
            double a = sqrt_of(last), b = sqrt_of(here), c = sqrt_of(next), bend = a - 2.0 * b + c;
            double shift = bend < -1e-12 ? 0.5 * (a - c) / bend : 0.0;
            shift = max_of(-0.5, min_of(0.5, shift));
            double *slot = best + 5 * PER_CELL_MOST * ((y / cell) * across + x / cell);
            int64_t k = per_cell - 1;
            if (!(here > slot[5 * k])) continue;
            for (; k > 0 && here > slot[5 * (k - 1)]; k--)
                copy(slot + 5 * (k - 1), slot + 5 * k, 5);
            double entry[5] = {here, (double)x + shift * (double)sx, (double)y + shift * (double)sy,
                               g[0] / b, g[1] / b};
            copy(entry, slot + 5 * k, 5);
        }
    for (int64_t i = 0; i < cells; i++)
        for (int64_t k = 0; k < per_cell; k++) {
            const double *entry = best + 5 * (PER_CELL_MOST * i + k);
            if (!(entry[0] > 0.0)) break;
            double x = entry[1], y = entry[2];
            int64_t column = (int64_t)(x + 0.5), row = (int64_t)(y + 0.5), triangle = -1;
            float near = 0.0f;
            for (int64_t j = -1; j <= 1; j++)
                for (int64_t l = -1; l <= 1; l++) {
                    int64_t at = (row + j) * width + column + l;
                    if (owner[at] >= 0 && nearest[at] > near)
                        near = nearest[at], triangle = owner[at];
                }
            if (triangle < 0) continue;
            int inside = 1;
            for (int j = 0; j < PROFILE && inside; j++)
                inside = interpolate(view, height, width, x + (j - HALF) * entry[3],
                                     y + (j - HALF) * entry[4], profiles + PROFILE * count + j);
            if (!inside) continue;
            double ray[3] = {(x - lens[2]) / lens[0], (y - lens[3]) / lens[1], 1.0};
            double depth = plane_depth(pose, vertices, triangles + 3 * triangle, ray, near);
            double next[3] = {ray[0] + entry[3] / lens[0], ray[1] + entry[4] / lens[1], 1.0};
            for (int p = 0; p < 2; p++) {
                double at[3], *out = (p ? ahead : points) + 3 * count;
                for (int j = 0; j < 3; j++) at[j] = (p ? next : ray)[j] / depth - pose[j];
                for (int j = 0; j < 3; j++)
                    out[j] = pose[3 + j] * at[0] + pose[6 + j] * at[1] + pose[9 + j] * at[2];
            }
            owners[count++] = triangle;
        }
    return count;
}

/* Convert an ideal pixel of a level to a pixel of the distorted image. */
static inline void distort_px(const LevelCamera *c, double u, double v, double *out) {
    distort_ray(&c->lens, (u - c->cx) / c->fx, (v - c->cy) / c->fy, out);
    out[0] = out[0] * c->fx + c->cx;
    out[1] = out[1] * c->fy + c->cy;
}

/* Shift of best correlation of ``profile`` along ``taps`` (2 (reach + HALF) + 1), in steps; refined
 * by least squares over shift, gain and offset. Return the correlation, -1 without texture;
 * ``variance``: of the shift for unit noise. */
static double match_profile(const double *profile, const double *taps, int reach, double *shift,
                            double *variance) {
    double mean = 0.0, power = 0.0, centred[PROFILE], best = -1.0;
    for (int j = 0; j < PROFILE; j++) mean += profile[j];
    mean /= PROFILE;
    for (int j = 0; j < PROFILE; j++)
        centred[j] = profile[j] - mean, power += centred[j] * centred[j];
    int chosen = 0;
    for (int d = -reach; d <= reach; d++) {
        const double *window = taps + d + reach;
        double sum = 0.0, squares = 0.0, product = 0.0;
        for (int j = 0; j < PROFILE; j++)
            sum += window[j], squares += window[j] * window[j], product += window[j] * centred[j];
        double spread = (squares - sum * sum / PROFILE) * power;
        if (!(spread > 1e-9)) continue;
        double correlation = product / sqrt_of(spread);
        if (correlation > best) best = correlation, chosen = d;
    }
    *shift = (double)chosen, *variance = 1e9;
    if (!(best > 0.0)) return -1.0;
    /* window = gain profile + offset - shift slope; slope of the window by central differences. */
    const double *window = taps + chosen + reach;
    double normal[9] = {0.0}, right[3] = {0.0};
    for (int j = 1; j < PROFILE - 1; j++) {
        double row[3] = {profile[j], 1.0, -0.5 * (window[j + 1] - window[j - 1])};
        for (int a = 0; a < 3; a++) {
            right[a] += row[a] * window[j];
            for (int b = 0; b < 3; b++) normal[3 * a + b] += row[a] * row[b];
        }
    }
    /* Variance of the shift with known gain and offset. */
    *variance = 1.0 / max_of(normal[8], 1e-9);
    if (solve_rows(normal, right, 3) && right[0] > 0.0 && abs_of(right[2]) <= 1.0)
        *shift += right[2];
    return best;
}

/* Return the element of rank ``rank`` of a (n) (C. A. R. Hoare's selection); reorders a. */
static double select_rank(double *a, int64_t n, int64_t rank) {
    int64_t low = 0, high = n - 1;
    while (low < high) {
        double pivot = a[low + (high - low) / 2];
        int64_t i = low, j = high;
        while (i <= j) {
            while (a[i] < pivot) i++;
            while (pivot < a[j]) j--;
            if (i <= j) {
                double swap = a[i];
                a[i++] = a[j], a[j--] = swap;
            }
        }
        if (rank <= j) high = j;
        else if (rank >= i) low = i;
        else break;
    }
    return a[rank];
}

/* Measure all points at a pose: ``residual`` (n), pixels along the gradient, ``weight`` (n):
 * inverse variance, 0 without a match and -1 outside the image, ``rows`` (n, 6): derivative by a
 * rotation in camera axes and by position. */
static void measure(const LevelCamera *camera, const float *image, const AlignSettings *set,
                    const double *pose, const double *points, const double *ahead,
                    const double *profiles, const double *border, int64_t n, int reach,
                    double *residual, double *weight, double *correlation, double *rows) {
    int64_t height = (int64_t)camera->height, width = (int64_t)camera->width;
    for (int64_t i = 0; i < n; i++) {
        double turned[3], at[3], next[3], taps[TAPS_OF_REACH], shift, variance;
        residual[i] = 0.0, weight[i] = -1.0, correlation[i] = 0.0;
        zero(rows + 6 * i, 6);
        multiply3(pose + 3, points + 3 * i, turned);
        multiply3(pose + 3, ahead + 3 * i, next);
        for (int k = 0; k < 3; k++) at[k] = turned[k] + pose[k], next[k] += pose[k];
        if (!(at[2] > 1e-3 && next[2] > 1e-3)) continue;
        double u = at[0] / at[2], v = at[1] / at[2];
        double px = camera->fx * u + camera->cx, py = camera->fy * v + camera->cy;
        double sx = camera->fx * next[0] / next[2] + camera->cx - px,
               sy = camera->fy * next[1] / next[2] + camera->cy - py;
        double step = sqrt_of(sx * sx + sy * sy);
        if (!(step > 0.1 && step < 10.0)) continue;
        int inside = 1;
        for (int k = -(reach + HALF); k <= reach + HALF && inside; k++) {
            double place[2];
            distort_px(camera, px + k * sx, py + k * sy, place);
            inside = interpolate(image, height, width, place[0], place[1], taps + k + reach + HALF);
        }
        if (!inside) continue;
        weight[i] = 0.0;
        correlation[i] = match_profile(profiles + PROFILE * i, taps, reach, &shift, &variance);
        residual[i] = shift * step;
        double by[3] = {camera->fx * sx, camera->fy * sy, 0.0}, *row = rows + 6 * i;
        for (int k = 0; k < 2; k++) by[k] /= step * at[2];
        by[2] = -(by[0] * u + by[1] * v);
        cross3(turned, by, row);
        copy(by, row + 3, 3);
        if (correlation[i] < set->min_correlation) continue;
        double floor_px = border[i] * camera->fx / at[2];
        double sigma_square = FLOOR_PX * FLOOR_PX + floor_px * floor_px +
                              set->noise * set->noise * variance * step * step;
        weight[i] = 1.0 / sigma_square;
    }
}

/* Compute exp([phi]x) R by Cayley's formula, which is a rotation and exact to third order; steps
 * are small. */
static void turn_pose(const double *phi, double *rotation) {
    double half[3] = {0.5 * phi[0], 0.5 * phi[1], 0.5 * phi[2]},
           factor = 2.0 / (1.0 + dot3(half, half));
    for (int j = 0; j < 3; j++) {
        double column[3] = {rotation[j], rotation[3 + j], rotation[6 + j]}, once[3], twice[3];
        cross3(half, column, once);
        cross3(half, once, twice);
        for (int i = 0; i < 3; i++) rotation[3 * i + j] = column[i] + factor * (once[i] + twice[i]);
    }
}

/* Align ``n`` control points with a level of an image, float (height, width); ``pose``, position
 * (3) and rotation (3, 3) TRF to IRF, is updated. ``border`` (n), m: standard deviation of where
 * the edge of a point is seen. Return the number of points within the image at the final pose, or 0
 * without a solution. Output at the final pose: ``residual`` (n), ``weight`` (n): inverse variance
 * times Tukey's weight, 0 for outliers and -1 outside the image;
 * ``correlation`` (n), ``rows`` (n, 6). ``work``: 2 n doubles. */
EXPORT int64_t NAME(align_points)(const LevelCamera *camera, const float *image,
                                  const AlignSettings *set, const double *points,
                                  const double *ahead, const double *profiles, const double *border,
                                  int64_t n, double *pose, double *residual, double *weight,
                                  double *correlation, double *rows, double *work) {
    int reach = (int)set->reach_px, iterations = (int)set->iterations;
    if (reach > REACH_MOST) reach = REACH_MOST;
    for (int iteration = 0; iteration <= iterations; iteration++) {
        measure(camera, image, set, pose, points, ahead, profiles, border, n, reach, residual,
                weight, correlation, rows);
        int64_t inside = 0, matched = 0;
        for (int64_t i = 0; i < n; i++) {
            inside += weight[i] >= 0.0;
            if (weight[i] > 0.0) work[matched++] = abs_of(residual[i]);
        }
        if (matched < 12) return 0;
        double scale = max_of(1.4826 * select_rank(work, matched, matched / 2), 0.15);
        /* The last measurement judges the pose: what is far off is an outlier, however many there
         * are. */
        double limit =
            iteration == iterations ? min_of(4.685 * scale, set->inlier_px) : 4.685 * scale;
        double matrix[36], step[6];
        zero(matrix, 36), zero(step, 6);
        for (int64_t i = 0; i < n; i++) {
            if (!(weight[i] > 0.0)) continue;
            double share = residual[i] / limit, kept = 1.0 - share * share;
            weight[i] = abs_of(share) < 1.0 ? weight[i] * kept * kept : 0.0;
            const double *row = rows + 6 * i;
            for (int a = 0; a < 6; a++) {
                step[a] += weight[i] * row[a] * residual[i];
                for (int b = 0; b < 6; b++) matrix[6 * a + b] += weight[i] * row[a] * row[b];
            }
        }
        if (iteration == iterations) return all_finite(pose, 12) ? inside : 0;
        for (int a = 0; a < 6; a++) matrix[7 * a] *= 1.0 + 1e-6;
        if (!solve_rows(matrix, step, 6) || !all_finite(step, 6)) return 0;
        turn_pose(step, pose + 3);
        for (int k = 0; k < 3; k++) pose[k] += step[3 + k];
        reach = iteration == 0 ? reach / 2 : reach / 3;
        if (reach < 2) reach = 2;
    }
    return 0;
}
