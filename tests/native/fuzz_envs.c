/* SPDX-License-Identifier: Apache-2.0 */
/* Fuzz targets of chaserdock/envs/native. */
#include "fuzz.h"
#include "kernels.c"

static int64_t *wholes(int64_t count, int64_t low, int64_t high) {
    int64_t *array = block((size_t)count * sizeof *array);
    for (int64_t i = 0; i < count; i++) array[i] = whole(low, high);
    return array;
}

static ProbeLimits limits(void) {
    return (ProbeLimits){value(0.0, 0.1), value(0.0, 0.2), value(0.0, 0.1), value(0.0, 0.1),
                         chance(0.5) ? 1e300 : value(0.0, 0.1)};
}

/* Properties of bodies (count, 17 + further): mass to centre of mass, then anything. */
static double *plants(int64_t count, int64_t further) {
    const int64_t width = BODY_ROWS - MASS + further;
    double *rows = doubles(count * width, -0.01, 0.01);
    for (int64_t i = 0; i < count; i++) {
        double *row = rows + i * width;
        fill(row, 4, 0.3, 2.0);
        fill_quaternion(row + FRAME - MASS);
        fill(row + BODY_ROWS - MASS, further, -1.0, 1.0);
    }
    return rows;
}

static Place *places(int64_t count) {
    Place *all = block((size_t)count * sizeof *all);
    for (int64_t i = 0; i < count; i++) {
        Place *p = all + i;
        fill(p->goal_m, 3, -1.0, 1.0), fill(p->port_m, 3, -0.3, 0.3);
        fill(p->start_m, 3, -2.0, 2.0), fill(p->start_velocity_m_s, 3, -0.1, 0.1);
        fill_quaternion(p->goal_wxyz), fill_quaternion(p->start_wxyz);
        for (int k = 0; k < 3; k++) p->port_axis[k] = p->cone_axis[k] = k ? 0.0 : 1.0;
        p->cone_sine = value(0.0, 0.8), p->cone_cosine = value(0.6, 1.0);
        p->cone_apex_m = value(-0.5, 0.5), p->nearest_m = value(0.0, 0.5);
    }
    return all;
}

/* Faces of any cuboids, some without points. */
static Surface surface(int64_t boxes) {
    const int64_t faces = boxes > 0 ? whole(1, 5) : 1, points = whole(1, 9);
    int64_t *first = wholes(faces + 1, 0, 0);
    double *planes = doubles(4 * faces, -0.3, 0.3), *points_m = doubles(3 * points, -0.5, 0.5);
    double *totals = outputs(4 * faces);
    zero(totals, 4 * faces);
    for (int64_t k = 0; k < faces; k++) {
        first[k + 1] = k == faces - 1 ? points : whole(first[k], points);
        for (int64_t p = first[k]; p < first[k + 1]; p++) {
            for (int i = 0; i < 3; i++) totals[4 * k + i] += points_m[3 * p + i];
            totals[4 * k + 3] += 1.0;
        }
    }
    Surface s = {.faces = faces, .points = points, .needed = whole(1, points),
                 .sunlit = whole(0, 1), .range_m = value(0.1, 3.0), .least_cosine = value(0.0, 1.0),
                 .extent_m = value(0.5, 3.0), .planes = planes, .points_m = points_m,
                 .totals = totals, .first = first, .box = wholes(faces, 0, boxes > 0 ? boxes - 1 : 0)};
    fill(s.to_sun, 3, -1.0, 1.0);
    return s;
}

static Task task_of_any(void) {
    const int64_t n = whole(1, 6), m = whole(1, 3), steps = whole(1, 9), actuators = whole(1, 7);
    const int64_t count = whole(1, 3), boxes = whole(0, 3), bins = whole(2, 5);
    Task t = {.environments = n, .chasers = m, .pitch = (n * m + 3) / 4 * 4,
              .target_pitch = (n + 3) / 4 * 4, .actuators = actuators, .pulsed = whole(0, 1),
              .steps = steps, .latency_steps = whole(0, steps), .episode_ticks = whole(1, 4),
              .held_ticks = whole(1, 3), .image_ticks = whole(1, 2), .plants = count,
              .boxes = boxes, .bins = bins, .task = whole(HOLD, DETUMBLE), .statistical = whole(0, 1)};
    t.width = 16 + 3 * (m - 1);
    if (t.task == INSPECT) t.width += SURFACE_ELEMENTS;
    if (t.task == DETUMBLE) t.width += STACK_ELEMENTS;
    t.surface = surface(boxes);
    t.stack = (Stack){.speed_m_s = value(0.0, 0.1), .rate_rad_s = value(0.0, 0.2)};
    fill(t.stack.centre_m, 3, -0.2, 0.2);
    if (chance(0.5)) t.stack.closed = wholes(m * actuators, 0, 1);
    t.step_s = value(0.001, 0.01), t.tick_s = value(0.01, 0.1), t.reach_m = value(0.3, 0.5);
    fill(t.half_m, 3, 0.05, 0.2);
    t.keep_target_m = value(0.0, 0.8), t.keep_chasers_m = value(0.0, 0.5);
    t.farthest_m = value(1.0, 9.0), t.fastest_rad_s = value(1.0, 20.0);
    t.held_m = value(0.0, 1.0), t.held_rad = value(0.0, 1.0);
    t.entry_m = value(0.1, 0.5), t.final_m = value(0.01, 0.1);
    t.corridor = limits(), t.final = limits(), t.contact = limits();
    fill((double *)&t.weights, (int64_t)(sizeof t.weights / sizeof(double)), -1.0, 1.0);
    fill(t.spread_m, 3, 0.0, 0.5);
    t.spread_rad = value(0.0, 3.0), t.spread_m_s = value(0.0, 0.1);
    t.spread_rad_s = value(0.0, 0.1), t.target_spread_rad_s = value(0.0, 0.1);
    fill(t.target_start, 13, -0.1, 0.1), fill_quaternion(t.target_start + 6);
    fill(t.camera_m, 3, -0.1, 0.1), fill_quaternion(t.camera_wxyz), fill(t.view, 4, 0.1, 1.0);
    t.bin_first_m = value(0.0, 0.5), t.bin_m = value(0.01, 0.5);
    t.places = places(m);
    t.chaser_plants = plants(count * m, 6 * actuators), t.target_plants = plants(count, 0);
    double *solids = doubles(16 * boxes, -0.3, 0.3);
    for (int64_t i = 0; i < boxes; i++) fill(solids + 16 * i, 3, 0.05, 0.2), solids[16 * i + 15] = 0.4;
    t.solids = solids;
    t.rise = doubles(actuators * steps, 0.0, 1.0), t.fall = doubles(actuators * steps, 0.0, 1.0);
    t.effort_N_s = doubles(actuators, 0.0, 1.0);
    t.sensor = doubles(bins * 6 * SENSOR_COLUMNS, 0.0, 0.9);
    t.rise_steps = wholes(actuators, 0, steps), t.fall_steps = wholes(actuators, 0, steps);
    t.shortest = wholes(actuators, 0, steps), t.longest = wholes(actuators, 0, steps);
    return t;
}

/* Bodies (BODY_ROWS, pitch) at rest in the origin, as those that fill up the last four are. */
static double *bodies_at_rest(int64_t pitch) {
    double *rows = outputs(BODY_ROWS * pitch);
    for (int64_t i = 0; i < BODY_ROWS * pitch; i++) {
        const int64_t row = i / pitch;
        rows[i] = row == ATTITUDE || row == FRAME || (row >= MASS && row < DISTURBANCE);
    }
    return rows;
}

static double *zeros(int64_t count) {
    double *array = outputs(count);
    zero(array, count);
    return array;
}

static Batch batch_of(const Task *t) {
    const int64_t n = t->environments, all = n * t->chasers, pitch = t->pitch;
    float *actions = block((size_t)(all * t->actuators) * sizeof *actions);
    const double most = t->pulsed ? 1.2 : 2.0;
    for (int64_t i = 0; i < all * t->actuators; i++) actions[i] = (float)value(-1.0, most);
    Batch b = {.bodies = bodies_at_rest(pitch),
               .targets = bodies_at_rest(t->target_pitch),
               .wrench = zeros(6 * pitch),
               .memory = zeros(MEMORY_ROWS * pitch),
               .docked = zeros(DOCKED_ROWS * pitch),
               .errors = zeros(ERROR_ROWS * pitch),
               .unseen = zeros(4 * t->surface.faces * n),
               .work = outputs(24 * t->steps),
               .pulse = wholes(t->actuators * all, 0, 0),
               .opened = wholes(t->actuators * all, 0, 0),
               .age = wholes(n, 0, 0),
               .plant = wholes(n, 0, 0),
               .done = wholes(n, 1, 1),
               .outcome = wholes(all, 0, 0),
               .random = block((size_t)n * 8),
               .actions = actions,
               .observations = block((size_t)(all * t->width) * sizeof(float)),
               .rewards = outputs(pitch),
               .seen = bytes(n * t->surface.points),
               .terminated = bytes(all),
               .truncated = bytes(all),
               .rejected = wholes(n, 5, 5),
               .idle = wholes(n, 0, 0)};
    for (int64_t i = 0; i < n; i++) b.random[i] = random_bits();
    return b;
}

static void check(const Task *t, const Batch *b) {
    for (int64_t i = 0; i < t->environments * t->chasers; i++) {
        const int64_t outcome = b->outcome[i], e = i / t->chasers;
        CHECK(outcome >= FLYING && outcome <= STOPPED);
        CHECK(b->terminated[i] <= 1 && b->truncated[i] <= 1 && b->plant[e] < t->plants);
        CHECK(!b->truncated[i] || outcome == HELD || outcome == TIME_OUT);
        CHECK(!b->terminated[i] || (outcome != FLYING && outcome != TIME_OUT));
        CHECK(b->done[e] || outcome == FLYING || outcome == DOCKED);
        if (special_drawn) continue;
        CHECK(finite(b->rewards[i]));
        for (int64_t k = 0; k < t->width; k++)
            CHECK(finite((double)b->observations[i * t->width + k]));
    }
}

static void start_batch(void) {
    const Task t = task_of_any();
    Batch b = batch_of(&t);
    NAME(start_batch)(&t, &b);
    for (int64_t e = 0; e < t.environments; e++) CHECK(!b.done[e] && !b.rejected[e] && !b.age[e]);
    for (int64_t p = 0; t.task == INSPECT && p < t.environments * t.surface.points; p++)
        CHECK(!b.seen[p]);
    check(&t, &b);
}

static void step_batch(void) {
    const Task t = task_of_any();
    Batch b = batch_of(&t);
    NAME(start_batch)(&t, &b);
    for (int tick = 0; tick < 6; tick++) {
        int64_t before = b.rejected[0], done = b.done[0];
        NAME(step_batch)(&t, &b);
        int valid = 1;
        for (int64_t i = 0; i < t.chasers * t.actuators; i++)
            valid &= finite((double)b.actions[i]);
        CHECK(b.rejected[0] == (done ? 0 : before + !valid));
        check(&t, &b);
    }
}

static const Target TARGETS[] = {{"start_batch", start_batch}, {"step_batch", step_batch}};
FUZZ_MAIN(TARGETS)
