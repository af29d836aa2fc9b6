# SPDX-License-Identifier: Apache-2.0
"""State machine of every chaser: phase, and motion of the reference position in TRF. No I/O; time
is an argument.

Phases and transitions: ``phases``. Every phase change looks up its target in the transition table.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from chaserdock_models.arrays import Array, length
from chaserdock_protocol.messages import Latch, OperatorCommand
from chaserdock_protocol.scenario import FlightScenario
from numpy.typing import ArrayLike

from chaserdock_controller.nmpc.plan_monitor import PlanningFailure

from . import command_validation as validation
from .approach_cone import Cone, cone_of
from .chaser_state import ChaserGuidance, CommandResult, NextMove, PhaseChange
from .docking import (
    Dock,
    DockingObservation,
    PhaseProgress,
    corridors_apart,
    dock_of,
    docking_trigger,
    pull_N,
    why_not_approach,
)
from .escape import EscapePlanner
from .phases import (
    APPROACHING,
    ATTACHED,
    DETUMBLING,
    Phase,
    Trigger,
    next_phase,
    permitted_commands,
    trigger_of,
)
from .pointing import CALIBRATION_S, calibration_turns
from .trajectories import Circuit, Escape, Motion, circuit, glide, move_to, stay, stop

_ABORT_SPEED_FACTOR = 2.0
_GOTO_SPEED_FACTOR = 2.0
_SEARCH_AFTER_S = 1.0
_REST_S = 0.5
"""Time for which a stack must be below its limits to count as stopped."""
_MOVING_S = 0.2
"""Time for which a stopped stack must move to be stopped again; it drifts meanwhile."""
_SETTLING_S = 0.5
"""Time after the last thrust in which the mean motion of the stack is still late."""
_SIGHT_LOSS_S = 3.0
"""An approach stops when no chaser has seen the target for this long."""
_HELD_MARGIN_M = 0.03
"""A chaser that docks at a distance may be planned this much nearer than that distance."""
_RELEASE_S = 1.0
"""A latch that is closed for this long after the command to release it does not open."""
_OUTSIDE_M = 0.02
"""A chaser this far outside of its cone is planned without it."""


class PhaseMachine:
    """Phases of all chasers (``chasers``, by number)."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario = scenario
        self._changes: list[PhaseChange] = []
        self.chasers = [
            ChaserGuidance(Phase.ACQUIRE, 0.0, stay(c.position_m, 0.0)) for c in scenario.chasers
        ]
        self._pending_goals: dict[int, Array] = {}
        self._pending_inspections: set[int] = set()
        self._docks = [dock_of(scenario, i) for i in range(len(scenario.chasers))]
        self._cones = [cone_of(scenario, i) for i in range(len(scenario.chasers))]
        self._observed: dict[int, DockingObservation] = {}
        self._positions: dict[int, Array] = {}
        self._last_commands: dict[int, tuple[float, OperatorCommand]] = {}
        self._timeline = sorted(scenario.timeline, key=lambda entry: entry.at_s)
        self._seen_s: float | None = None
        self._interrupted: set[int] = set()
        self._planning_failures: dict[int, PlanningFailure] = {}
        self._detumble_refusal = ""
        self.escapes: EscapePlanner | None = None
        if scenario.limits.passive_safety == "enforce":
            speed = scenario.approach.max_speed_m_s * _ABORT_SPEED_FACTOR
            self.escapes = EscapePlanner(scenario, speed)

    # -- the target's estimate ---------------------------------------------------------------------

    def target_acquired(self, now_s: float) -> None:
        """Let every chaser in ``acquire`` hold: the target's pose is known."""
        for i, c in enumerate(self.chasers):
            self._transition(i, Trigger.TARGET_ACQUIRED, now_s, c.move)

    def target_unknown(self, now_s: float) -> None:
        """Start the search with every chaser that has waited for the target's pose for a second."""
        for i, c in enumerate(self.chasers):
            if now_s - c.since_s >= _SEARCH_AFTER_S:
                self._transition(i, Trigger.TARGET_UNKNOWN, now_s, c.move)

    def target_settled(self, i: int, now_s: float, offset_m: Array) -> None:
        """Send a searching chaser at ``offset_m`` (3,), TRF, to its nominal offset, facing the
        target on the way.
        """
        speed = self._scenario.approach.max_speed_m_s * _GOTO_SPEED_FACTOR
        if not self._permits(i, Trigger.TARGET_SETTLED):
            return
        move = move_to(stay(offset_m, now_s), self._scenario.chasers[i].position_m, now_s, speed)
        self._transition(i, Trigger.TARGET_SETTLED, now_s, move, "the target is found")
        self.chasers[i] = replace(self.chasers[i], faces=True)

    def target_lost(self, now_s: float) -> None:
        """Stop every chaser that moves relative to the target; one in a port's corridor backs out."""
        for i in range(len(self.chasers)):
            self._stop_or_back_out(i, Trigger.TARGET_LOST, now_s, "the target is lost")

    def update_visibility(
        self, now_s: float, visible: bool, doubtful: Collection[int] = frozenset()
    ) -> None:
        """Interrupt approaches to a target that no chaser has seen for a while, and those of
        chasers whose odometry is ``doubtful``; resume them afterwards."""
        self._seen_s = now_s if visible or self._seen_s is None else self._seen_s
        unseen_s = now_s - self._seen_s
        for i in range(len(self.chasers)):
            if unseen_s >= _SIGHT_LOSS_S or i in doubtful:
                reason = f"no chaser has seen the target for {_SIGHT_LOSS_S:g} s"
                if i in doubtful:
                    reason = "its sightings have contradicted its odometry since that was received"
                if self._stop_or_back_out(i, Trigger.SIGHT_LOST, now_s, reason) is Phase.HOLD:
                    self._interrupted.add(i)
            elif (
                i in self._interrupted
                and unseen_s == 0.0
                and self._permits(i, Trigger.SIGHT_REGAINED)
            ):
                move = move_to(
                    self._in_trf(i, now_s),
                    self.dock_offset(i),
                    now_s,
                    self._scenario.approach.max_speed_m_s,
                )
                self._transition(
                    i, Trigger.SIGHT_REGAINED, now_s, move, "its sightings can be used again"
                )
            if self.chasers[i].phase is not Phase.HOLD:
                self._interrupted.discard(i)

    def _stop_or_back_out(
        self, i: int, trigger: Trigger, now_s: float, reason: str
    ) -> Phase | None:
        phase = next_phase(self.chasers[i].phase, trigger, self._docks[i] is not None)
        if phase is Phase.RETREAT:
            self._back_out(i, trigger, now_s, reason)
        elif phase is not None:
            # TARGET_LOST is an event of its own in the log; the phase change needs no reason.
            why = reason if trigger is Trigger.SIGHT_LOST else ""
            self._transition(i, trigger, now_s, stop(self._in_trf(i, now_s), now_s), why)
        return phase

    # -- planning ----------------------------------------------------------------------------------

    def update_planning(self, now_s: float, failures: Mapping[int, PlanningFailure]) -> None:
        """Let every chaser retreat for which planning fails, once per failure, and again when it
        becomes one without plans.
        """
        for i, failure in failures.items():
            before = self._planning_failures.get(i)
            worse = before is None or (failure.without_plan and not before.without_plan)
            if worse and self._permits(i, Trigger.PLANNING_FAILED):
                self._back_out(i, Trigger.PLANNING_FAILED, now_s, failure.text())
        self._planning_failures = dict(failures)

    # -- passive safety ----------------------------------------------------------------------------

    def update_safety(self, now_s: float, unsafe: Mapping[int, str]) -> None:
        """Let every chaser abort whose passive safety is enforced, but whose plans are ``unsafe``,
        with the reasons.
        """
        for i, reason in unsafe.items():
            if self.enforces_safety(i) and self._permits(i, Trigger.SAFETY_LOST):
                self._back_out(i, Trigger.SAFETY_LOST, now_s, reason)

    def enforces_safety(self, i: int) -> bool:
        """Return whether the passive safety of a chaser is enforced now: outside the final
        corridor.
        """
        position = self._positions.get(i)
        if self.escapes is None or position is None or i not in self.escapes.relative:
            return False
        final = (
            self.escapes.is_final(position) or self.in_corridor(i) or self.corridor(i) is not None
        )
        return not (final or self._is_held(i))

    def _in_trf(self, i: int, now_s: float) -> Motion:
        """Return a chaser's motion in TRF: in place of an abort's, which is in WRF, rest at the
        estimated position.
        """
        move = self.chasers[i].move
        return stay(self._positions[i], now_s) if isinstance(move, Escape) else move

    def _move(self, i: int, goal_m: Array, now_s: float, speed_m_s: float) -> Motion:
        """Return the move to a goal (3,), TRF, at most at a speed; if passive safety is enforced,
        as slow as it needs.
        """
        return self._safe_move(i, goal_m, now_s, speed_m_s) or move_to(
            self._in_trf(i, now_s), goal_m, now_s, speed_m_s
        )

    def _closing_speed(self, start: Motion, goal_m: Array, now_s: float, speed_m_s: float) -> float:
        """Return the largest speed of a move that keeps the speed limit by range all along its way,
        at least ``speed_m_s``.
        """
        slope = self._scenario.approach.closing_per_s
        if not slope:
            return speed_m_s
        farthest = max(
            float(np.linalg.norm(goal_m)), float(np.linalg.norm(start.at(np.array([now_s]))[0][0]))
        )
        speed = speed_m_s + slope * farthest
        while speed > speed_m_s:
            move = move_to(start, goal_m, now_s, speed)
            positions, velocities, _ = move.at(np.linspace(now_s, now_s + move.duration_s, 65))
            limits = speed_m_s + slope * np.linalg.norm(positions, axis=1)
            if np.all(np.linalg.norm(velocities, axis=1) <= limits):
                return speed
            speed *= 0.97
        return speed_m_s

    def _safe_move(self, i: int, goal_m: Array, now_s: float, speed_m_s: float) -> Motion | None:
        start = self._in_trf(i, now_s)
        speed_m_s = self._closing_speed(start, goal_m, now_s, speed_m_s)
        if self.escapes is None:
            return move_to(start, goal_m, now_s, speed_m_s)
        return self.escapes.limited(
            i, lambda speed: move_to(start, goal_m, now_s, speed), speed_m_s, now_s
        )

    def _escape(self, i: int, now_s: float) -> Escape | None:
        """Return the abort onto a safe coast if passive safety is enforced; log one whose coast is
        not safe.
        """
        found = self.escapes.escape(i, now_s) if self.escapes is not None else None
        if self.escapes is None or found is None:
            return None
        move, margin = found
        speed = float(np.linalg.norm(move.acceleration_m_s2)) * move.burn_s
        text = f"abort by {speed:.3f} m/s onto a coast with a margin of {margin:.1f} sigmas"
        level = "info" if margin >= self.escapes.sigmas else "warning"
        self._changes.append(PhaseChange(i, Phase.ABORT, text, level))
        return move

    def _why_not_safe(self, i: int, goal_m: Array, now_s: float) -> str:
        """Return why no move to a goal (3,), TRF, is passively safe, or an empty string."""
        speed = self._scenario.approach.max_speed_m_s * _GOTO_SPEED_FACTOR
        if self._safe_move(i, goal_m, now_s, speed) is not None:
            return ""
        return (
            "no speed makes the move passively safe: the coast after a loss of thrust comes within "
            f"{self._scenario.limits.min_distance_target_m:g} m of the target (limits.passive_safety)"
        )

    # -- commands ----------------------------------------------------------------------------------

    def due_commands(self, now_s: float) -> list[OperatorCommand]:
        """Return the commands of the scenario's timeline that are due and were not returned before."""
        out = []
        while self._timeline and self._timeline[0].at_s <= now_s + 1e-9:
            entry = self._timeline.pop(0)
            for chaser in entry.chasers:
                fields = {
                    "command": entry.command,
                    "offset_m": entry.offset_m,
                    "thruster": entry.thruster,
                }
                out.append(OperatorCommand(chaser=chaser, **fields))
        return out

    def set_pending_goals(self, commands: Sequence[OperatorCommand]) -> None:
        """Note the goals of one tick's commands together, so that two chasers can swap their
        places.
        """
        self._pending_inspections = {c.chaser for c in commands if c.command == "inspect"}
        self._pending_goals = {
            c.chaser: np.asarray(c.offset_m)
            for c in commands
            if c.command == "goto"
            and c.offset_m is not None
            and c.chaser < len(self.chasers)
            and not validation.why_not_offset(self._scenario, c.chaser, c.offset_m)
        }

    def command(self, command: OperatorCommand, now_s: float) -> CommandResult:
        """Apply or refuse a command.

        Of different commands to a chaser in one tick only the first is accepted, except that an
        abort always is.
        """
        i, what = command.chaser, command.command
        reason = validation.why_unknown_chaser(i, len(self.chasers)) or validation.why_stale(
            command, now_s
        )
        if reason:
            return CommandResult(False, reason)
        if self.chasers[i].phase in (Phase.ACQUIRE, Phase.SEARCHING):
            return CommandResult(False, "the target has not been found yet")
        done_s, done = self._last_commands.get(i, (-math.inf, command))
        differs = (done.command, done.offset_m) != (what, command.offset_m)
        if done_s == now_s and differs and what != "abort":
            return validation.superseded_by(done)
        result = self._apply_command(command, now_s)
        if result.accepted:
            self._last_commands[i] = now_s, command
        return result

    def _apply_command(self, command: OperatorCommand, now_s: float) -> CommandResult:
        i, what = command.chaser, command.command
        self._interrupted.discard(
            i
        )  # a new command cancels the automatic resumption of the one before
        c, dock = self.chasers[i], self._docks[i]
        if what != "goto" and (what == c.phase or (what == "approach" and c.phase in APPROACHING)):
            return CommandResult(True, f"already in phase {c.phase}")
        if reason := self._why_not(command, now_s):
            return CommandResult(False, reason)
        trigger, speed = trigger_of(what), self._scenario.approach.max_speed_m_s
        match trigger:
            case Trigger.COMMAND_RETREAT | Trigger.COMMAND_ABORT:
                self._back_out(i, trigger, now_s)
            case Trigger.COMMAND_DETUMBLE | Trigger.COMMAND_IDENTIFY:
                self._transition(i, trigger, now_s, c.move)
            case Trigger.COMMAND_HOLD if self.in_corridor(i):
                self._transition(i, trigger, now_s, stay(self._observed[i].offset_m, now_s))
            case Trigger.COMMAND_HOLD:
                self._transition(i, trigger, now_s, stop(self._in_trf(i, now_s), now_s))
            case Trigger.COMMAND_CALIBRATE:
                self._transition(i, trigger, now_s, c.move)
            case Trigger.COMMAND_INSPECT:
                self._transition(i, trigger, now_s, self._circuit(i, now_s))
                self.chasers[i] = replace(self.chasers[i], faces=True)
            case Trigger.COMMAND_APPROACH if dock is None:
                self._transition(
                    i,
                    trigger,
                    now_s,
                    move_to(self._in_trf(i, now_s), self.dock_offset(i), now_s, speed),
                )
            case Trigger.COMMAND_APPROACH:
                occupied = self._why_corridor_occupied(i)
                if occupied:
                    blocked = Trigger.COMMAND_APPROACH_BLOCKED
                    self._transition(
                        i, blocked, now_s, stop(self._in_trf(i, now_s), now_s), occupied
                    )
                else:
                    self._align(i, trigger, now_s, 1)
            case _:
                goal = np.asarray(command.offset_m)
                move = self._move(i, goal, now_s, speed * _GOTO_SPEED_FACTOR)
                self._transition(i, trigger, now_s, move)
        return CommandResult(True, f"phase {self.chasers[i].phase}")

    def _why_not(self, command: OperatorCommand, now_s: float) -> str:
        i, c, dock = command.chaser, self.chasers[command.chaser], self._docks[command.chaser]
        by_capture = dock is not None
        failure = self._planning_failures.get(i)
        if failure is not None and command.command in failure.refused:
            return failure.text()
        if command.command == "calibrate":
            return validation.why_not_calibrate(self._scenario, c.phase, c.move.over_at(now_s))
        if command.command == "inspect" and c.phase is Phase.HOLD:
            return self._why_not_inspect(i, now_s)
        if next_phase(c.phase, trigger_of(command.command), by_capture) is None:
            return f"in phase {c.phase} permitted: {', '.join(permitted_commands(c.phase, by_capture))}"
        if command.command == "detumble":
            return self._detumble_refusal
        if command.command == "identify":
            return validation.why_not_identify(self._scenario)
        if command.command == "approach":
            offset_m = self._in_trf(i, now_s).at(np.array([now_s]))[0][0]
            return (
                validation.why_not_along(self._scenario, i, offset_m)
                if dock is None
                else why_not_approach(dock, offset_m)
            )
        if command.command == "goto":
            if by_capture and self.in_corridor(i):
                return "the chaser is in its corridor: retreat or abort first"
            goals = {
                j: self._pending_goals.get(j, other.move.goal_m)
                for j, other in enumerate(self.chasers)
                if j != i
            }
            reason = validation.why_not_goto(self._scenario, i, command.offset_m, goals)
            reason = reason or validation.why_not_in_cone(
                self._scenario, i, np.asarray(command.offset_m)
            )
            return reason or self._why_not_safe(i, np.asarray(command.offset_m), now_s)
        return ""

    # -- inspection --------------------------------------------------------------------------------

    def _circuit(self, i: int, now_s: float) -> Circuit:
        section = self._scenario.inspection
        start = self._in_trf(i, now_s).at(np.array([now_s]))[0][0]
        return circuit(start, section.axis, section.distance_m, now_s, section.speed_m_s)

    def _why_not_inspect(self, i: int, now_s: float) -> str:
        """Return why a chaser may not fly around the target, or an empty string."""
        c = self.chasers[i]
        path = self._circuit(i, now_s)
        if reason := validation.why_not_inspect(
            self._scenario, i, path.from_m, c.move.over_at(now_s)
        ):
            return reason
        others = {j: o for j, o in enumerate(self.chasers) if j != i}
        if any(o.phase is Phase.INSPECT and o.since_s != now_s for o in others.values()):
            return "another chaser flies around the target already: command all of them at one time"
        places = path.at(np.linspace(now_s, now_s + path.duration_s, 181))[0]
        for j, other in others.items():
            if other.phase is Phase.INSPECT or j in self._pending_inspections:
                continue
            apart = float(np.linalg.norm(places - other.move.goal_m, axis=1).min())
            if apart < self._scenario.limits.min_distance_chasers_m:
                return f"the way around the target comes within {apart:.3g} m of chaser {j}"
        return self._why_not_safe(i, path.goal_m, now_s)

    # -- the stack of the target and latched chasers -----------------------------------------------

    def may_detumble(self, i: int) -> bool:
        """Return whether a chaser stops the stack already, or may be commanded to."""
        return self.chasers[i].phase in DETUMBLING or self._permits(i, Trigger.COMMAND_DETUMBLE)

    def detumbling(self) -> frozenset[int]:
        """Return the chasers that stop the stack or keep it at rest."""
        return frozenset(i for i, c in enumerate(self.chasers) if c.phase in DETUMBLING)

    def identifying(self) -> frozenset[int]:
        """Return the chasers that fire pulses which identify the stack."""
        return frozenset(i for i, c in enumerate(self.chasers) if c.phase is Phase.IDENTIFY)

    def thrusting(self) -> frozenset[int]:
        """Return the chasers whose thrusters the controller commands one by one."""
        return self.detumbling() | self.identifying()

    def update_identification(self, now_s: float) -> None:
        """End the manoeuvre of chasers that have fired identifying pulses for long enough."""
        duration_s = self._scenario.detumble.identification.duration_s
        for i in sorted(self.identifying()):
            c = self.chasers[i]
            if now_s - c.since_s >= duration_s:
                self._transition(i, Trigger.IDENTIFIED, now_s, c.move)

    def set_detumble_refusal(self, reason: str) -> None:
        """Set why this tick's commands to detumble are refused; empty if they are accepted."""
        self._detumble_refusal = reason

    def update_stack(self, now_s: float, stopped: bool, moving: bool) -> None:
        """Advance the phases of detumbling chasers by the motion of the stack, which is neither
        stopped nor moving in between.
        """
        timeout_s = self._scenario.detumble.timeout_s
        for i in sorted(self.detumbling()):
            c = self.chasers[i]
            holds = c.phase is Phase.STACK_HOLD
            settled = now_s - c.since_s >= _SETTLING_S
            since = self._inside_since(i, moving and settled if holds else stopped, now_s)
            self.chasers[i] = replace(c, inside_since_s=since)
            if since is not None and now_s - since >= (_MOVING_S if holds else _REST_S):
                trigger = Trigger.STACK_MOVED if holds else Trigger.STACK_STOPPED
                self._transition(i, trigger, now_s, c.move)
            elif not holds and now_s - c.since_s > timeout_s:
                reason = f"not stopped within {timeout_s:g} s"
                self._transition(i, Trigger.DETUMBLE_FAILED, now_s, c.move, reason)

    def detumble_failed(self, now_s: float, reason: str) -> None:
        """Close the thrusters of all detumbling chasers."""
        for i in self.detumbling():
            self._transition(i, Trigger.DETUMBLE_FAILED, now_s, self.chasers[i].move, reason)

    # -- progress ----------------------------------------------------------------------------------

    def update_tracking(
        self, i: int, now_s: float, position_error_m: float, angle_error_rad: float
    ) -> None:
        """Advance a chaser's phase by its estimated errors from the reference pose."""
        c, approach = self.chasers[i], self._scenario.approach
        if c.phase is Phase.CALIBRATE and now_s - c.since_s >= CALIBRATION_S:
            self._transition(
                i, Trigger.CALIBRATION_COMPLETE, now_s, c.move, "the manoeuvre is complete"
            )
        elif c.phase is Phase.INSPECT and c.move.over_at(now_s):
            self._transition(i, Trigger.INSPECTION_COMPLETE, now_s, stay(c.move.goal_m, now_s))
            self.chasers[i] = replace(self.chasers[i], faces=False)
        elif c.phase in (Phase.RETREAT, Phase.ABORT, Phase.GOTO) and c.move.over_at(now_s):
            self._continue_move(i, now_s)
        elif (
            self._docks[i] is None
            and c.phase in (Phase.APPROACH, Phase.DOCKED)
            and c.move.over_at(now_s)
        ):
            inside = (
                position_error_m <= approach.docked_position_m
                and angle_error_rad <= math.radians(approach.docked_angle_deg)
            )
            since = self._inside_since(i, inside, now_s)
            self.chasers[i] = ChaserGuidance(c.phase, c.since_s, c.move, since, faces=c.faces)
            if since is not None and now_s - since >= approach.docked_time_s:
                self._transition(i, Trigger.WITHIN_TOLERANCE, now_s, c.move, inside_since_s=since)
            elif since is None:
                self._transition(i, Trigger.OUTSIDE_TOLERANCE, now_s, c.move)

    def _continue_move(self, i: int, now_s: float) -> None:
        c = self.chasers[i]
        match c.then:
            case NextMove.ATTEMPT if i not in self._planning_failures:
                self._align(i, Trigger.NEXT_ATTEMPT, now_s, c.attempt + 1)
            case NextMove.ATTEMPT | NextMove.NOMINAL:
                nominal, speed = self._scenario.chasers[i].position_m, self._back_out_speed(c.phase)
                self.chasers[i] = replace(
                    c,
                    move=move_to(self._in_trf(i, now_s), nominal, now_s, speed),
                    then=NextMove.NONE,
                )
            case NextMove.ESCAPE if (escape := self._escape(i, now_s)) is not None:
                self.chasers[i] = replace(c, move=escape, then=NextMove.NONE)
            case NextMove.NONE | NextMove.ESCAPE:
                self._transition(i, Trigger.MOVE_COMPLETE, now_s, c.move)
                self.chasers[i] = replace(self.chasers[i], faces=False)

    def update_docking(self, i: int, now_s: float, observed: DockingObservation) -> None:
        """Advance the phase of a chaser that docks by capture by its observed state at the port."""
        self._observed[i] = observed
        c, dock = self.chasers[i], self._docks[i]
        if dock is None:
            return
        if c.phase in (Phase.RETREAT, Phase.ABORT):
            self._update_stuck(i, dock, now_s)
            return
        if c.phase is Phase.WAIT:
            if not self._why_corridor_occupied(i):
                self._align(i, Trigger.CORRIDOR_FREE, now_s, 1)
            return
        docking = dock.docking
        if c.phase is Phase.ALIGN:
            inside = not observed.view.fault(docking.corridor, docking.corridor.closing_m_s)
            c = replace(c, inside_since_s=self._inside_since(i, inside, now_s))
        elif c.phase is Phase.LATCHED and c.held is None and now_s - c.since_s >= docking.settle_s:
            c = replace(c, held=(observed.offset_m, observed.q_wxyz))
        self.chasers[i] = c
        progress = PhaseProgress(
            phase=c.phase,
            in_phase_s=now_s - c.since_s,
            move_complete=c.move.over_at(now_s),
            reference_gap_m=dock.gap_and_lateral(c.move.at(np.array([now_s]))[0][0])[0],
            inside_s=0.0 if c.inside_since_s is None else now_s - c.inside_since_s,
            held=c.held,
        )
        outcome = docking_trigger(docking, progress, observed)
        if outcome is not None:
            self._apply_docking_trigger(i, now_s, *outcome)

    def _update_stuck(self, i: int, dock: Dock, now_s: float) -> None:
        """Restart the way out of a chaser in every tick, for as long as its latch does not open."""
        c, observed = self.chasers[i], self._observed[i]
        sensed = observed.sensed or c.stuck
        stuck = observed.latched and sensed and now_s - c.since_s >= _RELEASE_S
        if stuck:
            entry, speed = dock.offset(dock.docking.entry_m), self._back_out_speed(c.phase)
            c = replace(c, move=move_to(stay(observed.offset_m, now_s), entry, now_s, speed))
        if stuck and not c.stuck:
            self._changes.append(PhaseChange(i, c.phase, "the latch does not open", "warning"))
        elif c.stuck and not stuck:
            self._changes.append(PhaseChange(i, c.phase, "the latch opened"))
        self.chasers[i] = replace(c, stuck=stuck)

    def _apply_docking_trigger(self, i: int, now_s: float, trigger: Trigger, reason: str) -> None:
        c, dock = self.chasers[i], self._docks[i]
        assert dock is not None
        docking, move = dock.docking, c.move
        match trigger:
            case Trigger.ATTEMPT_FAILED:
                again = c.attempt < docking.attempts and c.phase not in ATTACHED
                self._back_out(
                    i, trigger, now_s, reason, NextMove.ATTEMPT if again else NextMove.NOMINAL
                )
                return
            case Trigger.ALIGNED:
                fast = (docking.entry_m - docking.final_m, docking.approach_speed_m_s)
                slow = (docking.final_m + docking.overdrive_m, docking.contact_speed_m_s)
                inward = -np.asarray(dock.port.axis)
                move = glide(dock.offset(docking.entry_m), inward, now_s, fast, slow)
            case Trigger.LATCH_CLOSED:
                move = stay(self._observed[i].offset_m, now_s)
            case _:
                pass
        self._transition(i, trigger, now_s, move, reason, attempt=c.attempt)

    def _inside_since(self, i: int, inside: bool, now_s: float) -> float | None:
        since_s = self.chasers[i].inside_since_s
        if not inside:
            return None
        return now_s if since_s is None else since_s

    # -- what the plan and the commands depend on --------------------------------------------------

    def body_rotations(self, i: int, times_s: ArrayLike) -> Array | None:
        """Return rotations (K, 4) of the body from its reference attitude at times (K,), or None
        without any.
        """
        c = self.chasers[i]
        if c.phase is not Phase.CALIBRATE:
            return None
        return calibration_turns(np.asarray(times_s, dtype=float) - c.since_s)

    def is_free(self, i: int) -> bool:
        """Return whether a chaser's docking sensor reports neither contact nor a closed latch."""
        observed = self._observed.get(i)
        return observed is None or not (observed.contact or observed.latched)

    def in_corridor(self, i: int) -> bool:
        """Return whether a chaser is in its corridor or at its port, by its phase or its estimated
        position.
        """
        c, dock = self.chasers[i], self._docks[i]
        if dock is None or i not in self._observed:
            return False
        at_port = c.phase in (Phase.APPROACH, Phase.FINAL, Phase.CONTACT, *ATTACHED)
        return at_port or dock.inside(self._observed[i].offset_m)

    def _is_held(self, i: int) -> bool:
        """Return whether the latch of a chaser holds the target, by its phase, or because it does
        not open.
        """
        return self.chasers[i].phase in ATTACHED or self.chasers[i].stuck

    def set_position(self, i: int, offset_m: Array) -> None:
        """Set a chaser's estimated centre (3,), TRF."""
        self._positions[i] = offset_m

    def corridor(self, i: int) -> Cone | None:
        """Return the cone in which a chaser on its way in or out is planned; None outside of it.

        A chaser that docks at a distance has its cone from the command on, and on its way out until
        it is at the distance that every chaser keeps.
        """
        position, dock = self._positions.get(i), self._docks[i]
        if position is None or self._is_held(i):
            return None
        if dock is None:
            near = length(position) < self._scenario.limits.min_distance_target_m
            applies = near or self.chasers[i].phase in (Phase.APPROACH, Phase.DOCKED)
        else:
            applies = self.in_corridor(i)
        return self._cones[i] if applies and self._cones[i].room_m(position) > -_OUTSIDE_M else None

    def min_distance_target_m(self, i: int) -> float:
        """Return the distance from the target that a chaser's plan keeps; 0 when its latch holds
        the target.
        """
        limit, dock = self._scenario.limits.min_distance_target_m, self._docks[i]
        if dock is None:
            docked_m = max(0.0, self._scenario.approach.dock_distance_m - _HELD_MARGIN_M)
            return min(limit, docked_m) if self.corridor(i) is not None else limit
        if not self.in_corridor(i):
            return limit
        return 0.0 if self._is_held(i) else min(limit, dock.keep_out_m())

    def min_distance_shape_m(self, i: int) -> float:
        """Return the distance from the target's shape that a chaser's plan keeps; 0 in its corridor
        and at its port.
        """
        free = self.corridor(i) is None and not self.in_corridor(i) and not self._is_held(i)
        return self._scenario.limits.min_distance_shape_m if free else 0.0

    def latch(self, i: int) -> Latch:
        """Return the latch command: armed from the final approach on, open before and when backing
        out.
        """
        if self._docks[i] is None:
            return "keep"
        return (
            "arm" if self.chasers[i].phase in (Phase.FINAL, Phase.CONTACT, *ATTACHED) else "release"
        )

    def pull_N(self, i: int, now_s: float) -> float:
        """Return the force along -X, CRF, of the latch test."""
        c = self.chasers[i]
        return (
            pull_N(self._scenario.docking, now_s - c.since_s) if c.phase is Phase.LATCHED else 0.0
        )

    def dock_offset(self, i: int) -> Array:
        """Return a docked chaser's centre (3,), TRF, for docking at a distance."""
        nominal = np.asarray(self._scenario.chasers[i].position_m)
        return nominal / np.linalg.norm(nominal) * self._scenario.approach.dock_distance_m

    def drain_changes(self) -> list[PhaseChange]:
        """Return the phase changes since the last call."""
        changes, self._changes = self._changes, []
        return changes

    # -- transitions -------------------------------------------------------------------------------

    def _permits(self, i: int, trigger: Trigger) -> bool:
        return next_phase(self.chasers[i].phase, trigger, self._docks[i] is not None) is not None

    def _transition(
        self,
        i: int,
        trigger: Trigger,
        now_s: float,
        move: Motion,
        reason: str = "",
        inside_since_s: float | None = None,
        then: NextMove = NextMove.NONE,
        attempt: int | None = None,
    ) -> None:
        """Enter the phase that the transition table gives for ``trigger``; do nothing where it
        gives none.
        """
        before = self.chasers[i]
        phase = next_phase(before.phase, trigger, self._docks[i] is not None)
        if phase is None:
            return
        number = before.attempt if attempt is None else attempt
        self.chasers[i] = ChaserGuidance(
            phase, now_s, move, inside_since_s, then, number, faces=before.faces
        )
        if phase is not before.phase:
            detail = f"from {before.phase}" + (f": {reason}" if reason else "")
            failed = (
                Trigger.PLANNING_FAILED,
                Trigger.DETUMBLE_FAILED,
                Trigger.ATTEMPT_FAILED,
                Trigger.SAFETY_LOST,
            )
            level = "warning" if trigger in failed else "info"
            complete = trigger is Trigger.CALIBRATION_COMPLETE
            self._changes.append(PhaseChange(i, phase, detail, level, complete))

    def _back_out_speed(self, phase: Phase) -> float:
        factor = _ABORT_SPEED_FACTOR if phase is Phase.ABORT else 1.0
        return self._scenario.approach.max_speed_m_s * factor

    def _back_out(
        self,
        i: int,
        trigger: Trigger,
        now_s: float,
        reason: str = "",
        then: NextMove = NextMove.NOMINAL,
    ) -> None:
        """Move to the nominal offset; from inside a corridor first along its axis to the entry."""
        dock = self._docks[i]
        aborts = trigger in (Trigger.COMMAND_ABORT, Trigger.SAFETY_LOST)
        speed = self._back_out_speed(Phase.ABORT if aborts else Phase.RETREAT)
        if dock is None or not self.in_corridor(i):
            escape = self._escape(i, now_s) if aborts else None
            move = escape or self._move(
                i, np.asarray(self._scenario.chasers[i].position_m), now_s, speed
            )
            self._transition(i, trigger, now_s, move, reason)
            return
        if aborts and self.escapes is not None:
            then = NextMove.ESCAPE
        entry = dock.offset(dock.docking.entry_m)
        move = move_to(stay(self._observed[i].offset_m, now_s), entry, now_s, speed)
        self._transition(i, trigger, now_s, move, reason, then=then)

    def _align(self, i: int, trigger: Trigger, now_s: float, attempt: int) -> None:
        dock = self._docks[i]
        assert dock is not None
        speed = self._scenario.approach.max_speed_m_s * _GOTO_SPEED_FACTOR
        move = self._move(i, dock.offset(dock.docking.entry_m), now_s, speed)
        self._transition(i, trigger, now_s, move, attempt=attempt)

    def _why_corridor_occupied(self, i: int) -> str:
        """Return which chaser blocks an approach, or an empty string."""
        own, docking, active = self._docks[i], self._scenario.docking, 0
        assert own is not None
        for j, other in enumerate(self._docks):
            phase = self.chasers[j].phase
            if j == i or other is None or not (phase is Phase.ALIGN or self.in_corridor(j)):
                continue
            active += phase not in ATTACHED
            if corridors_apart(own, other) < docking.clearance_m:
                return f"chaser {j} is in the way"
        return f"{active} are docking already" if active >= docking.at_once else ""
