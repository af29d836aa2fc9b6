# SPDX-License-Identifier: Apache-2.0
"""The last usable plan of every chaser, and for how long planning has failed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from chaserdock_models.arrays import Array

from .types import BUDGET, FAILED, INFEASIBLE_RELAXED, NmpcPlan

FAILED_S = 1.0
"""Time (s) without a usable plan after which a chaser retreats. Until then it flies its last plan,
which is longer (3 s by default) but was made for an approach that must not go on without feedback.
"""
DEGRADED_S = 5.0
"""Time (s) with failed solves, or with plans that violate distances or are cut short, after which a
chaser retreats. Such plans lead out of a keep-out zone at a few cm/s, which takes seconds. The
clock runs back while plans are sound."""


@dataclass(frozen=True)
class ChaserPlan:
    """Plan of one chaser from ``time_ns`` on: states (D+1, 13) and inputs (D, 6), as in
    ``NmpcPlan``.
    """

    time_ns: int
    states: Array
    inputs: Array

    def input_at(self, time_ns: int, step_s: float) -> Array | None:
        """Return the input (6,) at a time, None after the plan's end."""
        stage = int((time_ns - self.time_ns) / 1e9 / step_s + 1e-9)
        return self.inputs[stage] if 0 <= stage < len(self.inputs) else None


@dataclass(frozen=True)
class PlanningFailure:
    """``without_plan``: no usable plan for `FAILED_S`; otherwise degraded plans for `DEGRADED_S`,
    until sound ones for as long.
    """

    without_plan: bool

    @property
    def refused(self) -> tuple[str, ...]:
        """Return the operator commands that are refused meanwhile; an operator may lead a chaser
        out by degraded plans.
        """
        always = ("approach", "inspect")
        return (*always, "goto", "calibrate") if self.without_plan else always

    def text(self) -> str:
        """Return the reason for a retreat."""
        if self.without_plan:
            return f"no usable plan for {FAILED_S:g} s"
        return f"plans infeasible or over budget for {DEGRADED_S:g} s"


class PlanMonitor:
    """Follows the results of the solver; chasers that are not planned for are forgotten."""

    def __init__(self) -> None:
        self._last: dict[int, ChaserPlan] = {}
        self._failed_since_ns: dict[int, int] = {}
        self._degraded_since_ns: dict[int, int] = {}
        self._degraded: set[int] = set()
        self._time_ns = 0

    def update(
        self, chasers: tuple[int, ...], plan: NmpcPlan | None, time_ns: int, effective_ns: int
    ) -> None:
        """Record the result of the tick at ``time_ns`` for ``chasers``; ``effective_ns``: when its
        plan begins.
        """
        for by_chaser in (self._last, self._failed_since_ns, self._degraded_since_ns):
            for i in by_chaser.keys() - set(chasers):
                del by_chaser[i]
        self._degraded &= set(chasers)
        for row, i in enumerate(chasers):
            status = FAILED if plan is None else plan.status[row]
            if plan is not None and status != FAILED:
                self._last[i] = ChaserPlan(effective_ns, plan.states[row], plan.inputs[row])
            if status == FAILED:
                self._failed_since_ns.setdefault(i, time_ns)
            else:
                self._failed_since_ns.pop(i, None)
            self._follow_degraded(i, time_ns, status in (FAILED, BUDGET, INFEASIBLE_RELAXED))
        self._time_ns = time_ns

    def plans(self, time_ns: int) -> Mapping[int, ChaserPlan]:
        """Return what chasers may fly at ``time_ns``: the newest plans, or older ones within
        `FAILED_S`.
        """
        out = {}
        for i, plan in self._last.items():
            failed_ns = time_ns - self._failed_since_ns.get(i, time_ns)
            if failed_ns < FAILED_S * 1e9:
                out[i] = plan
        return out

    def failures(self, time_ns: int) -> Mapping[int, PlanningFailure]:
        """Return the chasers that have to retreat at ``time_ns``."""
        out = {}
        for i, since_ns in self._degraded_since_ns.items():
            failed_ns = time_ns - self._failed_since_ns.get(i, time_ns)
            if failed_ns >= FAILED_S * 1e9:
                out[i] = PlanningFailure(without_plan=True)
            elif i in self._degraded or time_ns - since_ns >= DEGRADED_S * 1e9:
                out[i] = PlanningFailure(without_plan=False)
        return out

    def _follow_degraded(self, i: int, time_ns: int, degraded: bool) -> None:
        """Let the clock of degraded plans run, or back to zero, where a failure ends; it shows
        `DEGRADED_S` at most.
        """
        since_ns, limit_ns = self._degraded_since_ns.get(i, time_ns), round(DEGRADED_S * 1e9)
        if time_ns - since_ns >= limit_ns:
            self._degraded.add(i)
        if not degraded:
            since_ns += 2 * (time_ns - self._time_ns)
        if degraded or since_ns < time_ns:
            self._degraded_since_ns[i] = max(since_ns, time_ns - limit_ns)
        else:
            self._degraded_since_ns.pop(i, None)
            self._degraded.discard(i)
