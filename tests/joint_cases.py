# SPDX-License-Identifier: Apache-2.0
"""Synthetic flights for the joint filter: chasers around a tumbling target, with the errors of a
navigation grade.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
from chaserdock_controller.estimation.joint import JointEstimator, JointParameters
from chaserdock_controller.estimation.joint.parameters import SightingNoise, TargetParameters
from chaserdock_controller.estimation.joint.state import CHASER, TARGET, JointState, empty_state
from chaserdock_controller.estimation.types import EstimatorInputs, MeasuredChaser
from chaserdock_controller.interfaces import AppliedImpulse
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import propagate
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Odometry, PoseSolution, Sighting
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.navigation import NavigationErrors, NavigationSection
from general_position import attitude, covariance, target_state
from msgspec.structs import replace as structs_replace

PERIOD_S = 1.0 / 15.0
SIGHTING_SIGMAS = np.array([3e-4] * 3 + [math.radians(0.08)] * 3)


def navigation(grade: str, **figures: float) -> NavigationErrors:
    """Return the sensor errors of a grade, with some figures replaced."""
    return NavigationSection(grade=grade, **figures).errors()  # type: ignore[arg-type]


def joint_state(rng: np.random.Generator, chasers: int = 2, time_ns: int = 10**9) -> JointState:
    """A state of the joint filter in general position with all correlations."""
    target, extra = target_state(rng), rng.normal(0.0, 0.02, (chasers, CHASER - 12))
    return structs_replace(
        empty_state(time_ns, chasers),
        target_known=True,
        alive=np.ones(chasers, dtype=bool),
        position_m=target.position_m,
        velocity_m_s=target.velocity_m_s,
        q_wxyz=target.q_wxyz,
        omega_rad_s=target.omega_rad_s,
        positions_m=rng.uniform(-2.0, 2.0, (chasers, 3)),
        velocities_m_s=rng.uniform(-0.1, 0.1, (chasers, 3)),
        attitudes_wxyz=np.array([attitude(rng) for _ in range(chasers)]),
        omegas_rad_s=rng.uniform(-0.2, 0.2, (chasers, 3)),
        extra=extra,
        covariance=covariance(rng, np.full(TARGET + CHASER * chasers, 3e-3)),
    )


@dataclass
class TrueChaser:
    """State (13,) of a chaser, and the constant and drifting errors of its sensors."""

    state: Array
    position_drift_m: Array
    attitude_drift_rad: Array
    gyro_bias_rad_s: Array
    camera_turn_rad: Array
    camera_shift_m: Array
    camera_focal_share: float
    disturbance: Array


class SyntheticFlight:
    """N chasers that hold a place around a target with constant rates, with the errors of
    ``errors``, one ``step`` per tick.

    The chasers follow the reference exactly by a wrench computed from it, plus a command noise;
    ``disturbance`` acts on them. ``view_error``: ratio of the part of a sighting's error that is
    constant. ``texts``: events of the estimator that it feeds.
    ``turns``: rotations (4,) of the attitudes that the chasers hold.
    """

    def __init__(
        self,
        scenario: Scenario,
        errors: NavigationErrors,
        chasers: int,
        seed: int,
        disturbance: float = 0.0,
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.errors, self.n, self.tick = errors, chasers, 0
        self.body, self.camera = scenario.chaser, scenario.camera_model()
        self.target = np.array([0, 0, 0, 0.015, 0.0075, 0.03, 1.0, 0, 0, 0, 0.015, 0.045, 0.03])
        places = [(-1.0, 0, 0), (0, -1.0, 0), (0, 1.0, 0), (1.0, 0, 0)]
        self.chasers = []
        e, r = errors, self.rng
        for i in range(chasers):
            angle = 2 * math.pi * i / max(chasers, 4)
            place = np.array(
                places[i % 4]
                if chasers <= 4
                else (math.cos(angle), math.sin(angle), 0.3 * (i % 3 - 1))
            )
            q = _facing(-place)
            state = np.concatenate([place, self.target[3:6], q, np.zeros(3)])
            self.chasers.append(
                TrueChaser(
                    state,
                    r.normal(0, e.position_drift_m, 3),
                    r.normal(0, e.attitude_drift_rad, 3),
                    r.normal(0, e.gyro_bias_rad_s, 3),
                    r.normal(0, e.camera_turn_rad, 3),
                    r.normal(0, e.camera_shift_m, 3),
                    float(r.normal(0, e.camera_focal_share)),
                    disturbance * r.normal(0, 1, 6) * np.repeat([1.0, 0.1], 3),
                )
            )
        self.impulses = np.zeros((chasers, 6))
        self.texts: list[str] = []
        self.turns = [rotations.IDENTITY] * chasers

    @property
    def time_ns(self) -> int:
        return round(self.tick * PERIOD_S * 1e9)

    def inputs(self) -> EstimatorInputs:
        """Return the measurements now."""
        odometry = [self._odometry(i) for i in range(self.n)]
        sightings = tuple(self._sighting(i) for i in range(self.n))
        chasers = tuple(
            MeasuredChaser(i, AppliedImpulse.steady(self.impulses[i].copy()), odometry[i])
            for i in range(self.n)
        )
        return EstimatorInputs(self.time_ns, PERIOD_S, chasers, sightings)

    def step(self, exposures_s: Mapping[int, float] | None = None) -> list[Sighting]:
        """Move everything to the next tick under a feedback that holds the chasers at their
        places. Returns the sightings of chasers with an exposure so long after the present tick.
        """
        e, r = self.errors, self.rng
        earlier = self.target.copy(), [c.state for c in self.chasers]
        wrenches = []
        for i, c in enumerate(self.chasers):
            wrench = np.concatenate([self._pull(i), self._turn(i)]) + r.normal(0, 1, 6) * np.repeat(
                [0.01, 0.001], 3
            )
            c.state = propagate(c.state, wrench + c.disturbance, self.body, PERIOD_S)
            self.impulses[i] = wrench * PERIOD_S
            wrenches.append(wrench + c.disturbance)
            for name, sigma, time_s in (
                ("position_drift_m", e.position_drift_m, e.position_drift_time_s),
                ("attitude_drift_rad", e.attitude_drift_rad, e.attitude_drift_time_s),
            ):
                fade = math.exp(-PERIOD_S / time_s)
                noise = r.normal(0, sigma * math.sqrt(1 - fade**2), 3)
                setattr(c, name, fade * getattr(c, name) + noise)
        self.target = self._target_after(PERIOD_S)
        self.tick += 1
        now = self.target, [c.state for c in self.chasers]
        seen = []
        for i, after_s in sorted((exposures_s or {}).items(), key=lambda x: x[1]):
            self.target = earlier[0]
            self.target = self._target_after(after_s)
            self.chasers[i].state = propagate(earlier[1][i], wrenches[i], self.body, after_s)
            time_ns = round(((self.tick - 1) * PERIOD_S + after_s) * 1e9)
            seen.append(msgspec.structs.replace(self._sighting(i), sim_time_ns=time_ns))
            self.target, self.chasers[i].state = now[0], now[1][i]
        return seen

    def _target_after(self, time_s: float) -> Array:
        """Return the target's state (13,) after ``time_s``."""
        t = self.target.copy()
        t[0:3] += t[3:6] * time_s
        t[6:10] = rotations.integrate(t[6:10], t[10:13], time_s)
        return t

    def _place(self, i: int) -> tuple[Array, Array]:
        """Return the place (3,) in TRF and the attitude (4,) that the chaser holds."""
        if not hasattr(self, "_places"):
            q = rotations.conjugate(self.target[6:10])
            self._places = [
                (
                    rotations.rotate(q, c.state[:3] - self.target[:3]),
                    rotations.multiply(q, c.state[6:10]),
                )
                for c in self.chasers
            ]
        return self._places[i]

    def _pull(self, i: int) -> Array:
        t, s = self.target, self.chasers[i].state
        place = rotations.rotate(t[6:10], self._place(i)[0])
        spin = rotations.rotate(t[6:10], t[10:13])
        velocity = t[3:6] + np.cross(spin, place)
        acceleration = np.cross(spin, np.cross(spin, place))
        wanted = acceleration + 0.5 * (t[:3] + place - s[:3]) + 1.2 * (velocity - s[3:6])
        return rotations.rotate_inverse(s[6:10], self.body.mass_kg * wanted)

    def _turn(self, i: int) -> Array:
        t, s = self.target, self.chasers[i].state
        wanted = rotations.multiply(t[6:10], rotations.multiply(self._place(i)[1], self.turns[i]))
        error = rotations.log(rotations.multiply(rotations.conjugate(s[6:10]), wanted))
        rate = rotations.rotate_inverse(self._place(i)[1], t[10:13])
        inertia = np.array(self.body.inertia)
        return inertia * (0.5 * error + 1.2 * (rate - s[10:13])) + np.cross(
            s[10:13], inertia * s[10:13]
        )

    def _odometry(self, i: int) -> Odometry:
        e, r, c = self.errors, self.rng, self.chasers[i]
        s = c.state
        turn = r.normal(0, 1, 3) * [
            e.attitude_roll_noise_rad,
            e.attitude_noise_rad,
            e.attitude_noise_rad,
        ]
        q = rotations.multiply(s[6:10], rotations.exp(c.attitude_drift_rad))
        attitude = np.diag(
            np.square([e.attitude_roll_noise_rad, e.attitude_noise_rad, e.attitude_noise_rad])
        )
        return Odometry(
            tick=self.tick,
            sim_time_ns=self.time_ns,
            chaser=i,
            position_m=vector(s[:3] + c.position_drift_m + r.normal(0, e.position_noise_m, 3)),
            velocity_m_s=vector(s[3:6] + r.normal(0, e.velocity_noise_m_s, 3)),
            q_wxyz=vector(rotations.multiply(q, rotations.exp(turn))),
            omega_rad_s=vector(s[10:13] + c.gyro_bias_rad_s + r.normal(0, e.omega_noise_rad_s, 3)),
            position_covariance_m2=vector(np.eye(3) * e.position_noise_m**2),
            velocity_covariance_m2_s2=vector(np.eye(3) * e.velocity_noise_m_s**2),
            attitude_covariance_rad2=vector(attitude),
            omega_covariance_rad2_s2=vector(np.eye(3) * e.omega_noise_rad_s**2),
        )

    def _sighting(self, i: int) -> Sighting:
        c, r = self.chasers[i], self.rng
        eye, q_eye = self.camera.irf_pose_in_world(c.state[:3], c.state[6:10])
        line = rotations.rotate_inverse(q_eye, self.target[:3] - eye) - c.camera_shift_m
        turn = rotations.exp(-c.camera_turn_rad)
        seen = rotations.rotate(turn, line) / [1, 1, 1 + c.camera_focal_share]
        q = rotations.multiply(
            turn, rotations.multiply(rotations.conjugate(q_eye), self.target[6:10])
        )
        noise = r.normal(0, SIGHTING_SIGMAS)
        solution = PoseSolution(
            position_m=vector(seen + noise[:3]),
            q_wxyz=vector(rotations.multiply(q, rotations.exp(noise[3:]))),
            covariance=vector(np.diag(SIGHTING_SIGMAS**2)),
            reprojection_rms_px=0.1,
        )
        return Sighting(
            tick=self.tick, sim_time_ns=self.time_ns, chaser=i, status="seen",
            solutions=(solution,),
            marker_ids=(0, 1, 2, 3), corners_px=(), rejected_ids=(),
        )  # fmt: skip

    def relative_error(self, estimator: JointEstimator, i: int) -> tuple[float, float, float]:
        """Return the error of a chaser's estimated pose relative to the target: m, rad, and NEES
        (of 6).
        """
        pose = estimator.relative_poses()[i]
        t, s = self.target, self.chasers[i].state
        place = rotations.rotate_inverse(t[6:10], s[:3] - t[:3])
        q = rotations.multiply(rotations.conjugate(t[6:10]), s[6:10])
        turn = rotations.log(rotations.multiply(rotations.conjugate(pose.q_wxyz), q))
        e = np.concatenate([place - pose.position_m, turn])
        nees = float(e @ np.linalg.solve(pose.covariance, e))
        return float(np.linalg.norm(e[:3])), float(np.linalg.norm(turn)), nees


def odometry_in(inputs: EstimatorInputs, i: int) -> Odometry:
    """Return the odometry of a chaser that is measured."""
    odometry = inputs.chasers[i].odometry
    assert odometry is not None
    return odometry


def changed(inputs: EstimatorInputs, i: int, **fields: Any) -> EstimatorInputs:
    """Return inputs with other fields of one chaser."""
    chasers = list(inputs.chasers)
    chasers[i] = replace(chasers[i], **fields)
    return replace(inputs, chasers=tuple(chasers))


WHITE = SightingNoise(white_ratio=0.85, view_ratio=0.0, view_time_s=1.0)
"""Sightings without a persistent error."""


def parameters(scenario: Scenario, errors: NavigationErrors, **more: object) -> JointParameters:
    """Return the parameters of a filter that knows the errors' sigmas; sightings without a
    persistent error.
    """
    options = {"single_marker": WHITE, "floor_sighting_m": 0.0, "floor_sighting_rad": 0.0, **more}
    return JointParameters(
        TargetParameters(), scenario.chaser, scenario.camera_model(), errors, **options
    )  # type: ignore[arg-type]


def _facing(direction: Array) -> Array:
    """Return an attitude (4,) whose X axis has this direction."""
    x = direction / np.linalg.norm(direction)
    helper = np.array([0.0, 0.0, 1.0]) if abs(x[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    y = np.cross(helper, x)
    y /= np.linalg.norm(y)
    return rotations.from_matrix(np.column_stack([x, y, np.cross(x, y)]))
