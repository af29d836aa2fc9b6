/* SPDX-License-Identifier: Apache-2.0 */
/* Fuzz targets of world/chaserdock_world/physics/native, with an imitation of Bullet's C
 * interface. */
#include "fuzz.h"
#include "kernels.c"

typedef struct {
    int64_t count, steps, contact_step;
    double *q, *u, *loads;
    int64_t *applied;
} World; /* the client; a command or status is the index of a body, plus one */

static World world;
static int body_now;

static void *submitted;
static int submit(void *client, void *command) {
    CHECK(client == &world);
    submitted = command;
    return 0;
}
static void *status_of(void *client) {
    CHECK(client == &world);
    return submitted;
}
static void *begin_state(void *client, int body) {
    CHECK(client == &world && body >= 0 && body < world.count);
    body_now = body;
    return &world.q[7 * body];
}
static int read_state(void *status, int *body, int *q_count, int *u_count, const double **frame,
                      const double **q, const double **u, const double **reactions) {
    CHECK(!body && !q_count && !u_count && !frame && !reactions);
    *q = status;
    *u = world.u + 6 * body_now;
    return 0;
}
static void *begin(void *client) { return client; }
static void add_force(void *command, int body, int link, const double *force, const double *point,
                      int axes) {
    CHECK(command == &world && body == body_now && link == -1 && axes == 1 && point[0] == 0.0);
    CHECK(same_bits(force, world.loads + 9 * body + 3, 3));
}
static void add_torque(void *command, int body, int link, const double *torque, int axes) {
    CHECK(command == &world && body == body_now && link == -1 && axes == 1);
    if (!special_drawn) CHECK(all_finite(torque, 3));
    world.applied[body]++;
}
static void *begin_step(void *client) {
    world.steps++;
    return client;
}
static int placed;
static void *begin_placement(void *client, int body) {
    CHECK(client == &world && body == 7);
    placed++;
    return client;
}
static int turn_to(void *command, double x, double y, double z, double w) {
    (void)x, (void)y, (void)z, (void)w;
    CHECK(command == &world);
    return 0;
}
static int place_at(void *command, double x, double y, double z) {
    return turn_to(command, x, y, z, 0.0);
}
static int set_rates(void *command, const double *rates) {
    return turn_to(command, rates[0], rates[1], rates[2], 0.0);
}
static void read_contacts(void *client, Contacts *found) {
    CHECK(client == &world);
    found->count = world.steps == world.contact_step;
}

static void advance(void) {
    const Bullet bullet = {submit,          status_of,  begin_state, read_state, begin,
                           add_force,       add_torque, begin_step,  begin,      read_contacts,
                           begin_placement, place_at,   turn_to,     set_rates,  set_rates};
    const int64_t count = whole(0, 4), steps = whole(0, 5), contact_step = whole(1, 8);
    world = (World){count,
                    0,
                    contact_step,
                    outputs(7 * count),
                    doubles(6 * count, -1.0, 1.0),
                    doubles(9 * count, 0.1, 1.0),
                    block((size_t)count * 8)};
    int64_t *bodies = block((size_t)count * 8), *touching = block(8);
    for (int64_t i = 0; i < count; i++) {
        bodies[i] = i, world.applied[i] = 0;
        fill(world.q + 7 * i, 3, -1.0, 1.0);
        fill_quaternion(world.q + 7 * i + 3);
    }
    const int64_t first = whole(1, 4), every = whole(1, 4);
    Path path = {7, first, every, doubles(13 * 6, -1.0, 1.0)};
    placed = 0;
    const int64_t made = NAME(advance)(&bullet, &world, count, bodies, world.loads, steps,
                                       value(0.001, 0.01), whole(0, 1) ? &path : 0, touching);
    const int64_t quiet = made - (made == contact_step);
    CHECK(!placed || placed == 2 * (quiet < first ? 0 : 1 + (quiet - first) / every));
    CHECK(made == (contact_step < steps ? contact_step : steps) && made == world.steps);
    CHECK(*touching == (made == contact_step));
    for (int64_t i = 0; i < count; i++) CHECK(world.applied[i] == made);
}

static const Target TARGETS[] = {{"advance", advance}};
FUZZ_MAIN(TARGETS)
