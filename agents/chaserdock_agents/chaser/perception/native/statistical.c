/* SPDX-License-Identifier: Apache-2.0 */
/* The markers that a camera sees of a target in a known pose, and an error of the pose drawn from
 * theirs. */
#include "lens.h"

typedef struct {
    double fx, fy, cx, cy, width, height;
} PinholeCamera;

/* See the constants of statistical.py. */
typedef struct {
    double place_px, slope_px, fine_place_px, fine_slope_px, most_lines;
    double small_cell_px, small_place_px, small_slope_px;
    double cells, least_cell_px, least_cosine, least_side_px, least_cosine_found,
        least_cosine_single, margin_px;
} MarkerLimits;
LAYOUT(MarkerLimits, place_px, slope_px, fine_place_px, fine_slope_px, most_lines,
       small_cell_px, small_place_px, small_slope_px, cells, least_cell_px, least_cosine,
       least_side_px, least_cosine_found, least_cosine_single, margin_px)

/* Factorize the symmetric a (6, 6) in place: lower triangle of G, G G' = a. Return 0 unless each
 * pivot is larger than ``least`` (false for NaN). */
static int factorize6(double *a, double least) {
    for (int i = 0; i < 6; i++)
        for (int j = 0; j <= i; j++) {
            double s = a[6 * i + j];
            for (int k = 0; k < j; k++) s -= a[6 * i + k] * a[6 * j + k];
            if (i > j)
                a[6 * i + j] = s / a[6 * j + j];
            else if (s > least)
                a[6 * i + i] = sqrt_of(s);
            else
                return 0;
        }
    return 1;
}

/* What a camera sees of a marker: ideal pixels of its corners, its sides in pixels of the image,
 * width of a cell where it is narrowest, and cosine of the angle of view; whether it is `read`
 * where others put it, and `found` without. */
typedef struct {
    double px[8], cell, cosine;
    Side sides[4];
    int read, found;
} SeenMarker;

/* See marker i in a pose. ``imaged`` (4, 2): its pixels in the image, null without distortion.
 * ``stretch``: ideal pixels per pixel of the image. */
static void see_marker(const PinholeCamera *lens, const MarkerLimits *limits, const double *corners,
                       const double *origin, const double *normal, const double *position,
                       const double *rotation, const double *imaged, double stretch,
                       SeenMarker *seen) {
    double low = 1e300, right = -1e300, bottom = -1e300, centre[3], outwards[3], scaled[8];
    int inside = 1;
    for (int k = 0; k < 4; k++) {
        double at[3], *px = seen->px + 2 * k;
        multiply3(rotation, corners + 3 * k, at);
        for (int j = 0; j < 3; j++) at[j] += position[j];
        px[0] = at[0] / at[2] * lens->fx + lens->cx;
        px[1] = at[1] / at[2] * lens->fy + lens->cy;
        const double *at_px = imaged ? imaged + 2 * k : px;
        inside &= finite(at_px[0]) && finite(at_px[1]);
        low = min_of(low, min_of(at_px[0], at_px[1]));
        right = max_of(right, at_px[0]);
        bottom = max_of(bottom, at_px[1]);
    }
    for (int i = 0; i < 8; i++) scaled[i] = seen->px[i] / stretch;
    sides_of(scaled, seen->sides);
    double least = 1e300, extent = 1e300;
    for (int i = 0; i < 4; i++) {
        const double *along = seen->sides[i].vector;
        least = min_of(least, along[0] * along[0] + along[1] * along[1]);
        extent = min_of(extent, seen->sides[i].extent);
    }
    seen->cell = extent / limits->cells;
    multiply3(rotation, origin, centre);
    multiply3(rotation, normal, outwards);
    for (int j = 0; j < 3; j++) centre[j] += position[j];
    seen->cosine = -dot3(outwards, centre) / sqrt_of(dot3(centre, centre));
    inside = inside && low >= limits->margin_px && right <= lens->width - 1.0 - limits->margin_px &&
             bottom <= lens->height - 1.0 - limits->margin_px;
    seen->read = inside && seen->cosine > limits->least_cosine &&
                 seen->cell >= limits->least_cell_px;
    seen->found = seen->read && seen->cosine > limits->least_cosine_found &&
                  sqrt_of(least) >= limits->least_side_px;
}

/* Derivative of a corner's ideal pixel by position and rotation dtheta (R exp([dtheta]x)). */
static void corner_rows(const PinholeCamera *lens, const double *p, const double *position,
                        const double *rotation, double rows[2][6]) {
    double at[3];
    multiply3(rotation, p, at);
    for (int j = 0; j < 3; j++) at[j] += position[j];
    const double by[2][3] = {{lens->fx / at[2], 0.0, -lens->fx * (at[0] / at[2]) / at[2]},
                             {0.0, lens->fy / at[2], -lens->fy * (at[1] / at[2]) / at[2]}};
    for (int r = 0; r < 2; r++) {
        /* A rotation moves the corner by R (dtheta x p): the row by dtheta is p x (row R). */
        double turned[3];
        for (int c = 0; c < 3; c++)
            turned[c] = by[r][0] * rotation[c] + by[r][1] * rotation[3 + c] +
                        by[r][2] * rotation[6 + c];
        copy(by[r], rows[r], 3);
        cross3(p, turned, rows[r] + 3);
    }
}

/* Add to the information (6, 6), lower triangle, by position and rotation, that of the lines of a
 * marker's sides: place of their middle, and difference of their ends. */
static void add_information(const PinholeCamera *lens, const MarkerLimits *limits,
                            const double *corners, const double *position, const double *rotation,
                            double stretch, const SeenMarker *seen, double *information) {
    double rows[4][2][6];
    for (int k = 0; k < 4; k++) corner_rows(lens, corners + 3 * k, position, rotation, rows[k]);
    double fine = 1.0 / (seen->cell * sqrt_of(sqrt_of(seen->cell)));
    double place = limits->fine_place_px * fine, slope = limits->fine_slope_px * fine;
    double square[2] = {limits->place_px * limits->place_px + place * place,
                        limits->slope_px * limits->slope_px + slope * slope};
    if (seen->cell < limits->small_cell_px) {
        square[0] = limits->small_place_px * limits->small_place_px;
        square[1] = limits->small_slope_px * limits->small_slope_px;
    }
    for (int i = 0; i < 4; i++) {
        const Side *side = seen->sides + i;
        double longer = max_of(abs_of(side->vector[0]), abs_of(side->vector[1]));
        double lines = max_of(min_of(longer, limits->most_lines), 1.0);
        double scale = stretch * stretch / lines;
        double variance[2] = {scale * square[0], scale * square[1]};
        double end[2][6], j[2][6];
        for (int e = 0; e < 2; e++)
            for (int a = 0; a < 6; a++)
                end[e][a] = side->normal[0] * rows[(i + e) % 4][0][a] +
                            side->normal[1] * rows[(i + e) % 4][1][a];
        for (int a = 0; a < 6; a++)
            j[0][a] = 0.5 * (end[0][a] + end[1][a]), j[1][a] = end[1][a] - end[0][a];
        for (int e = 0; e < 2; e++)
            for (int a = 0; a < 6; a++)
                for (int b = 0; b <= a; b++)
                    information[6 * a + b] += j[e][a] * j[e][b] / variance[e];
    }
}

/* Measure a pose as an image would, by the markers that it shows. ``corners`` (m, 4, 3),
 * ``origins`` and ``normals`` (m, 3): of m markers in the target's axes. ``pose``: position (3) and
 * rotation (3, 3) of the target in the camera. ``imaged`` (m, 4, 2) and ``stretch`` (m): pixels of
 * the corners in the image, and ideal pixels per such pixel; both null without distortion.
 * ``white`` (6): standard normal numbers. Writes which markers are seen (m), the ideal pixels of all
 * corners (m, 4, 2), and, by position and rotation vector, the covariance (6, 6) of the pose and an
 * error (6) drawn from it. Returns the number of markers seen; 0 if none is or if they do not
 * determine the pose; -1 if a corner of any is behind the camera. */
EXPORT int64_t NAME(measure_pose)(const PinholeCamera *lens, const MarkerLimits *limits,
                                  const double *corners, const double *origins,
                                  const double *normals, int64_t m, const double *pose,
                                  const double *imaged, const double *stretch,
                                  const double *white, int64_t *seen, double *px,
                                  double *covariance, double *error) {
    const double *position = pose, *rotation = pose + 3;
    for (int64_t i = 0; i < 4 * m; i++)
        if (!(dot3(rotation + 6, corners + 3 * i) + position[2] > 0.0)) return -1;
    double information[36], scale[6], inverse[36], cosine_of_last = 0.0;
    zero(information, 36);
    int64_t count = 0, found = 0;
    for (int64_t i = 0; i < m; i++) {
        SeenMarker marker;
        double ratio = stretch ? stretch[i] : 1.0;
        see_marker(lens, limits, corners + 12 * i, origins + 3 * i, normals + 3 * i, position,
                   rotation, imaged ? imaged + 8 * i : NULL, ratio, &marker);
        copy(marker.px, px + 8 * i, 8);
        seen[i] = marker.read, found += marker.found;
        if (!marker.read) continue;
        count++;
        cosine_of_last = marker.cosine;
        add_information(lens, limits, corners + 12 * i, position, rotation, ratio, &marker,
                        information);
    }
    if (!found || (count == 1 && cosine_of_last < limits->least_cosine_single)) return 0;
    /* Metres and radians are scaled to comparable size before the pivots are checked. */
    for (int i = 0; i < 6; i++) {
        if (!(information[7 * i] > 0.0)) return 0;
        scale[i] = 1.0 / sqrt_of(information[7 * i]);
    }
    for (int i = 0; i < 6; i++)
        for (int j = 0; j <= i; j++) information[6 * i + j] *= scale[i] * scale[j];
    if (!factorize6(information, 1e-12)) return 0;
    /* Columns of the inverse of G, then covariance = S G^-T G^-1 S and error = S G^-T white. */
    zero(inverse, 36);
    for (int c = 0; c < 6; c++)
        for (int i = c; i < 6; i++) {
            double s = i == c ? 1.0 : 0.0;
            for (int k = c; k < i; k++) s -= information[6 * i + k] * inverse[6 * k + c];
            inverse[6 * i + c] = s / information[7 * i];
        }
    for (int i = 0; i < 6; i++) {
        error[i] = 0.0;
        for (int k = i; k < 6; k++) error[i] += inverse[6 * k + i] * white[k];
        error[i] *= scale[i];
        for (int j = 0; j <= i; j++) {
            double s = 0.0;
            for (int k = i; k < 6; k++) s += inverse[6 * k + i] * inverse[6 * k + j];
            covariance[6 * i + j] = covariance[6 * j + i] = s * (scale[i] * scale[j]);
        }
    }
    return all_finite(covariance, 36) ? count : 0;
}
