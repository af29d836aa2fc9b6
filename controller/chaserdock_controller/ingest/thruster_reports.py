# SPDX-License-Identifier: Apache-2.0
"""The newest thruster report of every chaser: input limits and impulses. No I/O."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import ThrusterReport
from chaserdock_protocol.scenario import FlightScenario


class ThrusterReports:
    """Reports by chaser."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._nominal = scenario.chaser.wrench_max
        self._reports: dict[int, ThrusterReport] = {}

    def update(self, reports: Mapping[int, ThrusterReport]) -> None:
        """Replace the reports of the given chasers."""
        self._reports.update(reports)

    def limits(self, chaser: int) -> Array:
        """Return the greatest force and torque (6,) per body axis that a chaser can produce now."""
        report = self._reports.get(chaser)
        if report is None:
            return self._nominal.copy()
        return np.minimum(self._nominal, np.abs([*report.force_max_N, *report.torque_max_N_m]))

    def coming(self, chaser: int, tick: int) -> Array | None:
        """Return the impulse (6,), body axes, of pulses that are still to fire before the tick's
        command acts, if reported.
        """
        report = self._reports.get(chaser)
        if report is None or report.tick != tick:
            return None
        return np.array([*report.coming_impulse_N_s, *report.coming_angular_impulse_N_m_s])

    def isolated(self) -> dict[int, tuple[int, ...]]:
        """Return the thrusters that every chaser reports as closed."""
        return {i: report.isolated for i, report in self._reports.items() if report.isolated}

    def given(self, tick: int) -> dict[int, Array]:
        """Return the impulses (6,), body axes, that thrusters gave between the tick before and
        ``tick``, as reported.
        """
        return {
            i: np.array([*r.given_impulse_N_s, *r.given_angular_impulse_N_m_s])
            for i, r in self._reports.items()
            if r.tick == tick
        }

    def given_by_thruster(self, tick: int) -> dict[int, Array]:
        """Return the impulses (n,) of every chaser's thrusters between the tick before and
        ``tick``, as reported.
        """
        return {
            i: np.array(r.given_thrusters_N_s)
            for i, r in self._reports.items()
            if r.tick == tick and r.given_thrusters_N_s
        }
