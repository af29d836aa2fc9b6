# SPDX-License-Identifier: Apache-2.0
"""Likelihood of a robot's motion, and its derivative by what is identified: an extended Kalman
filter over the run. Pure functions.

The error state holds the motion of the centre of mass (position and velocity in WRF, attitude and
rate in CRF, 12) and the parameters. Within a pass the parameters keep the values about which the
motion is linearized, so the filter is linear in them however wide their prior is; the caller
repeats passes about the result (Gauss-Newton). Mass is fixed: motion tells thrusts and inertia in
units of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from chaserdock_models import plane, rotations
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.rigid_body import MAX_STEP_S, free_rotation
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.scenario.bodies import Body

from .recorded import MeasuredMotion, Pulses, ResponseDelay, Wrenches

INERTIA_ROWS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Row and column of the identified elements of the inertia tensor, in their order."""
_BASIS = np.zeros((6, 3, 3))
for _k, (_i, _j) in enumerate(INERTIA_ROWS):
    _BASIS[_k, _i, _j] = _BASIS[_k, _j, _i] = 1.0
_DELAY_STEP_S = 0.004
"""Step, s, of the derivative by the delay: short against a pulse, long against the valves' rise."""
_LAG_STEP_S2 = 1e-4
"""Step, s^2, of the derivative by the square of the lag's time constant: of 10 ms, which is short
against a tick, and longer than what a run can tell from none.
"""
_SHOWN_SIGMAS = 3.0
"""Standard deviations, of innovations that have no noise of the odometry, by which a noise must
exceed zero to be told. Fewer: what pulses scatter hides it, and it is taken for zero; more: short
runs keep the stated one.
"""
_X, _V, _Q, _W = (slice(k, k + 3) for k in (0, 3, 6, 9))


@dataclass(frozen=True, eq=False)
class Actuation:
    """How gains of the actuators act. ``columns`` (C, 6, a): wrench of each gain by 1 N s (or 1 of
    each component) of the a commanded quantities; ``nominal`` (C,): gains as stated; ``along``:
    gains that are shares of the stated thrust, the others are across it. ``scattered`` (S, 6, a):
    wrenches that scatter independently of each other. ``axes`` (6,): components of a wrench that
    move the body.
    """

    columns: Array
    nominal: Array
    along: tuple[int, ...]
    scattered: Array
    axes: Array

    @property
    def gains(self) -> int:
        """Number of gains."""
        return len(self.nominal)


def actuation_of(body: Body) -> Actuation:
    """Return the gains of a body's actuators: of each thruster along its stated direction and along
    two across it; without thrusters one for the whole wrench.
    """
    axes = np.where(body.wrench_max > 0.0, 1.0, 0.0)
    if body.actuation != "thrusters":
        whole, each = np.eye(6)[None], np.zeros((6, 6, 6))
        each[range(6), range(6), range(6)] = 1.0
        return Actuation(whole * axes[:, None], np.ones(1), (0,), each * axes[:, None], axes)
    n = len(body.thrusters)
    columns, nominal = np.zeros((3 * n, 6, n)), np.zeros(3 * n)
    for j, thruster in enumerate(body.thrusters):
        direction = np.array(thruster.direction)
        turned = [direction, *plane.across(direction)]
        for k, along in enumerate(turned):
            columns[3 * j + k, :3, j] = along
            columns[3 * j + k, 3:, j] = np.cross(thruster.position_m, along)
        nominal[3 * j] = 1.0
    along = tuple(range(0, 3 * n, 3))
    scattered = np.zeros((n, 6, n))
    scattered[range(n), :, range(n)] = wrench_matrix(body.thrusters).T
    return Actuation(columns * axes[:, None], nominal, along, scattered * axes[:, None], axes)


@dataclass(frozen=True, eq=False)
class RobotParameters:
    """Parameters as one vector: ``gains`` (C,), ``centre_m`` (3,) CRF, ``inertia`` (6,) about it,
    ``push`` (6,): constant force and torque at the origin of CRF in its axes, ``delay_s``: mean
    time from command to force, of which the square root of ``lag_s2`` is the time constant of a
    first-order lag, ``bias_rad_s`` (3,) of the rate. Thrusts, inertia and push are in units of the
    mass.
    """

    gains: Array
    centre_m: Array
    inertia_kg_m2: Array
    push: Array
    delay_s: float
    lag_s2: float
    bias_rad_s: Array

    @property
    def vector(self) -> Array:
        """Return all of them, (P,)."""
        return np.concatenate(
            [
                self.gains,
                self.centre_m,
                self.inertia_kg_m2,
                self.push,
                [self.delay_s, self.lag_s2],
                self.bias_rad_s,
            ]
        )

    @classmethod
    def of(cls, vector: Array) -> RobotParameters:
        """Return the parameters in a vector (P,)."""
        gains, rest = vector[:-20], vector[-20:]
        late = float(rest[15]), float(rest[16])
        return cls(gains, rest[:3], rest[3:9], rest[9:15], *late, rest[17:])

    @property
    def latency(self) -> ResponseDelay:
        """Return the time from command to force."""
        return latency_of(self.delay_s, self.lag_s2)

    @property
    def tensor(self) -> Array:
        """Return the inertia tensor (3, 3)."""
        return np.tensordot(self.inertia_kg_m2, _BASIS, 1)


@dataclass(frozen=True, eq=False)
class Commanded:
    """What actuators were told to give in each interval between two odometries: impulses (K - 1, a)
    with their first moments, the derivatives of both by delay and lag (K - 1, a, 2), impulses and
    moments of n equal parts of each interval (K - 1, n, a), and the impulses (K - 1, a) by whose
    share the given ones scatter.
    """

    impulses: Array
    moments: Array
    impulses_by_latency: Array
    moments_by_latency: Array
    impulses_of_parts: Array
    moments_of_parts: Array
    scattered: Array


def latency_of(delay_s: float, lag_s2: float) -> ResponseDelay:
    """Return the latency with this mean and this square of the time constant of its lag."""
    lag_s = math.sqrt(max(0.0, lag_s2))  # rounding may leave less
    return ResponseDelay(delay_s - lag_s, lag_s)


def commanded_over(
    actuators: Pulses | Wrenches, time_ns: IntArray, parameters: RobotParameters
) -> Commanded:
    """Return what actuators were told to give between successive times (K,), later by the latency
    of ``parameters``.
    """
    parts = max(1, math.ceil(float(np.median(np.diff(time_ns))) * 1e-9 / MAX_STEP_S))
    shares = np.arange(parts) / parts
    fine_ns = (time_ns[:-1, None] + shares * np.diff(time_ns)[:, None]).ravel().astype(np.int64)
    shape, own = (len(time_ns) - 1, parts, -1), parameters.latency
    u, m = actuators.over(np.append(fine_ns, time_ns[-1]), (own,))
    of_parts, moments_of_parts = u[0].reshape(shape), m[0].reshape(shape)
    delay_s, lag_s2, h = parameters.delay_s, parameters.lag_s2, _DELAY_STEP_S
    lags_s2 = max(0.0, lag_s2 - _LAG_STEP_S2), lag_s2 + _LAG_STEP_S2
    around = [latency_of(delay_s + d, lag_s2) for d in (-h, h)]
    around += [latency_of(delay_s, v) for v in lags_s2] if actuators.lags else []
    u, m = actuators.over(time_ns, (own, *around))
    by_delay = [(x[2] - x[1]) / (2.0 * h) for x in (u, m)]
    by_lag = [(x[-1] - x[-2]) / (lags_s2[1] - lags_s2[0]) for x in (u, m)]
    impulses, moments = (np.stack(both, axis=-1) for both in zip(by_delay, by_lag, strict=True))
    scattered = actuators.scattered(time_ns, delay_s)
    return Commanded(u[0], m[0], impulses, moments, of_parts, moments_of_parts, scattered)


@dataclass(frozen=True, eq=False)
class Noise:
    """``measured`` (12, 12): covariance of position, velocity, attitude and rate. ``wander`` (12,):
    variance per second of a random walk in them. ``scatter_share``: of the impulse of each pulse or
    command.
    """

    measured: Array
    wander: Array
    scatter_share: float


@dataclass(frozen=True, eq=False)
class Pass:
    """Result of a pass: ``change`` (P,) of the parameters with its ``covariance``, log-likelihood,
    innovations (M, 12), and the covariance (12, 12) of the measurement noise that they show if the
    parameters count as known; NaN where they do not.
    """

    change: Array
    covariance: Array
    log_likelihood: float
    innovations: Array
    measured: Array


_START_SIGMAS = np.repeat([0.05, 0.05, 0.02, 0.02], 3)
"""Standard deviations of position, velocity, attitude and rate at the start of a stretch, m, m/s,
rad, rad/s: far beyond the odometry's noise, from which the state is taken.
"""


@dataclass(frozen=True, eq=False)
class _State:
    """Motion (3,), (3,), (4,), (3,), mean (P,) of the parameters' error, and joint covariance."""

    x: Array
    v: Array
    q: Array
    w: Array
    mean: Array
    covariance: Array


_Motion = tuple[Array, Array, Array, Array]
"""Position, velocity, attitude and rate."""


class MotionFilter:
    """Linearizes about ``parameters`` of a robot of ``mass_kg``."""

    def __init__(
        self, actuation: Actuation, mass_kg: float, parameters: RobotParameters, noise: Noise
    ) -> None:
        self._actuation, self._mass_kg, self._p, self._noise = actuation, mass_kg, parameters, noise
        self._tensor = parameters.tensor
        self._inverse = np.linalg.inv(self._tensor)
        self._turns = np.diag(actuation.axes[3:])
        # Torque about the centre of mass by a force at the origin of CRF.
        self._across = -self._turns @ rotations.skew(parameters.centre_m)
        n = 12 + actuation.gains
        self._gains = slice(12, n)
        self._centre, self._inertia = slice(n, n + 3), slice(n + 3, n + 9)
        self._push = slice(n + 9, n + 15)
        self._latency, self._bias = slice(n + 15, n + 17), slice(n + 17, n + 20)

    def run(self, motion: MeasuredMotion, commanded: Commanded, start: Array, prior: Array) -> Pass:
        """Filter a run. ``start`` (P,): mean of the parameters' error, ``prior`` (P,): its standard
        deviations.
        """
        covariance = np.diag(np.square([*_START_SIGMAS, *prior]))
        s = self._started(motion.states[0], start, covariance)
        seconds = np.diff(motion.time_ns) * 1e-9
        log_likelihood, innovations, spreads = 0.0, [], []
        for k, dt in enumerate(seconds.tolist()):
            z = motion.states[k + 1]
            if not motion.free[k]:
                s = self._started(z, s.mean, s.covariance)
                continue
            s = self._predicted(s, commanded, k, dt)
            s, residual, spread, likelihood = self._updated(s, z)
            innovations.append(residual)
            spreads.append(spread)
            log_likelihood += likelihood
        found, predicted = np.array(innovations), np.array(spreads)
        shown = self._shown(found, predicted)
        return Pass(s.mean, s.covariance[12:, 12:], log_likelihood, found, shown)

    def _shown(self, found: Array, predicted: Array) -> Array:
        """Return the noise (12, 12) that innovations (M, 12) show where their predictions (M, 12,
        12) are more certain than it; NaN where they do not tell it.
        """
        settled = np.diagonal(predicted, axis1=1, axis2=2) < np.diag(self._noise.measured)
        both = settled[:, :, None] & settled[:, None, :]
        count = both.sum(axis=0)
        least = np.maximum(count, 1)
        squares = np.where(both, found[:, :, None] * found[:, None, :], 0.0).sum(axis=0) / least
        expected = np.where(both, predicted, 0.0).sum(axis=0) / least
        shown, doubt = squares - expected, _SHOWN_SIGMAS * expected * np.sqrt(2.0 / least)
        told = np.diag(shown) > np.diag(doubt)
        return np.where((count > 1) & told[:, None] & told, shown, np.nan)

    def _started(self, z: Array, mean: Array, covariance: Array) -> _State:
        """Return the state of a stretch that begins with a measurement (13,)."""
        covariance = covariance.copy()
        covariance[:12], covariance[:, :12] = 0.0, 0.0
        covariance[range(12), range(12)] = _START_SIGMAS**2
        q, w = z[6:10], z[10:] - self._p.bias_rad_s
        arm = rotations.rotate(q, self._p.centre_m)
        moved = rotations.rotate(q, rotations.cross(w, self._p.centre_m))
        return _State(z[:3] + arm, z[3:6] + moved, q, w, mean, covariance)

    def _predicted(self, s: _State, commanded: Commanded, k: int, dt: float) -> _State:
        """Return the state after interval ``k`` of length ``dt``."""
        f = self._transition(s, commanded, k, dt)
        covariance, moved_by = s.covariance.copy(), f @ s.covariance
        covariance[:12], covariance[:, :12] = moved_by, moved_by.T
        covariance[:12, :12] = moved_by @ f.T
        covariance[range(12), range(12)] += self._noise.wander * dt
        if self._noise.scatter_share:
            scattered = (self._actuation.scattered @ commanded.scattered[k]).T
            b = self._noise.scatter_share * self._effects(self._middle(s.q, s.w, dt), scattered, dt)
            covariance[:12, :12] += b @ b.T

        g, columns = self._p.gains, self._actuation.columns
        push = self._actuation.axes * self._p.push
        motion = s.x, s.v, s.q, s.w
        parts, moments = commanded.impulses_of_parts[k], commanded.moments_of_parts[k]
        for of_part, moment in zip(parts, moments, strict=True):
            part_s = dt / len(parts)
            given = g @ (columns @ of_part) + push * part_s
            motion = self._moved(motion, given, g @ (columns @ moment), part_s)
        x, v, q, w = motion
        moved = f[:, 12:] @ s.mean
        return _State(
            x + moved[_X],
            v + moved[_V],
            rotations.multiply(q, rotations.exp(moved[_Q])),
            w + moved[_W],
            s.mean,
            covariance,
        )

    def _transition(self, s: _State, commanded: Commanded, k: int, dt: float) -> Array:
        """Return the derivative (12, size) of the motion after an interval by the error state."""
        p, g, columns = self._p, self._p.gains, self._actuation.columns
        by_gain, moment_by_gain = columns @ commanded.impulses[k], columns @ commanded.moments[k]
        impulse = g @ by_gain + self._actuation.axes * p.push * dt
        moment = g @ moment_by_gain
        turn = self._inverse @ (impulse[3:] + self._across @ impulse[:3])
        w = s.w + turn / 2.0
        half = self._middle(s.q, s.w + turn / 4.0, dt)

        f = np.zeros((12, len(s.covariance)))
        free = self._inverse @ (rotations.skew(self._tensor @ w) - rotations.skew(w) @ self._tensor)
        f[:, :12] = np.eye(12)
        f[_X, _V] = dt * np.eye(3)
        f[_Q, _Q] = rotations.to_matrix(rotations.exp(-w * dt))
        f[_Q, _W] = dt * (np.eye(3) + dt / 2.0 * (free - rotations.skew(w)))
        f[_W, _W] = np.eye(3) + dt * free + dt**2 / 2.0 * free @ free
        turned = -half @ rotations.skew(impulse[:3]) / self._mass_kg
        f[_V, _Q], f[_V, _W] = turned, dt / 2.0 * turned
        f[_X, _Q] = dt / 2.0 * turned - half @ rotations.skew(moment[:3]) / self._mass_kg

        late = np.asarray(
            np.tensordot(g, columns @ commanded.impulses_by_latency[k], 1), dtype=float
        )
        late_moment = np.asarray(
            np.tensordot(g, columns @ commanded.moments_by_latency[k], 1), dtype=float
        )
        f[:, self._gains] = self._effects(half, by_gain.T, dt, moment_by_gain.T)
        f[:, self._latency] = self._effects(half, late, dt, late_moment)
        f[:, self._push] = self._effects(half, np.diag(self._actuation.axes) * dt, dt)
        self._add_body(f, w, turn, impulse, moment, dt)
        return f

    def _middle(self, q: Array, w: Array, dt: float) -> Array:
        """Return the attitude (3, 3) in the middle of an interval."""
        return rotations.to_matrix(rotations.multiply(q, rotations.exp(w * (dt / 2.0))))

    def _effects(
        self, half: Array, wrenches: Array, dt: float, moments: Array | None = None
    ) -> Array:
        """Return the change of the motion (12, c) by impulses (6, c) with these first moments."""
        out = np.zeros((12, wrenches.shape[1]))
        out[_V] = half @ wrenches[:3] / self._mass_kg
        out[_W] = self._inverse @ (wrenches[3:] + self._across @ wrenches[:3])
        out[_X], out[_Q] = dt / 2.0 * out[_V], dt / 2.0 * out[_W]
        if moments is not None:
            out[_X] += half @ moments[:3] / self._mass_kg
            out[_Q] += self._inverse @ (moments[3:] + self._across @ moments[:3])
        return out

    def _add_body(
        self, f: Array, w: Array, turn: Array, impulse: Array, moment: Array, dt: float
    ) -> None:
        """Add the derivatives by centre of mass and inertia."""
        by_arm = self._inverse @ self._turns
        f[_W, self._centre] = by_arm @ rotations.skew(impulse[:3])
        f[_Q, self._centre] = by_arm @ rotations.skew(dt / 2.0 * impulse[:3] + moment[:3])
        alpha = self._inverse @ rotations.cross(self._tensor @ w, w)
        changes = [e @ (turn + dt * alpha) + dt * rotations.cross(w, e @ w) for e in _BASIS]
        f[_W, self._inertia] = -self._inverse @ np.stack(changes, axis=1)
        f[_Q, self._inertia] = dt / 2.0 * f[_W, self._inertia]

    def _moved(self, motion: _Motion, impulse: Array, moment: Array, dt: float) -> _Motion:
        """Return the motion after ``dt`` under an impulse (6,) at the origin of CRF with a first
        moment (6,). Half of the torque's impulse acts at the beginning and half at the end.
        """
        x, v, q, w = motion
        torque = impulse[3:] + self._across @ impulse[:3]
        early = moment[3:] + self._across @ moment[:3]
        turn = self._inverse @ torque
        mean = w + turn / 2.0
        middle = rotations.multiply(q, rotations.exp((w + turn / 4.0) * (dt / 2.0)))
        # A force turns with the body: what acts before the middle is turned less.
        force = impulse[:3] - rotations.cross(mean, moment[:3])
        lead = moment[:3] - dt**2 / 12.0 * rotations.cross(mean, force)
        kick = rotations.rotate(middle, force) / self._mass_kg
        qs, ws, _ = free_rotation(q, mean, self._tensor, dt, 2)
        return (
            x + dt * (v + kick / 2.0) + rotations.rotate(middle, lead) / self._mass_kg,
            v + kick,
            rotations.multiply(qs[1], rotations.exp(self._inverse @ early)),
            ws[1] + turn / 2.0,
        )

    def _updated(self, s: _State, z: Array) -> tuple[_State, Array, Array, float]:
        """Return the state after a measurement (13,), its innovation (12,), the covariance of the
        prediction (12, 12), and the log-likelihood.
        """
        c, r = self._p.centre_m, rotations.to_matrix(s.q)
        sweep = rotations.cross(s.w, c)
        h = np.zeros((12, len(s.covariance)))
        h[:, :12] = np.eye(12)
        h[_X, _Q], h[_X, self._centre] = r @ rotations.skew(c), -r
        h[_V, _Q], h[_V, _W] = r @ rotations.skew(sweep), r @ rotations.skew(c)
        h[_V, self._centre] = -r @ rotations.skew(s.w)
        h[_W, self._bias] = np.eye(3)
        residual = np.concatenate(
            [
                z[:3] - (s.x - r @ c),
                z[3:6] - (s.v - r @ sweep),
                rotations.log(rotations.multiply(rotations.conjugate(s.q), z[6:10])),
                z[10:] - s.w - self._p.bias_rad_s,
            ]
        )
        residual = residual - h[:, 12:] @ s.mean
        ph = s.covariance @ h.T
        spread = h @ ph
        total = spread + self._noise.measured
        total = (total + total.T) / 2.0
        root = np.linalg.cholesky(total)
        white = np.linalg.solve(root, residual)
        gained = np.linalg.solve(root, ph.T)
        change = gained.T @ white
        covariance = s.covariance - gained.T @ gained
        likelihood = -0.5 * float(white @ white) - float(np.log(np.diag(root)).sum())
        after = replace(
            s,
            x=s.x + change[_X],
            v=s.v + change[_V],
            q=rotations.multiply(s.q, rotations.exp(change[_Q])),
            w=s.w + change[_W],
            mean=s.mean + change[12:],
            covariance=(covariance + covariance.T) / 2.0,
        )
        return after, residual, spread, likelihood
