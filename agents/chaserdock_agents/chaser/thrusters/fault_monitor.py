# SPDX-License-Identifier: Apache-2.0
"""Decide when a chaser's motion proves a failed thruster, and when a thruster is fired to
find out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import ActuatorCommand, Odometry, WrenchCommand
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.thrusters import thrusts_max

from .allocation import Allocator
from .fault_detection import SUFFICIENT_INFORMATION, Flags, ThrusterFault, ThrusterFaultDetector
from .impulse_residual import (
    PlantMismatch,
    covariance,
    mismatch_signatures,
    noise_of,
    observed_impulse,
    quiescent_variance,
)
from .self_test import MAX_TEST_PULSES, ThrusterSelfTest


class FaultMonitor:
    """Compare a freely flying chaser's motion with what its thrusters should have given.

    Schedules test pulses for thrusters that have not been observed recently.
    """

    def __init__(self, scenario: FlightScenario, allocator: Allocator) -> None:
        body = scenario.chaser
        self._body, self._matrix = body, allocator.matrix
        self._full_N = thrusts_max(body.thrusters)
        min_on_s = np.array([t.min_on_s for t in body.thrusters])
        min_pulse_N_s = self._full_N * min_on_s
        self._detector = ThrusterFaultDetector(self._matrix, min_on_s, 13 + len(min_on_s))
        self._mismatch = PlantMismatch()
        self._noise = noise_of(scenario.navigation.errors())
        variance = quiescent_variance(self._noise, body)
        information = (min_pulse_N_s**2 * (self._matrix**2 / variance[:, None]).sum(axis=0)).min()
        # A single thruster cannot be tested by pulses below the noise.
        testable = MAX_TEST_PULSES * information >= SUFFICIENT_INFORMATION
        self._self_test = ThrusterSelfTest(
            allocator,
            min_pulse_N_s,
            body.thruster_test_s if testable else 0.0,
            self._detector.ticks_to_tell,
        )
        self._test_allowed = False
        self._free_since_ns: int | None = 0

    def apply_command(self, command: WrenchCommand) -> None:
        """Note whether the chaser flies freely."""
        # With an armed latch the chaser is about to touch and must not be disturbed.
        self._test_allowed = command.free and command.latch != "arm"
        if not command.free:
            self._free_since_ns = None
        elif self._free_since_ns is None:
            self._free_since_ns = command.sim_time_ns

    def reset(self) -> None:
        """Discard the motion so far, as more than the known thrusters caused it."""
        self._detector.reset()
        self._self_test.reset()

    def detect(
        self,
        before: Odometry,
        after: Odometry,
        given_N_s: Array,
        suspects: Flags,
        known_N: Array,
    ) -> ThrusterFault | None:
        """Return the failure that the motion between two odometries proves, if any.

        ``given_N_s`` (n,): impulses of thrusters as far as they are known to work; ``suspects``
        (n,): those that may fail; ``known_N`` (n,): known thrust of each when open.
        """
        if self._free_since_ns is None or before.sim_time_ns < self._free_since_ns:
            self.reset()
            return None
        residual = observed_impulse(before, after, self._body) - self._matrix @ given_N_s
        noise = covariance(self._noise, self._body, self._matrix, given_N_s, before, after)
        time_s = (after.sim_time_ns - before.sim_time_ns) * 1e-9
        mismatch = mismatch_signatures(
            self._mismatch, self._body, self._matrix, given_N_s, before, after
        )
        fault = self._detector.update(
            residual, noise, given_N_s, time_s, suspects, mismatch, known_N
        )
        if fault is None:
            self._self_test.add_pulses(self._detector.fired, after.sim_time_ns)
            return None
        if fault.kind != "weak":
            return fault
        share = float(known_N[fault.thruster] / self._full_N[fault.thruster])
        return replace(fault, factor=share * fault.factor)

    def test_pulses(
        self,
        command: ActuatorCommand,
        suspects: Flags,
        available_N: Array,
        thrusts_N: Array,
        period_s: float,
    ) -> Array | None:
        """Return the impulses (n,), N s, of a test burn beside a command; None if none is due.

        See ``ThrusterSelfTest.schedule``.
        """
        if not (self._test_allowed and command.source == "command"):
            return None
        return self._self_test.schedule(
            command.effective_time_ns, suspects, available_N, thrusts_N, period_s
        )
