/* SPDX-License-Identifier: Apache-2.0 */
/* Synthetic views of a triangle mesh: z-buffer rasterization, Lambert shading with Blinn's gloss,
 * cast shadows. */
#include "base.h"

#define CLIPPED_MOST 4 /* corners of a triangle that is cut by one plane */
/* M: what is nearer to the lens is not drawn; a docked port is several times farther. */
#define NEAR_M 0.02
#define GLOSS_MOST 1023 /* largest exponent of a highlight: ten squarings */

/* A vertex on the sample grid: position, depth (linear on the grid, larger is nearer) and Lambert
 * factor. */
typedef struct {
    double x, y, depth, shade;
} Sample;

/* A light: unit vector to it in IRF; direct and ambient share; whether it is a lamp at the lens
 * instead (inverse square). */
typedef struct {
    double to_light[3], direct, ambient, lamp;
} MeshLight;

/* A depth map towards the sun: rows right, up and to the sun in TRF, texels per metre, texels along
 * each axis (0: none), and tolerance, metres. */
typedef struct {
    double basis[9], texels_per_m, size, tolerance_m;
} ShadowMap;

/* Limit ``value`` to [0, limit] and round up; NaN gives 0. */
static inline int64_t ceiling(double value, double limit) {
    if (!(value > 0.0)) return 0;
    if (value >= limit) return (int64_t)limit;
    int64_t whole = (int64_t)value;
    return whole + ((double)whole < value);
}

/* Rasterize a triangle; write depth, index and shade of samples that are nearer than before.
 * ``shade`` may be null. */
static void fill_triangle(const Sample *a, const Sample *b, const Sample *c, int32_t index,
                          int64_t width, int64_t height, float *depth, int32_t *owner,
                          float *shade) {
    const Sample *corner[3] = {a, b, c};
    double area = (b->x - a->x) * (c->y - a->y) - (b->y - a->y) * (c->x - a->x);
    if (!(abs_of(area) > 1e-12) || !finite(area)) return;
    double low = min_of(a->y, min_of(b->y, c->y)), high = max_of(a->y, max_of(b->y, c->y)),
           edge[3][3];
    for (int i = 0; i < 3; i++) {
        const Sample *p = corner[i], *q = corner[(i + 1) % 3];
        double sign = area > 0.0 ? 1.0 : -1.0;
        edge[i][0] = -sign * (q->y - p->y);
        edge[i][1] = sign * (q->x - p->x);
        edge[i][2] = -(edge[i][0] * p->x + edge[i][1] * p->y);
    }
    double dx[2], dy[2], first[2];
    for (int k = 0; k < 2; k++) {
        double va = k ? a->shade : a->depth, vb = (k ? b->shade : b->depth) - va,
               vc = (k ? c->shade : c->depth) - va;
        dx[k] = (vb * (c->y - a->y) - vc * (b->y - a->y)) / area;
        dy[k] = (vc * (b->x - a->x) - vb * (c->x - a->x)) / area;
        first[k] = va - dx[k] * a->x - dy[k] * a->y;
    }
    int64_t row = ceiling(low, (double)height), last_row = ceiling(high + 1e-9, (double)height);
    for (; row < last_row; row++) {
        double y = (double)row, left = 0.0, right = (double)width;
        int empty = 0;
        for (int i = 0; i < 3; i++) {
            double value = edge[i][1] * y + edge[i][2];
            if (edge[i][0] > 0.0)
                left = max_of(left, -value / edge[i][0]);
            else if (edge[i][0] < 0.0)
                right = min_of(right, -value / edge[i][0]);
            else
                empty |= value < 0.0;
        }
        if (empty || !(left <= right)) continue;
        int64_t x = ceiling(left, (double)width), end = ceiling(right + 1e-9, (double)width);
        float at = (float)(first[0] + dy[0] * y), step = (float)dx[0];
        float lit = (float)(first[1] + dy[1] * y), lit_step = (float)dx[1];
        float *d = depth + row * width, *s = shade ? shade + row * width : 0;
        int32_t *o = owner ? owner + row * width : 0;
        for (; x < end; x++) {
            float value = at + step * (float)x;
            if (!(value > d[x])) continue;
            d[x] = value;
            if (o) o[x] = index;
            if (s) s[x] = lit + lit_step * (float)x;
        }
    }
}

/* Compute the depth map (size, size), float, of a mesh towards the sun: of the faces turned away
 * from it, so that a face never shadows itself. ``vertices`` (.., 3) TRF, ``triangles`` (n, 3)
 * int64 with outward orientation. Texels without a surface: -1e30. */
EXPORT void NAME(shadow_map)(const ShadowMap *map, const double *vertices, const int64_t *triangles,
                             int64_t n, float *depth) {
    int64_t size = (int64_t)map->size;
    for (int64_t i = 0; i < size * size; i++) depth[i] = -1e30f;
    for (int64_t t = 0; t < n; t++) {
        Sample corner[3];
        for (int i = 0; i < 3; i++) {
            double at[3];
            multiply3(map->basis, vertices + 3 * triangles[3 * t + i], at);
            corner[i].x = at[0] * map->texels_per_m + 0.5 * map->size;
            corner[i].y = at[1] * map->texels_per_m + 0.5 * map->size;
            corner[i].depth = at[2], corner[i].shade = 0.0;
        }
        double area = (corner[1].x - corner[0].x) * (corner[2].y - corner[0].y) -
                      (corner[1].y - corner[0].y) * (corner[2].x - corner[0].x);
        if (area >= 0.0) continue; /* faces the sun */
        fill_triangle(corner, corner + 1, corner + 2, (int32_t)t, size, size, depth, 0, 0);
    }
}

/* Return whether a point in TRF lies behind a surface of the depth map. */
static inline int in_shadow(const ShadowMap *map, const float *depth, const double *at) {
    double x = dot3(map->basis, at) * map->texels_per_m + 0.5 * map->size + 0.5;
    double y = dot3(map->basis + 3, at) * map->texels_per_m + 0.5 * map->size + 0.5;
    if (!(x >= 0.0 && y >= 0.0 && x < map->size && y < map->size)) return 0;
    return dot3(map->basis + 6, at) <
           (double)depth[(int64_t)y * (int64_t)map->size + (int64_t)x] - map->tolerance_m;
}

/* Return the sunlit share of a point in TRF: bilinear interpolation of the comparisons with four
 * texels. */
static inline double sunlit_share(const ShadowMap *map, const float *depth, const double *at) {
    double x = dot3(map->basis, at) * map->texels_per_m + 0.5 * map->size;
    double y = dot3(map->basis + 3, at) * map->texels_per_m + 0.5 * map->size;
    if (!(x >= 0.0 && y >= 0.0 && x < map->size - 1.0 && y < map->size - 1.0)) return 1.0;
    int64_t size = (int64_t)map->size, column = (int64_t)x, row = (int64_t)y;
    const float *d = depth + row * size + column;
    float near = (float)(dot3(map->basis + 6, at) + map->tolerance_m);
    double u = x - (double)column, v = y - (double)row;
    double upper = (near < d[0] ? 0.0 : 1.0 - u) + (near < d[1] ? 0.0 : u);
    double lower = (near < d[size] ? 0.0 : 1.0 - u) + (near < d[size + 1] ? 0.0 : u);
    return upper + v * (lower - upper);
}

/* Project the corners of a triangle in IRF, clip them at NEAR_M, and rasterize. ``lens``: fx, fy,
 * cx, cy on the sample grid. */
static void draw_triangle(const double *lens, double at[3][4], int32_t index, int64_t width,
                          int64_t height, float *depth, int32_t *owner, float *shade) {
    double kept[CLIPPED_MOST][4];
    Sample sample[CLIPPED_MOST];
    int count = 0;
    for (int i = 0; i < 3; i++) {
        const double *a = at[(i + 2) % 3], *b = at[i];
        if ((a[2] < NEAR_M) != (b[2] < NEAR_M)) {
            double share = (NEAR_M - a[2]) / (b[2] - a[2]);
            for (int k = 0; k < 4; k++) kept[count][k] = a[k] + share * (b[k] - a[k]);
            count++;
        }
        if (b[2] >= NEAR_M) copy(b, kept[count++], 4);
    }
    for (int i = 0; i < count; i++) {
        sample[i].depth = 1.0 / kept[i][2];
        sample[i].x = kept[i][0] * sample[i].depth * lens[0] + lens[2];
        sample[i].y = kept[i][1] * sample[i].depth * lens[1] + lens[3];
        sample[i].shade = kept[i][3];
    }
    for (int i = 2; i < count; i++)
        fill_triangle(sample, sample + i - 1, sample + i, index, width, height, depth, owner,
                      shade);
}

/* Lambert factor, without shadows, of a surface at ``at`` with ``normal``, both in IRF. */
static inline double lambert(const MeshLight *light, const double *at, const double *normal) {
    if (light->lamp == 0.0) return max_of(0.0, dot3(normal, light->to_light));
    double square = max_of(dot3(at, at), 1e-4), distance = sqrt_of(square);
    return max_of(0.0, -dot3(normal, at)) / (distance * square);
}

/* (n'h)^exponent for unit vectors to the camera and to the light. */
static inline double gloss_factor(const double *normal, const double *to_camera,
                                  const double *to_light, double exponent) {
    double half[3];
    for (int i = 0; i < 3; i++) half[i] = to_camera[i] + to_light[i];
    double square = dot3(half, half), along = dot3(normal, half), power = 1.0;
    if (!(along > 0.0 && square > 1e-12)) return 0.0;
    along /= sqrt_of(square);
    /* Below, the result is less than 0.001. */
    if (1.0 - along > 7.0 / max_of(exponent, 1.0)) return 0.0;
    for (int64_t m = ceiling(exponent, GLOSS_MOST); m > 0; m >>= 1) {
        if (m & 1) power *= along;
        along *= along;
    }
    return power;
}

/* What shades a sample: the view's grid (lens), TRF to IRF, surfaces and facing normals by
 * triangle, light and its shadows. */
typedef struct {
    const double *grid, *to_trf, *offset, *surfaces, *facing;
    const MeshLight *light;
    const ShadowMap *map;
    const float *map_depth;
} SampleShading;

/* Light reflected by triangle ``which`` at (x, y) of the grid, with inverse depth ``depth`` and
 * Lambert factor ``lit``. */
static inline double shade_sample(const SampleShading *s, int32_t which, double x, double y,
                                  double depth, double lit) {
    const double *surface = s->surfaces + 3 * which;
    const MeshLight *light = s->light;
    double shine = 0.0;
    if (lit > 0.0 && light->lamp == 0.0 && (s->map->size > 0.0 || surface[1] > 0.0)) {
        double z = 1.0 / depth, point[3],
               ray[3] = {(x - s->grid[2]) / s->grid[0] * z, (y - s->grid[3]) / s->grid[1] * z, z};
        double share = 1.0;
        if (s->map->size > 0.0) {
            multiply3(s->to_trf, ray, point);
            subtract3(point, s->offset, point);
            share = sunlit_share(s->map, s->map_depth, point);
        }
        lit *= share;
        if (lit > 0.0 && surface[1] > 0.0) {
            double length = sqrt_of(dot3(ray, ray)), to_camera[3];
            for (int i = 0; i < 3; i++) to_camera[i] = -ray[i] / length;
            shine = share * surface[1] *
                    gloss_factor(s->facing + 3 * which, to_camera, light->to_light, surface[2]);
        }
    }
    return surface[0] * (light->ambient + light->direct * lit) + light->direct * shine;
}

/* Render a mesh. ``lens``: fx, fy, cx, cy of the image (height, width) of ideal pixels;
 * ``samples``: per pixel along each axis;
 * ``pose``: position (3) and rotation (3, 3) TRF to IRF; ``vertices`` (.., 3) and ``normals`` (n,
 * 3, 3), of each corner, in TRF;
 * ``triangles`` (n, 3) int64, outward orientation; ``surfaces`` (n, 3): reflectance, gloss and
 * Blinn's exponent. Output, (height, width): ``grey`` float, light reflected, averaged over the
 * target's samples and black ones of the background; ``coverage`` float, share of the target's
 * samples; ``nearest`` float, inverse depth of the nearest sample, 1/m, 0 without any; ``owner``
 * int32, its triangle or -1. ``facing``: 3 n doubles; ``work``: 3 samples^2 height width floats.
 * Faces turned away are not drawn. */
EXPORT void NAME(render_mesh)(const double *lens, int64_t height, int64_t width, int64_t samples,
                              const double *pose, const double *vertices, const int64_t *triangles,
                              const double *normals, const double *surfaces, int64_t n,
                              const MeshLight *light, const ShadowMap *map, const float *map_depth,
                              float *grey, float *coverage, float *nearest, int32_t *owner,
                              double *facing, float *work) {
    int64_t wide = width * samples, high = height * samples, all = wide * high;
    float *depth = work, *shade = work + all;
    int32_t *index = (int32_t *)(work + 2 * all);
    double scale = (double)samples,
           grid[4] = {lens[0] * scale, lens[1] * scale, (lens[2] + 0.5) * scale - 0.5,
                      (lens[3] + 0.5) * scale - 0.5};
    for (int64_t i = 0; i < all; i++) depth[i] = 0.0f, shade[i] = 0.0f, index[i] = -1;
    for (int64_t t = 0; t < n; t++) {
        double at[3][4], ab[3], ac[3], normal[3];
        for (int i = 0; i < 3; i++) {
            multiply3(pose + 3, vertices + 3 * triangles[3 * t + i], at[i]);
            for (int k = 0; k < 3; k++) at[i][k] += pose[k];
        }
        subtract3(at[1], at[0], ab), subtract3(at[2], at[0], ac);
        cross3(ab, ac, facing + 3 * t);
        if (!(dot3(facing + 3 * t, at[0]) < 0.0)) continue;
        normalize3(facing + 3 * t);
        for (int i = 0; i < 3; i++) {
            multiply3(pose + 3, normals + 9 * t + 3 * i, normal);
            at[i][3] = lambert(light, at[i], normal);
        }
        draw_triangle(grid, at, (int32_t)t, wide, high, depth, index, shade);
    }
    double share = 1.0 / (scale * scale), to_trf[9], offset[3];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) to_trf[3 * i + j] = pose[3 + 3 * j + i];
    multiply3(to_trf, pose, offset);
    const SampleShading shading = {grid, to_trf, offset, surfaces, facing, light, map, map_depth};
    for (int64_t y = 0; y < height; y++)
        for (int64_t x = 0; x < width; x++) {
            int64_t corner = y * samples * wide + x * samples, at = y * width + x, count = 0,
                    best = -1;
            int32_t first = index[corner];
            int uniform = 1;
            for (int64_t j = 0; j < samples; j++)
                for (int64_t i = 0; i < samples; i++)
                    uniform &= index[corner + j * wide + i] == first;
            double sum = 0.0;
            float near = 0.0f;
            if (uniform && first >= 0) {
                /* Depth and Lambert factor are linear on the grid: shade the middle of the
                 * pixel. */
                double lit = 0.0, middle = 0.0;
                for (int64_t j = 0; j < samples; j++)
                    for (int64_t i = 0; i < samples; i++) {
                        int64_t k = corner + j * wide + i;
                        lit += (double)shade[k], middle += (double)depth[k];
                        if (depth[k] > near) near = depth[k];
                    }
                double half = 0.5 * (scale - 1.0);
                count = samples * samples, best = first;
                sum = (double)count * shade_sample(&shading, first, (double)(x * samples) + half,
                                                   (double)(y * samples) + half, middle * share,
                                                   lit * share);
            } else if (!uniform) {
                for (int64_t j = 0; j < samples; j++)
                    for (int64_t i = 0; i < samples; i++) {
                        int64_t k = corner + j * wide + i;
                        int32_t which = index[k];
                        if (which < 0) continue;
                        count++;
                        if (depth[k] > near) near = depth[k], best = which;
                        sum += shade_sample(&shading, which, (double)(x * samples + i),
                                            (double)(y * samples + j), (double)depth[k],
                                            (double)shade[k]);
                    }
            }
            grey[at] = (float)(sum * share), coverage[at] = (float)((double)count * share);
            nearest[at] = near, owner[at] = (int32_t)best;
        }
}
