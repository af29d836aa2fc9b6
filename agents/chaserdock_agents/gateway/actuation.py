# SPDX-License-Identifier: Apache-2.0
"""Actuator commands of the mission as commands to a robot, at the times at which they act. No I/O.

Implements ``CommandedActuators``: what the world does with simulated actuators.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable

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

    With thrusters, each carrier period's pulses become one duty, which the robot holds for a period
    from when it gets it: a command that comes late is late, and nothing of it is lost. Without, a
    wrench acts until the next one. ``matrix`` (6, n): wrench of each open thruster. ``due_ns``:
    when the wrench that was taken last had arrived and was to act, by ``arrived_ns()`` while it is
    given; None for others.
    """

    def __init__(
        self, body: Body, timing: Timing, arrived_ns: Callable[[], int] = lambda: 0
    ) -> None:
        self._timing, self._arrived_ns = timing, arrived_ns
        self.due_ns: int | None = None
        self._has_thrusters = body.actuation == "thrusters"
        self.matrix: Array = wrench_matrix(body.thrusters) if self._has_thrusters else np.zeros(0)
        self._period_steps = timing.physics_hz // body.modulation.carrier_hz
        # As chasers have it: the first period begins when a command can first take effect.
        self._first_step = timing.latency_steps % self._period_steps
        self._waiting: list[tuple[int, int, int, ActuatorCommand]] = []
        self._received = 0
        self._pulses: list[ThrusterPulse] = []
        self._isolated: tuple[int, ...] = ()
        self._sent: tuple[int, int] = (-1, 0)
        self._until_ns: int | None = None
        self._is_stopped = False

    def command(self, command: ActuatorCommand, effective_step: int, now_step: int) -> None:
        """Queue a command that acts from ``effective_step`` on; a late one acts at once."""
        self._received += 1
        time_ns = self._timing.time_ns(max(effective_step, now_step))
        due_ns = max(self._timing.time_ns(effective_step), self._arrived_ns())
        heapq.heappush(self._waiting, (time_ns, self._received, due_ns, command))

    def stop(self, step: int) -> None:
        """Discard all commands; the next output is zero."""
        self._waiting.clear()
        self._pulses.clear()
        self._until_ns = None
        self._is_stopped = True

    def take(self, now_ns: int) -> tuple[Array, Array, Array] | None:
        """Return force (3,), torque (3,) and duty (n,) that act from now on; None if nothing
        changes. Body axes, CRF.
        """
        newest = self.due_ns = None
        while self._waiting and self._waiting[0][0] <= now_ns:
            *_, due_ns, newest = heapq.heappop(self._waiting)
            self.due_ns = None if self._has_thrusters else due_ns
            self._pulses += newest.pulses
            self._isolated = newest.isolated
        if self._is_stopped and newest is None:
            self._is_stopped = False
            return np.zeros(3), np.zeros(3), np.zeros(self._thrusters)
        if self._has_thrusters:
            return self._duty_at(now_ns)
        if newest is None:
            return None
        return np.array(newest.force_N), np.array(newest.torque_N_m), np.zeros(0)

    @property
    def _thrusters(self) -> int:
        return self.matrix.shape[1] if self._has_thrusters else 0

    def _begin_ns(self, period: int) -> int:
        return self._timing.time_ns(self._first_step + period * self._period_steps)

    def _duty_at(self, now_ns: int) -> tuple[Array, Array, Array] | None:
        """Return the output of the present carrier period when its pulses are known, once; and zero
        when a period has passed without others.
        """
        step = (now_ns + 1) * self._timing.physics_hz // _NS
        period = (step - self._first_step) // self._period_steps
        begin_ns, end_ns = self._begin_ns(period), self._begin_ns(period + 1)
        self._pulses = [p for p in self._pulses if p.close_ns > begin_ns]
        pulses = [p for p in self._pulses if p.open_ns < end_ns]
        is_over = self._until_ns is not None and now_ns >= self._until_ns
        if (period, len(pulses)) == self._sent or not (pulses or is_over):
            return None
        self._sent = period, len(pulses)
        self._until_ns = now_ns + end_ns - begin_ns if pulses else None
        duty = np.zeros(self._thrusters)
        for pulse in pulses:
            if pulse.thruster < len(duty) and pulse.thruster not in self._isolated:
                duty[pulse.thruster] += (pulse.close_ns - pulse.open_ns) / (end_ns - begin_ns)
        wrench = self.matrix @ duty
        return wrench[:3], wrench[3:], duty
