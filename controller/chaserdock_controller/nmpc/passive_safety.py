# SPDX-License-Identifier: Apache-2.0
"""Monitor of passive safety: checks whether the coast from every state of a plan stays clear of the
target.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.passive_safety import STEP_S, CoastCertificate, CoastModel
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.estimation.joint.parameters import parameters_of
from chaserdock_controller.interfaces import LogEntry, PlanCertificate, TargetEstimation

from .types import CoastSafety

ORBITS = 2.0
"""Length of a coast in an orbit, in orbital periods, unless the scenario states one. The drift of a
coast repeats with the orbit, so that a second period shows whether it returns.
"""
FREE_SPACE_S = 600.0
"""Length of a coast without an orbit, s, unless the scenario states one: 18 m at the 3 cm/s of an
approach. Larger: stricter for slow drifts; smaller: later collisions are missed.
"""
PERSISTENT_S = 1.0
"""Time, s, for which plans must be safe, or unsafe, before the log or an abort takes note."""
CONVERGED_S, ARMED_AFTER_S = 10.0, 60.0
"""A chaser is monitored for aborts once its plans were safe for the first of these times, or known
for the second: the filter has then converged.
"""


def coast_model(scenario: FlightScenario, step_s: float = STEP_S) -> CoastModel:
    """Return the model of the coasts that have to be safe, with the process noise that the joint
    filter assumes.
    """
    orbit = scenario.orbit
    mean_motion = 0.0 if orbit is None else orbit.elements.mean_motion_rad_s
    noise = parameters_of(scenario).coast_noise
    return CoastModel(mean_motion, coast_duration_s(scenario), step_s, noise)


def coast_duration_s(scenario: FlightScenario) -> float:
    """Return the length (s) of the coast that has to be safe."""
    orbit = scenario.orbit
    default_s = FREE_SPACE_S if orbit is None else ORBITS * orbit.elements.period_s
    return scenario.limits.passive_safety_s or default_s


@dataclass
class ChaserSafety:
    """Passive safety of the plans of one chaser.

    ``certificate``: of its newest plan. ``reported``: the log states that its plans are safe.
    ``since``: whether they are safe, and since when. ``first_ns``: time of its first plan.
    ``armed``: it may have to abort, see ``PassiveSafetyMonitor.unsafe``.
    """

    certificate: PlanCertificate | None = None
    reported: bool | None = None
    first_ns: int | None = None
    since: tuple[bool, int] | None = None
    armed: bool = False

    def forget(self) -> None:
        """Start again, but keep whether the chaser is armed."""
        self.certificate = self.reported = self.first_ns = self.since = None

    def lasts(self, time_ns: int, duration_s: float = PERSISTENT_S) -> bool:
        """Return whether the plans have been safe, or unsafe, without a change for a time."""
        return self.since is not None and time_ns - self.since[1] >= duration_s * 1e9

    def follow(self, safe: bool, time_ns: int) -> None:
        """Record whether the plan of a tick is safe."""
        self.first_ns = time_ns if self.first_ns is None else self.first_ns
        if self.since is None or self.since[0] != safe:
            self.since = safe, time_ns
        converged = safe and self.lasts(time_ns, CONVERGED_S)
        self.armed |= converged or time_ns - self.first_ns >= ARMED_AFTER_S * 1e9


class PassiveSafetyMonitor:
    """Certifies the plans of a tick. ``chasers``: state of each. ``guidance.escape`` reacts to
    unsafe plans.
    """

    def __init__(self, scenario: FlightScenario) -> None:
        limits = scenario.limits
        self.duration_s = coast_duration_s(scenario)
        self._coast = coast_model(scenario)
        self._force_N = parameters_of(scenario).lasting_force_N
        self._keep_out_m, self._step_s = limits.min_distance_target_m, scenario.controller.dt_s
        self._sigmas = limits.estimate_margin_sigmas
        self.chasers = tuple(ChaserSafety() for _ in scenario.chasers)

    def update(
        self,
        chasers: Sequence[int],
        states: Array,
        estimation: TargetEstimation,
        time_ns: int = 0,
        known: Mapping[int, CoastCertificate] = MappingProxyType({}),
    ) -> tuple[LogEntry, ...]:
        """Certify the plans ``states`` (N, D+1, 13) of these chasers. Returns log entries for
        changes since the last tick.

        A plan is safe if its margin is at least ``limits.estimate_margin_sigmas``. Chasers that
        hold the target are left out. ``known``: certificates from the solver, by row.
        """
        target, events = estimation.at_effect, []
        if target is None:
            return ()
        times = np.arange(states.shape[1])[:, None] * self._step_s
        moving = target.position_m + times * target.velocity_m_s
        for row, i in enumerate(chasers):
            estimate, safety = estimation.chasers[i], self.chasers[i]
            motion = estimate.disturbed
            if motion is None or estimate.latched:
                safety.forget()
                continue
            own = states[row]
            relative = np.concatenate(
                [own[:, :3] - moving, own[:, 3:6] - target.velocity_m_s], axis=1
            )
            found = known.get(row) or self._coast.certify(relative, motion, self._keep_out_m)
            safe = found.margin_sigmas >= self._sigmas
            safety.certificate = PlanCertificate(found, found.loss * self._step_s, safe)
            safety.follow(safe, time_ns)
            if safety.reported != safe and (safety.reported is None or safety.lasts(time_ns)):
                safety.reported = safe
                events.append(("info" if safe else "warning", self._text(i, found, safe)))
        return tuple(events)

    def restriction(
        self, chasers: Sequence[int], enforced: Set[int], estimation: TargetEstimation
    ) -> CoastSafety | None:
        """Return the passive safety that the plans of ``chasers``, the rows of a problem, have to
        keep; None without any.

        It applies to armed chasers among ``enforced`` (see ``unsafe``).
        """
        target, kept = estimation.at_effect, {}
        for row, i in enumerate(chasers):
            motion = estimation.chasers[i].disturbed
            if i in enforced and self.chasers[i].armed and motion is not None:
                kept[row] = motion
        if target is None or not kept:
            return None
        return CoastSafety(self._coast, self._keep_out_m, self._sigmas, target.velocity_m_s, kept)

    def unsafe(self, chaser: int, time_ns: int) -> str:
        """Return why a chaser has to abort at ``time_ns``: its plans were unsafe for
        `PERSISTENT_S`. Empty if it need not.

        A chaser is armed once its plans were safe for `CONVERGED_S`, or `ARMED_AFTER_S` after its
        first plan. Before that the filter has not converged and plans are safe only at times.
        """
        safety = self.chasers[chaser]
        if safety.certificate is None or safety.since is None or safety.since[0]:
            return ""
        counts = safety.armed and safety.lasts(time_ns)
        return self._text(chaser, safety.certificate.coast, False) if counts else ""

    def _text(self, chaser: int, found: CoastCertificate, safe: bool) -> str:
        state = "passively safe" if safe else "not passively safe"
        return (
            f"chaser {chaser}: {state}: without thrust it comes to {found.distance_m:.2f} m of the "
            "target after "
            f"{found.time_s:.0f} s, {found.margin_sigmas:.1f} sigmas from the keep-out of "
            f"{self._keep_out_m:g} m, in a coast of "
            f"{self.duration_s:.0f} s under forces of {self._force_N:g} N "
            "(limits.passive_safety_force_N)"
        )
