/* SPDX-License-Identifier: Apache-2.0 */
/* Reads the cells of markers where a pose puts them. Method:
 * chaserdock_agents.chaser.perception.reading. */
#include "lens.h"

/* Limits of a marker that is read: least cosine of its viewing angle, least width of a cell, least
 * distance of its corners from the border of the image, px; distance of the four samples of a cell
 * from its centre, along both axes, as a share of it; least contrast, grey levels. */
typedef struct {
    double cosine, cell_px, frame_px, sampled, contrast;
} ReadLimits;
LAYOUT(ReadLimits, cosine, cell_px, frame_px, sampled, contrast)

/* Least distance between opposite sides of a quadrilateral (4, 2), px. */
static double least_extent(const double *px) {
    Side sides[4];
    sides_of(px, sides);
    double least = sides[0].extent;
    for (int i = 1; i < 4; i++) least = min_of(least, sides[i].extent);
    return least;
}

/* Correlation of the grey levels of a marker's cells, from -1 to 1, with `white` (cells, cells): 1
 * for white and 0 for black; 0 without contrast. `px` (4, 2): its corners in marker coordinates
 * of `p`, ideal pixels. */
static double correlation(const Image *p, const ReadLimits *limits, const double *px,
                          const uint8_t *white, int64_t cells) {
    double h[9];
    square_homography(px, h);
    double sum[2] = {0.0}, square = 0.0, count[2] = {0.0};
    for (int64_t row = 0; row < cells; row++)
        for (int64_t column = 0; column < cells; column++) {
            double level = 0.0;
            for (int k = 0; k < 4; k++) {
                double u = (column + 0.5 + (k & 1 ? 1.0 : -1.0) * limits->sampled) / cells,
                       v = (row + 0.5 + (k & 2 ? 1.0 : -1.0) * limits->sampled) / cells;
                double at[2];
                on_square(h, u, v, at);
                if (p->lens) distort(p, at, at + 1);
                level += level_at(p, at[0], at[1]);
            }
            level *= 0.25;
            int is_white = white[row * cells + column] != 0;
            sum[is_white] += level;
            count[is_white] += 1.0;
            square += level * level;
        }
    double n = count[0] + count[1], mean = (sum[0] + sum[1]) / n;
    double step = sum[1] / count[1] - sum[0] / count[0];
    double variance = square / n - mean * mean, share = count[0] * count[1] / (n * n);
    if (!(step > limits->contrast && variance > 0.0)) return 0.0;
    return step * sqrt_of(share / variance);
}

/* Moves a marker's corners `px` (4, 2) to the place, of those up to `reach` half cells away along
 * both axes of the image, where its cells correlate best; return that correlation. */
static double located(const Image *p, const ReadLimits *limits, double *px, const uint8_t *white,
                      int64_t cells, int64_t reach) {
    double across[2], down[2], best = 0.0, at[2] = {0.0};
    for (int k = 0; k < 2; k++) across[k] = px[4 + k] - px[k], down[k] = px[6 + k] - px[2 + k];
    double area = 0.5 * abs_of(across[0] * down[1] - across[1] * down[0]);
    double step = 0.5 * sqrt_of(area) / (double)cells;
    for (int64_t i = -reach; i <= reach; i++)
        for (int64_t j = -reach; j <= reach; j++) {
            double moved[8];
            for (int k = 0; k < 8; k++) moved[k] = px[k] + step * (double)(k & 1 ? j : i);
            double found = correlation(p, limits, moved, white, cells);
            if (found > best) best = found, at[0] = step * (double)i, at[1] = step * (double)j;
        }
    for (int k = 0; k < 8; k++) px[k] += at[k & 1];
    return best;
}

/* Reads the markers that a pose shows: `surface` (6 m, 3), rotated into IRF axes: the 4 corners of
 * each of m markers, their centres and their normals; `position` of the target, m; `margin` (m): as
 * for `refine_corners`. `white` (m, cells, cells): 1 for white cells; `skip` (m): markers not to be
 * read; `reach`: as for `located`. Output: `px` (m, 4, 2), ideal; `finest` (m): width of the finer
 * of cell and border, px, NaN for a marker that does not face the camera; `found` (m): correlation
 * with its cells, 0 for those that are not read. */
EXPORT void NAME(read_markers)(const uint8_t *image, int64_t height, int64_t width,
                               const double *camera, const Lens *lens, const ReadLimits *limits,
                               const double *surface, const double *position,
                               const double *margin, int64_t markers, const uint8_t *white,
                               int64_t cells, const uint8_t *skip, int64_t reach, double *px,
                               double *finest, double *found) {
    Image p = {image, height, width, camera, lens, NULL};
    const double *centres = surface + 12 * markers, *normals = surface + 15 * markers;
    for (int64_t m = 0; m < markers; m++) {
        double centre[3], *corners = px + 8 * m;
        finest[m] = __builtin_nan("");
        found[m] = 0.0;
        zero(corners, 8);
        for (int k = 0; k < 3; k++) centre[k] = centres[3 * m + k] + position[k];
        double cosine = -dot3(normals + 3 * m, centre) / sqrt_of(dot3(centre, centre));
        int seen = cosine >= limits->cosine, inside = 1;
        for (int i = 0; i < 4 && seen; i++) {
            double at[3];
            for (int k = 0; k < 3; k++) at[k] = surface[12 * m + 3 * i + k] + position[k];
            seen = at[2] > 1e-6;
            if (!seen) break;
            for (int k = 0; k < 2; k++)
                corners[2 * i + k] = at[k] / at[2] * camera[k] + camera[2 + k];
            double x = corners[2 * i], y = corners[2 * i + 1];
            if (lens) distort(&p, &x, &y);
            inside &= x >= limits->frame_px && x <= (double)(width - 1) - limits->frame_px &&
                      y >= limits->frame_px && y <= (double)(height - 1) - limits->frame_px;
        }
        if (!seen) continue;
        double extent = least_extent(corners);
        finest[m] = extent * min_of(margin[m], 1.0 / (double)cells);
        if (inside && !skip[m] && extent >= limits->cell_px * (double)cells)
            found[m] = located(&p, limits, corners, white + m * cells * cells, cells, reach);
    }
}
