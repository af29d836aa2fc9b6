/* SPDX-License-Identifier: Apache-2.0 */
/* Motion of a chaser: mean, and transition of the errors. Equations: prediction.py. */
#include "layout.h"

/* Parameters of a prediction over dt. inertia: principal moments. fade_*: decay factors of
 * drifts. unknown_s: time for which the command is unknown. Others: as in JointParameters. */
typedef struct {
    double dt, mass, inertia[3], mean_motion, fade_position, fade_attitude, unknown_s;
    double control_force_share, control_torque_share, control_arm, force_max, torque_max,
        disturbance_force, disturbance_torque, latched_acceleration, latched_angular_acceleration;
} Motion;
LAYOUT(Motion, dt, mass, inertia, mean_motion, fade_position, fade_attitude, unknown_s,
       control_force_share, control_torque_share, control_arm, force_max, torque_max,
       disturbance_force, disturbance_torque, latched_acceleration, latched_angular_acceleration)

static void angular_acceleration(const double *torque, const double *omega, const double *inertia,
                                 double *alpha) {
    const double momentum[3] = {inertia[0] * omega[0], inertia[1] * omega[1],
                                inertia[2] * omega[2]};
    double gyroscopic[3];
    cross3(omega, momentum, gyroscopic);
    for (int i = 0; i < 3; i++) alpha[i] = (torque[i] - gyroscopic[i]) / inertia[i];
}

static void shift_wrench(const double *wrench, const double *centre, const double *omega,
                         double mass, const double *inertia, double *out) {
    double moment[3], alpha[3], tangential[3], spin[3], centripetal[3];
    cross3(centre, wrench, moment);
    subtract3(wrench + 3, moment, out + 3);
    angular_acceleration(out + 3, omega, inertia, alpha);
    cross3(alpha, centre, tangential);
    cross3(omega, centre, spin);
    cross3(omega, spin, centripetal);
    for (int i = 0; i < 3; i++) out[i] = wrench[i] - mass * (tangential[i] + centripetal[i]);
}

/* Compute the wrench (6) that moves a body with its centre of mass at the origin as `wrench`
 * (6) moves one with it at `centre` (3). */
EXPORT void NAME(wrench_at_origin)(const double *wrench, const double *centre, const double *omega,
                                   double mass, const double *inertia, double *out) {
    shift_wrench(wrench, centre, omega, mass, inertia, out);
}

/* Evaluate the Newton-Euler equations for a state (13) under a wrench (6) in body axes. */
static void state_rate(const double *y, const double *u, const Motion *p, double *out) {
    const double *q = y + QUATERNION, *omega = y + OMEGA;
    double t[3], force[3], cross[3];
    cross3(q + 1, u, t);
    for (int i = 0; i < 3; i++) t[i] *= 2.0;
    cross3(q + 1, t, cross);
    for (int i = 0; i < 3; i++) force[i] = u[i] + q[0] * t[i] + cross[i];
    cross3(q + 1, omega, cross);
    copy(y + 3, out, 3);
    for (int i = 0; i < 3; i++) out[3 + i] = force[i] / p->mass;
    out[6] = -0.5 * dot3(q + 1, omega);
    for (int i = 0; i < 3; i++) out[7 + i] = 0.5 * (q[0] * omega[i] + cross[i]);
    angular_acceleration(u + 3, omega, p->inertia, out + 10);
}

/* Advance by one step of the classical Runge-Kutta method, in place. */
static void move(double *y, const double *u, const Motion *p) {
    double k[4][13], at[13];
    copy(y, at, 13);
    for (int s = 0; s < 4; s++) {
        state_rate(at, u, p, k[s]);
        const double step = s == 2 ? p->dt : 0.5 * p->dt;
        if (s < 3)
            for (int i = 0; i < 13; i++) at[i] = y[i] + step * k[s][i];
    }
    for (int i = 0; i < 13; i++)
        y[i] += p->dt / 6.0 * ((k[0][i] + k[3][i]) + 2.0 * (k[1][i] + k[2][i]));
    normalize_quaternion(y + QUATERNION);
}

/* Change velocity and rate of a state (13) by `sign` times an impulse (6) in body axes; centre (3):
 * its centre of mass. */
static void push(double *y, const double *impulse, double sign, const double *centre,
                 const Motion *p) {
    const double at_rest[3] = {0};
    double total[6], gained[3], c[9];
    shift_wrench(impulse, centre, at_rest, p->mass, p->inertia, total);
    matrix_of(y + QUATERNION, c);
    for (int i = 0; i < 3; i++) gained[i] = dot3(c + 3 * i, total);
    for (int i = 0; i < 3; i++) {
        y[3 + i] += sign * gained[i] / p->mass;
        y[OMEGA + i] += sign * total[3 + i] / p->inertia[i];
    }
}

/* Transposed rows 0 .. COUPLED - 1 of a chaser's transition 1 + A dt + (A dt)^2 / 2, `out` (MOTION,
 * COUPLED); its other rows are those of the unit matrix. wrench, total (6): at the centre of mass,
 * at the origin. lead (6): impulse at the beginning and, negative, at the end of dt. */
static void motion_transition(const double *x, const double *wrench, const double *total,
                              const double *lead, const double *centre, const Motion *p,
                              double *out) {
    double a[COUPLED * MOTION], c[9], centre_skew[9], turning[9], m[9], n[9], alpha[3], momentum[3],
        spin[3];
    const double *omega = x + OMEGA, *inertia = p->inertia;
    zero(a, COUPLED * MOTION);
    matrix_of(x + QUATERNION, c);
    skew(centre, centre_skew);
    skew(omega, turning);
    angular_acceleration(total + 3, omega, inertia, alpha);
    double *velocity = a + MOTION * VELOCITY, *rate = a + MOTION * RATE;
    put_identity(a, MOTION, VELOCITY);
    put(a + MOTION * ATTITUDE, MOTION, ATTITUDE, -1.0, turning);
    put_identity(a + MOTION * ATTITUDE, MOTION, RATE);
    for (int i = 0; i < 3; i++) momentum[i] = inertia[i] * omega[i];
    skew(momentum, m);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++)
            rate[MOTION * i + RATE + j] =
                (m[3 * i + j] - turning[3 * i + j] * inertia[j]) / inertia[i];
        for (int j = 0; j < 3; j++)
            rate[MOTION * i + FORCE + j] = -centre_skew[3 * i + j] / inertia[i];
        rate[MOTION * i + TORQUE + i] = 1.0 / inertia[i];
    }
    skew(lead, m);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            a[MOTION * (ATTITUDE + i) + CENTRE + j] = m[3 * i + j] / inertia[i];
    multiply_matrices(c, m, n);
    put(a, MOTION, ATTITUDE, -1.0 / p->mass, n);
    skew(wrench, m);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) rate[MOTION * i + CENTRE + j] = m[3 * i + j] / inertia[i];
    multiply_matrices(c, centre_skew, m);
    for (int i = 0; i < 3; i++)
        for (int j = RATE; j < MOTION; j++)
            velocity[MOTION * i + j] = m[3 * i] * rate[j] + m[3 * i + 1] * rate[MOTION + j] +
                                       m[3 * i + 2] * rate[2 * MOTION + j];
    skew(total, m);
    multiply_matrices(c, m, n);
    put(velocity, MOTION, ATTITUDE, -1.0 / p->mass, n);
    cross3(omega, centre, spin);
    skew(spin, m);
    multiply_matrices(turning, centre_skew, n);
    for (int i = 0; i < 9; i++) m[i] += n[i];
    multiply_matrices(c, m, n);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) velocity[MOTION * i + RATE + j] += n[3 * i + j];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) velocity[MOTION * i + FORCE + j] += c[3 * i + j] / p->mass;
    skew(alpha, m);
    multiply_matrices(turning, turning, n);
    for (int i = 0; i < 9; i++) m[i] += n[i];
    multiply_matrices(c, m, n);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) velocity[MOTION * i + CENTRE + j] -= n[3 * i + j];
    /* Clohessy-Wiltshire accelerations. */
    const double w = p->mean_motion;
    velocity[POSITION] += 3.0 * w * w, velocity[2 * MOTION + POSITION + 2] -= w * w;
    velocity[VELOCITY + 1] += 2.0 * w, velocity[MOTION + VELOCITY] -= 2.0 * w;
    for (int i = 0; i < COUPLED * MOTION; i++) a[i] *= p->dt;
    for (int i = 0; i < COUPLED; i++)
        for (int j = 0; j < MOTION; j++) {
            double square = 0.0;
            for (int k = 0; k < COUPLED; k++) square += a[MOTION * i + k] * a[MOTION * k + j];
            out[COUPLED * j + i] = (i == j) + a[MOTION * i + j] + 0.5 * square;
        }
}
