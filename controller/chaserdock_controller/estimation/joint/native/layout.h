/* SPDX-License-Identifier: Apache-2.0 */
/* Layout of the error vector and of the mean, as in state.py.
 *
 * Error vector (D = TARGET + CHASER n, or more): components of the target, then of each chaser.
 * Further components are constant and no measurement depends on them; the mean does not contain
 * them. They are the shape of a torque-free target.
 *
 * Mean (TARGET_MEAN + CHASER_MEAN n): position, velocity, attitude and rate of the target; the
 * same of each chaser, then its additive states (its error components from FORCE on). */
#ifndef CHASERDOCK_LAYOUT_H
#define CHASERDOCK_LAYOUT_H

enum { TARGET = 12, CHASER = 43, MOTION = 21, COUPLED = 12, TARGET_MEAN = 13, CHASER_MEAN = 44 };
/* Components of the error of target and chaser. */
enum { POSITION = 0, VELOCITY = 3, ATTITUDE = 6, RATE = 9 };
/* Further components of a chaser's error. */
enum {
    FORCE = 12,
    TORQUE = 15,
    CENTRE = 18,
    POSITION_DRIFT = 21,
    ATTITUDE_DRIFT = 24,
    GYRO_BIAS = 27,
    TURN = 30,
    SHIFT = 33,
    FOCAL = 36,
    VIEW = 37
};
/* Offsets in a mean: attitude, rate; ADDITIVE: offset of an additive state less that of its
 * error component. */
enum { QUATERNION = 6, OMEGA = 10, ADDITIVE = 1 };
/* Rows of measurements, channels of a chaser's measurements, components that measurements
 * depend on. */
enum {
    SIGHTING_ROWS = 6,
    ODOMETRY_ROWS = 12,
    MOST_ROWS = 18,
    CHANNELS = 5,
    SEEN = TARGET + CHASER
};
/* Components of what the actuators of a chaser gave: impulse, first moment, magnitude. */
enum { GIVEN = 18 };

static inline int64_t size_of(int64_t n) { return TARGET + CHASER * n; }
static inline int64_t first_of(int64_t i) { return TARGET + CHASER * i; }
static inline const double *chaser_of(const double *mean, int64_t i) {
    return mean + TARGET_MEAN + CHASER_MEAN * i;
}

#endif
