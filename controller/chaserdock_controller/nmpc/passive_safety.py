# SPDX-License-Identifier: Apache-2.0
"""Monitor of passive safety: whether the coast from any state of a plan stays clear of the target."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.passive_safety import CoastCertificate, CoastModel
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.interfaces import LogEntry, TargetEstimation

ORBITS = 2.0
FREE_SPACE_S = 600.0


class PassiveSafetyMonitor:
    """Certifies the plans of a tick. ``certificates``: of each chaser's newest plan."""

    def __init__(self, scenario: FlightScenario) -> None:
        limits, orbit = scenario.limits, scenario.orbit
        mean_motion = 0.0 if orbit is None else orbit.elements.mean_motion_rad_s
        default_s = FREE_SPACE_S if orbit is None else ORBITS * orbit.elements.period_s
        self.duration_s = limits.passive_safety_s or default_s
        self._coast = CoastModel(mean_motion, self.duration_s)
        self._keep_out_m, self._step_s = limits.min_distance_target_m, scenario.controller.dt_s
        self._sigmas = limits.estimate_margin_sigmas
        self._safe: dict[int, bool] = {}
        self.certificates: dict[int, CoastCertificate] = {}

    def update(
        self, chasers: Sequence[int], states: Array, estimation: TargetEstimation
    ) -> tuple[LogEntry, ...]:
        """Certify the plans ``states`` (N, D+1, 13) of these chasers; return what has changed since the last tick.

        A plan is safe if its margin is at least ``limits.estimate_margin_sigmas``. Chasers that hold the target are left out.
        """
        target, events = estimation.at_effect, []
        if target is None:
            return ()
        times = np.arange(states.shape[1])[:, None] * self._step_s
        moving = target.position_m + times * target.velocity_m_s
        for row, i in enumerate(chasers):
            covariance = estimation.motion_covariances.get(i)
            if covariance is None or i in estimation.latched:
                self._safe.pop(i, None)
                self.certificates.pop(i, None)
                continue
            own = states[row]
            relative = np.concatenate([own[:, :3] - moving, own[:, 3:6] - target.velocity_m_s], axis=1)
            found = self._coast.certify(relative, covariance, self._keep_out_m)
            self.certificates[i] = found
            safe = found.margin_sigmas >= self._sigmas
            if self._safe.get(i) != safe:
                self._safe[i] = safe
                events.append(("info" if safe else "warning", self._text(i, found, safe)))
        return tuple(events)

    def _text(self, chaser: int, found: CoastCertificate, safe: bool) -> str:
        state = "passively safe" if safe else "not passively safe"
        return (
            f"chaser {chaser}: {state}: without thrust it comes to {found.distance_m:.2f} m of the target after "
            f"{found.time_s:.0f} s, {found.margin_sigmas:.1f} sigmas from the keep-out of {self._keep_out_m:g} m, in a coast of "
            f"{self.duration_s:.0f} s"
        )
