"""A chaser's thrusters in flight: wrench -> thrusts -> pulses, which thrusters it trusts, what it tells of them. No I/O."""

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
    ThrusterReport,
    ThrusterState,
    WrenchCommand,
)
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.thrusters import FailureKind, thrusts_max

from .allocation import allocator_of
from .fault_detection import ENOUGH, Flags, ThrusterFaultDetector, Verdict
from .impulse_residual import Noise, at_rest, covariance, noise_of, observed_impulse
from .modulation import Modulator
from .self_test import ThrusterSelfTest

_LEAST_SCALE = 0.02
"""Of the body's limits: what the controller may ask for even of thrusters that cannot give every wrench any more."""
_MOST_LOOKS = 10
"""A thruster is tested if so many least pulses would prove that it works."""
_FORGET_NS = 1_000_000_000
_LONGEST_NS = 1_000_000_000
"""No carrier period is longer."""


class ThrusterController:
    """Thrusters of chaser ``chaser``: give it every odometry, then every command. ``events`` (level, what, detail) pile up
    until drained."""

    def __init__(self, scenario: Scenario, chaser: int, noise: Noise | None = None) -> None:
        body = scenario.chaser
        self._body, self._timing, self._chaser = body, scenario.timing, chaser
        self._allocator = allocator_of(body)
        self._matrix = self._allocator.matrix
        self._full_N = thrusts_max(body.thrusters)
        self._box = np.array([body.force_max_N] * 3 + [body.torque_max_N_m] * 3)
        self._set = wrench_set(self._matrix)
        self._modulator = Modulator(body.thrusters, body.modulation, scenario.timing)
        self._valves = Valves(body.thrusters)  # what this chaser believes of the real ones
        least = self._full_N * [t.min_on_s for t in body.thrusters]
        self._watch = ThrusterFaultDetector(self._matrix, self._full_N, least)
        self._noise = noise or noise_of(scenario.odometry)
        tells = (least**2 * (self._matrix**2 / at_rest(self._noise, body)[:, None]).sum(axis=0)).min()
        # Pulses of whole periods are no test of one thruster, and neither are those that drown in noise.
        can_tell = body.modulation.modulator == "pwm" and _MOST_LOOKS * tells >= ENOUGH
        self._proof = ThrusterSelfTest(
            self._allocator, least, body.thruster_test_s if can_tell else 0.0, ENOUGH
        )
        self._may_test = False
        self._told = [f for f in scenario.thruster_failure if f.reported and f.chaser == chaser]
        self._failed: dict[int, Verdict] = {}
        self._wanted_shut: frozenset[int] = frozenset()
        self._trusted: frozenset[int] = frozenset()
        self._free_since_ns: int | None = 0
        self._odometry: Odometry | None = None
        self._scale: float | None = None
        self._forgotten_ns = 0
        self.events: list[tuple[Level, str, str]] = []

    @property
    def isolated(self) -> tuple[int, ...]:
        """Thrusters whose shut-off valves are to be closed."""
        return tuple(sorted(self._wanted_shut | (self._useless() - self._trusted)))

    def _useless(self) -> set[int]:
        return {thruster for thruster, verdict in self._failed.items() if verdict.kind != "weak"}

    def observe(self, odometry: Odometry, touched: bool = False) -> ThrusterReport:
        """Looks for failed thrusters in the motion since the last odometry; what the thrusters can do now.

        ``touched``: the docking sensor felt something since then. That motion is not the thrusters' alone.
        """
        before, self._odometry = self._odometry, odometry
        now_ns = odometry.sim_time_ns
        for failure in [f for f in self._told if round(f.at_s * 1e9) <= now_ns]:
            self._told.remove(failure)
            factor = 1.0 if failure.kind == "stuck_on" else failure.factor or 0.0
            self._convict(
                Verdict(failure.thruster, failure.kind, factor), round(failure.at_s * 1e9), "was told"
            )
        given = np.zeros(len(self._full_N))
        if before is not None and before.sim_time_ns < now_ns:
            given = self._impulses(before.sim_time_ns, now_ns)
            if touched:
                self._watch.forget()
            else:
                self._compare(before, odometry, given)
        if now_ns - self._forgotten_ns > _FORGET_NS:
            self._forgotten_ns = now_ns
            self._valves.forget_before(now_ns - _FORGET_NS)
        return self._report(odometry, self._matrix @ given)

    def _compare(self, before: Odometry, after: Odometry, thrusters: Array) -> None:
        if self._free_since_ns is None or before.sim_time_ns < self._free_since_ns:
            self._watch.forget()
            return
        residual = observed_impulse(before, after, self._body) - self._matrix @ thrusters
        noise = covariance(self._noise, self._body, self._matrix, thrusters, before, after)
        time_s = (after.sim_time_ns - before.sim_time_ns) * 1e-9
        suspects = self._suspects(before.sim_time_ns)
        if (verdict := self._watch.look(residual, noise, thrusters, time_s, suspects)) is not None:
            self._convict(verdict, after.sim_time_ns, "found")
        else:
            self._proof.heard(self._watch.information, after.sim_time_ns)

    def _suspects(self, at_ns: int) -> Flags:
        """Thrusters (n,) whose failure could be found: not those that are shut, known to have failed, or vouched for."""
        out = {*self._failed, *self._valves.shut_at(at_ns), *self._trusted}
        return np.array([thruster not in out for thruster in range(len(self._full_N))])

    def _convict(self, verdict: Verdict, at_ns: int, how: str) -> None:
        kind: FailureKind = verdict.kind
        self._failed[verdict.thruster] = verdict
        self._valves.fail(verdict.thruster, kind, at_ns, verdict.factor)
        self._watch.forget()
        left = f", {verdict.factor:.2f} of its thrust left" if kind == "weak" else ", isolated"
        self.events.append(("warning", f"thruster {verdict.thruster} {kind.replace('_', ' ')}", how + left))

    def _impulses(self, from_ns: int, to_ns: int) -> Array:
        return self._valves.impulses(np.array([from_ns, to_ns]))[0]

    def _can_N(self) -> Array:
        """What every thruster gives when opened, (n,) N, as far as known."""
        can = self._full_N.copy()
        for thruster, verdict in self._failed.items():
            can[thruster] *= verdict.factor
        can[list(self.isolated)] = 0.0
        return can

    def _report(self, odometry: Odometry, given: Array) -> ThrusterReport:
        scale = min(1.0, self._set.box_scale(self._can_N(), self._box))
        if scale != self._scale and self._scale is not None:
            text = f"the controller's limits are {scale:.3f} of the body's"
            if scale < _LEAST_SCALE:
                text = f"the thrusters left do not give force and torque in every direction ({scale:.3f} of the limits)"
            self.events.append(("warning" if scale < _LEAST_SCALE else "info", "thrusters changed", text))
        self._scale = scale
        limits = self._box * max(scale, _LEAST_SCALE)
        effective_ns = self._timing.effective_ns(odometry.tick)
        self._valves.set_shut(self.isolated, effective_ns)
        # Pulses that go on after the next command takes effect count beyond what of them belongs to that command.
        under_way = self._impulses(odometry.sim_time_ns, effective_ns + _LONGEST_NS)
        coming = self._matrix @ (under_way - self._modulator.paid_ahead_N_s(effective_ns))
        kinds: list[ThrusterState] = ["healthy"] * len(self._full_N)
        for thruster, verdict in self._failed.items():
            kinds[thruster] = verdict.kind
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
            given_impulse_N_s=vector(given[:3]),
            given_angular_impulse_N_m_s=vector(given[3:]),
        )

    def apply_command(self, command: WrenchCommand) -> None:
        """Takes what a command says beside its wrench: what the operator wants of thrusters, whether it flies freely."""
        shut, trusted = frozenset(command.isolated), frozenset(command.trusted)
        count = len(self._full_N)
        shut = frozenset(j for j in shut if j < count)
        for thruster in trusted - self._trusted:
            if self._failed.pop(thruster, None) is not None:
                self._valves.fail(thruster, None, 0)
        if shut != self._wanted_shut or trusted != self._trusted:
            self._watch.forget()
        self._wanted_shut, self._trusted = shut, trusted
        # With its latch armed it is about to touch, or does, and wants to be pushed by nothing.
        self._may_test = command.free and command.latch != "arm"
        if not command.free:
            self._free_since_ns = None
        elif self._free_since_ns is None:
            self._free_since_ns = command.sim_time_ns

    def fly(self, command: ActuatorCommand) -> ActuatorCommand:
        """The command with the pulses of the carrier periods that begin while it acts."""
        can_N = self._can_N()
        wrench = np.array([*command.force_N, *command.torque_N_m])
        try:
            thrusts = self._allocator.allocate(wrench, can_N).thrusts_N
        except RuntimeError as error:  # no reason to leave the mission: the next command is another problem
            self.events.append(("error", "no thrusts", str(error)))
            thrusts = np.zeros(len(can_N))
        begin_ns, isolated = command.effective_time_ns, self.isolated
        end_ns = self._timing.effective_ns(command.tick + 1)
        test = None
        if self._may_test and command.source == "command":
            suspects = self._suspects(begin_ns)
            test = self._proof.burn(begin_ns, suspects, can_N, thrusts, self._modulator.period_s)
        pulses = self._modulator.pulses(thrusts, can_N, begin_ns, end_ns, test)
        for p in pulses:
            self._valves.pulse(p.thruster, p.open_ns, p.close_ns)
        self._valves.set_shut(isolated, begin_ns)
        return msgspec.structs.replace(command, pulses=tuple(pulses), isolated=isolated)

    def drain_events(self) -> list[tuple[Level, str, str]]:
        """What has been found since the last call."""
        events, self.events = self.events, []
        return events
