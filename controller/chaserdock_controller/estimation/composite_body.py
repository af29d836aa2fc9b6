# SPDX-License-Identifier: Apache-2.0
"""The target and the chasers whose latch holds it, as one rigid body."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.mounting import MountedChaser
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.bodies.mass_properties import (
    MassProperties,
    attach,
    covariance_by_chasers,
    prior_of,
    with_shape,
)
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.interfaces import (
    AppliedImpulse,
    ChaserObservation,
    Observation,
    TargetState,
)

from .types import Estimator, Shock

_TOUCH = Shock(0.005, 0.01)
"""One sigma of the rate changes by a touch or a capture at the limits' speed (m/s, rad/s)."""
_CHASER_MASS_SHARE, _CHASER_CENTRE_M = 0.1, 0.01
"""One sigma of a chaser's mass, as a share, and of its centre of mass per axis."""
_COMMANDED_UNKNOWN = 0.1
"""Share of a commanded impulse's effect that is unknown."""
_MEASURED_UNKNOWN = 1.0
"""Share of a measured impulse that may act in any other direction: an undetected thruster failure.
"""


def target_body(scenario: FlightScenario) -> TargetBody:
    """Return the scenario's target without any chaser."""
    target = scenario.target
    return TargetBody(target.mass_kg, target.inertia_tensor, np.array(target.centre_of_mass_m))


def stated_properties(scenario: FlightScenario) -> MassProperties:
    """Return the scenario's target without any chaser, with the covariance of what is not known of
    it.
    """
    t = scenario.target
    return prior_of(
        target_body(scenario), t.mass_sigma_share, t.inertia_sigma_share, t.centre_of_mass_sigma_m
    )


def centre_in_target(target: TargetState, odometry: Odometry) -> Array:
    """Return a chaser's estimated centre (3,) in TRF."""
    return rotations.rotate_inverse(
        target.q_wxyz, np.array(odometry.position_m) - target.position_m
    )


def pose_in_target(target: TargetState, odometry: Odometry) -> tuple[Array, Array]:
    """Return a chaser's estimated centre (3,) and attitude (4,) in TRF."""
    centre = centre_in_target(target, odometry)
    return centre, rotations.multiply(rotations.conjugate(target.q_wxyz), odometry.q_wxyz)


class CompositeBody:
    """The rigid body that the target and the chasers latched to it form (``body``).

    ``latched``: chasers whose latch holds the target. The body follows from what was known of the
    target alone when a latch last changed.
    """

    def __init__(self, scenario: FlightScenario, estimator: Estimator) -> None:
        self._scenario = scenario
        self._estimator = estimator
        self._target_alone = stated_properties(scenario)
        self.body = self._target_alone.body
        self.latched: frozenset[int] = frozenset()
        self._changed = False

    def disturb(self, observation: Observation) -> None:
        """Inform the estimator of contacts, latch changes and impulses of latched chasers. Call
        before a tick's sightings are processed.
        """
        chasers = observation.chasers
        latched = frozenset(c.chaser for c in chasers if self._is_latched(c))
        changed = latched != self.latched
        if changed:
            self._target_alone = self.target
        if changed or any(c.touches for c in chasers):
            self._estimator.disturb(_TOUCH)
        else:
            for c in chasers:
                if c.chaser in latched and c.odometry is not None and c.impulse is not None:
                    odometry = self._estimator.without_drift(c.odometry)
                    self._push(odometry, c.impulse, observation.time_ns)
        self._changed |= changed
        self.latched = latched

    def _is_latched(self, c: ChaserObservation) -> bool:
        """Return whether a chaser's latch holds the target; without a docking status, as it was
        before.
        """
        return c.chaser in self.latched if c.docking is None else c.docking.latched

    def _push(self, odometry: Odometry, applied: AppliedImpulse, now_ns: int) -> None:
        impulse = applied.impulse
        if not impulse.any():
            return
        before = self._estimator.estimate_at(now_ns)
        centre, q = pose_in_target(before, odometry)
        force, torque = rotations.rotate(q, impulse[:3]), rotations.rotate(q, impulse[3:])
        torque = torque + rotations.cross(centre - self.body.centre_trf_m, force)
        omega = np.asarray(np.linalg.solve(self.body.inertia_kg_m2, torque), dtype=np.float64)
        moved = force / self.body.mass_kg - rotations.cross(omega, self.body.centre_trf_m)
        velocity = rotations.rotate(before.q_wxyz, moved)
        sigmas = [_COMMANDED_UNKNOWN * float(np.linalg.norm(v)) for v in (velocity, omega)]
        if applied.measured:
            other = _MEASURED_UNKNOWN * float(np.linalg.norm(force))
            arm_m = float(np.linalg.norm(centre - self.body.centre_trf_m))
            turned = other * arm_m / float(np.linalg.eigvalsh(self.body.inertia_kg_m2)[-1])
            origin_m = float(np.linalg.norm(self.body.centre_trf_m))
            sigmas[0] = math.hypot(sigmas[0], other / self.body.mass_kg, turned * origin_m)
            sigmas[1] = math.hypot(sigmas[1], turned)
        self._estimator.disturb(Shock(sigmas[0], sigmas[1], velocity, omega))

    @property
    def target(self) -> MassProperties:
        """Return the mass properties of the target alone. While nothing is latched, its observed
        motion gives the shape.
        """
        estimated = self._estimator.shape if not self.latched else None
        return (
            self._target_alone if estimated is None else with_shape(self._target_alone, *estimated)
        )

    @property
    def moving(self) -> TargetBody:
        """Return the body that moves with the target; while nothing is latched, with the shape that
        its observed motion gives.
        """
        estimated = self._estimator.shape
        if estimated is None:
            return self.body
        shape, _ = estimated
        return TargetBody(
            self.body.mass_kg,
            float(np.trace(self.body.inertia_kg_m2)) * shape.inertia,
            shape.centre_m,
        )

    def refine_target(self, target: MassProperties) -> None:
        """Replace the target's mass properties by identified ones. They count from the next
        ``update_body`` on.
        """
        self._target_alone = target
        self._changed = True

    def update_body(self, target: TargetState, own: Sequence[Odometry | None]) -> None:
        """Recompute the body after a latch change or a refinement of the target's mass properties.
        Call after a tick's sightings are processed.

        ``own``: estimated states of the chasers. Their masses are the scenario's; the poses of the
        latched ones are estimated.
        """
        states = [own[i] for i in sorted(self.latched)]
        known = [state for state in states if state is not None]
        if not self._changed or len(known) < len(states):
            return
        chaser = self._scenario.chaser
        mounted = [MountedChaser(*pose_in_target(target, state)) for state in known]
        stack = attach(self._target_alone, mounted, chaser)
        self.body = stack.body
        covariance = stack.covariance + covariance_by_chasers(
            self._target_alone.body, mounted, chaser, _CHASER_MASS_SHARE, _CHASER_CENTRE_M
        )
        self._estimator.change_body(self.body, covariance[1:, 1:])
        self._changed = False
