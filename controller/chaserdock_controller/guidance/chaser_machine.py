# SPDX-License-Identifier: Apache-2.0
"""State machine of one chaser, and the interface of its activities. No I/O; time is an argument.

Phases and transitions: ``phases``. Every phase change looks up its target in the transition table;
the activity to which that phase belongs then begins.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from chaserdock_models.arrays import Array, length
from chaserdock_protocol.messages import ChosenPort, Latch, OperatorCommand, SightedMap
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.interfaces import (
    DirectCommand,
    Directive,
    Observation,
    PlanningFailure,
    ReferencePose,
    TargetEstimation,
)

from . import command_validation as validation
from .approach_cone import Cone, cone_of
from .approach_line import approach_line
from .chaser_state import (
    Cause,
    ChaserGuidance,
    ChaserTick,
    CommandResult,
    PhaseChange,
    TrackingErrors,
)
from .docking import DockingObservation, dock_of
from .escape import RelativeState
from .parameters import GUIDANCE
from .phases import (
    APPROACHING,
    ATTACHED,
    BACKING_OUT,
    Phase,
    Trigger,
    next_phase,
    permitted_commands,
    trigger_of,
)
from .thruster_commands import ThrusterCommands
from .trajectories import Escape, Motion, stay

_FAILURES = (
    Trigger.PLANNING_FAILED,
    Trigger.DETUMBLE_FAILED,
    Trigger.ATTEMPT_FAILED,
    Trigger.SAFETY_LOST,
)
"""Triggers whose phase changes are logged as warnings."""


class Activity:
    """What a chaser does in ``phases``, and the operator ``commands`` that it answers.

    ``by_capture``: for chasers that dock by capture (True), at a distance (False), or both (None).
    One object serves all chasers; the state of a chaser's activity is in its machine.
    """

    phases: tuple[Phase, ...] = ()
    commands: tuple[str, ...] = ()
    by_capture: bool | None = None

    def refuse(self, chaser: ChaserMachine, command: OperatorCommand, now_s: float) -> str:
        """Return why a command that would start the activity is refused now; empty if it is not."""
        phase, by_capture = chaser.state.phase, chaser.by_capture
        if next_phase(phase, trigger_of(command.command), by_capture) is not None:
            return ""
        return f"in phase {phase} permitted: {', '.join(permitted_commands(phase, by_capture))}"

    def start(self, chaser: ChaserMachine, command: OperatorCommand, now_s: float) -> None:
        """Execute a command that is not refused."""
        chaser.fire(trigger_of(command.command), now_s)

    def enter(self, chaser: ChaserMachine, begun: ChaserGuidance, cause: Cause) -> ChaserGuidance:
        """Return the state with which a phase begins: ``begun``, which keeps the present motion, or
        a copy with the phase's own motion.

        ``chaser`` is still in the previous phase.
        """
        return begun

    def step(self, chaser: ChaserMachine, known: ChaserTick, errors: TrackingErrors) -> None:
        """Advance by a tick in which the target's pose and the chaser's state are known."""

    def command(self, chaser: ChaserMachine, known: ChaserTick) -> DirectCommand | None:
        """Return the command of this tick, or None where the NMPC flies the chaser. By default a
        chaser at its port only coasts.
        """
        return pull(0.0) if chaser.is_attached(known) else None

    def observe(
        self,
        commands: Sequence[OperatorCommand],
        observation: Observation,
        estimation: TargetEstimation,
    ) -> None:
        """Compute what the chasers of this activity share, before the ``commands`` of a tick are
        executed.
        """

    def conclude(self, observation: Observation) -> None:
        """Do what the chasers of this activity do together, after each was stepped."""


def pull(force_N: float) -> DirectCommand:
    """Return the command of a chaser at its port: a pull along -X (CRF), N; zero to coast."""
    wrench = np.array([-force_N, 0.0, 0.0, 0.0, 0.0, 0.0])
    return DirectCommand("pull" if force_N else "coast", wrench)


class ChaserMachine:
    """Phase, motion and observed state of one chaser.

    As of the last tick in which they were known: ``position_m`` (3,), its estimated centre in TRF;
    ``seen``, its state at its port; ``relative``, its state relative to the target where passive
    safety is enforced. ``failure``: why no plan of it can be flown. ``interrupted``: it resumes its
    approach when the target is seen again. ``abort_margin``: sigmas of its best abort. ``led_s``:
    time of the last tick in which its state and the target's pose were known. ``unseen``: why its
    last image showed no pose, or empty. ``sighted``: what its last image with a map of an unknown
    target said of that. ``port``: chosen on that map, as the chaser uses it. ``line``: of its
    approach, if it docks at a distance. ``changes``: log that all chasers share.
    """

    def __init__(self, scenario: FlightScenario, number: int, changes: list[PhaseChange]) -> None:
        self.scenario, self.number, self._changes = scenario, number, changes
        self.nominal_m = np.asarray(scenario.chasers[number].position_m)
        self.dock, self._cone = dock_of(scenario, number), cone_of(scenario, number)
        self.line = approach_line(scenario, number)
        self.thrusters = ThrusterCommands(scenario.chaser)
        first = Phase.SURVEY if scenario.maps_target else Phase.ACQUIRE
        self.state = ChaserGuidance(first, 0.0, stay(self.nominal_m, 0.0))
        self.position_m: Array | None = None
        self.seen: DockingObservation | None = None
        self.relative: RelativeState | None = None
        self.failure: PlanningFailure | None = None
        self.interrupted = False
        self.abort_margin: float | None = None
        self.led_s: float | None = None
        self.unseen = ""
        self.sighted: SightedMap | None = None
        self.port: ChosenPort | None = None
        self._last_command: tuple[float, OperatorCommand] | None = None
        self._activities: dict[Phase, Activity] = {}
        self._answering: dict[str, Activity] = {}

    @property
    def by_capture(self) -> bool:
        """Return whether the chaser docks by capture, and not at a distance."""
        return self.dock is not None

    @property
    def phase(self) -> Phase:
        """Return the phase that the chaser is in."""
        return self.state.phase

    def take_up(self, activities: Sequence[Activity]) -> None:
        """Register those of ``activities`` that suit the chaser's kind of docking."""
        for activity in activities:
            if activity.by_capture in (None, self.by_capture):
                self._activities |= dict.fromkeys(activity.phases, activity)
                self._answering |= dict.fromkeys(activity.commands, activity)

    # -- port on an unknown target ----------------------------------------------------------------

    def sight_map(self, sighted: SightedMap, now_s: float) -> None:
        """Take what an image says of the map. The chaser's port follows the map; another choice
        counts from the next `goto` on, or at once in the survey. Without its port, as of a mapper
        that begins again, it holds.
        """
        self.sighted = sighted
        old, new = self.port, sighted.port
        if old is not None and new is None:
            self.use_port(None)
            self.fire(Trigger.COMMAND_HOLD, now_s, "the map has lost its port")
        if new is not None and (
            self.phase is Phase.SURVEY or (old is not None and old.number == new.number)
        ):
            self.use_port(new)

    def use_port(self, port: ChosenPort | None) -> None:
        """Dock at a port from now on."""
        self.port = port
        self.line = approach_line(self.scenario, self.number, port)

    def cone(self) -> Cone:
        """Return the corridor of the chaser's approach."""
        if self.port is None:
            return self._cone
        return self.line.cone(math.radians(self.scenario.docking.corridor_angle_deg))

    # -- phase changes -----------------------------------------------------------------------------

    def fire(
        self, trigger: Trigger, now_s: float, reason: str = "", place_m: Array | None = None
    ) -> Phase | None:
        """Make the transition of ``trigger``, if the table has one in this phase. Returns the new
        phase, or None.
        """
        before = self.state
        phase = next_phase(before.phase, trigger, self.by_capture)
        if phase is None:
            return None
        begun = ChaserGuidance(
            phase,
            now_s,
            before.move,
            attempt=before.attempt,
            faces=before.faces,
            slew=before.slew,
        )
        cause = Cause(trigger, now_s, place_m)
        self.state = self._activities[phase].enter(self, begun, cause)
        if phase is not before.phase:
            detail = f"from {before.phase}" + (f": {reason}" if reason else "")
            self.log(detail, trigger in _FAILURES)
        return phase

    def log(self, detail: str, warns: bool = False, phase: Phase | None = None) -> None:
        """Log an event in the present phase, or in ``phase``, which is about to begin."""
        level = "warning" if warns else "info"
        self._changes.append(PhaseChange(self.number, phase or self.phase, detail, level))

    def lose_target(self, now_s: float) -> None:
        """Stop, or back out of a port's corridor, because the target is lost."""
        ends = next_phase(self.phase, Trigger.TARGET_LOST, self.by_capture)
        # The loss is logged as an event of its own; a chaser that stops needs no further reason.
        reason = "the target is lost" if ends is Phase.RETREAT else ""
        self.fire(Trigger.TARGET_LOST, now_s, reason)

    def follow_sight(self, known: ChaserTick, unseen_s: float) -> None:
        """Interrupt an approach while no chaser has seen the target for ``unseen_s`` or odometry is
        doubtful. Resume it afterwards.
        """
        if unseen_s >= GUIDANCE.sight_loss_s or known.doubtful:
            reason = f"no chaser has seen the target for {GUIDANCE.sight_loss_s:g} s"
            if known.doubtful:
                reason = "its sightings have contradicted its odometry since that was received"
            if self.fire(Trigger.SIGHT_LOST, known.now_s, reason) is Phase.HOLD:
                self.interrupted = True
        elif self.interrupted and unseen_s == 0.0:
            reason = "its sightings can be used again"
            self.fire(Trigger.SIGHT_REGAINED, known.now_s, reason)
        self.interrupted &= self.phase is Phase.HOLD

    def follow_planning(self, known: ChaserTick) -> None:
        """Retreat when planning fails: once per failure, and again if no plans are left."""
        before, failure = self.failure, known.failure
        self.relative = known.relative
        if failure is not None and (
            before is None or (failure.without_plan and not before.without_plan)
        ):
            self.fire(Trigger.PLANNING_FAILED, known.now_s, failure.text)
        self.failure = failure

    def follow_safety(self, known: ChaserTick) -> None:
        """Abort where passive safety is enforced and plans are unsafe."""
        if known.unsafe and self.enforces_safety():
            self.fire(Trigger.SAFETY_LOST, known.now_s, known.unsafe)

    def command(self, command: OperatorCommand, now_s: float) -> CommandResult:
        """Execute or refuse a command.

        In one tick only the first of different commands is accepted; an abort always is.
        """
        if self.phase in (Phase.ACQUIRE, Phase.SEARCHING):
            return CommandResult(False, "the target has not been found yet")
        if self.phase is Phase.SURVEY and not self._is_led(now_s):
            return CommandResult(False, self.unseen or "the target has not been mapped yet")
        done_s, done = self._last_command or (-math.inf, command)
        differs = (done.command, done.offset_m) != (command.command, command.offset_m)
        if done_s == now_s and differs and command.command != "abort":
            return validation.superseded_by(done)
        result = self._obey(command, now_s)
        if result.accepted:
            self._last_command = now_s, command
        return result

    def _is_led(self, now_s: float) -> bool:
        """Return whether the target's pose is known, or was for as long as a command lives."""
        lifetime_s = self.scenario.controller.command_lifetime_s
        return self.led_s is not None and now_s - self.led_s <= lifetime_s

    def _obey(self, command: OperatorCommand, now_s: float) -> CommandResult:
        self.interrupted = False  # a new command cancels the resumption of the one before
        what, phase = command.command, self.phase
        if what != "goto" and (what == phase or (what == "approach" and phase in APPROACHING)):
            return CommandResult(True, f"already in phase {phase}")
        if self.failure is not None and what in validation.refused_by(self.failure):
            return CommandResult(False, self.failure.text)
        activity = self._answering[what]
        if reason := activity.refuse(self, command, now_s):
            return CommandResult(False, reason)
        activity.start(self, command, now_s)
        return CommandResult(True, f"phase {self.phase}")

    # -- a tick ------------------------------------------------------------------------------------

    def step(self, known: ChaserTick, errors: TrackingErrors) -> None:
        """Advance the phase by the estimated tracking errors and the docking sensor."""
        self.position_m, self.seen = known.offset_m, known.port
        self._activities[self.phase].step(self, known, errors)

    def directive(self, known: ChaserTick, reference: ReferencePose | None) -> Directive:
        """Return what the chaser is to do after this tick; with invalid odometry it coasts."""
        direct = DirectCommand("coast", np.zeros(6)) if known.invalid else None
        if known.own is not None:
            direct = self._activities[self.phase].command(self, known)
        return Directive(
            chaser=self.number,
            phase=self.phase.value,
            phase_time_s=known.now_s - self.state.since_s,
            latch=self.latch(),
            free=self.is_free(),
            isolated=self.thrusters.closed(known.stuck_thrusters),
            trusted=tuple(sorted(self.thrusters.trusted)),
            reference=reference,
            direct=direct,
            inspects=self.phase is Phase.INSPECT,
            abort_margin=self.abort_margin,
        )

    def motion(self, now_s: float) -> Motion:
        """Return the motion in TRF. During an abort, whose motion is in WRF, it is rest at the
        estimated position.
        """
        if not isinstance(self.state.move, Escape):
            return self.state.move
        assert self.position_m is not None
        return stay(self.position_m, now_s)

    # -- conditions for plan and commands ----------------------------------------------------------

    def is_attached(self, known: ChaserTick) -> bool:
        """Return whether the chaser is latched and is to stay, or cannot leave. Its actuators are
        then off except for the latch test.
        """
        return known.latched and (self.phase not in BACKING_OUT or self.state.stuck)

    def is_free(self) -> bool:
        """Return whether the docking sensor reports neither contact nor a closed latch."""
        return self.seen is None or not (self.seen.contact or self.seen.latched)

    def in_corridor(self) -> bool:
        """Return whether the chaser is in its corridor or at its port, by phase or estimated
        position.
        """
        if self.dock is None or self.seen is None:
            return False
        at_port = (Phase.APPROACH, Phase.FINAL, Phase.CONTACT, *ATTACHED)
        return self.phase in at_port or self.dock.inside(self.seen.offset_m)

    def _is_held(self) -> bool:
        """Return whether the latch holds the target: by the phase, or because it does not open."""
        return self.phase in ATTACHED or self.state.stuck

    def enforces_safety(self) -> bool:
        """Return whether passive safety applies now; it does not in the final corridor."""
        if self.position_m is None or self.relative is None or self._is_held():
            return False
        final = float(np.linalg.norm(self.position_m)) <= self.scenario.limits.final_corridor_m
        return not (final or self.in_corridor() or self.corridor() is not None)

    def corridor(self) -> Cone | None:
        """Return the cone that limits the plan of a chaser on its way in or out, else None.

        A chaser that docks at a distance has its cone from the command on. On its way out it keeps
        the cone until it is at the distance that every chaser keeps.
        """
        position = self.position_m
        if position is None or self._is_held():
            return None
        if self.dock is None:
            near = length(position) < self.scenario.limits.min_distance_target_m
            applies = near or self.phase in (Phase.APPROACH, Phase.DOCKED)
        else:
            applies = self.in_corridor()
        cone = self.cone()
        return cone if applies and cone.room_m(position) > -GUIDANCE.outside_m else None

    def min_distance_target_m(self) -> float:
        """Return the distance from the target that a plan must keep; 0 while the latch holds it."""
        limit, dock = self.scenario.limits.min_distance_target_m, self.dock
        if dock is None:
            docked_m = max(0.0, length(self.line.docked_m) - GUIDANCE.held_margin_m)
            return min(limit, docked_m) if self.corridor() is not None else limit
        if not self.in_corridor():
            return limit
        return 0.0 if self._is_held() else min(limit, dock.keep_out_m())

    def min_distance_shape_m(self) -> float:
        """Return the distance from the target's shape that a plan must keep; 0 in the corridor and
        at the port.
        """
        free = self.corridor() is None and not self.in_corridor() and not self._is_held()
        return self.scenario.limits.min_distance_shape_m if free else 0.0

    def latch(self) -> Latch:
        """Return the latch command: armed from the final approach on, open before it and when
        backing out.
        """
        if self.dock is None:
            return "keep"
        return "arm" if self.phase in (Phase.FINAL, Phase.CONTACT, *ATTACHED) else "release"
