/* SPDX-License-Identifier: Apache-2.0 */
/* Fuzz targets of world/chaserdock_world/rendering/native. */
#include "fuzz.h"
#include "kernels.c"

static void add_noise(void) {
    const int64_t rows = whole(0, 3), columns = whole(1, 80), stride = columns + whole(0, 5);
    const int64_t cells = rows ? (rows - 1) * stride + columns : 0, flat = chance(0.5);
    uint8_t *image = bytes(rows * columns), *out = chance(0.5) ? image : bytes(rows * columns);
    int16_t *bank = block((size_t)cells * 2), *sigma = block(512);
    for (int64_t i = 0; i < cells; i++) bank[i] = (int16_t)random_bits();
    for (int64_t i = 0; i < 256; i++) sigma[i] = flat ? 0 : (int16_t)random_bits();
    for (int64_t i = 0; i < rows * columns && chance(0.99); i++) image[i] = image[0];
    uint8_t *given = bytes(rows * columns);
    memcpy(given, image, (size_t)(rows * columns));
    double scale = chance(special_share) ? special() : uniform(-1e-4, 1e-4);
    NAME(add_noise)(image, bank, stride, sigma, scale, rows, columns, out);
    if (flat && finite((float)scale)) CHECK(memcmp(out, given, (size_t)(rows * columns)) == 0);
}

/* A camera of 64 x 48 pixels, with its planes and borders as in scene_geometry.Frustum. */
static Frustum *frustum(void) {
    Frustum *f = block(sizeof *f);
    const double left = -33.0, top = -25.0, right = 33.0, bottom = 25.0;
    f->fx = value(20.0, 80.0), f->fy = value(20.0, 80.0), f->cx = value(30.0, 34.0),
    f->cy = value(22.0, 26.0);
    f->origin[0] = value(-2.0, 2.0), f->origin[1] = value(-2.0, 2.0), f->near_m = 0.01;
    const double planes[5][4] = {{0, 0, 1, -0.01},
                                 {f->fx, 0, -left, 0},
                                 {-f->fx, 0, right, 0},
                                 {0, f->fy, -top, 0},
                                 {0, -f->fy, bottom, 0}};
    copy(planes[0], f->planes[0], 20);
    for (int i = 0; i < 4; i++) {
        copy(planes[1 + i], f->borders[i], 3);
        normalize3(f->borders[i]);
    }
    return f;
}

static void fill_pose(double *pose, double low, double high) {
    fill(pose, 2, -0.5, 0.5);
    pose[2] = value(low, high);
    fill_quaternion(pose + 3);
}

/* Right, up and normal of the six sides as columns. */
static double *sides_of_boxes(void) {
    double *sides = doubles(54, 0.0, 0.0);
    for (int side = 0; side < 6; side++)
        for (int column = 0; column < 3; column++)
            sides[9 * side + 3 * ((side / 2 + 1 + column) % 3) + column] =
                column == 2 && side % 2 ? -1.0 : 1.0;
    return sides;
}

static Face *seen_faces(const Frustum *f, int64_t shapes, VisibleBox *boxes, int64_t *counts) {
    const int64_t bodies = whole(1, 2);
    Shape *shape = block((size_t)shapes * sizeof *shape);
    Face *faces = block((size_t)(6 * shapes) * sizeof *faces);
    double *camera = outputs(7), *poses = outputs(7 * bodies), *sides = sides_of_boxes();
    fill_pose(camera, -0.1, 0.1);
    if (chance(0.7)) camera[3] = 1.0, camera[4] = camera[5] = camera[6] = 0.0;
    for (int64_t i = 0; i < bodies; i++) fill_pose(poses + 7 * i, -0.5, 3.0);
    for (int64_t i = 0; i < shapes; i++) {
        double q[4];
        shape[i].body = (double)whole(0, bodies - 1);
        fill(shape[i].position, 3, -0.3, 0.3);
        fill_quaternion(q);
        matrix_of(q, shape[i].rotation);
        fill(shape[i].half, 3, 0.01, 0.5);
        shape[i].radius = sqrt_of(dot3(shape[i].half, shape[i].half));
    }
    NAME(visible_faces)(f, camera, poses, shapes, shape, sides, boxes, faces, counts);
    return faces;
}

static void visible_faces(void) {
    const int64_t shapes = whole(0, 5);
    const Frustum *f = frustum();
    VisibleBox *boxes = block((size_t)shapes * sizeof *boxes);
    int64_t *counts = block(16);
    Face *faces = seen_faces(f, shapes, boxes, counts);
    CHECK(0 <= counts[0] && counts[0] <= shapes && counts[0] <= counts[1] &&
          counts[1] <= 6 * shapes);
    for (int64_t i = 0; i < counts[0]; i++) CHECK(!any_nan(boxes[i].centre, 3));
    for (int64_t i = 0; i < counts[1]; i++) {
        CHECK(faces[i].count >= 3.0 && faces[i].count <= OUTLINE_MOST);
        CHECK(faces[i].box >= 0.0 && faces[i].box < (double)counts[0]);
        if (!special_drawn) CHECK(all_finite(faces[i].outline[0], 2 * (int64_t)faces[i].count));
    }
}

static void paint_order(void) {
    const int64_t n = whole(0, 6);
    VisibleBox *boxes = block((size_t)n * sizeof *boxes);
    uint8_t *occluded = bytes(n * n), seen[6] = {0};
    int64_t *order = block((size_t)n * sizeof *order);
    for (int64_t i = 0; i < n; i++) {
        double q[4];
        boxes[i].shape = (double)i;
        fill(boxes[i].centre, 3, -1.0, 3.0);
        fill_quaternion(q);
        matrix_of(q, boxes[i].rotation);
        fill(boxes[i].half, 3, 0.01, 1.0);
        fill(boxes[i].low, 2, 0.0, 30.0);
        fill(boxes[i].high, 2, 20.0, 60.0);
    }
    NAME(paint_order)(n, boxes, occluded, order);
    for (int64_t i = 0; i < n; i++) {
        CHECK(0 <= order[i] && order[i] < n && !seen[order[i]]);
        seen[order[i]] = 1;
    }
}

static void place_texture(void) {
    const Frustum *f = frustum();
    VisibleBox *boxes = block(sizeof *boxes);
    int64_t *counts = block(16), *patch = block(16), *finest = block(16), *region = block(32),
            *halved = block(16);
    Face *face = seen_faces(f, 1, boxes, counts);
    if (!counts[1] || chance(0.2)) {
        fill((double *)face, (int64_t)(sizeof *face / sizeof(double)), -3.0, 60.0);
        face->count = (double)whole(3, OUTLINE_MOST);
    }
    for (int k = 0; k < 2; k++) patch[k] = whole(1, 80), finest[k] = whole(1, 400);
    double *matrix = outputs(9), samples = (double)whole(1, 4);
    int64_t placed = NAME(place_texture)(f, face, samples, value(0.0, 20.0), value(0.0, 20.0),
                                         patch, finest, value(0.001, 0.01), region, halved, matrix);
    if (!placed) return;
    for (int k = 0; k < 2; k++) {
        CHECK(0 <= region[k] && region[k] < region[2 + k] && region[2 + k] <= patch[k]);
        CHECK(0 <= halved[k] && halved[k] <= 30);
    }
    CHECK(all_finite(matrix, 9));
}

static void draw_stars(void) {
    const int64_t count = whole(0, 20), width = whole(1, 20), height = whole(1, 20);
    double *directions = doubles(3 * count, -1.0, 1.0), *lens = doubles(6, -10.0, 20.0);
    uint8_t *levels = block((size_t)count), *canvas = bytes(width * height);
    int64_t *at = block((size_t)count * 2 * sizeof(int64_t));
    if (count) memset(levels, 200, (size_t)count);
    memset(canvas, 4, (size_t)(width * height));
    int64_t stated = NAME(draw_stars)(directions, levels, count, lens, width, height, canvas, at);
    int64_t drawn = 0;
    for (int64_t i = 0; i < width * height; i++) drawn += canvas[i] != 4;
    CHECK(drawn <= stated && stated <= count);
    for (int64_t i = 0; i < stated; i++) {
        CHECK(0 <= at[2 * i] && at[2 * i] < width && 0 <= at[2 * i + 1] && at[2 * i + 1] < height);
        CHECK(canvas[at[2 * i + 1] * width + at[2 * i]] == 200);
    }
}

static void spread_and_halve(void) {
    const int64_t height = whole(1, 6), width = whole(1, 70), reach = whole(0, 20);
    uint8_t *fine = bytes(4 * height * width), *out = bytes(height * width);
    uint16_t *weights = block((size_t)(2 * reach + 2) * 2),
             *work = block((size_t)(4 * (width + reach + 1)) * 2);
    memset(weights, 0, (size_t)(2 * reach + 2) * 2);
    for (int i = 0; i < 256; i++) weights[whole(0, 2 * reach + 1)]++;
    memset(fine, 77, (size_t)(4 * height * width));
    NAME(spread_and_halve)(fine, height, width, weights, reach, out, work);
    for (int64_t i = 0; i < height * width; i++) CHECK(out[i] == 77);
}

static void draw_meshes(void) {
    const int64_t bodies = whole(1, 2), each = whole(0, 4), m = bodies * each, width = whole(1, 70),
                  height = whole(1, 20), n = whole(1, 3);
    const Frustum *f = frustum();
    double *camera = outputs(7), *poses = outputs(7 * bodies), *corners = doubles(9 * m, -0.5, 0.5);
    double *normals = doubles(9 * m, -1.0, 1.0), *uv = doubles(6 * m, -1.0, 1.0);
    int64_t *first = block((size_t)(bodies + 1) * 8), *surface = block((size_t)m * 8),
            depth_size = 0;
    Surface *surfaces = block(2 * sizeof *surfaces);
    Illumination *light = block(sizeof *light);
    ShadowMap *maps = block((size_t)bodies * sizeof *maps);
    float *wrinkles = block((size_t)(3 * n * n) * sizeof *wrinkles),
          *samples = block((size_t)(BAND * width * SAMPLES * 2) * 4);
    fill_pose(camera, -0.1, 0.1);
    if (chance(0.7)) camera[3] = 1.0, camera[4] = camera[5] = camera[6] = 0.0;
    for (int64_t i = 0; i < bodies; i++) fill_pose(poses + 7 * i, -0.5, 3.0);
    for (int64_t i = 0; i <= bodies; i++) first[i] = i * each;
    for (int64_t i = 0; i < m; i++) surface[i] = whole(0, 1);
    fill((double *)surfaces, 8, 0.0, 3.0);
    fill((double *)light, (int64_t)(sizeof *light / 8), -1.0, 1.0);
    if (chance(0.8)) light->sun_share = 0.8;
    for (int64_t i = 0; i < 3 * n * n; i++) wrinkles[i] = (float)value(-0.5, 0.5);
    for (int64_t i = 0; i < bodies; i++) {
        maps[i].width = 8 * whole(1, 3), maps[i].height = whole(1, 20), maps[i].offset = depth_size,
        maps[i].padding = 0;
        fill(maps[i].low, 2, -1.0, 1.0);
        maps[i].texel_m = value(0.01, 0.2), maps[i].used = (double)chance(0.9);
        depth_size += maps[i].width * maps[i].height;
    }
    /* What an unused map contains does not matter, but it must not be what a sanitizer reports. */
    float *depth = block((size_t)depth_size * sizeof *depth);
    memset(depth, 0, (size_t)depth_size * sizeof *depth);
    BodyPose *placed = block((size_t)bodies * sizeof *placed);
    Triangle *triangles = block((size_t)(6 * m) * sizeof *triangles);
    int32_t *spans =
        block((size_t)(12 * m + 2 * (6 * m / GROUP + 1) + 2 * (height / BAND + 1)) * sizeof *spans);
    uint8_t *canvas = bytes(width * height);
    memset(canvas, 4, (size_t)(width * height));
    NAME(draw_meshes)(f, width, height, camera, bodies, poses, first, corners, normals, uv, surface,
                      surfaces, light, wrinkles, n, maps, depth, placed, triangles, spans, samples,
                      canvas);
    if (!m)
        for (int64_t i = 0; i < width * height; i++) CHECK(canvas[i] == 4);
}

static const Target TARGETS[] = {
    {"add_noise", add_noise},     {"visible_faces", visible_faces},
    {"paint_order", paint_order}, {"place_texture", place_texture},
    {"draw_stars", draw_stars},   {"draw_meshes", draw_meshes},
    {"spread_and_halve", spread_and_halve},
};
FUZZ_MAIN(TARGETS)
