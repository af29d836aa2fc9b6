# SPDX-License-Identifier: Apache-2.0
"""Control a chaser's thrusters: wrench to thrusts to pulses, fault detection, capability report.

No I/O.
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
    WrenchCommand,
)
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.thrusters import FailureKind, thrusts_max

from .allocation import allocator_of
from .fault_detection import Flags, ThrusterFault
from .fault_monitor import FaultMonitor
from .health import ThrusterHealth
from .modulation import Modulator
from .plume_avoidance import PlumeAvoidance

_MIN_SCALE = 0.02
"""Share of the body's limits that is reported even if the remaining thrusters cannot produce every
wrench. Smaller: the NMPC hardly moves such a chaser; larger: it plans what the thrusters cannot
give.
"""
_HISTORY_NS = 1_000_000_000
"""Time for which past pulses are kept, ns: more than the interval between two odometries, over
which impulses are summed, and more than the delay of a lock-step message.
"""
_MAX_PERIOD_NS = 1_000_000_000
"""Upper bound of a carrier period, ns."""


class ThrusterController:
    """Controls the thrusters of one chaser. Call ``observe`` with every odometry, then
    ``add_pulses`` with every command.

    ``health``: which thrusters work. ``events`` (level, what, detail) accumulate until
    ``drain_events``.
    """

    def __init__(self, scenario: FlightScenario, chaser: int) -> None:
        body = scenario.chaser
        self._timing, self._chaser = scenario.timing, chaser
        self._allocator = allocator_of(body)
        self._matrix = self._allocator.matrix
        self._box = body.wrench_max
        self._set = wrench_set(self._matrix, np.flatnonzero(self._box))
        self._modulator = Modulator(body.thrusters, body.modulation, scenario.timing)
        self._valves = Valves(body.thrusters)  # the chaser's model of the real valves
        self.health = ThrusterHealth(thrusts_max(body.thrusters))
        self._monitor = FaultMonitor(scenario, self._allocator)
        self._avoidance = None if scenario.plume is None else PlumeAvoidance(scenario)
        self._cost_factors: Array | None = None
        self._reports_each = scenario.detumble.identification.enabled
        self._odometry: Odometry | None = None
        self._scale: float | None = None
        self._pruned_ns = 0
        self.events: list[tuple[Level, str, str]] = []

    # -- motion and failures -----------------------------------------------------------------------

    def observe(self, odometry: Odometry, touched: bool = False) -> ThrusterReport:
        """Run fault detection on the motion since the last odometry; return the thrusters'
        capability.

        ``touched``: the docking sensor reported contact since then, so the motion is not due to the
        thrusters only.
        """
        before, self._odometry = self._odometry, odometry
        now_ns = odometry.sim_time_ns
        given_N_s = moments_N_s2 = np.zeros(self._matrix.shape[1])
        if before is not None and before.sim_time_ns < now_ns:
            given_N_s = self._impulses(before.sim_time_ns, now_ns)
            moments_N_s2 = self._valves.first_moments(before.sim_time_ns, now_ns)
            if touched:
                self._monitor.reset()
            else:
                suspects = self._suspects(before.sim_time_ns)
                known_N = self.health.available_N()
                fault = self._monitor.detect(before, odometry, given_N_s, suspects, known_N)
                if fault is not None:
                    self._add_fault(fault, now_ns, "detected")
        if now_ns - self._pruned_ns > _HISTORY_NS:
            self._pruned_ns = now_ns
            self._valves.forget_before(now_ns - _HISTORY_NS)
        return self._report(odometry, given_N_s, moments_N_s2)

    def report_failure(self, thruster: int, kind: FailureKind, factor: float, at_ns: int) -> None:
        """Take over a failure that the hardware reports; ``factor``: remaining share of the
        thrust.
        """
        self._add_fault(ThrusterFault(thruster, kind, factor), at_ns, "reported")

    def _add_fault(self, fault: ThrusterFault, at_ns: int, how: str) -> None:
        kind: FailureKind = fault.kind
        self.health.add_fault(fault)
        self._valves.fail(fault.thruster, kind, at_ns, fault.factor)
        self._monitor.reset()
        effect = f", {fault.factor:.2f} of its thrust left" if kind == "weak" else ", isolated"
        self.events.append(
            ("warning", f"thruster {fault.thruster} {kind.replace('_', ' ')}", how + effect)
        )

    def _suspects(self, at_ns: int) -> Flags:
        return np.array(self.health.suspects(self._valves.shut_at(at_ns)))

    def _impulses(self, from_ns: int, to_ns: int) -> Array:
        return self._valves.impulses(np.array([from_ns, to_ns]))[0]

    def _report(self, odometry: Odometry, given_N_s: Array, moments_N_s2: Array) -> ThrusterReport:
        scale = min(1.0, self._set.box_scale(self.health.available_N(), self._box))
        if scale != self._scale and self._scale is not None:
            text = f"wrench limits are {scale:.3f} of the body's"
            if scale < _MIN_SCALE:
                text = (
                    f"the remaining thrusters cannot produce every wrench ({scale:.3f} of the "
                    "limits)"
                )
            self.events.append(
                ("warning" if scale < _MIN_SCALE else "info", "thrusters changed", text)
            )
        self._scale = scale
        limits = self._box * max(scale, _MIN_SCALE)
        effective_ns = self._timing.effective_ns(odometry.tick)
        isolated = self.health.isolated
        self._valves.set_shut(isolated, effective_ns)
        # Impulse of pulses that extend beyond the effective time of the next command, less what
        # belongs to that command.
        pulses_N_s = self._impulses(odometry.sim_time_ns, effective_ns + _MAX_PERIOD_NS)
        coming = self._matrix @ (pulses_N_s - self._modulator.advance_N_s(effective_ns))
        total, moment = self._matrix @ given_N_s, self._matrix @ moments_N_s2
        magnitude = np.abs(self._matrix) @ given_N_s
        return ThrusterReport(
            tick=odometry.tick,
            sim_time_ns=odometry.sim_time_ns,
            chaser=self._chaser,
            force_max_N=vector(limits[:3]),
            torque_max_N_m=vector(limits[3:]),
            coming_impulse_N_s=vector(coming[:3]),
            coming_angular_impulse_N_m_s=vector(coming[3:]),
            thrusters=self.health.states(),
            isolated=isolated,
            given_impulse_N_s=vector(total[:3]),
            given_angular_impulse_N_m_s=vector(total[3:]),
            given_moment_N_s2=vector(moment[:3]),
            given_angular_moment_N_m_s2=vector(moment[3:]),
            given_magnitude_N_s=vector(magnitude[:3]),
            given_angular_magnitude_N_m_s=vector(magnitude[3:]),
            given_thrusters_N_s=vector(given_N_s) if self._reports_each else (),
        )

    def drain_events(self) -> list[tuple[Level, str, str]]:
        """Return the events since the last call."""
        events, self.events = self.events, []
        return events

    # -- commands ----------------------------------------------------------------------------------

    def apply_command(self, command: WrenchCommand) -> None:
        """Apply a command's isolated and trusted thrusters, and whether the chaser flies freely."""
        revoked, changed = self.health.apply_command(command)
        for thruster in revoked:
            self._valves.fail(thruster, None, 0)
        if changed:
            self._monitor.reset()
        self._monitor.apply_command(command)

    def avoid_plumes(self, target: TargetEstimate | None) -> None:
        """Raise the cost of thrusters whose plume hits the target or another chaser, from now on.

        ``target``: estimate of the target and of the chasers' poses, None if unknown.
        """
        self._cost_factors = None
        if self._avoidance is not None and target is not None and target.status != "none":
            self._cost_factors = self._avoidance.cost_factors(self._odometry, target)

    def add_pulses(
        self, command: ActuatorCommand, thrusts_N: Array | None = None
    ) -> ActuatorCommand:
        """Return the command with the pulses of the carrier periods that begin while it acts.

        ``thrusts_N`` (n,): thrust of every thruster, in place of an allocation of the command's
        force and torque.
        """
        available_N = self.health.available_N()
        thrusts = (
            self._allocate(command, available_N)
            if thrusts_N is None
            else np.minimum(thrusts_N, available_N)
        )
        begin_ns, isolated = command.effective_time_ns, self.health.isolated
        end_ns = self._timing.effective_ns(command.tick + 1)
        test_N_s = self._monitor.test_pulses(
            command, self._suspects(begin_ns), available_N, thrusts, self._modulator.period_s
        )
        pulses = self._modulator.pulses(thrusts, available_N, begin_ns, end_ns, test_N_s)
        for p in pulses:
            self._valves.pulse(p.thruster, p.open_ns, p.close_ns)
        self._valves.set_shut(isolated, begin_ns)
        return msgspec.structs.replace(command, pulses=tuple(pulses), isolated=isolated)

    def _allocate(self, command: ActuatorCommand, available_N: Array) -> Array:
        wrench = np.array([*command.force_N, *command.torque_N_m])
        try:
            return self._allocator.allocate(wrench, available_N, self._cost_factors).thrusts_N
        except RuntimeError as error:  # the next command may be solvable
            self.events.append(("error", "thruster allocation failed", str(error)))
            return np.zeros(len(available_N))
