# SPDX-License-Identifier: Apache-2.0
"""Actuator commands of the mission as commands to a robot, at the times at which they act. No I/O.

Implements ``CommandedActuators``: what the world does with simulated actuators.
"""

from __future__ import annotations

import heapq

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.clock import Timing
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import ActuatorCommand, ThrusterPulse
from chaserdock_protocol.scenario.bodies import Body

_NS = 1_000_000_000
"""Nanoseconds of a second."""


class RobotActuation:
    """Commands of one chaser that wait for their time, in mission time.

    With thrusters, the duty of each carrier period follows from its pulses; without, a wrench acts
    until the next one. ``matrix`` (6, n): wrench of each open thruster.
    """

    def __init__(self, body: Body, timing: Timing) -> None:
        self._timing = timing
        self._has_thrusters = body.actuation == "thrusters"
        self.matrix: Array = wrench_matrix(body.thrusters) if self._has_thrusters else np.zeros(0)
        self._period_ns = _NS // body.modulation.carrier_hz
        self._waiting: list[tuple[int, int, ActuatorCommand]] = []
        self._received = 0
        self._pulses: list[ThrusterPulse] = []
        self._isolated: tuple[int, ...] = ()
        self._sent_period = -1
        self._is_stopped = False

    def command(self, command: ActuatorCommand, effective_step: int, now_step: int) -> None:
        """Queue a command that acts from ``effective_step`` on; a late one acts at once."""
        self._received += 1
        time_ns = self._timing.time_ns(max(effective_step, now_step))
        heapq.heappush(self._waiting, (time_ns, self._received, command))

    def stop(self, step: int) -> None:
        """Discard all commands; the next output is zero."""
        self._waiting.clear()
        self._pulses.clear()
        self._is_stopped = True

    def take(self, now_ns: int) -> tuple[Array, Array, Array] | None:
        """Return force (3,), torque (3,) and duty (n,) that act from now on; None if nothing
        changes. Body axes, CRF.
        """
        newest = None
        while self._waiting and self._waiting[0][0] <= now_ns:
            newest = heapq.heappop(self._waiting)[2]
            self._pulses += newest.pulses
            self._isolated = newest.isolated
        if self._is_stopped and newest is None:
            self._is_stopped = False
            return np.zeros(3), np.zeros(3), np.zeros(self._thrusters)
        if self._has_thrusters:
            return self._duty_of(now_ns // self._period_ns)
        if newest is None:
            return None
        return np.array(newest.force_N), np.array(newest.torque_N_m), np.zeros(0)

    @property
    def _thrusters(self) -> int:
        return self.matrix.shape[1] if self._has_thrusters else 0

    def _duty_of(self, period: int) -> tuple[Array, Array, Array] | None:
        """Return the output of a carrier period, once."""
        if period == self._sent_period:
            return None
        self._sent_period = period
        begin_ns, end_ns = period * self._period_ns, (period + 1) * self._period_ns
        duty = np.zeros(self._thrusters)
        for pulse in self._pulses:
            open_ns = min(pulse.close_ns, end_ns) - max(pulse.open_ns, begin_ns)
            if open_ns > 0 and pulse.thruster < len(duty) and pulse.thruster not in self._isolated:
                duty[pulse.thruster] += open_ns / self._period_ns
        self._pulses = [p for p in self._pulses if p.close_ns > end_ns]
        wrench = self.matrix @ duty
        return wrench[:3], wrench[3:], duty
