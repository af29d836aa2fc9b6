# SPDX-License-Identifier: Apache-2.0
"""Accuracy with which chasers follow their references relative to the true target."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.messages import ActuatorCommand, BodyTruth, Reference, TargetEstimate

from ..mission import SimulatedFlight
from .check import Check
from .expectations import Expectation
from .reader import reads

CONTROL_M = {"ideal": 1e-3, "thrusters": 2e-3}
"""Expected error (m) of control besides that of the estimate, by actuation
(docs/evidence/thrusters.md: 1.42 mm of both with thrusters). Larger: lags pass;
smaller: sound flights fail.
"""
SETTLED_S = 10.0
"""Time (s) after the start, a fault or a partition from which tracking is judged: chasers start
centimetres off, and one that has flown without commands returns in about 8 s.
"""
LEAST_TRACKING, MOST_TRACKING, FLIGHT_TRACKING = 0.2, 1.5, 6.0
"""Bounds of the mean normalized tracking error over many flights, and the largest in one. A gamma
distribution of mean 1 and the spread below exceeds the last in one flight of 100,000.
"""
TRACKING = Expectation(
    "tracking accuracy",
    "normalized tracking error",
    LEAST_TRACKING,
    MOST_TRACKING,
    0.6,
    FLIGHT_TRACKING,
)


@dataclass
class TrackingAccuracy(Check):
    """While nothing has disturbed the flight, and the chaser has had its commands, for
    ``SETTLED_S``, the mean distance of a chaser from its reference relative to the true target,
    over that expected by the covariance of its relative pose and by the resolution of its
    actuators, is at most ``FLIGHT_TRACKING`` in a flight, and over many such flights
    ``LEAST_TRACKING`` to ``MOST_TRACKING``.

    ``values``: normalized errors by chaser, one a second.
    """

    name = TRACKING.invariant
    exceptions = (
        "in flights with lying sensors, thruster failures or `[truth]`",
        "for a chaser from when the target is on its way to its reference, or another chaser is "
        "nearer than twice the distance that they keep",
    )

    values: dict[int, list[float]] = field(default_factory=dict)
    _estimate: TargetEstimate | None = None
    _blocked: set[int] = field(default_factory=set)
    _alone_s: dict[int, float] = field(default_factory=dict)

    @reads(TargetEstimate)
    def note(self, estimate: TargetEstimate) -> None:
        self._estimate = estimate

    @reads(ActuatorCommand)
    def note_alone(self, command: ActuatorCommand) -> None:
        if command.source != "command":
            self._alone_s[command.chaser] = self.view.time_s

    @reads(Reference)
    def measure(self, reference: Reference) -> None:
        i, tick, view, known = reference.chaser, reference.tick, self.view, self._estimate
        own, target = view.states.get(f"chaser/{i}"), view.states.get("target")
        if own is None or target is None or known is None or known.tick != tick:
            return
        if own.sim_time_ns != reference.sim_time_ns or tick % self.scenario.time.rate_hz:
            return
        disturbed_s = view.causes.lasted_until_s(view.causes.faults, view.time_s)
        disturbed_s = max(disturbed_s, self._alone_s.get(i, -math.inf))
        settled = view.time_s - disturbed_s >= SETTLED_S and not view.is_on_its_own(i)
        relative = next((r for r in known.relative if r.chaser == i), None)
        if not settled or own.body in view.touching or relative is None:
            return
        if i in self._blocked or self._has_to_yield(own, target, reference):
            self._blocked.add(i)
            self.values.pop(i, None)
            return
        apart_m = np.subtract(own.position_m, target.position_m)
        place_m = rotations.rotate_inverse(np.array(target.q_wxyz), apart_m)
        variance_m2 = float(np.trace(np.reshape(relative.covariance, (6, 6))[:3, :3]))
        control_m = CONTROL_M[self.scenario.chaser.actuation]
        expected_m = math.sqrt(variance_m2 + control_m**2)
        error_m = math.dist(place_m, reference.offset_m)
        self.values.setdefault(i, []).append(error_m / expected_m)

    def _has_to_yield(self, own: BodyTruth, target: BodyTruth, reference: Reference) -> bool:
        """Return whether another chaser is near, or the target's keep-out is on a chaser's way to
        its reference.
        """
        limits = self.scenario.limits
        others = [s for n, s in self.view.states.items() if n not in (own.body, target.body)]
        near_m = 2.0 * limits.min_distance_chasers_m
        if any(math.dist(own.position_m, other.position_m) < near_m for other in others):
            return True
        to_target_m = np.subtract(target.position_m, own.position_m)
        offset_m = rotations.rotate(np.array(target.q_wxyz), np.array(reference.offset_m))
        way_m = to_target_m + offset_m
        share = to_target_m @ way_m / max(way_m @ way_m, 1e-12)
        gap_m = np.linalg.norm(to_target_m - share * way_m)
        return bool(0.0 < share < 1.0 and gap_m < limits.min_distance_target_m)

    def end(self, flight: SimulatedFlight) -> None:
        for i, values in self.values.items() if self.view.causes.honest else ():
            if defect := TRACKING.defect_of(values):
                self.violate(f"chaser/{i}", defect)
