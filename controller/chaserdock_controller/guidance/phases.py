# SPDX-License-Identifier: Apache-2.0
"""Phases of a chaser and the transitions between them, as one table.

`docs/phases.md` is generated from ``TRANSITIONS``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Phase(StrEnum):
    """What a chaser does. The values are those of the ``Reference`` message."""

    ACQUIRE = "acquire"
    SEARCHING = "searching"
    SURVEY = "survey"
    HOLD = "hold"
    CALIBRATE = "calibrate"
    INSPECT = "inspect"
    APPROACH = "approach"
    DOCKED = "docked"
    RETREAT = "retreat"
    GOTO = "goto"
    ABORT = "abort"
    WAIT = "wait"
    ALIGN = "align"
    FINAL = "final"
    CONTACT = "contact"
    LATCHED = "latched"
    VERIFIED = "verified"
    IDENTIFY = "identify"
    DETUMBLE = "detumble"
    STACK_HOLD = "stack_hold"


class Trigger(StrEnum):
    """What makes a chaser change its phase: an event, a condition or a command."""

    TARGET_ACQUIRED = "target acquired"
    TARGET_UNKNOWN = "target unknown for 1 s"
    TARGET_SETTLED = "target rates known"
    TARGET_LOST = "target lost"
    SIGHT_LOST = "out of sight for 3 s, or odometry doubtful"
    SIGHT_REGAINED = "sightings usable again"
    COMMAND_HOLD = "command hold"
    COMMAND_APPROACH = "command approach"
    COMMAND_APPROACH_BLOCKED = "command approach, corridor occupied"
    COMMAND_CALIBRATE = "command calibrate"
    COMMAND_INSPECT = "command inspect"
    COMMAND_GOTO = "command goto"
    COMMAND_RETREAT = "command retreat"
    COMMAND_ABORT = "command abort"
    COMMAND_IDENTIFY = "command identify"
    COMMAND_DETUMBLE = "command detumble"
    CALIBRATION_COMPLETE = "calibration complete"
    INSPECTION_COMPLETE = "inspection complete"
    MOVE_COMPLETE = "move complete"
    NEXT_ATTEMPT = "move complete, attempts left"
    WITHIN_TOLERANCE = "within docking tolerance"
    OUTSIDE_TOLERANCE = "outside docking tolerance"
    CORRIDOR_FREE = "corridor free"
    ALIGNED = "aligned"
    FINAL_DISTANCE = "final distance reached"
    TIP_CONTACT = "tip in contact"
    LATCH_CLOSED = "latch closed"
    PULL_WITHSTOOD = "pull test passed"
    IDENTIFIED = "manoeuvre complete"
    STACK_STOPPED = "stack at rest"
    STACK_MOVED = "stack moves again"
    DETUMBLE_FAILED = "stack cannot be stopped"
    ATTEMPT_FAILED = "limit violated or time-out"
    PLANNING_FAILED = "planning failed"
    SAFETY_LOST = "not passively safe for 1 s"


@dataclass(frozen=True)
class Transition:
    """A row of the table. ``by_capture``: valid for chasers that dock by capture (True), at a
    distance (False), or both (None).
    """

    sources: tuple[Phase, ...]
    trigger: Trigger
    target: Phase
    by_capture: bool | None = None


_P, _T = Phase, Trigger
CORRIDOR = (_P.ALIGN, _P.APPROACH, _P.FINAL, _P.CONTACT)
"""Phases of an approach to a port before the latch has closed."""
DETUMBLING = (_P.DETUMBLE, _P.STACK_HOLD)
"""Phases in which the controller commands the thrusters of a latched chaser individually."""
ATTACHED = (_P.LATCHED, _P.VERIFIED, _P.IDENTIFY, *DETUMBLING)
"""Phases of a chaser whose latch holds the target."""
APPROACHING = (_P.WAIT, *CORRIDOR, *ATTACHED, _P.DOCKED)
"""Phases that an ``approach`` command leads through."""
DOCKING = (*CORRIDOR, _P.DOCKED)
"""Phases of a chaser on its way to dock, or that stays docked at a distance."""
BACKING_OUT = (_P.RETREAT, _P.ABORT)
"""Phases in which a chaser leaves its port or the vicinity of the target."""
_MOVING = (*BACKING_OUT, _P.GOTO)
_FREE = (_P.HOLD, _P.CALIBRATE, _P.INSPECT, *_MOVING)

TRANSITIONS = (
    Transition((_P.ACQUIRE,), _T.TARGET_ACQUIRED, _P.HOLD),
    Transition((_P.ACQUIRE, _P.HOLD), _T.TARGET_UNKNOWN, _P.SEARCHING),
    Transition((_P.SEARCHING,), _T.TARGET_SETTLED, _P.GOTO),
    Transition((_P.CALIBRATE, _P.INSPECT, *_MOVING), _T.TARGET_LOST, _P.HOLD),
    Transition((_P.APPROACH,), _T.TARGET_LOST, _P.HOLD, by_capture=False),
    Transition(CORRIDOR, _T.TARGET_LOST, _P.RETREAT, by_capture=True),
    Transition((_P.APPROACH,), _T.SIGHT_LOST, _P.HOLD, by_capture=False),
    Transition((_P.HOLD,), _T.SIGHT_REGAINED, _P.APPROACH, by_capture=False),
    Transition((_P.ALIGN, _P.APPROACH, _P.FINAL), _T.SIGHT_LOST, _P.RETREAT, by_capture=True),
    Transition((_P.CALIBRATE, _P.INSPECT, *_MOVING), _T.COMMAND_HOLD, _P.HOLD),
    Transition((_P.APPROACH, _P.DOCKED), _T.COMMAND_HOLD, _P.HOLD, by_capture=False),
    Transition(
        (_P.WAIT, _P.ALIGN, _P.APPROACH, _P.FINAL), _T.COMMAND_HOLD, _P.HOLD, by_capture=True
    ),
    Transition((_P.HOLD,), _T.COMMAND_CALIBRATE, _P.CALIBRATE),
    Transition((_P.CALIBRATE,), _T.CALIBRATION_COMPLETE, _P.HOLD),
    Transition((_P.HOLD,), _T.COMMAND_INSPECT, _P.INSPECT),
    Transition((_P.INSPECT,), _T.INSPECTION_COMPLETE, _P.HOLD),
    Transition(_FREE, _T.COMMAND_GOTO, _P.GOTO),
    Transition((_P.SURVEY,), _T.COMMAND_GOTO, _P.GOTO, by_capture=False),
    Transition((_P.APPROACH, _P.DOCKED), _T.COMMAND_GOTO, _P.GOTO, by_capture=False),
    Transition((_P.WAIT, _P.ALIGN), _T.COMMAND_GOTO, _P.GOTO, by_capture=True),
    Transition(
        (_P.HOLD, _P.CALIBRATE, _P.INSPECT, _P.ABORT, _P.GOTO), _T.COMMAND_RETREAT, _P.RETREAT
    ),
    Transition((_P.APPROACH, _P.DOCKED), _T.COMMAND_RETREAT, _P.RETREAT, by_capture=False),
    Transition((_P.WAIT, *CORRIDOR, *ATTACHED), _T.COMMAND_RETREAT, _P.RETREAT, by_capture=True),
    Transition(
        (_P.HOLD, _P.CALIBRATE, _P.INSPECT, _P.RETREAT, _P.GOTO), _T.COMMAND_ABORT, _P.ABORT
    ),
    Transition((_P.APPROACH, _P.DOCKED), _T.COMMAND_ABORT, _P.ABORT, by_capture=False),
    Transition((_P.WAIT, *CORRIDOR, *ATTACHED), _T.COMMAND_ABORT, _P.ABORT, by_capture=True),
    Transition(_MOVING, _T.MOVE_COMPLETE, _P.HOLD),
    Transition(_FREE, _T.COMMAND_APPROACH, _P.APPROACH, by_capture=False),
    Transition((_P.APPROACH,), _T.WITHIN_TOLERANCE, _P.DOCKED, by_capture=False),
    Transition((_P.DOCKED,), _T.OUTSIDE_TOLERANCE, _P.APPROACH, by_capture=False),
    Transition(_FREE, _T.COMMAND_APPROACH, _P.ALIGN, by_capture=True),
    Transition(_FREE, _T.COMMAND_APPROACH_BLOCKED, _P.WAIT, by_capture=True),
    Transition((_P.WAIT,), _T.CORRIDOR_FREE, _P.ALIGN, by_capture=True),
    Transition((_P.ALIGN,), _T.ALIGNED, _P.APPROACH, by_capture=True),
    Transition((_P.APPROACH,), _T.FINAL_DISTANCE, _P.FINAL, by_capture=True),
    Transition((_P.FINAL,), _T.TIP_CONTACT, _P.CONTACT, by_capture=True),
    Transition(CORRIDOR, _T.LATCH_CLOSED, _P.LATCHED, by_capture=True),
    Transition((_P.LATCHED,), _T.PULL_WITHSTOOD, _P.VERIFIED, by_capture=True),
    Transition((_P.VERIFIED,), _T.COMMAND_IDENTIFY, _P.IDENTIFY, by_capture=True),
    Transition((_P.IDENTIFY,), _T.IDENTIFIED, _P.VERIFIED, by_capture=True),
    Transition((_P.VERIFIED, _P.IDENTIFY), _T.COMMAND_DETUMBLE, _P.DETUMBLE, by_capture=True),
    Transition((_P.DETUMBLE,), _T.STACK_STOPPED, _P.STACK_HOLD, by_capture=True),
    Transition((_P.STACK_HOLD,), _T.STACK_MOVED, _P.DETUMBLE, by_capture=True),
    Transition((_P.IDENTIFY, *DETUMBLING), _T.COMMAND_HOLD, _P.VERIFIED, by_capture=True),
    Transition(DETUMBLING, _T.DETUMBLE_FAILED, _P.VERIFIED, by_capture=True),
    Transition((*CORRIDOR, *ATTACHED), _T.ATTEMPT_FAILED, _P.RETREAT, by_capture=True),
    Transition((_P.RETREAT,), _T.NEXT_ATTEMPT, _P.ALIGN, by_capture=True),
    Transition((_P.HOLD, _P.CALIBRATE, _P.INSPECT, _P.GOTO), _T.PLANNING_FAILED, _P.RETREAT),
    Transition((_P.APPROACH, _P.DOCKED), _T.PLANNING_FAILED, _P.RETREAT, by_capture=False),
    Transition((_P.WAIT, *CORRIDOR), _T.PLANNING_FAILED, _P.RETREAT, by_capture=True),
    Transition((_P.HOLD, _P.CALIBRATE, _P.INSPECT, _P.RETREAT, _P.GOTO), _T.SAFETY_LOST, _P.ABORT),
    Transition((_P.APPROACH, _P.DOCKED), _T.SAFETY_LOST, _P.ABORT, by_capture=False),
    Transition((_P.WAIT, *CORRIDOR), _T.SAFETY_LOST, _P.ABORT, by_capture=True),
)
"""All transitions, at most one for a phase, a trigger and a kind of docking."""

_TARGETS = {
    (source, t.trigger, by_capture): t.target
    for t in TRANSITIONS
    for source in t.sources
    for by_capture in ((False, True) if t.by_capture is None else (t.by_capture,))
}
_COMMANDS = {
    "hold": Trigger.COMMAND_HOLD,
    "approach": Trigger.COMMAND_APPROACH,
    "calibrate": Trigger.COMMAND_CALIBRATE,
    "inspect": Trigger.COMMAND_INSPECT,
    "goto": Trigger.COMMAND_GOTO,
    "retreat": Trigger.COMMAND_RETREAT,
    "abort": Trigger.COMMAND_ABORT,
    "identify": Trigger.COMMAND_IDENTIFY,
    "detumble": Trigger.COMMAND_DETUMBLE,
}


def next_phase(phase: Phase, trigger: Trigger, by_capture: bool) -> Phase | None:
    """Return the phase that ``trigger`` leads to from ``phase``; None without such a transition."""
    return _TARGETS.get((phase, trigger, by_capture))


def trigger_of(command: str) -> Trigger:
    """Return the trigger of an operator command that changes phases."""
    return _COMMANDS[command]


def permitted_commands(phase: Phase, by_capture: bool) -> list[str]:
    """Return the operator commands that change ``phase``, in alphabetical order."""
    return sorted(c for c, trigger in _COMMANDS.items() if next_phase(phase, trigger, by_capture))
