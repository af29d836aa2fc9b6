# SPDX-License-Identifier: Apache-2.0
"""Extended Kalman filter that identifies the mass properties of a stack from odometry and thruster
pulses of its latched chasers. No I/O.

Error state, with N chasers of n thrusters each:

- position and velocity of the centre of mass (WRF), attitude (TRF axes), rate (TRF);
- logarithm of the mass, centre of mass (TRF), inertia about it (TRF axes; xx, yy, zz, xy, xz, yz);
- position (TRF) and attitude (CRF) of every chaser;
- relative thrust error of every thruster that may fire;
- bias of every chaser's rate, if its sensor has one.

The parameters are those of the whole stack. A filter in those of the target alone is inconsistent:
subtracting the chasers amplifies linearization errors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, BoolArray
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.rigid_body import BodyState, RigidBody, free_rotation
from chaserdock_models.wrench_set import ThrusterMount, wrench_matrix
from chaserdock_protocol.scenario.navigation import NavigationErrors

from chaserdock_controller.bodies.mass_properties import INERTIA_ROWS, MassProperties, detach
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.interfaces import StackChaser

POSITION, VELOCITY, ATTITUDE, RATE = (slice(k, k + 3) for k in (0, 3, 6, 9))
MASS, CENTRE, INERTIA = slice(12, 13), slice(13, 16), slice(16, 22)
PROPERTIES = slice(12, 22)
# First component of the chasers' mounts, which follow the mass properties.
_MOUNTS = 22
_BASIS = np.zeros((6, 3, 3))
for _k, (_i, _j) in enumerate(INERTIA_ROWS):
    _BASIS[_k, _i, _j] = _BASIS[_k, _j, _i] = 1.0


@dataclass(frozen=True)
class IdentificationParameters:
    """Standard deviations of the prior and of the noise.

    mount_m, mount_rad: of a latched chaser's pose in TRF. thrust_share: of a thruster's thrust,
    constant. scatter_share: of each pulse. floor_velocity_m_s, floor_omega_rad_s: of the motion per
    tick.
    """

    mount_m: float = 0.003
    mount_rad: float = 0.005
    thrust_share: float = 0.05
    scatter_share: float = 0.03
    floor_velocity_m_s: float = 1e-6
    floor_omega_rad_s: float = 1e-6


@dataclass(frozen=True, eq=False)
class CompositeEstimate:
    """Nominal state of the filter. ``thrusts`` (N n,): relative thrust errors of all thrusters.
    ``biases`` (N, 3): of the rates.
    """

    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array
    body: TargetBody
    mounts_m: Array
    mounts_wxyz: Array
    thrusts: Array
    biases: Array


@dataclass(frozen=True, eq=False)
class CompositeFilterState:
    """State of the filter after a tick, sufficient to continue it: nominal state, covariance (size,
    size) of its error, and number of updates.
    """

    estimate: CompositeEstimate
    covariance: Array
    ticks: int


@dataclass(frozen=True, eq=False)
class StackPrediction:
    """Linearized prediction over ``step_s``.

    ``transition``: of the error state. ``pushed`` (6, u): change of velocity (WRF) and rate (TRF)
    per 1 N s of each thruster that may fire. ``impulses_N_s`` (u,): commanded impulses of these
    thrusters.
    """

    transition: Array
    pushed: Array
    impulses_N_s: Array
    step_s: float


@dataclass(frozen=True, eq=False)
class StackInnovation:
    """Innovation of an update: measurement ``matrix`` (K, size), ``gain`` (size, K), ``residual``
    (K,) and its expected ``covariance`` (K, K).
    """

    matrix: Array
    gain: Array
    covariance: Array
    residual: Array


class CompositeIdentification:
    """Identifies the stack of ``chasers``. Each tick, call ``predict`` with the pulses since the
    last one, then ``update``.

    ``prior``: mass properties of the stack, as ``attach`` returns them. ``measured``: the first so
    many chasers have a measured state; all by default. ``usable`` (n,) for each chaser: thrusters
    that may fire; only their thrust is estimated.
    """

    def __init__(
        self,
        prior: MassProperties,
        chasers: Mapping[int, MountedChaser],
        states: Mapping[int, BodyState],
        thrusters: Sequence[ThrusterMount],
        usable: Mapping[int, BoolArray],
        errors: NavigationErrors,
        parameters: IdentificationParameters,
        measured: int | None = None,
    ) -> None:
        self.chasers = tuple(chasers)
        self._thrusters, self._n = wrench_matrix(thrusters), len(thrusters)
        self._usable = np.flatnonzero(np.concatenate([usable[i] for i in self.chasers]))
        self._errors, self._parameters = errors, parameters
        mounts_m = np.array([c.position_m for c in chasers.values()])
        mounts_wxyz = np.array([c.q_wxyz for c in chasers.values()])
        first = [states[i] for i in self.chasers[:measured]]
        self._estimate = _start(prior.body, mounts_m, mounts_wxyz, first, self._n)
        self.covariance = self._prior_covariance(prior, len(self.chasers))
        self.ticks = 0
        self.nis = 0.0
        self._noise = np.square(
            [
                *[math.hypot(errors.position_noise_m, 1e-5)] * 3,
                *[math.hypot(errors.velocity_noise_m_s, 1e-5)] * 3,
                math.hypot(errors.attitude_roll_noise_rad, 1e-5),
                *[math.hypot(errors.attitude_noise_rad, 1e-5)] * 2,
                *[math.hypot(errors.omega_noise_rad_s, 1e-5)] * 3,
            ]
        )

    def save(self) -> CompositeFilterState:
        """Return a copy of the state."""
        return CompositeFilterState(self._estimate, self.covariance.copy(), self.ticks)

    def load(self, state: CompositeFilterState) -> None:
        """Replace the state by a saved one. Raises ValueError if that belongs to other chasers."""
        own, other = self._estimate, state.estimate
        if state.covariance.shape != self.covariance.shape or any(
            np.shape(getattr(own, name)) != np.shape(getattr(other, name))
            for name in ("mounts_m", "mounts_wxyz", "thrusts", "biases")
        ):
            raise ValueError("the state is of another stack")
        self._estimate, self.covariance, self.ticks = (
            state.estimate,
            state.covariance.copy(),
            state.ticks,
        )

    # -- layout ------------------------------------------------------------------------------------

    def _mount(self, row: int) -> slice:
        return slice(_MOUNTS + 6 * row, _MOUNTS + 6 * row + 6)

    @property
    def _scales(self) -> slice:
        begin = _MOUNTS + 6 * len(self.chasers)
        return slice(begin, begin + len(self._usable))

    @property
    def _biases(self) -> int:
        """Return how many chasers have a bias among the states: all or none."""
        return len(self.chasers) if self._errors.gyro_bias_rad_s else 0

    def _bias(self, row: int) -> slice:
        begin = self._scales.stop + 3 * row
        return slice(begin, begin + 3 if self._biases else begin)

    def _prior_covariance(self, prior: MassProperties, chasers: int) -> Array:
        p, e = self._parameters, self._errors
        size = self._scales.stop + 3 * self._biases
        covariance = np.zeros((size, size))
        sigmas = np.array([*[0.05] * 3, *[0.05] * 3, *[0.02] * 3, *[0.02] * 3])
        covariance[:12, :12] = np.diag(sigmas**2)
        scale = np.ones(10)
        scale[0] = 1.0 / prior.body.mass_kg
        covariance[PROPERTIES, PROPERTIES] = prior.covariance * np.outer(scale, scale)
        for row in range(chasers):
            drift_m = math.hypot(e.position_drift_m, e.position_bias_m)
            drift_rad = math.hypot(e.attitude_drift_rad, e.attitude_bias_rad)
            sigmas = [math.hypot(p.mount_m, drift_m)] * 3 + [math.hypot(p.mount_rad, drift_rad)] * 3
            covariance[self._mount(row), self._mount(row)] = np.diag(np.square(sigmas))
            bias = self._bias(row)
            covariance[bias, bias] = e.gyro_bias_rad_s**2 * np.eye(bias.stop - bias.start)
        covariance[self._scales, self._scales] = p.thrust_share**2 * np.eye(len(self._usable))
        return covariance

    # -- prediction --------------------------------------------------------------------------------

    def predict(
        self,
        impulses_N_s: Mapping[int, Array],
        step_s: float,
        unknown: Mapping[int, Array] | None = None,
    ) -> StackPrediction:
        """Advance by ``step_s`` with the impulses (n,), N s, expected of each chaser's thrusters
        since the last tick.

        Half of each impulse acts at the beginning of the step and half at the end. ``unknown``
        (n,): standard deviations of further impulses, for chasers whose thrusters were not
        reported.
        """
        x, p = self._estimate, self._parameters
        stated = self._of_all(impulses_N_s)
        impulses = stated * (1.0 + x.thrusts)
        wrenches = self._wrenches()
        total = wrenches @ impulses
        rotation = rotations.to_matrix(x.q_wxyz)
        inverse = _inverse(x.body.inertia_kg_m2)
        kick, turn = rotation @ total[:3] / x.body.mass_kg, inverse @ total[3:]
        omega = x.omega_rad_s + turn / 2.0
        qs, omegas, alphas = free_rotation(x.q_wxyz, omega, x.body.inertia_kg_m2, step_s, 2)
        transition = self._transition(rotation, inverse, omega, alphas[0], stated, impulses, step_s)
        pushed = np.concatenate([rotation @ wrenches[:3] / x.body.mass_kg, inverse @ wrenches[3:]])
        rows = [3, 4, 5, 9, 10, 11]
        noise = pushed * np.hypot(p.scatter_share * impulses, self._of_all(unknown or {}))
        self.covariance = transition @ self.covariance @ transition.T
        self.covariance[np.ix_(rows, rows)] += noise @ noise.T
        floors = np.repeat([p.floor_velocity_m_s, p.floor_omega_rad_s], 3) ** 2
        self.covariance[rows, rows] += floors
        self._estimate = replace(
            x,
            position_m=x.position_m + step_s * (x.velocity_m_s + kick / 2.0),
            velocity_m_s=x.velocity_m_s + kick,
            q_wxyz=qs[1],
            omega_rad_s=omegas[1] + turn / 2.0,
        )
        return StackPrediction(transition, pushed[:, self._usable], stated[self._usable], step_s)

    def _of_all(self, by_chaser: Mapping[int, Array]) -> Array:
        """Return per-chaser values as one array (N n,), zero for a chaser without any."""
        return np.concatenate([by_chaser.get(i, np.zeros(self._n)) for i in self.chasers])

    def _wrenches(self) -> Array:
        """Return the wrenches (6, N n) about the centre of mass of 1 N of every thruster, TRF
        axes.
        """
        x = self._estimate
        mounts = [MountedChaser(r, q) for r, q in zip(x.mounts_m, x.mounts_wxyz, strict=True)]
        parts = [m.wrench_to_stack(self._thrusters, x.body.centre_trf_m) for m in mounts]
        return np.concatenate(parts, axis=1)

    def _transition(
        self,
        rotation: Array,
        inverse: Array,
        omega: Array,
        alpha: Array,
        stated: Array,
        impulses: Array,
        step_s: float,
    ) -> Array:
        x = self._estimate
        inertia = x.body.inertia_kg_m2
        f = np.eye(len(self.covariance))
        free = inverse @ (rotations.skew(inertia @ omega) - rotations.skew(omega) @ inertia)
        by_inertia = np.stack(
            [-inverse @ (e @ alpha + rotations.cross(omega, e @ omega)) for e in _BASIS], axis=1
        )
        f[POSITION, VELOCITY] = step_s * np.eye(3)
        f[ATTITUDE, ATTITUDE] = rotations.to_matrix(rotations.exp(-omega * step_s))
        f[ATTITUDE, RATE] = step_s * (np.eye(3) + step_s / 2.0 * (free - rotations.skew(omega)))
        f[ATTITUDE, INERTIA] = step_s**2 / 2.0 * by_inertia
        f[RATE, RATE] = np.eye(3) + step_s * free + step_s**2 / 2.0 * free @ free
        f[RATE, INERTIA] = step_s * (np.eye(3) + step_s / 2.0 * free) @ by_inertia
        if not stated.any():
            return f
        pushes, turns = self._by_pulses(rotation, inverse, stated, impulses)
        f[VELOCITY] += pushes
        f[RATE] += turns
        # Half of a change of velocity and rate acts during the step.
        f[POSITION] += step_s / 2.0 * pushes
        f[ATTITUDE] += step_s / 2.0 * turns
        return f

    def _by_pulses(
        self, rotation: Array, inverse: Array, stated: Array, impulses: Array
    ) -> tuple[Array, Array]:
        """Return the Jacobians (3, size), by the error state, of the changes of velocity (WRF) and
        rate (TRF) that pulses cause.
        """
        x, size = self._estimate, len(self.covariance)
        mass = x.body.mass_kg
        pushes, turns = np.zeros((3, size)), np.zeros((3, size))
        wrenches = self._wrenches()
        total = wrenches @ impulses
        turn = inverse @ total[3:]
        pushes[:, ATTITUDE] = -rotation @ rotations.skew(total[:3]) / mass
        pushes[:, MASS] = -rotation @ total[:3, None] / mass
        turns[:, CENTRE] = inverse @ rotations.skew(total[:3])
        turns[:, INERTIA] = np.stack([-inverse @ (e @ turn) for e in _BASIS], axis=1)
        of_usable = wrenches[:, self._usable] * stated[self._usable]
        pushes[:, self._scales] = rotation @ of_usable[:3] / mass
        turns[:, self._scales] = inverse @ of_usable[3:]
        for row in range(len(self.chasers)):
            of_chaser = slice(self._n * row, self._n * (row + 1))
            if not stated[of_chaser].any():
                continue
            own = self._thrusters @ impulses[of_chaser]
            turned = rotations.to_matrix(x.mounts_wxyz[row])
            force = turned @ own[:3]
            place, attitude = self._mount(row).start, self._mount(row).start + 3
            arm = rotations.skew(x.mounts_m[row] - x.body.centre_trf_m)
            by_turn = -turned @ rotations.skew(own[:3])
            pushes[:, attitude : attitude + 3] = rotation @ by_turn / mass
            turns[:, place : place + 3] = -inverse @ rotations.skew(force)
            turns[:, attitude : attitude + 3] = inverse @ (
                arm @ by_turn - turned @ rotations.skew(own[3:])
            )
        return pushes, turns

    # -- update ------------------------------------------------------------------------------------

    def update(self, states: Mapping[int, BodyState]) -> StackInnovation | None:
        """Correct the state by the chasers' measured states at this tick. Returns the innovation,
        or None without a measurement.
        """
        self.ticks += 1
        rows = [row for row, chaser in enumerate(self.chasers) if chaser in states]
        if not rows:
            return None
        parts = [self._measurement(row, states[self.chasers[row]]) for row in rows]
        h, residual = np.concatenate([m for m, _ in parts]), np.concatenate([r for _, r in parts])
        return self._update(h, residual, np.diag(np.tile(self._noise, len(rows))))

    def _update(self, h: Array, residual: Array, noise: Array) -> StackInnovation:
        projected = h @ self.covariance
        expected = projected @ h.T + noise
        self.nis = float(residual @ np.linalg.solve(expected, residual)) / len(residual)
        gain = np.asarray(np.linalg.solve(expected, projected).T, dtype=np.float64)
        # Joseph's form, which stays positive definite under rounding.
        kept = self.covariance - gain @ projected
        kept = kept - (kept @ h.T) @ gain.T + gain @ noise @ gain.T
        self.covariance = (kept + kept.T) / 2.0
        self._estimate = self._corrected(self._estimate, gain @ residual)
        return StackInnovation(h, gain, expected, residual)

    def disturb(self, velocity_m_s: float, omega_rad_s: float) -> None:
        """Add to the covariance an unknown shock: standard deviations per axis of changes of
        velocity and rate.
        """
        for part, sigma in ((VELOCITY, velocity_m_s), (RATE, omega_rad_s)):
            self.covariance[part, part] += sigma**2 * np.eye(3)

    def pulse_gains(self, impulse_N_s: float, noise: Array, scale: Array) -> Array:
        """Return, for each thruster that may fire, how much one pulse would reduce the variances of
        the mass properties.

        The variances are in units of ``scale`` (10,). Assumes that the change of velocity and rate
        is then measured with standard deviations ``noise`` (6,).
        """
        x = self._estimate
        rotation, inverse = rotations.to_matrix(x.q_wxyz), _inverse(x.body.inertia_kg_m2)
        rows = [*range(3, 6), *range(9, 12)]
        none = np.zeros(self._n * len(self.chasers))
        rest = self._transition(rotation, inverse, x.omega_rad_s, np.zeros(3), none, none, 0.0)[
            rows
        ]
        unit = scale.copy()
        unit[0] /= x.body.mass_kg
        gains = []
        for k in self._usable:
            stated = none.copy()
            stated[k] = impulse_N_s
            given = stated * (1.0 + x.thrusts)
            effect = (
                self._transition(rotation, inverse, x.omega_rad_s, np.zeros(3), stated, given, 0.0)[
                    rows
                ]
                - rest
            )
            cross = effect @ self.covariance
            spread = cross @ effect.T + np.diag(noise**2)
            shared = cross[:, PROPERTIES] / unit
            gains.append(float(np.sum(shared * np.linalg.solve(spread, shared))))
        return np.array(gains)

    def _measurement(self, row: int, measured: BodyState) -> tuple[Array, Array]:
        """Return the Jacobian (12, size) and the residual of a chaser's odometry: position,
        velocity, attitude, rate.
        """
        x = self._estimate
        rotation, turned = rotations.to_matrix(x.q_wxyz), rotations.to_matrix(x.mounts_wxyz[row])
        arm = x.mounts_m[row] - x.body.centre_trf_m
        moving = rotations.cross(x.omega_rad_s, arm)
        own = turned.T @ x.omega_rad_s
        h = np.zeros((12, len(self.covariance)))
        place, attitude = self._mount(row).start, self._mount(row).start + 3
        h[0:3, POSITION] = h[3:6, VELOCITY] = np.eye(3)
        h[0:3, ATTITUDE] = -rotation @ rotations.skew(arm)
        h[0:3, CENTRE], h[0:3, place : place + 3] = -rotation, rotation
        spin = rotation @ rotations.skew(x.omega_rad_s)
        h[3:6, ATTITUDE] = -rotation @ rotations.skew(moving)
        h[3:6, RATE] = -rotation @ rotations.skew(arm)
        h[3:6, CENTRE], h[3:6, place : place + 3] = -spin, spin
        h[6:9, ATTITUDE], h[6:9, attitude : attitude + 3] = turned.T, np.eye(3)
        h[9:12, RATE], h[9:12, attitude : attitude + 3] = turned.T, rotations.skew(own)
        if self._biases:
            h[9:12, self._bias(row)] = np.eye(3)
        expected = rotations.multiply(x.q_wxyz, x.mounts_wxyz[row])
        residual = np.concatenate(
            [
                measured.position_m - x.position_m - rotation @ arm,
                measured.velocity_m_s - x.velocity_m_s - rotation @ moving,
                rotations.log(rotations.multiply(rotations.conjugate(expected), measured.q_wxyz)),
                measured.omega_rad_s - own - x.biases[row],
            ]
        )
        return h, residual

    def _corrected(self, x: CompositeEstimate, d: Array) -> CompositeEstimate:
        chasers = range(len(self.chasers))
        mounts = d[_MOUNTS : self._scales.start].reshape(-1, 6)
        thrusts = x.thrusts.copy()
        thrusts[self._usable] += d[self._scales]
        body = TargetBody(
            x.body.mass_kg * math.exp(float(d[12])),
            x.body.inertia_kg_m2 + np.tensordot(d[INERTIA], _BASIS, 1),
            x.body.centre_trf_m + d[CENTRE],
        )
        return CompositeEstimate(
            x.position_m + d[POSITION],
            x.velocity_m_s + d[VELOCITY],
            rotations.normalize(rotations.multiply(x.q_wxyz, rotations.exp(d[ATTITUDE]))),
            x.omega_rad_s + d[RATE],
            body,
            x.mounts_m + mounts[:, :3],
            np.array(
                [
                    rotations.multiply(x.mounts_wxyz[k], rotations.exp(mounts[k, 3:]))
                    for k in chasers
                ]
            ),
            thrusts,
            x.biases + d[self._scales.stop :].reshape(-1, 3) if self._biases else x.biases,
        )

    # -- results -----------------------------------------------------------------------------------

    @property
    def usable(self) -> list[tuple[int, int]]:
        """Return (chaser, number) of the thrusters that may fire, in the order of
        ``StackPrediction``.
        """
        return [(self.chasers[k // self._n], int(k % self._n)) for k in self._usable]

    @property
    def stack(self) -> MassProperties:
        """Return the mass properties of the stack."""
        scale = np.ones(10)
        scale[0] = self._estimate.body.mass_kg
        return MassProperties(
            self._estimate.body, self.covariance[PROPERTIES, PROPERTIES] * np.outer(scale, scale)
        )

    @property
    def members(self) -> tuple[StackChaser, ...]:
        """Return the estimated poses of the chasers in TRF, and their thrust relative to the stated
        one.
        """
        x = self._estimate
        factors = (1.0 + x.thrusts).reshape(len(self.chasers), -1)
        return tuple(
            StackChaser(i, MountedChaser(x.mounts_m[k], x.mounts_wxyz[k]), factors[k])
            for k, i in enumerate(self.chasers)
        )

    def target(self, body: RigidBody) -> MassProperties:
        """Return the mass properties of the target alone. ``body``: mass properties of each
        chaser.
        """
        return detach(self.stack, [c.mounting for c in self.members], body)

    @property
    def motion(self) -> BodyState:
        """Return position and velocity of the centre of mass (WRF), attitude (TRF to WRF) and rate
        (TRF).
        """
        x = self._estimate
        return BodyState(x.position_m, x.velocity_m_s, x.q_wxyz, x.omega_rad_s)


def _inverse(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _start(
    body: TargetBody,
    mounts_m: Array,
    mounts_wxyz: Array,
    states: Sequence[BodyState],
    thrusters: int,
) -> CompositeEstimate:
    """Return the filter's initial state, computed from the first measurements."""
    q = rotations.multiply(states[0].q_wxyz, rotations.conjugate(mounts_wxyz[0]))
    omega = np.mean(
        [rotations.rotate(m, s.omega_rad_s) for m, s in zip(mounts_wxyz, states, strict=False)],
        axis=0,
    )
    arms = mounts_m[: len(states)] - body.centre_trf_m
    places = [s.position_m - rotations.rotate(q, arm) for s, arm in zip(states, arms, strict=True)]
    velocities = [
        s.velocity_m_s - rotations.rotate(q, rotations.cross(omega, arm))
        for s, arm in zip(states, arms, strict=True)
    ]
    return CompositeEstimate(
        np.mean(places, axis=0),
        np.mean(velocities, axis=0),
        q,
        omega,
        body,
        mounts_m,
        mounts_wxyz,
        np.zeros(thrusters * len(mounts_m)),
        np.zeros((len(mounts_m), 3)),
    )
