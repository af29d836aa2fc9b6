# SPDX-License-Identifier: Apache-2.0
"""Draw true bodies and actuators: nominal ones with the errors of ``[truth]``.

Everything is drawn from the scenario's seed and the chaser's number. Without ``[truth]`` a plant is
the nominal body.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.meshes import TriangleMesh, with_geometry_errors
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.targets import Marker, TargetModel
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.truth import Mismatch, TruthValues

from .random_draws import TARGET_KEY, Stream, generator

Moments = tuple[float, float, float]
_LARGEST_SIGMA = 3.0
"""Largest draw, in standard deviations, so that shares stay positive; 0.3 % of a normal
distribution lie beyond.
"""


@dataclass(frozen=True, eq=False)
class PrincipalFrame:
    """Principal axes at the centre of mass, in which an engine integrates.

    ``q_wxyz`` (4,): principal to body axes. ``offset_m`` (3,): centre of mass in body axes.
    """

    q_wxyz: Array
    offset_m: Array

    def from_body(self, s: BodyState) -> BodyState:
        """Return the state of this frame from that of the body's frame."""
        arm = rotations.rotate(s.q_wxyz, self.offset_m)
        turning = rotations.rotate(s.q_wxyz, rotations.cross(s.omega_rad_s, self.offset_m))
        return BodyState(
            s.position_m + arm,
            s.velocity_m_s + turning,
            rotations.multiply(s.q_wxyz, self.q_wxyz),
            rotations.rotate_inverse(self.q_wxyz, s.omega_rad_s),
        )

    def to_body(self, s: BodyState) -> BodyState:
        """Return the state of the body's frame from that of this frame."""
        q = rotations.multiply(s.q_wxyz, rotations.conjugate(self.q_wxyz))
        omega = rotations.rotate(self.q_wxyz, s.omega_rad_s)
        return BodyState(
            s.position_m - rotations.rotate(q, self.offset_m),
            s.velocity_m_s - rotations.rotate(q, rotations.cross(omega, self.offset_m)),
            q,
            omega,
        )

    def wrench(self, wrench: Array) -> Array:
        """Return force and torque (6,) about the centre of mass, principal axes, of a wrench at the
        body's origin.
        """
        torque = wrench[3:] - rotations.cross(self.offset_m, wrench[:3])
        return np.concatenate(
            [rotations.rotate_inverse(self.q_wxyz, part) for part in (wrench[:3], torque)]
        )

    def place(self, position_m: Array, q_wxyz: Array) -> tuple[Array, Array]:
        """Return the pose in this frame of a part with this pose in the body's frame."""
        inverse = rotations.conjugate(self.q_wxyz)
        return rotations.rotate(inverse, position_m - self.offset_m), rotations.multiply(
            inverse, q_wxyz
        )


@dataclass(frozen=True, eq=False)
class Plant:
    """True mass properties of a body, and its constant disturbance.

    Disturbance (6,): N and N m, at the body's origin in its axes. ``frame``: None if the principal
    axes at the centre of mass are the body's frame.
    """

    mass_kg: float
    moments_kg_m2: Moments
    frame: PrincipalFrame | None = None
    disturbance: Array = field(default_factory=lambda: np.zeros(6))

    @property
    def centre_of_mass_m(self) -> Array:
        """Centre of mass (3,), body axes."""
        return np.zeros(3) if self.frame is None else self.frame.offset_m

    @property
    def inertia_kg_m2(self) -> Array:
        """Inertia tensor (3, 3) about the centre of mass, body axes."""
        turn = np.eye(3) if self.frame is None else rotations.to_matrix(self.frame.q_wxyz)
        return turn @ np.diag(self.moments_kg_m2) @ turn.T

    def to_engine(self, state: BodyState) -> BodyState:
        """Return the state of the frame that an engine integrates from that of the body's frame."""
        return state if self.frame is None else self.frame.from_body(state)

    def from_engine(self, state: BodyState) -> BodyState:
        """Return the state of the body's frame from that of the frame that an engine integrates."""
        return state if self.frame is None else self.frame.to_body(state)

    def part_in_engine(self, position_m: Array, q_wxyz: Array) -> tuple[Array, Array]:
        """Return the pose of a part in the engine's frame from that in the body's frame."""
        return (position_m, q_wxyz) if self.frame is None else self.frame.place(position_m, q_wxyz)

    def wrench_in_engine(self, wrench: Array) -> Array:
        """Return a wrench (6,) at the body's origin in the engine's frame."""
        return wrench if self.frame is None else self.frame.wrench(wrench)


@dataclass(frozen=True, eq=False)
class ActuationErrors:
    """Errors of one chaser's actuators.

    ``thrust_share`` (n,) and ``thrust_turn_rad`` (n, 3): of each thruster. With ideal actuation,
    the shares (6,) of force and torque per axis, and the turns (2, 3) of force and torque.
    """

    seed: int
    chaser: int
    thrust_share: Array
    thrust_turn_rad: Array
    scatter_share: float
    delay_s: float
    delay_jitter_s: float
    clock_offset_s: float

    @property
    def none(self) -> bool:
        """Whether there are no errors."""
        figures = (self.scatter_share, self.delay_s, self.delay_jitter_s, self.clock_offset_s)
        return not (any(figures) or self.thrust_share.any() or self.thrust_turn_rad.any())

    def delay(self, step: int) -> float:
        """Return the time, s, after which a command for this physics step acts.

        Negative if the chaser's clock is ahead.
        """
        jitter = 0.0
        if self.delay_jitter_s:
            draw = generator(self.seed, Stream.DELAY, self.chaser, step).standard_normal()
            jitter = self.delay_jitter_s * float(np.clip(draw, -_LARGEST_SIGMA, _LARGEST_SIGMA))
        return max(0.0, self.delay_s + jitter) - self.clock_offset_s

    def scatter(self, key: int, time: int, count: int) -> Array:
        """Return factors (count,) that scatter around 1, drawn for a pulse or command.

        ``key``: of the thruster. ``time``: of the pulse or command.
        """
        draw = generator(self.seed, Stream.SCATTER, self.chaser, key, time).standard_normal(count)
        return 1.0 + self.scatter_share * np.clip(draw, -_LARGEST_SIGMA, _LARGEST_SIGMA)


def _normal(seed: int, stream: Stream, key: int, count: int) -> Array:
    draw = generator(seed, stream, key).standard_normal(count)
    return np.clip(draw, -_LARGEST_SIGMA, _LARGEST_SIGMA)


def draw_moments(nominal: Moments, share: float, rng: np.random.Generator) -> Moments:
    """Return principal moments with relative errors of standard deviation ``share``.

    A rigid body must be able to have them: what violates the triangle inequality is drawn again,
    each time with a slightly smaller deviation, which ends for every nominal body.
    """
    while share:
        draw = np.clip(rng.standard_normal(3), -_LARGEST_SIGMA, _LARGEST_SIGMA)
        a, b, c = (np.asarray(nominal) * (1.0 + share * draw)).tolist()
        if min(a, b, c) > 0.0 and 2.0 * max(a, b, c) <= a + b + c:
            return a, b, c
        share = share * 0.98 if share > 1e-12 else 0.0
    return nominal


def principal_axes(inertia: Array) -> tuple[Moments, Array]:
    """Return principal moments of an inertia tensor (3, 3), and rotation (4,) principal to body
    axes.
    """
    values, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    a, b, c = values.tolist()
    return (a, b, c), rotations.from_matrix(axes)


def _plant(
    seed: int,
    key: int,
    mass_kg: float,
    moments: Moments,
    sigma: Mismatch,
    explicit: TruthValues | None,
    axes_wxyz: Array | None = None,
    centre_m: Array | None = None,
) -> Plant:
    """Return a body with errors. ``axes_wxyz`` (4,): stated principal axes to body axes;
    ``centre_m`` (3,): stated centre of mass.
    """
    draw = _normal(seed, Stream.PLANT, key, 13)
    mass = mass_kg * (1.0 + sigma.mass_share * float(draw[0]))
    offset, turn = sigma.centre_of_mass_m * draw[1:4], sigma.inertia_turn_rad * draw[4:7]
    disturbance = np.concatenate([sigma.force_N * draw[7:10], sigma.torque_N_m * draw[10:13]])
    moments = draw_moments(moments, sigma.inertia_share, generator(seed, Stream.INERTIA, key))
    q = rotations.exp(turn)
    if axes_wxyz is not None:
        q = rotations.multiply(q, axes_wxyz)
    if centre_m is not None:
        offset = offset + centre_m
    if explicit is not None:
        mass = explicit.mass_kg or mass
        if explicit.inertia is not None:
            moments, q = principal_axes(explicit.inertia)
        if explicit.centre_of_mass_m is not None:
            offset = np.array(explicit.centre_of_mass_m)
        if explicit.force_N is not None:
            disturbance[:3] = explicit.force_N
        if explicit.torque_N_m is not None:
            disturbance[3:] = explicit.torque_N_m
    shifted = offset.any() or q[0] != 1.0
    return Plant(mass, moments, PrincipalFrame(q, offset) if shifted else None, disturbance)


def chaser_plant(scenario: Scenario, chaser: int) -> Plant:
    """Return the true body of a chaser."""
    body, truth = scenario.chaser, scenario.truth
    sigma, explicit = truth.mismatch("chaser"), truth.values_of(chaser)
    return _plant(scenario.seed, chaser, body.mass_kg, body.inertia, sigma, explicit)


def target_plant(scenario: Scenario) -> Plant:
    """Return the true body of the target; the stated one for a prescribed motion."""
    target = scenario.target
    if target.motion != "torque_free":
        return Plant(target.mass_kg, target.moments)
    sigma, explicit = scenario.truth.mismatch("target"), scenario.truth.values_of(None)
    moments, axes = target.moments, None
    tensor = target.inertia_tensor
    if np.any(tensor[~np.eye(3, dtype=bool)]):
        moments, axes = principal_axes(tensor)
    place = np.array(target.centre_of_mass_m)
    return _plant(scenario.seed, TARGET_KEY, target.mass_kg, moments, sigma, explicit, axes, place)


def actuation_errors(scenario: Scenario, chaser: int) -> ActuationErrors:
    """Return the errors of a chaser's actuators."""
    sigma, explicit = scenario.truth.mismatch("chaser"), scenario.truth.values_of(chaser)
    ideal = scenario.chaser.actuation == "ideal"
    shares, turns = (6, 2) if ideal else (len(scenario.chaser.thrusters),) * 2
    draw = _normal(scenario.seed, Stream.THRUST, chaser, 1 + shares + 3 * turns)
    share = sigma.thrust_share * draw[1 : 1 + shares] + 0.0  # no negative zeros
    clock_offset_s = sigma.clock_offset_s * float(draw[0])
    if explicit is not None and explicit.thrust_share is not None:
        share = np.array(explicit.thrust_share)
    if explicit is not None and explicit.clock_offset_s is not None:
        clock_offset_s = explicit.clock_offset_s
    return ActuationErrors(
        seed=scenario.seed,
        chaser=chaser,
        thrust_share=share,
        thrust_turn_rad=sigma.thrust_turn_rad * draw[1 + shares :].reshape(turns, 3),
        scatter_share=sigma.pulse_scatter_share,
        delay_s=sigma.delay_s,
        delay_jitter_s=sigma.delay_jitter_s,
        clock_offset_s=clock_offset_s,
    )


def true_target(scenario: Scenario) -> TargetModel:
    """Return the true target, whose markers are displaced in their planes."""
    model, sigma = scenario.target_model(), scenario.truth.mismatch("target").marker_m
    if not sigma:
        return model
    draw = sigma * _normal(
        scenario.seed, Stream.MARKERS, TARGET_KEY, 2 * len(model.markers)
    ).reshape(-1, 2)
    markers = tuple(_moved(m, off) for m, off in zip(model.markers, draw, strict=True))
    return replace(model, markers=markers)


def true_mesh(scenario: Scenario) -> TriangleMesh | None:
    """Return the true mesh of the target, or None without a mesh.

    It is finer than the known one, and its size and the angles of its joints are in error.
    """
    mesh = scenario.target.nominal_mesh()
    return None if mesh is None else with_geometry_errors(mesh, *true_geometry_errors(scenario))


def true_geometry_errors(scenario: Scenario) -> tuple[float, dict[str, Array]]:
    """Return the errors of the known mesh that a seed draws.

    Relative error of the scale, and the rotation vector (3,) of each joint, rad.
    """
    mesh, knowledge = scenario.target.nominal_mesh(), scenario.target.knowledge
    joints = () if mesh is None else tuple(mesh.joints)
    draw = _normal(scenario.seed, Stream.MESH, TARGET_KEY, 1 + 3 * len(joints))
    turns = np.radians(knowledge.panel_deg) * draw[1:].reshape(-1, 3)
    return knowledge.scale_share * float(draw[0]), dict(zip(joints, turns, strict=True))


def _moved(marker: Marker, offset: Array) -> Marker:
    """Return a marker displaced by ``offset`` (2,), m, to its right and up."""
    shift = rotations.rotate(marker.q_trf_marker_wxyz, np.array([*offset.tolist(), 0.0]))
    x, y, z = (np.array(marker.position_trf_m) + shift).tolist()
    return replace(marker, position_trf_m=(x, y, z))
