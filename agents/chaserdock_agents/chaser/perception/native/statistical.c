/* SPDX-License-Identifier: Apache-2.0 */
/* The markers that a camera sees of a target in a known pose, and an error of the pose drawn from
 * theirs. */
#include "base.h"

typedef struct {
    double fx, fy, cx, cy, width, height;
} PinholeCamera;

/* See the constants of statistical.py. */
typedef struct {
    double sigma_px, small_side_px, least_side_px, least_cosine, least_cosine_single, margin_px;
} MarkerLimits;

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

/* Ideal pixels (4, 2) and cosine of the angle of view of marker i in a pose; return whether it is
 * detected. ``imaged`` (4, 2): its pixels in the image, null without distortion. ``stretch``: ideal
 * pixels per pixel of the image. ``side``: shortest side, pixels of the image. */
static int see_marker(const PinholeCamera *lens, const MarkerLimits *limits, const double *corners,
                      const double *origin, const double *normal, const double *position,
                      const double *rotation, const double *imaged, double stretch, double *px,
                      double *side, double *cosine) {
    double low = 1e300, right = -1e300, bottom = -1e300, centre[3], outwards[3];
    int inside = 1;
    for (int k = 0; k < 4; k++) {
        double at[3];
        multiply3(rotation, corners + 3 * k, at);
        for (int j = 0; j < 3; j++) at[j] += position[j];
        px[2 * k] = at[0] / at[2] * lens->fx + lens->cx;
        px[2 * k + 1] = at[1] / at[2] * lens->fy + lens->cy;
        const double *at_px = (imaged ? imaged : px) + 2 * k;
        inside &= finite(at_px[0]) && finite(at_px[1]);
        low = min_of(low, min_of(at_px[0], at_px[1]));
        right = max_of(right, at_px[0]);
        bottom = max_of(bottom, at_px[1]);
    }
    double least = 1e300;
    for (int k = 0; k < 4; k++) {
        const double *a = px + 2 * k, *b = px + 2 * ((k + 1) % 4);
        double u = a[0] - b[0], v = a[1] - b[1];
        least = min_of(least, u * u + v * v);
    }
    *side = sqrt_of(least) / stretch;
    multiply3(rotation, origin, centre);
    multiply3(rotation, normal, outwards);
    for (int j = 0; j < 3; j++) centre[j] += position[j];
    *cosine = -dot3(outwards, centre) / sqrt_of(dot3(centre, centre));
    return inside && low >= limits->margin_px && right <= lens->width - 1.0 - limits->margin_px &&
           bottom <= lens->height - 1.0 - limits->margin_px && *cosine > limits->least_cosine &&
           *side >= limits->least_side_px;
}

/* Add to the information (6, 6), lower triangle, by position and rotation dtheta (R
 * exp([dtheta]x)), that of a marker's corners with errors of standard deviation ``sigma``. */
static void add_information(const PinholeCamera *lens, const double *corners,
                            const double *position, const double *rotation, double sigma,
                            double *information) {
    for (int k = 0; k < 4; k++) {
        const double *p = corners + 3 * k;
        double at[3];
        multiply3(rotation, p, at);
        for (int j = 0; j < 3; j++) at[j] += position[j];
        const double inverse = 1.0 / (at[2] * sigma);
        const double rows[2][3] = {
            {lens->fx * inverse, 0.0, -lens->fx * (at[0] / at[2]) * inverse},
            {0.0, lens->fy * inverse, -lens->fy * (at[1] / at[2]) * inverse}};
        for (int r = 0; r < 2; r++) {
            /* A rotation moves the corner by R (dtheta x p): the row by dtheta is p x (row R). */
            double j[6], turned[3];
            for (int c = 0; c < 3; c++)
                turned[c] = rows[r][0] * rotation[c] + rows[r][1] * rotation[3 + c] +
                            rows[r][2] * rotation[6 + c];
            for (int c = 0; c < 3; c++) j[c] = rows[r][c];
            cross3(p, turned, j + 3);
            for (int a = 0; a < 6; a++)
                for (int b = 0; b <= a; b++) information[6 * a + b] += j[a] * j[b];
        }
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
    int64_t count = 0;
    for (int64_t i = 0; i < m; i++) {
        double side, cosine, ratio = stretch ? stretch[i] : 1.0;
        seen[i] = see_marker(lens, limits, corners + 12 * i, origins + 3 * i, normals + 3 * i,
                             position, rotation, imaged ? imaged + 8 * i : NULL, ratio, px + 8 * i,
                             &side, &cosine);
        if (!seen[i]) continue;
        count++;
        cosine_of_last = cosine;
        double sigma = limits->sigma_px * max_of(1.0, limits->small_side_px / side) * ratio;
        add_information(lens, corners + 12 * i, position, rotation, sigma, information);
    }
    if (count == 0 || (count == 1 && cosine_of_last < limits->least_cosine_single)) return 0;
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
