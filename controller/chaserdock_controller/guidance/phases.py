"""What each chaser is doing, and where in TRF it is therefore to be. No I/O; time is given.

Phases: ``acquire`` (the target has not been found), ``searching`` (it looks about for it), ``hold``, ``calibrate``
(turns about, watching the target, which shows how its camera is mounted), ``approach`` (the offset shrinks along its
own line to the docking distance, the relative attitude kept, as in the paper, but at a bounded speed), ``docked`` (within
the docking tolerances for long enough), ``retreat`` and ``abort`` (back to the nominal offset), ``goto``. Where docking
ends by capture, an approach goes through the phases of ``capture`` instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from chaserdock_protocol.messages import Latch, OperatorCommand
from chaserdock_protocol.scenario import Scenario
from numpy.typing import ArrayLike, NDArray

from . import loss_of_sight as vision
from .approach_cone import Cone, cone_of
from .chaser_state import Answer, ChaserGuidance
from .command_validation import why_not_along, why_not_calibrate, why_not_goto, why_not_there, why_stale
from .docking import (
    HOLDING_ON,
    IN_CORRIDOR,
    Senses,
    Situation,
    corridors_apart,
    dock_of,
    next_phase,
    pull_N,
    why_not_approach,
)
from .pointing import CALIBRATION_S, calibration_turns
from .trajectories import Motion, glide, move_to, stay, stop

Array = NDArray[np.float64]

_ABORT_HASTE = 2.0
_SEARCH_AFTER_S = 1.0
"""So long a chaser waits for the target to be seen before it looks about."""
_GOTO_SPEED = 2.0
CALIBRATED = "the manoeuvre is over"
# Who docks at a distance may plan to come so much nearer than that; who is so far outside its corridor has left it.
_HELD_MARGIN_M = 0.03
_OUTSIDE_M = 0.02


class Guidance:
    """All chasers' phases. ``events`` collects (chaser, what, detail) until drained."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self.events: list[tuple[int, str, str]] = []
        self.chasers = [ChaserGuidance("acquire", 0.0, stay(c.position_m, 0.0)) for c in scenario.chasers]
        self._leaving: dict[int, Array] = {}
        self._docks = [dock_of(scenario, i) for i in range(len(scenario.chasers))]
        self._cones = [cone_of(scenario, i) for i in range(len(scenario.chasers))]
        self._sensed: dict[int, Senses] = {}
        self._places: dict[int, Array] = {}
        self._done: dict[int, tuple[float, OperatorCommand]] = {}
        self._due = sorted(scenario.timeline, key=lambda entry: entry.at_s)
        self._seen_s: float | None = None
        self._blind: set[int] = set()

    def found(self, now_s: float) -> None:
        """The target is known: everyone who waited for that holds."""
        for i, c in enumerate(self.chasers):
            if c.phase == "acquire":
                self._enter(i, "hold", now_s, c.move)

    def search(self, now_s: float) -> None:
        """Nobody knows where the target is: whoever has waited for a while looks about."""
        for i, c in enumerate(self.chasers):
            if c.phase in ("acquire", "hold") and now_s - c.since_s >= _SEARCH_AFTER_S:
                self._enter(i, "searching", now_s, c.move)

    def follow(self, i: int, now_s: float, offset_m: Array) -> None:
        """The target's motion is known well enough to fly by: a chaser that searched, and is at ``offset_m`` (3,) TRF,
        goes to its nominal offset, facing the target all the way."""
        if self.chasers[i].phase != "searching":
            return
        speed = self._scenario.approach.max_speed_m_s * _GOTO_SPEED
        move = move_to(stay(offset_m, now_s), self._scenario.chasers[i].position_m, now_s, speed)
        self._enter(i, "goto", now_s, move, why="the target is found")
        self.chasers[i] = replace(self.chasers[i], faces=True)

    def turns(self, i: int, times_s: ArrayLike) -> Array | None:
        """Rotations (K, 4) of a chaser's body away from its reference attitude at times (K,); None for none."""
        c = self.chasers[i]
        if c.phase != "calibrate":
            return None
        return calibration_turns(np.asarray(times_s, dtype=float) - c.since_s)

    def lost(self, now_s: float) -> None:
        """The target is not known any more: whoever moved relative to it stops there."""
        for i, c in enumerate(self.chasers):
            if self._docks[i] is not None and c.phase in IN_CORRIDOR:
                self._back_out(i, "retreat", now_s, "the target is lost")
            elif c.phase in ("approach", "retreat", "goto", "abort", "calibrate"):
                self._enter(i, "hold", now_s, stop(c.move, now_s))

    def watch(self, now_s: float, seen: bool) -> None:
        """Whoever comes nearer to a target that nobody sees any more (``seen``: somebody does) stops that: ``vision``."""
        self._seen_s = now_s if seen or self._seen_s is None else self._seen_s
        unseen_s = now_s - self._seen_s
        for i, c in enumerate(self.chasers):
            instead = vision.on_loss(c.phase, self._docks[i] is not None, unseen_s)
            if instead == "back off":
                self._back_out(i, "retreat", now_s, vision.BLIND)
            elif instead == "hold":
                self._enter(i, "hold", now_s, stop(c.move, now_s), why=vision.BLIND)
                self._blind.add(i)
            elif vision.goes_on(c.phase, i in self._blind, unseen_s):
                move = move_to(c.move, self.dock_offset(i), now_s, self._scenario.approach.max_speed_m_s)
                self._enter(i, "approach", now_s, move, why=vision.SEEN)
            if self.chasers[i].phase != "hold":
                self._blind.discard(i)

    def due_commands(self, now_s: float) -> list[OperatorCommand]:
        """Commands of the scenario's time line that have come due since the last call."""
        out = []
        while self._due and self._due[0].at_s <= now_s + 1e-9:
            entry = self._due.pop(0)
            for chaser in entry.chasers:
                wish = {"command": entry.command, "offset_m": entry.offset_m, "thruster": entry.thruster}
                out.append(OperatorCommand(chaser=chaser, **wish))
        return out

    def expect(self, commands: Sequence[OperatorCommand]) -> None:
        """What one tick asks for together: a chaser may be sent to where another is being sent away from."""
        self._leaving = {
            c.chaser: np.asarray(c.offset_m)
            for c in commands
            if c.command == "goto"
            and c.offset_m is not None
            and not why_not_there(self._scenario, c.offset_m)
        }

    def command(self, command: OperatorCommand, now_s: float) -> Answer:
        """Does what an operator or the time line asks for, or says why not.

        Of different commands to a chaser in one tick the first counts, but an abort always does.
        """
        i, what = command.chaser, command.command
        if i >= len(self.chasers):
            return Answer(False, f"there is no chaser {i}; this mission has 0 to {len(self.chasers) - 1}")
        if late := why_stale(command, now_s):
            return Answer(False, late)
        if self.chasers[i].phase in ("acquire", "searching"):
            return Answer(False, "the target has not been found yet")
        done_s, done = self._done.get(i, (-math.inf, command))
        differs = (done.command, done.offset_m) != (what, command.offset_m)
        if done_s == now_s and differs and what != "abort":
            whose = f" by {done.operator}" if done.operator else ""
            return Answer(False, f"{done.command}{whose} came first in this tick")
        answer = self._obey(command, now_s)
        if answer.accepted:
            self._done[i] = now_s, command
        return answer

    def _obey(self, command: OperatorCommand, now_s: float) -> Answer:
        i, what = command.chaser, command.command
        self._blind.discard(i)  # what was asked for before does not come back by itself
        c, dock = self.chasers[i], self._docks[i]
        approaching = ("docked",) if dock is None else ("wait", *IN_CORRIDOR, *HOLDING_ON)
        if what != "goto" and (what == c.phase or (what == "approach" and c.phase in approaching)):
            return Answer(True, f"already in phase {c.phase}")
        if dock is not None and what in ("hold", "goto") and c.phase in ("contact", *HOLDING_ON):
            return Answer(False, f"in phase {c.phase} it can only retreat or abort")
        if dock is not None and what == "goto" and self.in_corridor(i):
            return Answer(False, "it is in its corridor: retreat or abort first")
        speed = self._scenario.approach.max_speed_m_s
        match what:
            case "hold":
                move = stay(self._sensed[i].offset_m, now_s) if self.in_corridor(i) else stop(c.move, now_s)
                self._enter(i, "hold", now_s, move)
            case "approach" if dock is not None:
                if reason := why_not_approach(dock, c.move.at(np.array([now_s]))[0][0]):
                    return Answer(False, reason)
                taken = self._corridor_taken(i)
                if taken:
                    self._enter(i, "wait", now_s, stop(c.move, now_s), why=taken)
                else:
                    self._align(i, now_s, 1)
            case "approach" if reason := why_not_along(self._scenario, i, c.move.at(np.array([now_s]))[0][0]):
                return Answer(False, reason)
            case "approach":
                self._enter(i, "approach", now_s, move_to(c.move, self.dock_offset(i), now_s, speed))
            case "retreat" | "abort":
                self._back_out(i, what, now_s)
            case "calibrate" if reason := why_not_calibrate(self._scenario, c.phase, c.move.over_at(now_s)):
                return Answer(False, reason)
            case "calibrate":
                self._enter(i, "calibrate", now_s, c.move)
            case "goto":
                nominal = self._scenario.chasers[i].position_m
                offset = np.asarray(command.offset_m if command.offset_m is not None else nominal)
                if reason := self._why_not_goto(i, command.offset_m):
                    return Answer(False, reason)
                self._enter(i, "goto", now_s, move_to(c.move, offset, now_s, speed * _GOTO_SPEED))
        return Answer(True, f"phase {self.chasers[i].phase}")

    def _back_out(self, i: int, phase: str, now_s: float, why: str = "", then: str = "nominal") -> None:
        """To the nominal offset; out of a corridor first along its axis, from where the chaser is."""
        c, dock = self.chasers[i], self._docks[i]
        speed = self._scenario.approach.max_speed_m_s * (_ABORT_HASTE if phase == "abort" else 1.0)
        if dock is None or not self.in_corridor(i):
            nominal = self._scenario.chasers[i].position_m
            self._enter(i, phase, now_s, move_to(c.move, nominal, now_s, speed), why=why)
            return
        entry = dock.offset(dock.docking.entry_m)
        move = move_to(stay(self._sensed[i].offset_m, now_s), entry, now_s, speed)
        self._enter(i, phase, now_s, move, why=why, then=then)

    def _align(self, i: int, now_s: float, attempt: int) -> None:
        dock = self._docks[i]
        assert dock is not None
        speed = self._scenario.approach.max_speed_m_s * _GOTO_SPEED
        move = move_to(self.chasers[i].move, dock.offset(dock.docking.entry_m), now_s, speed)
        self._enter(i, "align", now_s, move, attempt=attempt)

    def is_free(self, i: int) -> bool:
        """Whether nothing holds or touches a chaser, as far as its docking sensor says."""
        felt = self._sensed.get(i)
        return felt is None or not (felt.contact or felt.latched)

    def in_corridor(self, i: int) -> bool:
        """Whether a chaser is in its corridor or at its port, by its phase or by where it is."""
        c, dock = self.chasers[i], self._docks[i]
        if dock is None or i not in self._sensed:
            return False
        return c.phase in ("approach", "final", "contact", *HOLDING_ON) or dock.inside(
            self._sensed[i].offset_m
        )

    def placed(self, i: int, offset_m: Array) -> None:
        """Where a chaser is by estimate: its centre (3,) in TRF."""
        self._places[i] = offset_m

    def corridor(self, i: int) -> Cone | None:
        """The cone in which a chaser on its way in or out is planned; it has one only while it is inside.

        One that docks at a distance has it from the command on, and on its way out until it is at the distance that
        everybody keeps.
        """
        place, dock = self._places.get(i), self._docks[i]
        if place is None or self.chasers[i].phase in HOLDING_ON:
            return None
        if dock is None:
            near = float(np.linalg.norm(place)) < self._scenario.limits.min_distance_target_m
            wanted = near or self.chasers[i].phase in ("approach", "docked")
        else:
            wanted = self.in_corridor(i)
        return self._cones[i] if wanted and self._cones[i].room_m(place) > -_OUTSIDE_M else None

    def min_distance_target_m(self, i: int) -> float:
        """How near to the target a chaser may plan to come; 0, any distance, when it holds on to it."""
        limit, dock = self._scenario.limits.min_distance_target_m, self._docks[i]
        if dock is None:
            docked_m = max(0.0, self._scenario.approach.dock_distance_m - _HELD_MARGIN_M)
            return min(limit, docked_m) if self.corridor(i) is not None else limit
        if not self.in_corridor(i):
            return limit
        return 0.0 if self.chasers[i].phase in HOLDING_ON else min(limit, dock.keep_out_m())

    def latch(self, i: int) -> Latch:
        """What a chaser's latch is told: armed from the final approach on, open before and when backing out."""
        if self._docks[i] is None:
            return "keep"
        return "arm" if self.chasers[i].phase in ("final", "contact", *HOLDING_ON) else "release"

    def pull_N(self, i: int, now_s: float) -> float:
        """Force along -X, CRF, that the test of a latch asks of its chaser now."""
        c = self.chasers[i]
        return pull_N(self._scenario.docking, now_s - c.since_s) if c.phase == "latched" else 0.0

    def _corridor_taken(self, i: int) -> str:
        """Who is in the way of an approach, in words; empty when nobody is."""
        mine, docking, flying = self._docks[i], self._scenario.docking, 0
        assert mine is not None
        for j, other in enumerate(self._docks):
            if j == i or other is None or not (self.chasers[j].phase == "align" or self.in_corridor(j)):
                continue
            flying += self.chasers[j].phase not in HOLDING_ON
            if corridors_apart(mine, other) < docking.clearance_m:
                return f"chaser {j} is in the way"
        return f"{flying} are under way already" if flying >= docking.at_once else ""

    def _why_not_goto(self, i: int, offset_m: ArrayLike | None) -> str:
        ends = {j: self._leaving.get(j, c.move.goal_m) for j, c in enumerate(self.chasers) if j != i}
        return why_not_goto(self._scenario, offset_m, ends)

    def dock_offset(self, i: int) -> Array:
        """Where in TRF a docked chaser's centre is, (3,)."""
        nominal = np.asarray(self._scenario.chasers[i].position_m)
        return nominal / np.linalg.norm(nominal) * self._scenario.approach.dock_distance_m

    def observe(self, i: int, now_s: float, position_error_m: float, angle_error_rad: float) -> None:
        """Advances a chaser's phase by its estimated errors from the reference pose."""
        c, approach = self.chasers[i], self._scenario.approach
        if c.phase == "calibrate" and now_s - c.since_s >= CALIBRATION_S:
            self._enter(i, "hold", now_s, c.move, why=CALIBRATED)
        elif c.phase in ("retreat", "abort", "goto") and c.move.over_at(now_s):
            if c.then == "align":
                self._align(i, now_s, c.attempt + 1)
            elif c.then == "nominal":
                nominal, speed = self._scenario.chasers[i].position_m, approach.max_speed_m_s
                haste = _ABORT_HASTE if c.phase == "abort" else 1.0
                move = move_to(c.move, nominal, now_s, speed * haste)
                self.chasers[i] = replace(c, move=move, then="")
            else:
                self._enter(i, "hold", now_s, c.move)
                self.chasers[i] = replace(self.chasers[i], faces=False)
        elif self._docks[i] is None and c.phase in ("approach", "docked") and c.move.over_at(now_s):
            inside = position_error_m <= approach.docked_position_m and angle_error_rad <= math.radians(
                approach.docked_angle_deg
            )
            since = (c.inside_since_s if c.inside_since_s is not None else now_s) if inside else None
            self.chasers[i] = ChaserGuidance(c.phase, c.since_s, c.move, since, faces=c.faces)
            if c.phase == "approach" and since is not None and now_s - since >= approach.docked_time_s:
                self._enter(i, "docked", now_s, c.move, since)
            elif c.phase == "docked" and since is None:
                self._enter(i, "approach", now_s, c.move)

    def sense(self, i: int, now_s: float, senses: Senses) -> None:
        """Advances a chaser's phase by what is known of it at its port; only where it is captured."""
        self._sensed[i] = senses
        c, dock = self.chasers[i], self._docks[i]
        if dock is None:
            return
        if c.phase == "wait":
            if not self._corridor_taken(i):
                self._align(i, now_s, 1)
            return
        docking = dock.docking
        if c.phase == "align":
            inside = not senses.view.fault(docking.corridor, docking.corridor.closing_m_s)
            since = (c.inside_since_s if c.inside_since_s is not None else now_s) if inside else None
            c = replace(c, inside_since_s=since)
        elif c.phase == "latched" and c.held is None and now_s - c.since_s >= docking.settle_s:
            c = replace(c, held=(senses.offset_m, senses.q_wxyz))
        self.chasers[i] = c
        gap = dock.place_of(c.move.at(np.array([now_s]))[0][0])[0]
        inside_s = 0.0 if c.inside_since_s is None else now_s - c.inside_since_s
        over = c.move.over_at(now_s)
        follows = next_phase(
            docking, Situation(c.phase, now_s - c.since_s, over, gap, inside_s, c.held), senses
        )
        if follows is None:
            return
        phase, why = follows
        match phase:
            case "retreat":
                again = c.attempt < docking.attempts and c.phase not in HOLDING_ON
                self._back_out(i, phase, now_s, why, "align" if again else "nominal")
            case "approach":
                fast = (docking.entry_m - docking.final_m, docking.approach_speed_m_s)
                slow = (docking.final_m + docking.overdrive_m, docking.contact_speed_m_s)
                inward = -np.asarray(dock.port.axis)
                move = glide(dock.offset(docking.entry_m), inward, now_s, fast, slow)
                self._enter(i, phase, now_s, move, why=why, attempt=c.attempt)
            case "latched":
                self._enter(i, phase, now_s, stay(senses.offset_m, now_s), why=why, attempt=c.attempt)
            case _:
                self._enter(i, phase, now_s, c.move, why=why, attempt=c.attempt)

    def _enter(
        self,
        i: int,
        phase: str,
        now_s: float,
        move: Motion,
        inside_since_s: float | None = None,
        why: str = "",
        then: str = "",
        attempt: int | None = None,
    ) -> None:
        before = self.chasers[i]
        number = before.attempt if attempt is None else attempt
        self.chasers[i] = ChaserGuidance(phase, now_s, move, inside_since_s, then, number, faces=before.faces)
        if phase != before.phase:
            self.events.append((i, phase, f"from {before.phase}" + (f": {why}" if why else "")))

    def drain_events(self) -> list[tuple[int, str, str]]:
        """Phase changes since the last call."""
        events, self.events = self.events, []
        return events
