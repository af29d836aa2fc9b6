# SPDX-License-Identifier: Apache-2.0
"""Monitor of passive safety: whether the coast from any state of a plan stays clear of the target."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.passive_safety import CoastCertificate, CoastModel
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.interfaces import LogEntry, PlanCertificate, TargetEstimation

from .types import CoastSafety

ORBITS = 2.0
"""Length of a coast in an orbit, in its periods, unless the scenario states one. Chosen: the drift of
a coast repeats with the orbit.
"""
FREE_SPACE_S = 600.0
"""Length of a coast without an orbit, s, unless the scenario states one. Chosen: 18 m at the 3 cm/s
of an approach.
"""
PERSISTENT_S = 1.0
"""Time for which plans must be safe, or not, to count as such in the log and for an abort."""
CONVERGED_S, ARMED_AFTER_S = 10.0, 60.0
"""A chaser whose plans were safe for the first, or known for the second of these times counts: the
filter has converged.
"""


def coast_duration_s(scenario: FlightScenario) -> float:
    """Return the length of the coast that is to be safe."""
    orbit = scenario.orbit
    default_s = FREE_SPACE_S if orbit is None else ORBITS * orbit.elements.period_s
    return scenario.limits.passive_safety_s or default_s


class PassiveSafetyMonitor:
    """Certifies the plans of a tick. ``certificates``: of each chaser's newest plan. See
    ``guidance.escape`` for what follows.
    """

    def __init__(self, scenario: FlightScenario) -> None:
        limits, orbit = scenario.limits, scenario.orbit
        mean_motion = 0.0 if orbit is None else orbit.elements.mean_motion_rad_s
        self.duration_s = coast_duration_s(scenario)
        self._coast = CoastModel(mean_motion, self.duration_s)
        self._keep_out_m, self._step_s = limits.min_distance_target_m, scenario.controller.dt_s
        self._sigmas = limits.estimate_margin_sigmas
        self._safe: dict[int, bool] = {}
        self._armed: set[int] = set()
        self._first_ns: dict[int, int] = {}
        self._since: dict[int, tuple[bool, int]] = {}
        self.certificates: dict[int, PlanCertificate] = {}

    def update(
        self,
        chasers: Sequence[int],
        states: Array,
        estimation: TargetEstimation,
        time_ns: int = 0,
        known: Mapping[int, CoastCertificate] = MappingProxyType({}),
    ) -> tuple[LogEntry, ...]:
        """Certify the plans ``states`` (N, D+1, 13) of these chasers; return what has changed since
        the last tick.

        A plan is safe if its margin is at least ``limits.estimate_margin_sigmas``. Chasers that
        hold the target are left out. ``known``: certificates that the solver has found, by row.
        """
        target, events = estimation.at_effect, []
        if target is None:
            return ()
        times = np.arange(states.shape[1])[:, None] * self._step_s
        moving = target.position_m + times * target.velocity_m_s
        for row, i in enumerate(chasers):
            covariance = estimation.motion_covariances.get(i)
            if covariance is None or i in estimation.latched:
                for by_chaser in (self._safe, self.certificates, self._first_ns, self._since):
                    by_chaser.pop(i, None)
                continue
            own = states[row]
            relative = np.concatenate(
                [own[:, :3] - moving, own[:, 3:6] - target.velocity_m_s], axis=1
            )
            found = known.get(row) or self._coast.certify(relative, covariance, self._keep_out_m)
            safe = found.margin_sigmas >= self._sigmas
            self.certificates[i] = PlanCertificate(found, found.loss * self._step_s, safe)
            self._follow(i, safe, time_ns)
            if self._safe.get(i) != safe and (i not in self._safe or self._persists(i, time_ns)):
                self._safe[i] = safe
                events.append(("info" if safe else "warning", self._text(i, found, safe)))
        return tuple(events)

    def restriction(
        self, chasers: Sequence[int], enforced: Collection[int], estimation: TargetEstimation
    ) -> CoastSafety | None:
        """Return the passive safety that the plans of ``chasers``, the rows of a problem, have to
        keep; None for none.

        It applies to those of ``enforced`` that count (see ``unsafe``).
        """
        target, known = estimation.at_effect, estimation.motion_covariances
        kept = {
            row: known[i]
            for row, i in enumerate(chasers)
            if i in enforced and i in self._armed and i in known
        }
        if target is None or not kept:
            return None
        return CoastSafety(self._coast, self._keep_out_m, self._sigmas, target.velocity_m_s, kept)

    def unsafe(self, time_ns: int) -> dict[int, str]:
        """Return why chasers have to abort at ``time_ns``: their plans are not safe for
        `PERSISTENT_S`.

        A chaser counts once its plans were safe for `CONVERGED_S`, or `ARMED_AFTER_S` after its
        first plan: until the filter has converged, plans are safe at times only.
        """
        return {
            i: self._text(i, self.certificates[i].coast, False)
            for i, (safe, _) in self._since.items()
            if i in self._armed and not safe and self._persists(i, time_ns)
        }

    def _persists(self, i: int, time_ns: int, duration_s: float = PERSISTENT_S) -> bool:
        return time_ns - self._since[i][1] >= duration_s * 1e9

    def _follow(self, i: int, safe: bool, time_ns: int) -> None:
        first_ns = self._first_ns.setdefault(i, time_ns)
        if self._since.get(i, (not safe, 0))[0] != safe:
            self._since[i] = safe, time_ns
        if (
            safe and self._persists(i, time_ns, CONVERGED_S)
        ) or time_ns - first_ns >= ARMED_AFTER_S * 1e9:
            self._armed.add(i)

    def _text(self, chaser: int, found: CoastCertificate, safe: bool) -> str:
        state = "passively safe" if safe else "not passively safe"
        return (
            f"chaser {chaser}: {state}: without thrust it comes to {found.distance_m:.2f} m of the target after "
            f"{found.time_s:.0f} s, {found.margin_sigmas:.1f} sigmas from the keep-out of {self._keep_out_m:g} m, in a coast of "
            f"{self.duration_s:.0f} s"
        )
