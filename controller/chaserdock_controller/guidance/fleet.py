# SPDX-License-Identifier: Apache-2.0
"""What concerns several chasers: timeline, commands of one tick, and who blocks whom."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.docking_geometry import corridors_apart
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.planar import why_not_planar

from chaserdock_controller.interfaces import LogEntry

from . import command_validation as validation
from .chaser_machine import ChaserMachine
from .chaser_state import ChaserTick, CommandResult, PhaseChange
from .moves import MovePlanner
from .parameters import GUIDANCE
from .phases import ATTACHED, Phase, Trigger
from .thruster_commands import THRUSTER_COMMANDS


class ChaserFleet:
    """All ``chasers``, by number.

    ``changes``: their phase changes in this tick, in order. ``notes``: other log entries of it.
    ``left``: numbers of the entries of ``timeline``, which is in order of time, still to come.
    """

    def __init__(self, scenario: FlightScenario) -> None:
        self.scenario = scenario
        self.moves = MovePlanner(scenario)
        self.changes: list[PhaseChange] = []
        self.notes: list[LogEntry] = []
        numbers = range(len(scenario.chasers))
        self.chasers = tuple(ChaserMachine(scenario, i, self.changes) for i in numbers)
        self.timeline = sorted(scenario.timeline, key=lambda entry: entry.at_s)
        self.left = [k for k, entry in enumerate(self.timeline) if entry.port is None]
        self._pending_goals: dict[int, Array] = {}
        self._pending_inspections: set[int] = set()
        self._seen_s: float | None = None

    def others(self, chaser: ChaserMachine) -> Iterator[ChaserMachine]:
        """Return all chasers but one."""
        return (other for other in self.chasers if other is not chaser)

    def drain_events(self) -> tuple[LogEntry, ...]:
        """Return the log entries since the last call."""
        events: list[LogEntry] = [
            (c.level, f"chaser {c.chaser}: {c.phase} ({c.detail})") for c in self.changes
        ]
        events += self.notes
        self.changes.clear()
        self.notes.clear()
        return tuple(events)

    # -- the target's estimate ---------------------------------------------------------------------

    def miss_target(self, now_s: float, lost: bool) -> None:
        """React to an unknown pose of the target. If it is ``lost``, stop every chaser that moves
        relative to it; let chasers search that have waited for a while.
        """
        if lost:
            for chaser in self.chasers:
                chaser.lose_target(now_s)
        for chaser in self.chasers:
            if now_s - chaser.state.since_s >= GUIDANCE.search_after_s:
                chaser.fire(Trigger.TARGET_UNKNOWN, now_s)

    def follow_target(
        self, now_s: float, known: Sequence[ChaserTick], seen: bool, settled: bool
    ) -> None:
        """React to a known pose of the target.

        Interrupt and resume approaches by whether any chaser has ``seen`` it. Chasers that waited
        for it hold. Chasers that searched come when its motion is ``settled``.
        """
        self._seen_s = now_s if seen or self._seen_s is None else self._seen_s
        for chaser, tick in zip(self.chasers, known, strict=True):
            chaser.follow_sight(tick, now_s - self._seen_s)
        for chaser in self.chasers:
            chaser.fire(Trigger.TARGET_ACQUIRED, now_s)
        for chaser, tick in zip(self.chasers, known, strict=True):
            if settled and tick.own is not None:
                reason = "the target is found"
                chaser.fire(Trigger.TARGET_SETTLED, now_s, reason, tick.offset_m)

    # -- commands ----------------------------------------------------------------------------------

    def due_commands(self, now_s: float) -> list[OperatorCommand]:
        """Return the commands of the scenario's timeline that have become due since the last
        call. Beside an unknown target, a command waits for the map, for its chaser's port and for
        the way there, and so do later ones of the chaser.
        """
        out: list[OperatorCommand] = []
        waiting: set[int] = set()
        for k in tuple(self.left):
            entry = self.timeline[k]
            if entry.at_s > now_s + 1e-9:
                break
            commands = [
                OperatorCommand(
                    command=entry.command,  # type: ignore[arg-type]
                    chaser=chaser,
                    offset_m=entry.offset_m,
                    thruster=entry.thruster,
                )
                for chaser in entry.chasers
            ]
            if self.scenario.maps_target:
                waits = any(c.chaser in waiting or self._waits(c, now_s) for c in commands)
                waiting.update(entry.chasers)
                if waits:
                    continue
            self.left.remove(k)
            out += commands
        return out

    def _waits(self, command: OperatorCommand, now_s: float) -> bool:
        """Return whether a command of the timeline waits for the map, or for the chaser."""
        if command.command not in ("goto", "approach"):
            return False
        chaser = self.chasers[command.chaser]
        if validation.why_not_closed(self.scenario, chaser.sighted):
            return True
        if command.command == "approach":
            return chaser.phase in (Phase.SURVEY, Phase.GOTO)
        if command.offset_m is not None or chaser.phase is not Phase.SURVEY:
            return False
        entry_m = chaser.line.entry_m
        return chaser.port is None or bool(self.moves.why_not_past(chaser, entry_m, now_s))

    def apply(self, commands: Sequence[OperatorCommand], now_s: float) -> list[CommandResult]:
        """Execute or refuse the commands of one tick. All goals are known in advance, so that two
        chasers can swap places.
        """
        self._pending_inspections = {c.chaser for c in commands if c.command == "inspect"}
        self._pending_goals = {
            c.chaser: np.asarray(c.offset_m)
            for c in commands
            if c.command == "goto"
            and c.offset_m is not None
            and c.chaser < len(self.chasers)
            and not validation.why_not_offset(self.scenario, c.chaser, c.offset_m)
        }
        return [self._apply(c, now_s) for c in commands]

    def _apply(self, command: OperatorCommand, now_s: float) -> CommandResult:
        reason = (
            validation.why_unknown_chaser(command.chaser, len(self.chasers))
            or validation.why_stale(command, now_s)
            or why_not_planar(self.scenario, command.command, command.chaser, command.offset_m)
        )
        if reason:
            return CommandResult(False, reason)
        chaser = self.chasers[command.chaser]
        if command.command in THRUSTER_COMMANDS:
            return chaser.thrusters.command(command, now_s)
        return chaser.command(command, now_s)

    # -- who blocks whom ---------------------------------------------------------------------------

    def goals_besides(self, chaser: ChaserMachine) -> dict[int, Array]:
        """Return the goals (3,), TRF, of the other chasers after the commands of this tick."""
        return {
            other.number: self._pending_goals.get(other.number, other.state.move.goal_m)
            for other in self.others(chaser)
        }

    def inspects(self, chaser: ChaserMachine) -> bool:
        """Return whether a chaser flies around the target, or is commanded to in this tick."""
        return chaser.phase is Phase.INSPECT or chaser.number in self._pending_inspections

    def why_corridor_occupied(self, chaser: ChaserMachine) -> str:
        """Return which chaser blocks an approach to a port; empty if none does."""
        docking, active = self.scenario.docking, 0
        corridor = self.scenario.chaser.probe_reach_m, docking.entry_m
        clearance_m = docking.corridor_margin_m + self.scenario.limits.min_distance_chasers_m
        assert chaser.dock is not None
        for other in self.others(chaser):
            aligning = other.phase is Phase.ALIGN
            if other.dock is None or not (aligning or other.in_corridor()):
                continue
            active += other.phase not in ATTACHED
            if corridors_apart(chaser.dock.port, other.dock.port, *corridor) < clearance_m:
                return f"chaser {other.number} is in the way"
        return f"{active} are docking already" if active >= docking.at_once else ""
