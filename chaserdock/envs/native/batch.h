/* SPDX-License-Identifier: Apache-2.0 */
/* What a batch of environments consists of. Arrays of the state are by rows: element r of body b is
 * at r * pitch + b, with pitch a multiple of four. */
#ifndef CHASERDOCK_BATCH_H
#define CHASERDOCK_BATCH_H

#include "flight.h"
#include "quaternions.h"
#include "random.h"

/* Tasks: keep a place relative to the target; come to it; be latched by the port; see the target's
 * surface; latched to the target, stop it. With DETUMBLE `targets` and `target_plants` are stacks of
 * a target and all chasers, and the wrenches of `chaser_plants` are in the stack's principal frame. */
enum { HOLD, COME, LATCH, INSPECT, DETUMBLE };

/* How a chaser's episode stands or ended. DOCKED, HELD, INSPECTED and STOPPED are successes. In
 * AFTER_OTHERS another chaser ended it. */
enum { FLYING, DOCKED, HELD, TIME_OUT, COLLIDED, TOO_NEAR, LOST, AFTER_OTHERS, INSPECTED, STOPPED };

/* Limits of a probe relative to its port. */
typedef struct {
    double lateral_m, angle_rad, lateral_speed_m_s, closing_m_s, rate_rad_s;
} ProbeLimits;
LAYOUT(ProbeLimits, lateral_m, angle_rad, lateral_speed_m_s, closing_m_s, rate_rad_s)

/* Places of one chaser. TRF: where it shall be (centre and attitude), its port and the port's
 * outward axis, the cone in which it may be nearer than the keep-out distance (without: sine 0,
 * cosine 0, apex 1). WRF: where it starts. */
typedef struct {
    double goal_m[3], goal_wxyz[4], port_m[3], port_axis[3];
    double cone_axis[3], cone_sine, cone_cosine, cone_apex_m, nearest_m;
    double start_m[3], start_wxyz[4], start_velocity_m_s[3];
} Place;
LAYOUT(Place, goal_m, goal_wxyz, port_m, port_axis, cone_axis, cone_sine, cone_cosine, cone_apex_m,
       nearest_m, start_m, start_wxyz, start_velocity_m_s)

/* Weights of the reward; see the scenario's table [learning.reward]. */
typedef struct {
    double progress_per_m, turn_per_rad, distance_per_m_s, angle_per_rad_s, impulse_per_N_s;
    double corridor_per_s, within_per_s, time_per_s, seen, spin_per_rad_s, drift_per_m_s;
    double success, failure;
} Weights;
LAYOUT(Weights, progress_per_m, turn_per_rad, distance_per_m_s, angle_per_rad_s, impulse_per_N_s,
       corridor_per_s, within_per_s, time_per_s, seen, spin_per_rad_s, drift_per_m_s, success, failure)

/* Columns of `sensor`: whether markers are seen; gains of the filter for error and rate; what its
 * noise adds to them in an update, and how they are drawn at the start: factors of a first random
 * number for the error and the rate, and of a second one for the rate. In m or rad, and per s. */
enum {
    SEEN,
    GAIN,
    RATE_GAIN,
    NOISE,
    RATE_NOISE,
    RATE_NOISE_ALONE,
    ERROR,
    RATE_ERROR,
    RATE_ERROR_ALONE,
    SENSOR_COLUMNS
};

/* The target's faces, and points on them that a camera sees from at most `range_m`, with at least
 * `least_cosine` to the face's normal; with `sunlit` only those that nothing within `extent_m` towards
 * the sun (`to_sun`, WRF) shades. The task is done with `needed` points. By face: `planes` (faces, 4):
 * outward normal (TRF), and its distance from TRF's origin; `first` (faces + 1): its points in
 * `points_m` (points, 3), TRF; `box`: its cuboid; `totals` (faces, 4): sum of its points, and their
 * number. */
typedef struct {
    int64_t faces, points, needed, sunlit;
    double range_m, least_cosine, extent_m, to_sun[3];
    const double *planes, *points_m, *totals;
    const int64_t *first, *box;
} Surface;
LAYOUT(Surface, faces, points, needed, sunlit, range_m, least_cosine, extent_m, to_sun, planes,
       points_m, totals, first, box)

/* A stack is at rest below these rates, of its centre of mass and of its body. `centre_m`: stated
 * centre of mass (TRF). `closed` (chasers, actuators): thrusters that may not fire; null for none. */
typedef struct {
    double speed_m_s, rate_rad_s, centre_m[3];
    const int64_t *closed;
} Stack;
LAYOUT(Stack, speed_m_s, rate_rad_s, centre_m, closed)

/* What a step does not change. Spreads of the start are half widths of uniform distributions, per
 * axis. `chaser_plants` (plants, chasers, 17 + 6 actuators) and `target_plants` (plants, 17): rows
 * MASS to OFFSET of a body, then the wrench of each actuator at level 1. `solids` (boxes, 16): half
 * edges, centre, rotation matrix to TRF, radius. `rise`, `fall` (actuators, steps): share of the
 * thrust by which the mean of a physics step exceeds that of the step before, after opening, and
 * falls below it after closing; none after the first `rise_steps` and `fall_steps`. `shortest`, `longest` (actuators): steps of the shortest pulse, and
 * of the longest whose thrust ends within a tick. `effort_N_s` (actuators): impulse of a tick at level 1.
 * `sensor` (bins, 6, SENSOR_COLUMNS): at distances from `bin_first_m` in steps of `bin_m`, by axis
 * of position and rotation in CRF. */
typedef struct {
    int64_t environments, chasers, pitch, target_pitch, actuators, pulsed, steps, latency_steps;
    int64_t episode_ticks, held_ticks, image_ticks, plants, boxes, bins, task, statistical, width;
    double step_s, tick_s, reach_m, half_m[3], keep_target_m, keep_chasers_m, farthest_m;
    double fastest_rad_s, held_m, held_rad, entry_m, final_m;
    ProbeLimits corridor, final, contact;
    Weights weights;
    Surface surface;
    Stack stack;
    double spread_m[3], spread_rad, spread_m_s, spread_rad_s, target_spread_rad_s;
    double target_start[13], camera_m[3], camera_wxyz[4], view[4], bin_first_m, bin_m;
    const Place *places;
    const double *chaser_plants, *target_plants, *solids, *rise, *fall, *effort_N_s, *sensor;
    const int64_t *rise_steps, *fall_steps, *shortest, *longest;
} Task;
LAYOUT(Task, environments, chasers, pitch, target_pitch, actuators, pulsed, steps, latency_steps,
       episode_ticks, held_ticks, image_ticks, plants, boxes, bins, task, statistical, width, step_s,
       tick_s, reach_m, half_m, keep_target_m, keep_chasers_m, farthest_m, fastest_rad_s, held_m,
       held_rad, entry_m, final_m, corridor, final, contact, weights, surface, stack, spread_m,
       spread_rad, spread_m_s, spread_rad_s, target_spread_rad_s, target_start, camera_m,
       camera_wxyz, view, bin_first_m, bin_m, places, chaser_plants, target_plants, solids, rise,
       fall, effort_N_s, sensor, rise_steps, fall_steps, shortest, longest)

/* Rows of `memory`, of the last tick: distance and angle from the goal, or speed and rate of a stack;
 * the probe at its port; ticks within the tolerances. */
enum { AWAY, TURNED, GAP, LATERAL, LATERAL_SPEED, CLOSING, TURNING, WITHIN, MEMORY_ROWS };

/* Rows of `docked`: place of a docked chaser's frame in TRF, position and attitude. */
enum { DOCKED_ROWS = 7, ERROR_ROWS = 12, MOTION_ROWS = 13 };

/* The state of all environments. By rows: `bodies` (BODY_ROWS), `targets` (BODY_ROWS), `wrench` (6),
 * `memory`, `docked`, `errors` (6 of the observed pose in CRF, 6 rates). Per chaser: `outcome`, and
 * (chasers, actuators) `pulse` and `opened`: steps of the last pulse, and whether the valve was open
 * before. Per environment: `random`, `age` (ticks), `plant`, `done` (to be reset by the next step),
 * `idle` (whether a step has no action), `rejected`: number of actions of the episode that were not
 * finite; `seen` (environments, points): whether a point of the surface was seen; `unseen`
 * (environments, faces, 4): sum and number of the points of a face that were not. `work`: 24 doubles
 * for each physics step of a tick. Inputs of a step: `actions` (environments, chasers, actuators).
 * Outputs: `observations` (environments, chasers, width), `rewards`, `terminated`, `truncated`
 * (environments, chasers). */
typedef struct {
    double *bodies, *targets, *wrench, *memory, *docked, *errors, *unseen, *work;
    int64_t *pulse, *opened, *age, *plant, *done, *outcome;
    uint64_t *random;
    const float *actions;
    float *observations;
    double *rewards;
    uint8_t *seen, *terminated, *truncated;
    int64_t *rejected, *idle;
} Batch;
LAYOUT(Batch, bodies, targets, wrench, memory, docked, errors, unseen, work, pulse, opened, age,
       plant, done, outcome, random, actions, observations, rewards, seen, terminated, truncated,
       rejected, idle)

#endif
