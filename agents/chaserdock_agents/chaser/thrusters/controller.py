# SPDX-License-Identifier: Apache-2.0
"""Thruster controller of a chaser: wrench to thrusts to pulses, fault detection and capability
report. No I/O.
"""

from __future__ import annotations

import msgspec
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.thruster_model import Valves
from chaserdock_models.wrench_set import wrench_set
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import (
    ActuatorCommand,
    Level,
    Odometry,
    TargetEstimate,
    ThrusterReport,
    ThrusterState,
    WrenchCommand,
)
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.thrusters import FailureKind, thrusts_max

from .allocation import allocator_of
from .fault_detection import SUFFICIENT_INFORMATION, Flags, ThrusterFault, ThrusterFaultDetector
from .impulse_residual import (
    ImpulseNoise,
    PlantMismatch,
    covariance,
    mismatch_signatures,
    noise_of,
    observed_impulse,
    quiescent_variance,
)
from .modulation import Modulator
from .plume_avoidance import PlumeAvoidance
from .self_test import ThrusterSelfTest

_MIN_SCALE = 0.02
"""Share of the body's limits that is reported even if the remaining thrusters cannot produce every
wrench.
"""
_MAX_TEST_PULSES = 10
"""Thrusters are tested if at most this many minimum pulses prove that one works."""
_HISTORY_NS = 1_000_000_000
_MAX_PERIOD_NS = 1_000_000_000
"""Upper bound of a carrier period."""


class ThrusterController:
    """Controls the thrusters of one chaser. Call ``observe`` with every odometry, then
    ``add_pulses`` with every command.

    ``events`` (level, what, detail) accumulate until ``drain_events``.
    """

    def __init__(
        self, scenario: FlightScenario, chaser: int, noise: ImpulseNoise | None = None
    ) -> None:
        body = scenario.chaser
        self._body, self._timing, self._chaser = body, scenario.timing, chaser
        self._allocator = allocator_of(body)
        self._matrix = self._allocator.matrix
        self._full_N = thrusts_max(body.thrusters)
        self._box = body.wrench_max
        self._set = wrench_set(self._matrix)
        self._modulator = Modulator(body.thrusters, body.modulation, scenario.timing)
        self._valves = Valves(body.thrusters)  # the chaser's model of the real valves
        min_pulse_N_s = self._full_N * [t.min_on_s for t in body.thrusters]
        self._detector = ThrusterFaultDetector(
            self._matrix, self._full_N, min_pulse_N_s, 13 + len(self._full_N)
        )
        self._mismatch = PlantMismatch()
        self._noise = noise or noise_of(scenario.navigation.errors())
        variance = quiescent_variance(self._noise, body)
        information = (min_pulse_N_s**2 * (self._matrix**2 / variance[:, None]).sum(axis=0)).min()
        # Neither pulses of whole periods nor pulses below the noise can test a single thruster.
        testable = (
            body.modulation.modulator == "pwm"
            and _MAX_TEST_PULSES * information >= SUFFICIENT_INFORMATION
        )
        self._self_test = ThrusterSelfTest(
            self._allocator,
            min_pulse_N_s,
            body.thruster_test_s if testable else 0.0,
            SUFFICIENT_INFORMATION,
        )
        self._avoidance = (
            None if scenario.plume is None else PlumeAvoidance(scenario, scenario.plume)
        )
        self._cost_factors: Array | None = None
        self._test_allowed = False
        self._reports_each = scenario.detumble.identification.enabled
        self._failed: dict[int, ThrusterFault] = {}
        self._commanded_isolated: frozenset[int] = frozenset()
        self._trusted: frozenset[int] = frozenset()
        self._free_since_ns: int | None = 0
        self._odometry: Odometry | None = None
        self._scale: float | None = None
        self._pruned_ns = 0
        self.events: list[tuple[Level, str, str]] = []

    @property
    def isolated(self) -> tuple[int, ...]:
        """Thrusters whose shut-off valves are to be closed, in ascending order."""
        return tuple(sorted(self._commanded_isolated | (self._unusable() - self._trusted)))

    def _unusable(self) -> set[int]:
        return {thruster for thruster, fault in self._failed.items() if fault.kind != "weak"}

    def observe(self, odometry: Odometry, touched: bool = False) -> ThrusterReport:
        """Run fault detection on the motion since the last odometry; return the thrusters'
        capability.

        ``touched``: the docking sensor reported contact since then, so the motion is not due to the
        thrusters only.
        """
        before, self._odometry = self._odometry, odometry
        now_ns = odometry.sim_time_ns
        given = np.zeros(len(self._full_N))
        if before is not None and before.sim_time_ns < now_ns:
            given = self._impulses(before.sim_time_ns, now_ns)
            if touched:
                self._detector.reset()
            else:
                self._detect_faults(before, odometry, given)
        if now_ns - self._pruned_ns > _HISTORY_NS:
            self._pruned_ns = now_ns
            self._valves.forget_before(now_ns - _HISTORY_NS)
        return self._report(odometry, given)

    def report_failure(self, thruster: int, kind: FailureKind, factor: float, at_ns: int) -> None:
        """Take over a failure that the hardware reports; ``factor``: remaining share of the thrust."""
        self._add_fault(ThrusterFault(thruster, kind, factor), at_ns, "reported")

    def _detect_faults(self, before: Odometry, after: Odometry, thrusters: Array) -> None:
        if self._free_since_ns is None or before.sim_time_ns < self._free_since_ns:
            self._detector.reset()
            return
        residual = observed_impulse(before, after, self._body) - self._matrix @ thrusters
        noise = covariance(self._noise, self._body, self._matrix, thrusters, before, after)
        time_s = (after.sim_time_ns - before.sim_time_ns) * 1e-9
        suspects = self._suspects(before.sim_time_ns)
        mismatch = mismatch_signatures(
            self._mismatch, self._body, self._matrix, thrusters, before, after
        )
        fault = self._detector.update(residual, noise, thrusters, time_s, suspects, mismatch)
        if fault is not None:
            self._add_fault(fault, after.sim_time_ns, "detected")
        else:
            self._self_test.add_information(self._detector.information, after.sim_time_ns)

    def _suspects(self, at_ns: int) -> Flags:
        """Return the thrusters (n,) whose failure can be detected: not isolated, failed or trusted
        by command.
        """
        excluded = {*self._failed, *self._valves.shut_at(at_ns), *self._trusted}
        return np.array([thruster not in excluded for thruster in range(len(self._full_N))])

    def _add_fault(self, fault: ThrusterFault, at_ns: int, how: str) -> None:
        kind: FailureKind = fault.kind
        self._failed[fault.thruster] = fault
        self._valves.fail(fault.thruster, kind, at_ns, fault.factor)
        self._detector.reset()
        effect = f", {fault.factor:.2f} of its thrust left" if kind == "weak" else ", isolated"
        self.events.append(
            ("warning", f"thruster {fault.thruster} {kind.replace('_', ' ')}", how + effect)
        )

    def _impulses(self, from_ns: int, to_ns: int) -> Array:
        return self._valves.impulses(np.array([from_ns, to_ns]))[0]

    def _available_N(self) -> Array:
        """Return the known thrust of every open thruster, (n,) N."""
        available_N = self._full_N.copy()
        for thruster, fault in self._failed.items():
            available_N[thruster] *= fault.factor
        available_N[list(self.isolated)] = 0.0
        return available_N

    def _report(self, odometry: Odometry, given: Array) -> ThrusterReport:
        scale = min(1.0, self._set.box_scale(self._available_N(), self._box))
        if scale != self._scale and self._scale is not None:
            text = f"wrench limits are {scale:.3f} of the body's"
            if scale < _MIN_SCALE:
                text = f"the remaining thrusters cannot produce every wrench ({scale:.3f} of the limits)"
            self.events.append(
                ("warning" if scale < _MIN_SCALE else "info", "thrusters changed", text)
            )
        self._scale = scale
        limits = self._box * max(scale, _MIN_SCALE)
        effective_ns = self._timing.effective_ns(odometry.tick)
        self._valves.set_shut(self.isolated, effective_ns)
        # Pulses that extend beyond the effective time of the next command, less the part that
        # belongs to that command.
        pulses_N_s = self._impulses(odometry.sim_time_ns, effective_ns + _MAX_PERIOD_NS)
        coming = self._matrix @ (pulses_N_s - self._modulator.advance_N_s(effective_ns))
        total = self._matrix @ given
        kinds: list[ThrusterState] = ["healthy"] * len(self._full_N)
        for thruster, fault in self._failed.items():
            kinds[thruster] = fault.kind
        return ThrusterReport(
            tick=odometry.tick,
            sim_time_ns=odometry.sim_time_ns,
            chaser=self._chaser,
            force_max_N=vector(limits[:3]),
            torque_max_N_m=vector(limits[3:]),
            coming_impulse_N_s=vector(coming[:3]),
            coming_angular_impulse_N_m_s=vector(coming[3:]),
            thrusters=tuple(kinds),
            isolated=self.isolated,
            given_impulse_N_s=vector(total[:3]),
            given_angular_impulse_N_m_s=vector(total[3:]),
            given_thrusters_N_s=vector(given) if self._reports_each else (),
        )

    def apply_command(self, command: WrenchCommand) -> None:
        """Apply a command's isolated and trusted thrusters, and whether the chaser flies freely."""
        shut, trusted = frozenset(command.isolated), frozenset(command.trusted)
        count = len(self._full_N)
        shut = frozenset(j for j in shut if j < count)
        for thruster in trusted - self._trusted:
            if self._failed.pop(thruster, None) is not None:
                self._valves.fail(thruster, None, 0)
        if shut != self._commanded_isolated or trusted != self._trusted:
            self._detector.reset()
        self._commanded_isolated, self._trusted = shut, trusted
        # With an armed latch the chaser is about to touch and must not be disturbed.
        self._test_allowed = command.free and command.latch != "arm"
        if not command.free:
            self._free_since_ns = None
        elif self._free_since_ns is None:
            self._free_since_ns = command.sim_time_ns

    def add_pulses(
        self, command: ActuatorCommand, thrusts_N: Array | None = None
    ) -> ActuatorCommand:
        """Return the command with the pulses of the carrier periods that begin while it acts.

        ``thrusts_N`` (n,): thrust of every thruster, in place of an allocation of the command's
        force and torque.
        """
        available_N = self._available_N()
        thrusts = (
            self._allocate(command, available_N)
            if thrusts_N is None
            else np.minimum(thrusts_N, available_N)
        )
        begin_ns, isolated = command.effective_time_ns, self.isolated
        end_ns = self._timing.effective_ns(command.tick + 1)
        test = None
        if self._test_allowed and command.source == "command":
            suspects = self._suspects(begin_ns)
            test = self._self_test.schedule(
                begin_ns, suspects, available_N, thrusts, self._modulator.period_s
            )
        pulses = self._modulator.pulses(thrusts, available_N, begin_ns, end_ns, test)
        for p in pulses:
            self._valves.pulse(p.thruster, p.open_ns, p.close_ns)
        self._valves.set_shut(isolated, begin_ns)
        return msgspec.structs.replace(command, pulses=tuple(pulses), isolated=isolated)

    def avoid_plumes(self, target: TargetEstimate | None) -> None:
        """Make the thrusters whose plume hits the target or another chaser dear from now on;
        ``target``: an estimate of it and of the chasers' poses, None if unknown."""
        self._cost_factors = None
        if self._avoidance is not None and target is not None and target.status != "none":
            self._cost_factors = self._avoidance.cost_factors(self._odometry, target)

    def _allocate(self, command: ActuatorCommand, available_N: Array) -> Array:
        wrench = np.array([*command.force_N, *command.torque_N_m])
        try:
            return self._allocator.allocate(wrench, available_N, self._cost_factors).thrusts_N
        except RuntimeError as error:  # the next command may be solvable
            self.events.append(("error", "thruster allocation failed", str(error)))
            return np.zeros(len(available_N))

    def drain_events(self) -> list[tuple[Level, str, str]]:
        """Return the events since the last call."""
        events, self.events = self.events, []
        return events
