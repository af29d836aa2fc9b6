/* SPDX-License-Identifier: Apache-2.0 */
/* Steps of free bodies in PyBullet, by Bullet's C interface (PhysicsClientC_API.h), which
 * PyBullet's library exports.
 *
 * A body takes seven calls a step from Python, of which Bullet's own work is a fifth. The client of
 * the same world comes from Bullet's interface for plugins (b3PluginAPI.h). */
#include "base.h"

/* SHARED_MEMORY_MAGIC_NUMBER of SharedMemoryPublic.h; Bullet refuses another. */
#define PLUGIN_VERSION 202010061
#define NO_LINK (-1)             /* the base of a body */
#define BODY_AXES 1              /* EF_LINK_FRAME */

typedef struct {
    void *client;
} PluginContext; /* begin of b3PluginContext */

typedef struct {
    char text[1024];
    int int_count, ints[128], float_count;
    double floats[128];
} PluginArguments; /* b3PluginArguments */

EXPORT int PASTE(initPlugin_, LEVEL)(PluginContext *context) {
    return context ? PLUGIN_VERSION : 0;
}
EXPORT void PASTE(exitPlugin_, LEVEL)(PluginContext *context) { (void)context; }

/* Store the client at the address whose low and high 32 bits are the integer arguments; return 1,
 * or 0 without these. */
EXPORT int PASTE(executePluginCommand_, LEVEL)(PluginContext *context,
                                               const PluginArguments *arguments) {
    if (arguments->int_count != 2) return 0;
    uint64_t address = (uint32_t)arguments->ints[0] | (uint64_t)(uint32_t)arguments->ints[1] << 32;
    *(void **)(uintptr_t)address = context->client;
    return 1;
}

typedef struct {
    int count;
    void *points;
} Contacts; /* b3ContactInformation */

/* Addresses of Bullet's functions, in the order of FUNCTIONS in bullet_stepping.py. */
typedef struct {
    int (*submit)(void *client, void *command);
    void *(*status)(void *client);
    void *(*begin_state)(void *client, int body);
    int (*read_state)(void *status, int *body, int *q_count, int *u_count, const double **frame,
                      const double **q, const double **u, const double **reactions);
    void *(*begin_loads)(void *client);
    void (*add_force)(void *command, int body, int link, const double *force, const double *point,
                      int axes);
    void (*add_torque)(void *command, int body, int link, const double *torque, int axes);
    void *(*begin_step)(void *client);
    void *(*begin_contacts)(void *client);
    void (*read_contacts)(void *client, Contacts *found);
    void *(*begin_placement)(void *client, int body);
    int (*place_at)(void *command, double x, double y, double z);
    int (*turn_to)(void *command, double x, double y, double z, double w);
    int (*set_velocity)(void *command, const double *velocity);
    int (*set_rate)(void *command, const double *omega);
} Bullet;

/* Execute a command and return its status. A client in the same process has done so on return: to
 * wait for it, as b3SubmitClientCommandAndWaitStatus does, would only read the clock twice. */
static void *execute(const Bullet *bullet, void *client, void *command) {
    bullet->submit(client, command);
    return bullet->status(client);
}

/* Placements of a body after the step ``next`` and then every ``every`` steps. ``motion`` (., 13):
 * position, attitude x, y, z, w, velocity and rate in world axes. */
typedef struct {
    int64_t body, next, every;
    const double *motion;
} Path;
LAYOUT(Path, body, next, every, motion)

/* Torque (3), body axes, to add to ``torque`` for a step of ``step_s``: ``midpoint_torque`` of
 * gyroscopic.py, to the bit.
 * ``q``: attitude x, y, z, w; ``omega``: rate in world axes. */
static inline void midpoint_torque(const double *inertia, const double *q, const double *omega,
                                   const double *torque, double step_s, double *out) {
    double x = q[0], y = q[1], z = q[2], w = q[3], u = omega[0], v = omega[1], s = omega[2];
    double tx = 2.0 * (v * z - s * y), ty = 2.0 * (s * x - u * z), tz = 2.0 * (u * y - v * x);
    double a = u + w * tx + ty * z - tz * y, b = v + w * ty + tz * x - tx * z,
           c = s + w * tz + tx * y - ty * x;
    double ia = inertia[0], ib = inertia[1], ic = inertia[2];
    double ab = ib - ia, bc = ic - ib, ca = ia - ic;
    double gx = b * c * bc, gy = c * a * ca, gz = a * b * ab;
    double h = 0.5 * step_s;
    double ma = a + h * (torque[0] - gx) / ia, mb = b + h * (torque[1] - gy) / ib,
           mc = c + h * (torque[2] - gz) / ic;
    out[0] = gx - mb * mc * bc;
    out[1] = gy - mc * ma * ca;
    out[2] = gz - ma * mb * ab;
}

/* Place a body as resetBasePositionAndOrientation and resetBaseVelocity of PyBullet do. */
static void place(const Bullet *bullet, void *client, int body, const double *motion) {
    void *pose = bullet->begin_placement(client, body);
    bullet->place_at(pose, motion[0], motion[1], motion[2]);
    bullet->turn_to(pose, motion[3], motion[4], motion[5], motion[6]);
    execute(bullet, client, pose);
    void *rates = bullet->begin_placement(client, body);
    bullet->set_velocity(rates, motion + 7);
    bullet->set_rate(rates, motion + 10);
    execute(bullet, client, rates);
}

/* Make at most ``steps`` steps of ``count`` bodies under constant loads, and stop after one in
 * which bodies touched.
 * ``loads`` (count, 9): principal moments, force and torque in body axes. ``path``: of a body that
 * is placed after steps without contacts, or null. ``touching``: whether bodies touched in the last
 * step. Returns the number of steps made, -1 for a body that Bullet does not know. */
EXPORT int64_t NAME(advance)(const Bullet *bullet, void *client, int64_t count,
                             const int64_t *bodies, const double *loads, int64_t steps,
                             double step_s, Path *path, int64_t *touching) {
    static const double origin[3] = {0.0, 0.0, 0.0};
    *touching = 0;
    for (int64_t step = 0; step < steps; step++) {
        for (int64_t i = 0; i < count; i++) {
            const double *inertia = loads + 9 * i, *force = inertia + 3, *torque = inertia + 6,
                         *q = 0, *u = 0;
            const int body = (int)bodies[i];
            bullet->read_state(execute(bullet, client, bullet->begin_state(client, body)), 0, 0, 0,
                               0, &q, &u, 0);
            if (!q || !u) return -1;
            double turn[3];
            midpoint_torque(inertia, q + 3, u + 3, torque, step_s, turn);
            for (int k = 0; k < 3; k++) turn[k] = torque[k] + turn[k];
            /* One command each: a torque after a force in the same command overwrites a part of
             * it. */
            if (force[0] != 0.0 || force[1] != 0.0 || force[2] != 0.0) {
                void *command = bullet->begin_loads(client);
                bullet->add_force(command, body, NO_LINK, force, origin, BODY_AXES);
                execute(bullet, client, command);
            }
            void *command = bullet->begin_loads(client);
            bullet->add_torque(command, body, NO_LINK, turn, BODY_AXES);
            execute(bullet, client, command);
        }
        execute(bullet, client, bullet->begin_step(client));
        Contacts found = {0, 0};
        execute(bullet, client, bullet->begin_contacts(client));
        bullet->read_contacts(client, &found);
        *touching = found.count > 0;
        if (*touching) return step + 1;
        if (path && step + 1 == path->next) {
            place(bullet, client, (int)path->body, path->motion);
            path->next += path->every;
            path->motion += 13;
        }
    }
    return steps;
}
