# SPDX-License-Identifier: Apache-2.0
"""Invariants of thrusters: expected impulses are given, and healthy thrusters are not suspected."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import ThrusterReport

from .bodies import ARM_M
from .causes import DEVICES_SETTLE_S, IN_LATE_NETWORK
from .check import Check
from .reader import reads

FLOOR_N_S = 0.01
"""Impulse (N s) by which expected and true impulse may differ: one pulse of 10 ms of 1 N."""
THRUST_SHARE = 0.15
"""Difference of expected and given impulse, as a share of the latter. Larger: wrong models pass;
smaller: stated errors of thrust fail.
"""
SCATTER_SIGMAS = 3.0
"""Standard deviations of the scatter of thrust and delay in `[truth]`. A normal error exceeds them
once in 370.
"""


@dataclass
class NoHealthyThrusterSuspected(Check):
    """Where no thruster fails, no chaser takes one for failed, whatever else fails."""

    name = "thrusters as expected"
    exceptions = (IN_LATE_NETWORK,)

    @reads(ThrusterReport)
    def judge(self, report: ThrusterReport) -> None:
        suspected = [j for j, state in enumerate(report.thrusters) if state != "healthy"]
        fails = self.scenario.thruster_failure or self.view.causes.late_messages
        if suspected and not fails:
            self.violate(f"chaser/{report.chaser}", f"takes {suspected} for failed, but none is")


@dataclass
class ThrustersAsExpected(Check):
    """The impulse that a chaser expects of its thrusters, summed since the last fault, is the true
    one within ``THRUST_SHARE`` plus the scatter of `[truth]`."""

    name = "thrusters as expected"
    exceptions = (
        "with thruster failures",
        IN_LATE_NETWORK,
        f"during faults, partitions and slow reading, and {DEVICES_SETTLE_S:g} s after them",
        "while the chaser touches another body",
    )

    _unexplained: dict[int, Array] = field(default_factory=dict)
    """Impulse (6,) that each chaser expected but its thrusters did not give: N s, and N m s divided
    by ``ARM_M``.
    """
    _given_N_s: dict[int, float] = field(default_factory=dict)

    @reads(ThrusterReport)
    def judge(self, report: ThrusterReport) -> None:
        i, name = report.chaser, f"chaser/{report.chaser}"
        body, now_s = self.view.states.get(name), report.tick / self.scenario.time.rate_hz
        is_disturbed = name in self.view.touching or self.view.causes.disturbs_thrusters(now_s)
        if body is None or body.tick != report.tick or is_disturbed:
            self._unexplained.pop(i, None)
            return
        true = [*body.impulse_N_s, *np.divide(body.angular_impulse_N_m_s, ARM_M)]
        turning = np.divide(report.given_angular_impulse_N_m_s, ARM_M)
        expected = [*report.given_impulse_N_s, *turning]
        if i not in self._unexplained:
            self._unexplained[i], self._given_N_s[i] = np.zeros(6), 0.0
            return
        self._unexplained[i] = self._unexplained[i] + np.subtract(expected, true)
        self._given_N_s[i] += sum(body.thruster_impulse_N_s)
        error, given_N_s = float(np.linalg.norm(self._unexplained[i])), self._given_N_s[i]
        if error > self._allowed_N_s(name, given_N_s):
            more = f"{error:.2e} N s more of its thrusters than they gave, of {given_N_s:.2e}"
            self.violate(name, f"expects {more}")

    def _allowed_N_s(self, name: str, given_N_s: float) -> float:
        """Return by how much the given impulse of thrusters may differ from the expected one."""
        truth, drawn = self.view.mismatch, self.view.drawn.get(name)
        late_s = truth.delay_s + SCATTER_SIGMAS * truth.delay_jitter_s
        late_s += 0.0 if drawn is None else abs(drawn.clock_offset_s)
        # A thruster's force acts on position and, by its lever arm, on attitude.
        shifted_N_s = 2.0 * late_s * sum(t.thrust_N for t in self.scenario.chaser.thrusters)
        share = THRUST_SHARE + SCATTER_SIGMAS * truth.thrust_share
        return FLOOR_N_S + shifted_N_s + share * given_N_s
