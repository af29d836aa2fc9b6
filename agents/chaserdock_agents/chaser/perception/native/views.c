/* SPDX-License-Identifier: Apache-2.0 */
/* Project markers for a pose: distances from the detections, and which markers should be
 * visible. */
#include "base.h"

/* Project a point in IRF to an ideal pixel; return 0 without a result for a point behind the
 * camera. ``lens``: fx, fy, cx, cy. */
static inline int project(const double *lens, const double *at, double *px) {
    if (!(at[2] > 0.0)) return 0;
    for (int k = 0; k < 2; k++) px[k] = at[k] / at[2] * lens[k] + lens[2 + k];
    return 1;
}

/* Squared distance (n), pixels, of points ``at`` (n, 3) in IRF from ``pixels`` (n, 2), ideal; NaN
 * for points behind the camera or at NaN. */
EXPORT void NAME(squared_errors)(const double *lens, const double *at, const double *pixels,
                                 int64_t n, double *square) {
    for (int64_t i = 0; i < n; i++) {
        double px[2];
        square[i] = __builtin_nan("");
        if (!project(lens, at + 3 * i, px)) continue;
        double x = px[0] - pixels[2 * i], y = px[1] - pixels[2 * i + 1];
        square[i] = x * x + y * y;
    }
}

/* Largest distance (n), pixels, of each marker's corners from ``pixels`` (n, 4, 2), ideal; infinite
 * for a marker behind the camera, facing away or at NaN. ``at`` (n, 4, 3): corners in IRF, m;
 * ``outwards`` (n, 3): normals in IRF. */
EXPORT void NAME(marker_errors)(const double *lens, const double *at, const double *pixels,
                                const double *outwards, int64_t n, double *error) {
    for (int64_t m = 0; m < n; m++) {
        double worst = 0.0;
        int seen = dot3(outwards + 3 * m, at + 12 * m) < 0.0;
        for (int64_t i = 4 * m; i < 4 * m + 4 && seen; i++) {
            double px[2];
            seen = project(lens, at + 3 * i, px);
            if (!seen) break;
            double x = px[0] - pixels[2 * i], y = px[1] - pixels[2 * i + 1], square = x * x + y * y;
            seen = finite(square);
            worst = max_of(worst, square);
        }
        error[m] = seen ? sqrt_of(worst) : __builtin_inf();
    }
}

/* Return how many markers other than ``row`` are at least as visible as that one: all corners
 * within ``frame_px`` (left and top, right, bottom), of about its size and viewing angle.
 * ``surface`` (6 m, 3), rotated into IRF axes: the 4 corners of each of m markers, their centres,
 * m, and their normals; corners and centres are translated by ``position`` here. Output: cosine (m)
 * of each viewing angle, 1 face-on, negative from behind. */
EXPORT int64_t NAME(count_visible_markers)(const double *lens, const double *frame_px,
                                           const double *surface, const double *position,
                                           int64_t markers, int64_t row, double *size,
                                           double *cosine) {
    const double *centres = surface + 12 * markers, *normals = surface + 15 * markers;
    for (int64_t m = 0; m < markers; m++) {
        double px[4][2], centre[3];
        int inside = 1;
        for (int k = 0; k < 3; k++) centre[k] = centres[3 * m + k] + position[k];
        cosine[m] = -dot3(normals + 3 * m, centre) / sqrt_of(dot3(centre, centre));
        for (int i = 0; i < 4 && inside; i++) {
            double at[3];
            for (int k = 0; k < 3; k++) at[k] = surface[12 * m + 3 * i + k] + position[k];
            inside = project(lens, at, px[i]);
        }
        /* Behind the camera: NaN compares false with every size. */
        size[m] = __builtin_nan("");
        if (!inside) continue;
        for (int i = 0; i < 4; i++) {
            const double *a = px[i], *b = px[(i + 1) % 4];
            double side = max_of(abs_of(b[0] - a[0]), abs_of(b[1] - a[1]));
            size[m] = i ? min_of(size[m], side) : side;
            inside &= a[0] > frame_px[0] && a[0] < frame_px[1] && a[1] > frame_px[0] &&
                      a[1] < frame_px[2];
        }
        if (!inside && m != row) size[m] = __builtin_nan("");
    }
    int64_t count = 0;
    double near = 0.6 * size[row], ahead = 0.7 * cosine[row];
    if (!(ahead > 0.3)) ahead = 0.3;
    for (int64_t m = 0; m < markers; m++)
        count += m != row && size[m] >= near && cosine[m] >= ahead;
    return count;
}
