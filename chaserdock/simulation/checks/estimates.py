# SPDX-License-Identifier: Apache-2.0
"""Invariants of estimates: accuracy, consistency, and reports of damaged sightings."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from chaserdock_protocol.messages import (
    BodyTruth,
    Event,
    RelativeEstimate,
    Sighting,
    TargetEstimate,
)
from chaserdock_protocol.scenario.faults import Fault

from chaserdock.analysis.pose_errors import (
    Verticals,
    pose_covariance,
    pose_error,
    pose_nees,
    relative_pose,
    verticals_of,
)

from ..mission import SimulatedFlight
from .causes import keeps_commands
from .check import Check
from .expectations import Expectation
from .reader import reads

ACCURACY_M = 0.01
"""Largest error (m) of the target's position, drift aside, while two honest chasers see it. Larger:
poor estimates pass; smaller: consistent ones fail.
"""
DRIFT_SIGMAS = 4.0
"""Standard deviations of the drift of odometry, which the target's position inherits. A normal
error exceeds them once in 16,000.
"""
SEEN_S = 0.5
"""Time (s) for which a chaser counts as seeing the target after it last did: a few images may miss
it.
"""

DAMAGED_SIGHTINGS = 100.0
"""Number of damaged sightings of which the controller must report at least one as invalid. About
one in 14 still decodes and is invalid, so that chance alone reports none in one flight of 1,700.
"""
BESIDE_DAMAGE = frozenset({"corrupt", "flood", "duplicate"})
"""Kinds of faults under which the controller still receives sightings, damaged or not."""

LEAST_NEES, MOST_NEES, FLIGHT_NEES = 4.5, 7.5, 28.0
"""Bounds of the mean normalized squared error of a pose (6 if consistent) over many flights, and
the largest in one. Successive errors are correlated, so that the means of flights scatter: a gamma
distribution of mean 6 and standard deviation 3 exceeds the last in one flight of 100,000.
"""
NEES = Expectation("covariance consistency", "NEES", LEAST_NEES, MOST_NEES, 3.0, FLIGHT_NEES)


@dataclass
class AccurateEstimate(Check):
    """While two honest chasers see the target and at most one sensor lies, its estimated position
    is within ``ACCURACY_M``, plus ``DRIFT_SIGMAS`` standard deviations of the drift of odometry."""

    name = "accurate estimate"
    exceptions = (
        "in flights in which odometry or clocks are wrong, messages damaged, or the target's shape "
        "unknown, so that its frame is that of a map",
        "with thrusters in a network that delays or loses their pulses",
        "while a thruster of a latched chaser is stuck on without a report "
        "([limitations.md](limitations.md#estimation))",
    )

    _seen_s: dict[int, float] = field(default_factory=dict)

    def begin(self) -> None:
        causes = self.view.causes
        # Chasers do not know what late pulses lose.
        is_late = self.scenario.chaser.actuation == "thrusters" and causes.late_messages
        known = len(causes.liars) <= 1 and not causes.wrong_states and not is_late
        self._is_judged = known and not self.scenario.maps_target

    @reads(Sighting)
    def note_sighting(self, sighting: Sighting) -> None:
        if sighting.status == "seen" and f"chaser/{sighting.chaser}" not in self.view.causes.liars:
            self._seen_s[sighting.chaser] = self.view.time_s

    @reads(TargetEstimate)
    def judge(self, estimate: TargetEstimate) -> None:
        truth, now_s = self.view.truth_of(estimate), self.view.time_s
        if truth is None or not self._is_judged or self._is_pushed():
            return
        if sum(now_s - seen_s <= SEEN_S for seen_s in self._seen_s.values()) < 2:
            return
        error_m = math.dist(estimate.position_m, truth.position_m)
        drift_m = self.scenario.navigation.errors().position_drift_m
        allowed_m = ACCURACY_M + DRIFT_SIGMAS * drift_m
        if error_m > allowed_m:
            text = f"estimated {error_m:.3f} m from its position, {allowed_m:g} allowed"
            self.violate("target", text)

    def _is_pushed(self) -> bool:
        """Return whether a thruster of a latched chaser may be stuck on unreported: detection
        pauses while latched.
        """
        return any(
            f.kind == "stuck_on"
            and not f.reported
            and f.at_s <= self.view.time_s
            and f.chaser in self.view.latched
            for f in self.scenario.thruster_failure
        )


@dataclass
class DamageIsNamed(Check):
    """Of ``DAMAGED_SIGHTINGS`` sightings that a fault damages for the commanding controller, it
    reports at least one as invalid."""

    name = "damage is named"
    exceptions = ("sightings that another fault or a partition may keep from the controller",)

    _newest: dict[int, int] = field(default_factory=dict)
    _damaged: float = 0.0
    _is_named: bool = False

    @reads(Event)
    def note_event(self, event: Event) -> None:
        if event.level != "info" and "invalid sighting" in f"{event.what} {event.detail}":
            self._is_named = True

    @reads(Sighting)
    def count(self, sighting: Sighting) -> None:
        commander = self.view.commanders.get(self.view.tick - 1)
        if sighting.status == "seen" and sighting.tick > self._newest.get(sighting.chaser, -1):
            self._newest[sighting.chaser] = sighting.tick
            if commander is not None:
                self._damaged += self._damaged_share(f"chaser/{sighting.chaser}", commander)

    def _damaged_share(self, chaser: str, commander: str) -> float:
        """Return the share of a chaser's sightings that a fault damages now for the commander and
        that still arrive in time.
        """
        now_s, faults = self.view.time_s, self.scenario.fault
        active = [f for f in faults if f.at_s <= now_s < f.at_s + (f.duration_s or math.inf)]
        kept = (keeps_commands(f, chaser) for f in active if f.kind not in BESIDE_DAMAGE)
        if self.scenario.simulation.partition or any(kept):
            return 0.0
        damaging = (f for f in active if _damages_sightings(f, commander))
        shares = (f.share or 1.0 for f in damaging if f.peer in (None, chaser))
        return max(shares, default=0.0)

    def end(self, flight: SimulatedFlight) -> None:
        if self._damaged >= DAMAGED_SIGHTINGS and not self._is_named:
            self.violate(
                "controller", f"takes about {self._damaged:.0f} damaged sightings as valid"
            )


@dataclass
class CovarianceConsistency(Check):
    """The mean NEES (6 if consistent) of the target's pose in a flight, and that of each chaser's
    relative pose, are at most ``FLIGHT_NEES``; over many such flights each is ``LEAST_NEES``
    to ``MOST_NEES``.

    ``nees``, ``relative_nees``: of the target, and by chaser, one a second.
    """

    name = NEES.invariant
    exceptions = (
        "in flights with lying sensors, thruster failures or `[truth]`",
        "of a target of unknown shape, whose frame is that of a map",
    )

    nees: list[float] = field(default_factory=list)
    relative_nees: dict[int, list[float]] = field(default_factory=dict)

    @reads(TargetEstimate)
    def measure(self, estimate: TargetEstimate) -> None:
        truth = self.view.truth_of(estimate)
        if truth is None or estimate.tick % self.scenario.time.rate_hz or self.scenario.maps_target:
            return
        true, known = ((np.array(x.position_m), np.array(x.q_wxyz)) for x in (truth, estimate))
        covariance = pose_covariance(estimate.covariance)
        up = verticals_of(self.scenario)
        self.nees.append(float(pose_nees(pose_error(*true, *known), covariance, up and up[0])))
        for relative in estimate.relative:
            own = self.view.states.get(f"chaser/{relative.chaser}")
            if own is None or own.body in self.view.touching:
                continue
            if own.sim_time_ns == estimate.sim_time_ns:
                values = self.relative_nees.setdefault(relative.chaser, [])
                values.append(_relative_nees(relative, own, truth, up and up[1]))

    def end(self, flight: SimulatedFlight) -> None:
        if not self.view.causes.honest:
            return
        chasers = {f"chaser/{i} to the target": x for i, x in self.relative_nees.items()}
        for name, values in {"target": self.nees, **chasers}.items():
            if defect := NEES.defect_of(values):
                self.violate(name, defect)


def _damages_sightings(fault: Fault, controller: str) -> bool:
    """Return whether a fault damages sightings that a controller receives."""
    return (fault.kind, fault.process, fault.topic) == ("corrupt", controller, "sighting")


def _relative_nees(
    estimate: RelativeEstimate, own: BodyTruth, target: BodyTruth, up: Verticals | None
) -> float:
    """Return the NEES (6 on average if consistent) of the pose of a chaser relative to the target.
    ``up``: see ``pose_nees``.
    """
    own_pose, target_pose = ((np.array(b.position_m), np.array(b.q_wxyz)) for b in (own, target))
    true = relative_pose(*own_pose, *target_pose)
    error = pose_error(*true, np.array(estimate.position_m), np.array(estimate.q_wxyz))
    return float(pose_nees(error, np.reshape(estimate.covariance, (6, 6)), up))
