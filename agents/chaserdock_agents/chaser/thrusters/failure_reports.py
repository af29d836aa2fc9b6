# SPDX-License-Identifier: Apache-2.0
"""Report planned thruster failures to a chaser when they happen, as its hardware would
(test bed).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from chaserdock_protocol.scenario.thrusters import FailureKind, ThrusterFailure


class FailureReceiver(Protocol):
    """Receive the report of a failure."""

    def report_failure(
        self, thruster: int, kind: FailureKind, factor: float, at_ns: int
    ) -> None: ...


class FailureReports:
    """Hold the reports of one chaser's hardware until their time; the flight software sees none
    before.
    """

    def __init__(self, failures: Iterable[ThrusterFailure] = ()) -> None:
        self._coming = list(failures)

    def deliver(self, receiver: FailureReceiver, now_ns: int) -> None:
        """Report the failures that have happened by now."""
        for failure in [f for f in self._coming if round(f.at_s * 1e9) <= now_ns]:
            self._coming.remove(failure)
            factor = 1.0 if failure.kind == "stuck_on" else failure.factor or 0.0
            receiver.report_failure(
                failure.thruster, failure.kind, factor, round(failure.at_s * 1e9)
            )
