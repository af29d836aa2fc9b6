/* SPDX-License-Identifier: Apache-2.0 */
/* Fuzz targets of agents/chaserdock_agents/chaser/perception/native. */
#include "fuzz.h"
#include "kernels.c"

static double *lens_of_camera(void) {
    double *lens = outputs(4);
    for (int i = 0; i < 2; i++) lens[i] = value(50.0, 900.0), lens[2 + i] = value(0.0, 640.0);
    return lens;
}

/* An image with a bright quadrilateral, or noise. */
static uint8_t *image_of(int64_t height, int64_t width) {
    uint8_t *image = bytes(height * width);
    if (chance(0.3)) return image;
    const double x = uniform(0.0, (double)width), y = uniform(0.0, (double)height),
                 slope = uniform(-1.0, 1.0);
    for (int64_t i = 0; i < height * width; i++) {
        double column = (double)(i % width), row = (double)(i / width);
        image[i] = column + slope * row > x && row - slope * column > y ? 230 : 20;
    }
    return image;
}

static Settings settings(void) {
    Settings s = {0};
    s.first = uniform(0.0, 0.4), s.last = uniform(0.6, 1.0);
    s.reach_cells = uniform(0.1, 1.0), s.reach_least_px = uniform(0.5, 2.0);
    s.min_contrast = uniform(0.0, 20.0), s.min_rows_share = uniform(0.0, 1.0),
    s.max_move_px = uniform(0.5, 8.0);
    s.rows = (double)whole(2, ROWS_MOST), s.taps = (double)whole(2, TAPS_MOST),
    s.coarse_reach_px = uniform(1.0, 5.0);
    s.border_share = uniform(0.1, 1.0), s.columns = (double)whole(1, COLUMNS_MOST),
    s.end_px = uniform(0.0, 5.0);
    s.end_share = uniform(0.0, 0.4), s.reach_px = uniform(1.0, 5.0), s.clear_px = uniform(0.0, 2.0);
    s.beyond_px = uniform(0.1, 2.0), s.strip_px = uniform(0.0, 20.0),
    s.partial_px = uniform(0.0, 20.0), s.least_fall = uniform(-1.0, 1.0);
    s.agreement_px = uniform(0.0, 1.0), s.log_edge_sigma = uniform(-1.0, 1.0),
    s.edge_sigma_spread = uniform(0.05, 0.5);
    s.rounds = (double)whole(0, 3), s.iterations = (double)whole(1, 4),
    s.strip_iterations = (double)whole(1, 5);
    s.agreement_sigmas = uniform(0.0, 5.0), s.fade_spread = uniform(0.01, 0.1),
    s.alike_columns = uniform(1.0, 64.0);
    s.least_sigma_px = uniform(1e-3, 0.02), s.aligned_sigma_px = uniform(0.0, 0.1),
    s.fine_sigma_px = uniform(0.0, 0.5), s.border_sigma_px = uniform(0.0, 0.5);
    s.outer_sigma_px = uniform(0.0, 0.5), s.cut_sigma_px = uniform(0.0, 0.5),
    s.cut_spread_px = uniform(0.0, 0.5), s.common_share = uniform(0.0, 0.9);
    s.free_blur = uniform(0.0, 1.0), s.blur_sigma_px = uniform(0.0, 0.1),
    s.adjoining_sigma_px = uniform(0.0, 2.0);
    return s;
}

/* A lens of any kind. */
static Lens any_lens(void) {
    Lens lens = {(double)whole(0, 3), chance(0.5) ? __builtin_inf() : value(0.1, 4.0), {0}, {0}};
    for (int i = 0; i < 14; i++) lens.k[i] = value(-0.2, 0.2);
    for (int i = 0; i < 9; i++) lens.tilt[i] = (i % 4 == 0) + value(-0.05, 0.05);
    return lens;
}

static void refine_corners(void) {
    static const double around[8] = {-1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0};
    const int64_t height = whole(2, 40), width = whole(2, 40), n = whole(0, 2);
    const uint8_t *image = image_of(height, width);
    double *camera = outputs(4), *margin = doubles(n, 0.0, 0.3), *corners = outputs(8 * n),
           *whitening = outputs(64 * n), *common = outputs(8 * n),
           *frames = doubles(9 * n, -0.02, 0.02);
    uint8_t *good = bytes(n), *outlined = bytes(n), *framed = bytes(n);
    Settings set = settings();
    Lens lens = any_lens();
    for (int i = 0; i < 2; i++) camera[i] = value(20.0, 60.0), camera[2 + i] = value(0.0, 40.0);
    for (int64_t m = 0; m < n; m++) framed[m] = (uint8_t)whole(0, 1), frames[9 * m + 8] = value(0.5, 1.5);
    const int distorted = (int)whole(0, 1);
    if (!distorted)
        for (int64_t m = 0; m < n; m++) framed[m] = 0;
    for (int64_t m = 0; m < n; m++) {
        const double x = uniform(0.0, (double)width), y = uniform(0.0, (double)height),
                     half = uniform(1.0, 15.0);
        for (int i = 0; i < 8; i++)
            corners[8 * m + i] = chance(special_share)
                                     ? special()
                                     : (i % 2 ? y : x) + half * around[i] + uniform(-1.0, 1.0);
    }
    double *given = copy_of(corners, 8 * n);
    NAME(refine_corners)(image, height, width, camera, distorted ? &lens : NULL, frames, framed, &set,
                         (double)whole(3, 9), n, margin, outlined, corners, good, whitening, common);
    for (int64_t m = 0; m < n; m++) {
        CHECK(good[m] <= 1);
        if (good[m]) CHECK(all_finite(corners + 8 * m, 8) && all_finite(given + 8 * m, 8));
        if (good[m]) CHECK(all_finite(whitening + 64 * m, 64) && all_finite(common + 8 * m, 8));
        else CHECK(same_bits(corners + 8 * m, given + 8 * m, 8));
    }
}

static void read_markers(void) {
    const int64_t height = whole(2, 40), width = whole(2, 40), n = whole(1, 3), cells = whole(3, 8);
    const uint8_t *image = image_of(height, width), *white = bytes(n * cells * cells);
    const int distorted = (int)whole(0, 1);
    Lens lens = any_lens();
    ReadLimits limits = {value(-1.0, 0.5), value(0.0, 2.0), value(-1.0, 4.0), value(0.0, 0.5),
                         value(0.0, 20.0)};
    double *camera = outputs(4), *surface = doubles(18 * n, -1.0, 1.0),
           *position = doubles(3, -0.5, 3.0), *px = outputs(8 * n), *finest = outputs(n),
           *found = outputs(n);
    uint8_t *skip = bytes(n);
    for (int i = 0; i < 2; i++) camera[i] = value(20.0, 60.0), camera[2 + i] = value(0.0, 40.0);
    for (int64_t m = 0; m < n; m++) {
        skip[m] = (uint8_t)whole(0, 1);
        if (chance(0.5)) /* flat and ahead */
            for (int i = 0; i < 4; i++) surface[12 * m + 3 * i + 2] = 0.0;
    }
    NAME(read_markers)(image, height, width, camera, distorted ? &lens : NULL, &limits, surface,
                       position, doubles(n, 0.0, 0.3), n, white, cells, skip, whole(0, 4), px, finest,
                       found);
    for (int64_t m = 0; m < n; m++) {
        CHECK(found[m] >= 0.0 && found[m] < 1.0 + 1e-9);
        if (skip[m] || !finite(finest[m])) CHECK(found[m] == 0.0);
    }
}

static void fit_patterns(void) {
    static const double around[8] = {-1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0};
    const int64_t height = whole(2, 90), width = whole(2, 90), n = whole(0, 2), cells = whole(3, 18);
    const uint8_t *image = image_of(height, width), *white = bytes(n * cells * cells);
    double *camera = outputs(4), *margin = doubles(n, 0.0, 0.6), *corners = outputs(8 * n),
           *covariance = doubles(64 * n, -1.0, 1.0), *explained = outputs(n),
           *frames = doubles(9 * n, -0.02, 0.02);
    uint8_t *outlined = bytes(n), *framed = bytes(n);
    const int distorted = (int)whole(0, 1);
    Lens lens = any_lens();
    PatternSettings set = {uniform(-1.0, 1.0), uniform(0.05, 0.5), uniform(0.0, 2.0),
                           uniform(0.0, 4.0),  value(0.0, 1.0),    uniform(0.5, 8.0),
                           value(0.0, 20.0),   uniform(0.0, 1.0),  (double)whole(0, 9)};
    for (int i = 0; i < 2; i++) camera[i] = value(20.0, 60.0), camera[2 + i] = value(0.0, 40.0);
    for (int64_t m = 0; m < n; m++) {
        const double x = uniform(0.0, (double)width), y = uniform(0.0, (double)height),
                     half = chance(0.9) ? uniform(0.2, 20.0) : uniform(20.0, 90.0);
        framed[m] = (uint8_t)(distorted && chance(0.5)), frames[9 * m + 8] = value(0.5, 1.5);
        for (int i = 0; i < 8; i++)
            corners[8 * m + i] = chance(special_share)
                                     ? special()
                                     : (i % 2 ? y : x) + half * around[i] + uniform(-1.0, 1.0);
    }
    double *given = copy_of(corners, 8 * n), *before = copy_of(covariance, 64 * n);
    NAME(fit_patterns)(image, height, width, camera, distorted ? &lens : NULL, frames, framed, &set,
                       cells, n, margin, outlined, white, corners, explained, covariance);
    for (int64_t m = 0; m < n; m++) {
        CHECK(explained[m] >= 0.0 && explained[m] <= 1.0);
        if (explained[m] > 0.0)
            CHECK(all_finite(corners + 8 * m, 8) && all_finite(covariance + 64 * m, 64));
        else
            CHECK(same_bits(corners + 8 * m, given + 8 * m, 8) &&
                  same_bits(covariance + 64 * m, before + 64 * m, 64));
    }
}

static void refine_pose(void) {
    const int64_t n = whole(0, 3);
    double *lens = lens_of_camera(), *points = doubles(12 * n, -0.3, 0.3),
           *pixels = doubles(8 * n, 0.0, 640.0);
    double *whitening = doubles(64 * n, -2.0, 2.0), *pose = doubles(12, -1.0, 1.0);
    pose[2] = value(0.2, 3.0);
    if (chance(0.5)) /* near a solution */
        for (int64_t i = 0; i < 4 * n; i++) {
            double at[3];
            multiply3(pose + 3, points + 3 * i, at);
            for (int k = 0; k < 2; k++)
                pixels[2 * i + k] = lens[k] * (at[k] + pose[k]) / (at[2] + pose[2]) + lens[2 + k] +
                                    value(-1.0, 1.0);
        }
    int64_t found = NAME(refine_pose)(lens, points, pixels, whitening, n, pose);
    CHECK(found == 0 || found == 1);
    if (found) CHECK(all_finite(pose, 12));
}

static void squared_errors(void) {
    const int64_t n = whole(0, 9);
    double *lens = lens_of_camera(), *at = doubles(3 * n, -1.0, 3.0),
           *pixels = doubles(2 * n, 0.0, 640.0), *square = outputs(n);
    NAME(squared_errors)(lens, at, pixels, n, square);
    for (int64_t i = 0; i < n; i++) {
        CHECK(square[i] >= 0.0 || square[i] != square[i]);
        if (!(at[3 * i + 2] > 0.0)) CHECK(square[i] != square[i]);
    }
}

static void marker_errors(void) {
    const int64_t n = whole(0, 5);
    double *lens = lens_of_camera(), *at = doubles(12 * n, -1.0, 3.0),
           *pixels = doubles(8 * n, 0.0, 640.0);
    double *outwards = doubles(3 * n, -1.0, 0.2), *error = outputs(n);
    NAME(marker_errors)(lens, at, pixels, outwards, n, error);
    for (int64_t i = 0; i < n; i++) {
        CHECK(error[i] >= 0.0);
        if (any_nan(at + 12 * i, 12) || any_nan(outwards + 3 * i, 3) || any_nan(pixels + 8 * i, 8))
            CHECK(!finite(error[i]));
    }
}

static void count_visible_markers(void) {
    const int64_t markers = whole(1, 6), row = whole(0, markers - 1);
    double *lens = lens_of_camera(), *frame = doubles(3, 0.0, 640.0),
           *surface = doubles(18 * markers, -1.0, 1.0);
    double *position = doubles(3, -0.5, 3.0), *size = outputs(markers), *cosine = outputs(markers);
    int64_t count =
        NAME(count_visible_markers)(lens, frame, surface, position, markers, row, size, cosine);
    CHECK(0 <= count && count < markers);
    if (size[row] != size[row]) CHECK(count == 0); /* it is behind the camera, or at NaN */
}

/* Tetrahedra with vertices anywhere, some of them behind the camera or at NaN. */
typedef struct {
    int64_t vertices, n, *triangles;
    double *at, *normals, *reflectance, *pose;
} Mesh;

static Mesh any_mesh(void) {
    Mesh m = {whole(3, 12), whole(0, 12), 0, 0, 0, 0, 0};
    m.at = doubles(3 * m.vertices, -1.0, 1.0), m.normals = doubles(9 * m.n, -1.0, 1.0);
    m.reflectance = doubles(m.n, 0.0, 1.0), m.pose = doubles(12, -1.0, 1.0);
    m.pose[2] = value(-0.5, 4.0);
    m.triangles = block((size_t)(3 * m.n) * sizeof(int64_t));
    for (int64_t i = 0; i < 3 * m.n; i++) m.triangles[i] = whole(0, m.vertices - 1);
    return m;
}

static ShadowMap shadow_settings(void) {
    ShadowMap map = {{0}, value(0.1, 20.0), (double)whole(1, 20), value(0.0, 0.1)};
    for (int i = 0; i < 9; i++) map.basis[i] = value(-1.0, 1.0);
    return map;
}

static float *floats(int64_t n) { return block((size_t)n * sizeof(float)); }

static void shadow_map(void) {
    Mesh m = any_mesh();
    ShadowMap map = shadow_settings();
    float *depth = floats((int64_t)map.size * (int64_t)map.size);
    NAME(shadow_map)(&map, m.at, m.triangles, m.n, depth);
    for (int64_t i = 0; i < (int64_t)map.size * (int64_t)map.size; i++) CHECK(depth[i] >= -1e30f);
}

static void render_mesh(void) {
    const int64_t height = whole(1, 24), width = whole(1, 24), samples = whole(1, 3),
                  all = height * width;
    Mesh m = any_mesh();
    ShadowMap map = shadow_settings();
    MeshLight light = {{value(-1.0, 1.0), value(-1.0, 1.0), value(-1.0, 1.0)},
                       value(0.0, 1.0),
                       value(0.0, 1.0),
                       (double)whole(0, 1)};
    double *lens = lens_of_camera();
    float *depth = floats((int64_t)map.size * (int64_t)map.size), *grey = floats(all),
          *coverage = floats(all), *nearest = floats(all);
    int32_t *owner = block((size_t)(all) * sizeof(int32_t));
    for (int64_t i = 0; i < (int64_t)map.size * (int64_t)map.size; i++)
        depth[i] = (float)value(-1.0, 1.0);
    NAME(render_mesh)(lens, height, width, samples, m.pose, m.at, m.triangles, m.normals,
                      doubles(3 * m.n, 0.0, 1.0), m.n, &light, &map, depth, grey, coverage, nearest,
                      owner, outputs(3 * m.n), floats(3 * samples * samples * all));
    for (int64_t i = 0; i < all; i++) {
        CHECK(coverage[i] >= 0.0f && coverage[i] <= 1.0f && owner[i] >= -1 && owner[i] < m.n);
        CHECK((owner[i] >= 0) == (coverage[i] > 0.0f) && nearest[i] >= 0.0f);
    }
}

static void rate_suns(void) {
    const int64_t n = whole(0, 20), k = whole(0, 4);
    const ShadowMap any = shadow_settings();
    const int64_t texels = (int64_t)any.size * (int64_t)any.size;
    double *points = doubles(14 * n, -1.0, 1.0), *directions = doubles(3 * k, -1.0, 1.0),
           *out = outputs(3 * k);
    ShadowMap *maps = block((size_t)k * sizeof(ShadowMap));
    float *depths = floats(k * texels);
    for (int64_t j = 0; j < k; j++) maps[j] = any;
    for (int64_t i = 0; i < k * texels; i++) depths[i] = (float)value(-1.0, 1.0);
    for (int64_t i = 0; i < n; i++)
        points[14 * i + 11] = value(0.0, 60.0), points[14 * i + 12] = value(0.0, 255.0),
                        points[14 * i + 13] = value(2.0, 80.0);
    NAME(rate_suns)((const LitPoint *)points, n, directions, maps, depths, k, value(0.0, 0.1), out,
                    outputs(2 * n));
    for (int64_t j = 0; j < k; j++) CHECK(!(out[3 * j] < 0.0));
}

static void direct_light(void) {
    const int64_t n = whole(0, 20);
    const ShadowMap map = shadow_settings();
    const int64_t texels = (int64_t)map.size * (int64_t)map.size;
    double *points = doubles(14 * n, -1.0, 1.0), *sun = doubles(3, -1.0, 1.0);
    float *depth = floats(texels), *out = floats(n);
    for (int64_t i = 0; i < texels; i++) depth[i] = (float)value(-1.0, 1.0);
    for (int64_t i = 0; i < n; i++)
        points[14 * i + 9] = value(0.0, 1.0), points[14 * i + 10] = value(0.0, 1.0),
                        points[14 * i + 11] = value(0.0, 60.0);
    NAME(direct_light)((const LitPoint *)points, n, sun, &map, depth, out);
}

static void control_points(void) {
    const int64_t height = whole(1, 40), width = whole(1, 40), all = height * width;
    Mesh m = any_mesh();
    PointChoice choice = {(double)whole(2, 12), (double)whole(1, PER_CELL_MOST), value(0.0, 10.0)};
    const int64_t cell = (int64_t)choice.cell_px,
                  cells = (width + cell - 1) / cell * ((height + cell - 1) / cell);
    const int64_t most = cells * (int64_t)choice.per_cell;
    float *view = floats(all), *nearest = floats(all);
    int32_t *owner = block((size_t)(all) * sizeof(int32_t));
    for (int64_t i = 0; i < all; i++) {
        view[i] = (float)value(0.0, 255.0), nearest[i] = (float)value(0.1, 2.0);
        owner[i] = m.n ? (int32_t)whole(-1, m.n - 1) : -1;
    }
    double *points = outputs(3 * most), *ahead = outputs(3 * most),
           *profiles = outputs(PROFILE * most);
    int64_t *owners = block((size_t)(most) * sizeof(int64_t));
    int64_t n = NAME(control_points)(view, nearest, owner, height, width, lens_of_camera(), m.pose,
                                     m.at, m.triangles, &choice, points, ahead, profiles, owners,
                                     outputs(all + cells * 5 * PER_CELL_MOST));
    CHECK(n >= 0 && n <= most);
    for (int64_t i = 0; i < n; i++) CHECK(owners[i] >= 0 && owners[i] < m.n);
}

static void align_points(void) {
    const int64_t height = whole(2, 60), width = whole(2, 60), n = whole(0, 60);
    LevelCamera camera = {
        value(20.0, 90.0), value(20.0, 90.0), value(0.0, 60.0), value(0.0, 60.0),
        (double)height,    (double)width,     any_lens()};
    AlignSettings set = {(double)whole(0, 30), (double)whole(0, 6), value(0.0, 0.5),
                         value(0.5, 4.0), value(0.5, 3.0)};
    float *image = floats(height * width);
    for (int64_t i = 0; i < height * width; i++) image[i] = (float)value(0.0, 255.0);
    double *points = doubles(3 * n, -0.5, 0.5), *ahead = outputs(3 * n),
           *profiles = doubles(PROFILE * n, 0.0, 255.0);
    double *pose = doubles(12, -0.1, 0.1), *residual = outputs(n), *weight = outputs(n),
           *correlation = outputs(n);
    for (int64_t i = 0; i < 3 * n; i++) ahead[i] = points[i] + value(0.0, 0.02);
    for (int i = 0; i < 3; i++) pose[3 + 4 * i] += 1.0;
    pose[2] += 1.5;
    int64_t inside =
        NAME(align_points)(&camera, image, &set, points, ahead, profiles, doubles(n, 0.0, 0.002), n,
                           pose, residual, weight, correlation, outputs(6 * n), outputs(2 * n));
    CHECK(inside >= 0 && inside <= n);
    if (inside) CHECK(all_finite(pose, 12));
}

static void measure_pose(void) {
    const int64_t m = whole(0, 6);
    PinholeCamera *lens = block(sizeof *lens);
    MarkerLimits *limits = block(sizeof *limits);
    *lens = (PinholeCamera){value(200.0, 400.0),
                            value(200.0, 400.0),
                            value(200.0, 280.0),
                            value(100.0, 160.0),
                            480.0,
                            270.0};
    *limits = (MarkerLimits){value(0.01, 0.1), value(0.01, 0.1), value(0.0, 0.5),
                             value(0.0, 0.5),  value(10.0, 60.0), value(3.0, 9.0),
                             value(0.5, 3.0),  value(0.0, 0.4),   value(1.0, 10.0),
                             value(0.0, 0.4),  value(0.0, 0.8),   value(0.0, 3.0)};
    double *pose = doubles(12, -0.1, 0.1), *covariance = outputs(36), *error = outputs(6);
    for (int i = 0; i < 3; i++) pose[3 + 4 * i] = value(0.9, 1.0);
    pose[2] = value(0.3, 2.0);
    int64_t *seen = block((size_t)m * 8);
    double *corners = doubles(12 * m, -0.2, 0.2), *origins = doubles(3 * m, -0.2, 0.2),
           *normals = doubles(3 * m, -1.0, 1.0);
    const int distorted = (int)whole(0, 1);
    double *imaged = doubles(8 * m, -20.0, 500.0), *stretch = doubles(m, 1.0, 4.0);
    int64_t count = NAME(measure_pose)(lens, limits, corners, origins, normals, m, pose,
                                       distorted ? imaged : NULL, distorted ? stretch : NULL,
                                       doubles(6, -3.0, 3.0), seen, outputs(8 * m), covariance,
                                       error);
    CHECK(count >= -1 && count <= m);
    if (count > 0) CHECK(all_finite(covariance, 36));
    for (int i = 0; i < 6 && count > 0; i++) CHECK(covariance[7 * i] >= 0.0);
}

static const Target TARGETS[] = {
    {"refine_corners", refine_corners},
    {"read_markers", read_markers},
    {"fit_patterns", fit_patterns},
    {"refine_pose", refine_pose},
    {"squared_errors", squared_errors},
    {"marker_errors", marker_errors},
    {"count_visible_markers", count_visible_markers},
    {"shadow_map", shadow_map},
    {"render_mesh", render_mesh},
    {"rate_suns", rate_suns},
    {"direct_light", direct_light},
    {"control_points", control_points},
    {"align_points", align_points},
    {"measure_pose", measure_pose},
};
FUZZ_MAIN(TARGETS)
