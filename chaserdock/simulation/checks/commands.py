# SPDX-License-Identifier: Apache-2.0
"""Invariants of command: one commander, no stale commands, commands that are flown."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from chaserdock_models.arrays import Array, length
from chaserdock_protocol.leases import commander_of
from chaserdock_protocol.messages import ActuatorCommand, Plan, Tick, WrenchCommand

from .causes import FOLLOWING_S, IN_LATE_NETWORK
from .check import Check
from .messages import NO_AUTHORITY
from .reader import reads

KNOWN_AFTER_S = 0.1
"""Time (s), beyond the latency, after which a chaser that is not frozen knows a tick: ten times the
largest mean jitter that seeds draw (`swarm.py`). Larger: stale commands pass; smaller: jitter
fails.
"""
OPENED_TICKS = 200
"""Ticks whose opening times are kept: more than a frozen world opens at once when it continues."""
GAP_S = 1.1
"""Pause (s) of published commands after which the time to fly one starts again: 1 s, which a new
holder of leases has for its first command (docs/redundancy.md), plus a tick of 10 Hz.
"""
PLAN_SHARE = 1e-3
"""Largest difference of a command from its plan, as a share of the body's limits: above the
quantization of commands.
"""


@dataclass
class NoStaleCommand(Check):
    """Commands are flown in order, within `controller.command_lifetime_s` of the newest tick that
    has had ``KNOWN_AFTER_S`` to reach the chaser: a world that was frozen opens many at once."""

    name = "no stale command"

    _opened: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=OPENED_TICKS))
    _flown: dict[int, int] = field(default_factory=dict)

    def begin(self) -> None:
        s = self.scenario
        self._lifetime_ticks = math.ceil(s.controller.command_lifetime_s * s.time.rate_hz)

    @reads(Tick)
    def note_tick(self, tick: Tick) -> None:
        if self.view.opens_tick:
            self._opened.append((self.view.sent_s, tick.tick))

    @reads(ActuatorCommand)
    def judge(self, command: ActuatorCommand) -> None:
        if command.source != "command":
            return
        name, before = f"chaser/{command.chaser}", self._flown.get(command.chaser)
        self._flown[command.chaser] = command.tick
        age = self._known_tick() - command.tick
        if age > self._lifetime_ticks:
            self.violate(name, f"flies a command of {age} ticks ago")
        if before is not None and command.tick < before:
            self.violate(name, f"flies tick {command.tick} after {before}")

    def _known_tick(self) -> int:
        """Return the newest tick that should be known to the chasers by now."""
        network = self.scenario.simulation
        if network.mode == "lockstep":
            return self.view.tick
        sent_s = self.view.sent_s - network.latency_s - KNOWN_AFTER_S
        return next((tick for opened_s, tick in reversed(self._opened) if opened_s <= sent_s), -1)


@dataclass
class NoSupersededCommand(Check):
    """A chaser never flies an older term than before."""

    name = "no superseded command"

    _terms: dict[int, int] = field(default_factory=dict)

    @reads(ActuatorCommand)
    def judge(self, command: ActuatorCommand) -> None:
        if command.source != "command":
            return
        before = self._terms.get(command.chaser, command.term)
        self._terms[command.chaser] = command.term
        if command.term < before:
            self.violate(f"chaser/{command.chaser}", f"flies term {command.term} after {before}")


@dataclass
class OneCommander(Check):
    """No two chasers fly commands of different controllers for the same tick. No chaser flies a
    command of a lower term for a later tick than one of a higher term of the other controller."""

    name = "one commander"
    exceptions = ("in a tick in which a controller is lost: chasers may have flown its command",)

    _controllers: int = 0
    _controller_lost: set[int] = field(default_factory=set)
    _term_ticks: dict[int, tuple[int, int]] = field(default_factory=dict)
    """First and last tick for which commands of each term were flown."""

    @reads(Tick)
    def note_tick(self, tick: Tick) -> None:
        number = len(tick.controllers)
        if self.view.opens_tick:
            self._controllers = number
        elif tick.tick == self.view.tick and number < self._controllers:
            self._controller_lost.add(tick.tick)

    @reads(ActuatorCommand)
    def judge(self, command: ActuatorCommand) -> None:
        if command.source != "command":
            return
        name, term, tick = f"chaser/{command.chaser}", command.term, command.tick
        sender, other = commander_of(term), self.view.commanders[tick]
        if other != sender and tick not in self._controller_lost:
            text = f"flies a command of {sender} for tick {tick}, in which {other} commands"
            self.violate(name, text)

        # A repeated tick may have commands of both terms. A chaser that was lost may fly commands
        # late, but for their own ticks.
        first, last = self._term_ticks.get(term, (tick, tick))
        self._term_ticks[term] = min(first, tick), max(last, tick)
        for other_term, (from_tick, until_tick) in self._term_ticks.items():
            is_superseded = (other_term > term and from_tick < tick) or (
                other_term < term and tick < until_tick
            )
            if is_superseded and commander_of(other_term) != sender:
                span = f"from tick {from_tick} to {until_tick}"
                text = f"flies term {term} for tick {tick}; term {other_term} is flown {span}"
                self.violate(name, text)


@dataclass
class NoHandOverWithoutCause(Check):
    """Chasers pass from the commands of one controller to those of the other for a cause only."""

    name = "no hand-over without a cause"
    exceptions = (
        IN_LATE_NETWORK,
        "during a fault of any process (but a duplicate or a wrong sensor), a partition or a slow "
        f"reader, and {FOLLOWING_S:g} s after it",
    )

    _term: int = -1
    _last_tick: int = -1
    """Highest term of flown commands, and the last tick of it."""

    @reads(ActuatorCommand)
    def judge(self, command: ActuatorCommand) -> None:
        term, before = command.term, self._term
        if command.source != "command" or term < before:
            return
        if term == before:
            self._last_tick = max(self._last_tick, command.tick)
            return
        is_first, is_later = before < 0, command.tick > self._last_tick
        self._term, self._last_tick = term, command.tick
        if is_first or not is_later or commander_of(term) == commander_of(before):
            return
        if not self.view.causes.hands_over(self.view.time_s):
            text = f"flies term {term} after term {before}, but nothing disturbed its controller"
            self.violate(f"chaser/{command.chaser}", text)


@dataclass
class CommandsAreFlown(Check):
    """A chaser for which commands are published flies one at least every ``FOLLOWING_S``."""

    name = "commands are flown"
    exceptions = (
        "during a fault of its own, of the world or of a controller",
        "during a partition, or while a process reads slowly",
    )

    _commanded: dict[int, int] = field(default_factory=dict)
    """Newest tick for which each chaser was commanded."""
    _since: dict[int, int] = field(default_factory=dict)
    """Tick since which each chaser has to fly a command: that of the last one that it flew, or the
    first after a break of commands.
    """

    def begin(self) -> None:
        self._gap = math.ceil(GAP_S * self.scenario.time.rate_hz)

    @reads(WrenchCommand)
    def note_command(self, command: WrenchCommand) -> None:
        if command.mode in ("wait", "yield"):
            return  # of a controller that does not command
        i, newest = command.chaser, self._commanded.get(command.chaser, -self._gap)
        if command.mode == "none" or command.tick - newest > self._gap:
            self._since[i] = command.tick
        self._commanded[i] = max(command.tick, self._commanded.get(i, -1))

    @reads(ActuatorCommand)
    def judge(self, command: ActuatorCommand) -> None:
        i, tick, rate_hz = command.chaser, self.view.tick, self.scenario.time.rate_hz
        if command.source == "command":
            self._since[i] = tick
            return
        name, now_s = f"chaser/{i}", tick / rate_hz
        since_s = self._since.get(i, tick) / rate_hz
        since_s = max(since_s, self.view.causes.keep_commands_until_s(name, now_s))
        is_commanded = self._commanded.get(i, -1) >= tick - self._gap
        if is_commanded and now_s - since_s > FOLLOWING_S:
            waited = f"has flown no command for {now_s - since_s:.1f} s"
            self.violate(name, f"{waited}, but commands are published")


@dataclass
class ThrustersOpen(Check):
    """With thrusters, one of them opens before the force commanded since the last
    pulse gives more than all thrusters in one carrier period."""

    name = "commands are flown"
    exceptions = ("a chaser that has isolated thrusters",)

    _waiting_N_s: dict[int, tuple[int, Array]] = field(default_factory=dict)
    """Impulse (3,) commanded to each chaser since its last pulse, and the tick until which."""

    @reads(ActuatorCommand)
    def judge(self, command: ActuatorCommand) -> None:
        body, i = self.scenario.chaser, command.chaser
        if command.pulses or command.isolated or body.actuation != "thrusters":
            self._waiting_N_s.pop(i, None)
            return
        counted, total_N_s = self._waiting_N_s.get(i, (-1, np.zeros(3)))
        if command.tick == counted:
            return  # a copy, or the second command of a tick
        total_N_s = total_N_s + np.array(command.force_N) / self.scenario.time.rate_hz
        self._waiting_N_s[i] = command.tick, total_N_s
        waiting_N_s = length(total_N_s)
        if waiting_N_s > sum(t.thrust_N for t in body.thrusters) / body.modulation.carrier_hz:
            text = f"opens no thruster, although {waiting_N_s:.2g} N s are commanded"
            self.violate(f"chaser/{i}", text)


@dataclass
class PlanIsFlown(Check):
    """A command of the NMPC is its plan's input at the time from which it acts."""

    name = "plan is flown"

    _plans: dict[int, Plan] = field(default_factory=dict)

    @reads(Plan)
    def note_plan(self, plan: Plan) -> None:
        self._plans[plan.chaser] = plan

    @reads(WrenchCommand)
    def judge(self, command: WrenchCommand) -> None:
        plan = self._plans.get(command.chaser)
        if command.mode != "nmpc" or plan is None or plan.tick != command.tick:
            return
        acts_after_s = (command.effective_time_ns - plan.sim_time_ns) / 1e9
        stage = int(acts_after_s / plan.step_s + 1e-9)
        if not 0 <= stage < len(plan.inputs) // 6:
            return
        planned = plan.inputs[6 * stage : 6 * stage + 6]
        limits = np.maximum(self.scenario.chaser.wrench_max, NO_AUTHORITY)
        error = np.abs(np.array([*command.force_N, *command.torque_N_m]) - planned) / limits
        if float(error.max()) > PLAN_SHARE:
            text = f"differs from its plan by {error.max():.2e} of the limits"
            self.violate(f"chaser/{command.chaser}", text)
