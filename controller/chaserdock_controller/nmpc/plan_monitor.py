# SPDX-License-Identifier: Apache-2.0
"""Tracks the last usable plan of a chaser, and for how long its planning has failed."""

from __future__ import annotations

from chaserdock_controller.interfaces import ChaserPlan, PlanningFailure

from .types import BUDGET, FAILED, INFEASIBLE_RELAXED

FAILED_S = 1.0
"""Time, s, without a usable plan after which a chaser retreats. Until then it flies its last plan.
That is longer (3 s by default), but an approach must not continue without feedback.
"""
DEGRADED_S = 5.0
"""Time, s, of failed solves, or of plans that violate distances or are cut short, after which a
chaser retreats. Such plans lead out of a keep-out zone at a few cm/s, which takes seconds. The
clock runs back while plans are sound.
"""


class PlanMonitor:
    """Tracks the solver's results for one chaser."""

    def __init__(self) -> None:
        self._last: ChaserPlan | None = None
        self._failed_since_ns: int | None = None
        self._degraded_since_ns: int | None = None
        self._degraded = False
        self._time_ns = 0

    def forget(self) -> None:
        """Reset, because the chaser is not planned for."""
        self._last = self._failed_since_ns = self._degraded_since_ns = None
        self._degraded = False

    def update(self, status: str, plan: ChaserPlan | None, time_ns: int) -> None:
        """Record the result of the tick at ``time_ns``. ``plan``: None if the solver failed."""
        if plan is None:
            first_ns = self._failed_since_ns
            self._failed_since_ns = time_ns if first_ns is None else first_ns
        else:
            self._last, self._failed_since_ns = plan, None
        self._follow_degraded(time_ns, status in (FAILED, BUDGET, INFEASIBLE_RELAXED))
        self._time_ns = time_ns

    def flyable(self, time_ns: int) -> ChaserPlan | None:
        """Return the plan that the chaser may fly at ``time_ns``: the last usable one. None once
        there was no usable one for `FAILED_S`.
        """
        return None if self._has_failed(time_ns) else self._last

    def failure(self, time_ns: int) -> PlanningFailure | None:
        """Return why the chaser has to retreat at ``time_ns``: no usable plan for `FAILED_S`, or
        degraded ones for `DEGRADED_S`. None otherwise; degraded planning ends after sound plans for
        as long.
        """
        since_ns = self._degraded_since_ns
        if since_ns is None:
            return None
        if self._has_failed(time_ns):
            return PlanningFailure(True, f"no usable plan for {FAILED_S:g} s")
        if self._degraded or time_ns - since_ns >= DEGRADED_S * 1e9:
            return PlanningFailure(False, f"plans infeasible or over budget for {DEGRADED_S:g} s")
        return None

    def _has_failed(self, time_ns: int) -> bool:
        since_ns = self._failed_since_ns
        return since_ns is not None and time_ns - since_ns >= FAILED_S * 1e9

    def _follow_degraded(self, time_ns: int, degraded: bool) -> None:
        """Run the clock of degraded plans up, or down to zero, where a failure ends. It is limited
        to `DEGRADED_S`.
        """
        begun_ns, limit_ns = self._degraded_since_ns, round(DEGRADED_S * 1e9)
        since_ns = time_ns if begun_ns is None else begun_ns
        if time_ns - since_ns >= limit_ns:
            self._degraded = True
        if not degraded:
            since_ns += 2 * (time_ns - self._time_ns)
        if degraded or since_ns < time_ns:
            self._degraded_since_ns = max(since_ns, time_ns - limit_ns)
        else:
            self._degraded_since_ns, self._degraded = None, False
