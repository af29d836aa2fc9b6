# SPDX-License-Identifier: Apache-2.0
"""Decide when a chaser acts without commands of a controller, and what it does then. No I/O.

A free chaser flies the fallback (``fallback``). A chaser whose controller became silent while the
stack was being stopped goes on with it (``local_damping``). Other latched chasers, and those that
do not know their motion, fire nothing.
"""

from __future__ import annotations

from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import (
    ActuatorCommand,
    Odometry,
    Plan,
    TargetEstimate,
    WrenchCommand,
)
from chaserdock_protocol.scenario import FlightScenario

from .command_gate import autonomous_command, brake_command, damping_command
from .fallback import FallbackState, LastCommand, fallback_limits, fallback_wrench, next_state
from .local_damping import LocalDamping
from .outbox import Outbox


class FallbackControl:
    """Remember the last executed command, and replace commands that do not arrive.

    ``last``: plan and target estimate that belong to that command; they arrive before or after it.
    """

    def __init__(self, scenario: FlightScenario, number: int, outbox: Outbox) -> None:
        self._scenario, self._outbox = scenario, outbox
        self.last = LastCommand()
        self._last_tick = -1
        self._plan: Plan | None = None
        self._target: TargetEstimate | None = None
        self._commanded_ns: int | None = None
        self._was_detumbling = False
        self._state: FallbackState | None = None
        self._limits = fallback_limits(scenario, number)
        has_port = scenario.docking.port_of(number) is not None
        damps = has_port and scenario.chaser.actuation == "thrusters"
        self._damping = LocalDamping(scenario, number) if damps else None
        self._is_damping = False
        self._reported_missing = False  # in the current series of missing commands

    # -- commands that come ------------------------------------------------------------------------

    def add_plan(self, plan: Plan) -> bool:
        """Take a plan; return False if a newer one has arrived before."""
        if self._plan is not None and plan.tick < self._plan.tick:
            return False
        self._plan = plan
        if plan.tick == self._last_tick:  # the plan arrived after its command
            self.last = LastCommand(plan, self.last.target)
        return True

    def add_target(self, target: TargetEstimate) -> bool:
        """Take an estimate of the target; return False if a newer one has arrived before."""
        if self._target is not None and target.tick < self._target.tick:
            return False
        self._target = target
        if target.tick == self._last_tick:  # the estimate arrived after its command
            self.last = LastCommand(self.last.plan, target)
        return True

    def end(self, command: WrenchCommand) -> None:
        """End the fallback with a command that is executed, and remember it."""
        plan, target = self._plan, self._target
        self._reported_missing = False
        self._commanded_ns, self._last_tick = command.sim_time_ns, command.tick
        self._was_detumbling = command.mode == "detumble"
        self.last = LastCommand(
            plan if plan is not None and plan.tick == command.tick else None,
            target if target is not None and target.tick == command.tick else self.last.target,
        )
        if self._state is not None or self._is_damping:
            detail = f"tick {command.tick}"
            self._outbox.event("info", "fallback ends", detail, command.tick, command.sim_time_ns)
        self._state, self._is_damping = None, False
        if self._damping is not None:
            self._damping.reset()

    # -- commands that do not come -----------------------------------------------------------------

    def silence_ns(self, odometry: Odometry) -> int:
        """Return for how long no command was executed, or since the first odometry if none was."""
        if self._commanded_ns is None:
            self._commanded_ns = odometry.sim_time_ns
        return odometry.sim_time_ns - self._commanded_ns

    def report_missing(self, detail: str, odometry: Odometry) -> None:
        """Warn of the first in a series of missing commands."""
        if not self._reported_missing:
            self._outbox.warn("no command", detail, odometry.tick, odometry.sim_time_ns)
        self._reported_missing = True

    def command(
        self, odometry: Odometry, latched: bool, age_ns: int
    ) -> tuple[ActuatorCommand, Array | None]:
        """Return the chaser's own command, and thrusts (n,), N, where they replace an allocation.

        ``age_ns``: time since odometry was last measured.
        """
        effective_ns = self._scenario.timing.effective_ns(odometry.tick)
        body = self._scenario.chaser
        # Without recent odometry the motion is unknown and cannot be braked.
        stale = age_ns > self._scenario.controller.command_lifetime_s * 1e9
        if latched and not stale and self._was_detumbling and self._damping is not None:
            return self._damp(self._damping, odometry, effective_ns)
        if latched or stale:
            return brake_command(odometry, body, effective_ns, latched=True), None
        before = self._state
        state = next_state(before, odometry, effective_ns, self.last, self._limits)
        self._state = state
        if before is None or before.mode != state.mode:
            what = f"fallback: {state.mode}"
            self._outbox.warn(what, state.text(), odometry.tick, odometry.sim_time_ns)
        wrench = fallback_wrench(state, odometry, effective_ns, self.last, body)
        return autonomous_command(odometry, effective_ns, state.mode, wrench), None

    def _damp(
        self, damping: LocalDamping, odometry: Odometry, effective_ns: int
    ) -> tuple[ActuatorCommand, Array]:
        if not self._is_damping:
            detail = "stopping the stack by the chaser's own odometry"
            self._outbox.warn("fallback: brake", detail, odometry.tick, odometry.sim_time_ns)
        self._is_damping = True
        return damping_command(damping, odometry, effective_ns, self._scenario.chaser)
