"""What each chaser is doing, and where in TRF it is therefore to be. No I/O; time is given.

Phases: ``acquire`` (the target has not been found), ``hold``, ``approach`` (the offset shrinks along its own line to
the docking distance, the relative attitude kept, as in the paper, but at a bounded speed), ``docked`` (within
the docking tolerances for long enough), ``retreat`` and ``abort`` (back to the nominal offset), ``goto``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import Scenario
from numpy.typing import ArrayLike, NDArray

from .moves import Move, move_to, stay, stop

Array = NDArray[np.float64]

_ABORT_HASTE = 2.0
_GOTO_SPEED = 2.0


@dataclass(frozen=True)
class ChaserGuidance:
    """One chaser: its phase since ``since_s``, the motion of its reference in TRF, how long it has been in place."""

    phase: str
    since_s: float
    move: Move
    inside_since_s: float | None = None


@dataclass(frozen=True)
class Answer:
    """To a command: accepted or not, and why."""

    accepted: bool
    reason: str


class Guidance:
    """All chasers' phases. ``events`` collects (chaser, what, detail) until drained."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self.events: list[tuple[int, str, str]] = []
        self.chasers = [ChaserGuidance("acquire", 0.0, stay(c.position_m, 0.0)) for c in scenario.chasers]
        self._leaving: dict[int, Array] = {}
        self._due = sorted(scenario.timeline, key=lambda entry: entry.at_s)

    def found(self, now_s: float) -> None:
        """The target is known: everyone who waited for that holds."""
        for i, c in enumerate(self.chasers):
            if c.phase == "acquire":
                self._enter(i, "hold", now_s, c.move)

    def lost(self, now_s: float) -> None:
        """The target is not known any more: whoever moved relative to it stops there."""
        for i, c in enumerate(self.chasers):
            if c.phase in ("approach", "retreat", "goto", "abort"):
                self._enter(i, "hold", now_s, stop(c.move, now_s))

    def due_commands(self, now_s: float) -> list[OperatorCommand]:
        """Commands of the scenario's time line that have come due since the last call."""
        out = []
        while self._due and self._due[0].at_s <= now_s + 1e-9:
            entry = self._due.pop(0)
            for chaser in entry.chasers:
                wish = OperatorCommand(
                    command=entry.command, chaser=chaser, offset_m=entry.offset_m, jet=entry.jet
                )
                out.append(wish)
        return out

    def expect(self, commands: Sequence[OperatorCommand]) -> None:
        """What one tick asks for together: a chaser may be sent to where another is being sent away from."""
        self._leaving = {
            c.chaser: np.asarray(c.offset_m)
            for c in commands
            if c.command == "goto" and c.offset_m is not None and not self._why_not_there(c.offset_m)
        }

    def command(self, command: OperatorCommand, now_s: float) -> Answer:
        """Does what an operator or the time line asks for, or says why not."""
        i, what = command.chaser, command.command
        if i >= len(self.chasers):
            return Answer(False, f"there is no chaser {i}; this mission has 0 to {len(self.chasers) - 1}")
        c = self.chasers[i]
        if c.phase == "acquire":
            return Answer(False, "the target has not been found yet")
        if what != "goto" and (what == c.phase or (what == "approach" and c.phase == "docked")):
            return Answer(True, f"already in phase {c.phase}")
        speed = self._scenario.approach.max_speed_m_s
        nominal = np.asarray(self._scenario.chasers[i].position_m)
        match what:
            case "hold":
                self._enter(i, "hold", now_s, stop(c.move, now_s))
            case "approach":
                if reason := self._why_not_approach(i, now_s):
                    return Answer(False, reason)
                self._enter(i, "approach", now_s, move_to(c.move, self.dock_offset(i), now_s, speed))
            case "retreat":
                self._enter(i, "retreat", now_s, move_to(c.move, nominal, now_s, speed))
            case "abort":
                self._enter(i, "abort", now_s, move_to(c.move, nominal, now_s, speed * _ABORT_HASTE))
            case "goto":
                offset = np.asarray(command.offset_m if command.offset_m is not None else nominal)
                if reason := self._why_not_goto(i, command, offset):
                    return Answer(False, reason)
                self._enter(i, "goto", now_s, move_to(c.move, offset, now_s, speed * _GOTO_SPEED))
        return Answer(True, f"phase {self.chasers[i].phase}")

    def _why_not_approach(self, i: int, now_s: float) -> str:
        position = self.chasers[i].move.at(np.array([now_s]))[0][0]
        nominal = np.asarray(self._scenario.chasers[i].position_m)
        along = float(position @ nominal) / math.hypot(*nominal)
        aside = math.sqrt(max(0.0, float(position @ position) - along * along))
        if along <= 0.0 or aside > 0.1:
            return f"its reference is {aside:.2f} m beside its approach line; retreat or goto first"
        return ""

    def _why_not_goto(self, i: int, command: OperatorCommand, offset: Array) -> str:
        if command.offset_m is None:
            return "goto needs an offset"
        if reason := self._why_not_there(offset):
            return reason
        for j, other in enumerate(self.chasers):
            apart = float(np.linalg.norm(self._leaving.get(j, other.move.goal_m) - offset))
            if j != i and apart < self._scenario.limits.min_distance_chasers_m:
                return f"the offset is {apart:.3g} m from where chaser {j} is to be"
        return ""

    def _why_not_there(self, offset_m: ArrayLike) -> str:
        distance = float(np.linalg.norm(offset_m))
        nearest = self._scenario.limits.min_distance_target_m
        if not nearest < distance <= self._scenario.limits.max_reference_distance_m:
            return f"the offset is {distance:.3g} m from the target; allowed are more than {nearest:.3g} m"
        return ""

    def dock_offset(self, i: int) -> Array:
        """Where in TRF a docked chaser's centre is, (3,)."""
        nominal = np.asarray(self._scenario.chasers[i].position_m)
        return nominal / np.linalg.norm(nominal) * self._scenario.approach.dock_distance_m

    def observe(self, i: int, now_s: float, position_error_m: float, angle_error_rad: float) -> None:
        """Advances a chaser's phase by its estimated errors from the reference pose."""
        c, approach = self.chasers[i], self._scenario.approach
        if c.phase in ("retreat", "abort", "goto") and c.move.over_at(now_s):
            self._enter(i, "hold", now_s, c.move)
        elif c.phase in ("approach", "docked") and c.move.over_at(now_s):
            inside = position_error_m <= approach.docked_position_m and angle_error_rad <= math.radians(
                approach.docked_angle_deg
            )
            since = (c.inside_since_s if c.inside_since_s is not None else now_s) if inside else None
            self.chasers[i] = ChaserGuidance(c.phase, c.since_s, c.move, since)
            if c.phase == "approach" and since is not None and now_s - since >= approach.docked_time_s:
                self._enter(i, "docked", now_s, c.move, since)
            elif c.phase == "docked" and since is None:
                self._enter(i, "approach", now_s, c.move)

    def _enter(
        self, i: int, phase: str, now_s: float, move: Move, inside_since_s: float | None = None
    ) -> None:
        before = self.chasers[i].phase
        self.chasers[i] = ChaserGuidance(phase, now_s, move, inside_since_s)
        if phase != before:
            self.events.append((i, phase, f"from {before}"))

    def drain_events(self) -> list[tuple[int, str, str]]:
        """Phase changes since the last call."""
        events, self.events = self.events, []
        return events
