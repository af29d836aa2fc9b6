# SPDX-License-Identifier: Apache-2.0
"""Take up a chaser's motion where the chaser is after a pause, in which guidance did not lead it.

Robots that are disarmed get no ticks, and a chaser may be without odometry or target for a while.
It then comes to rest by its fallback, while target and time laws go on.
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import length

from .chaser_machine import ChaserMachine
from .chaser_state import ChaserTick
from .horizon import ReferenceBuilder
from .moves import MovePlanner
from .phases import ATTACHED, Phase, Trigger
from .trajectories import Circuit, Escape, Glide, Motion, Slew, slew, stay


def resume_after_pause(
    chaser: ChaserMachine, known: ChaserTick, moves: MovePlanner, references: ReferenceBuilder
) -> None:
    """Restart the motion of a chaser if it was not led for longer than its commands live: from
    where it is, and from where it points. The time of its phase stands still meanwhile. Call in
    every tick in which its pose is known, before commands are executed.
    """
    now_s, led_s = known.now_s, chaser.led_s
    chaser.led_s = now_s
    lifetime_s = chaser.scenario.controller.command_lifetime_s
    if led_s is None or now_s - led_s <= lifetime_s or known.offset_m is None:
        return
    if chaser.phase in (Phase.ACQUIRE, Phase.SEARCHING, Phase.SURVEY):
        return  # they have no motion, and search without a known place
    chaser.position_m, chaser.seen, chaser.relative = known.offset_m, known.port, known.relative
    since_s = now_s - max(0.0, led_s - chaser.state.since_s)
    before = replace(chaser.state, since_s=since_s, inside_since_s=None)
    chaser.state = before
    if chaser.phase in ATTACHED:
        return
    chaser.state = replace(before, move=stay(chaser.position_m, now_s), slew=None)
    reason = f"not led for {now_s - led_s:.1f} s"
    if (motion := _again(chaser, before.move, now_s, moves)) is None:
        chaser.fire(Trigger.ATTEMPT_FAILED, now_s, reason)
    else:
        chaser.state = replace(chaser.state, move=motion)
        chaser.log(f"begins its motion again where it is: {reason}")
    turn_back = _turn_back(chaser, known, moves.speed_m_s(chaser.phase), references)
    chaser.state = replace(chaser.state, slew=turn_back)


def lead_from_here(
    chaser: ChaserMachine, known: ChaserTick, moves: MovePlanner, references: ReferenceBuilder
) -> None:
    """Let the motion of a chaser that is not led relative to the target begin where it is and
    where it points. Call in every tick in which its pose is known.
    """
    assert known.offset_m is not None
    chaser.state = replace(chaser.state, move=stay(known.offset_m, known.now_s), slew=None)
    turn = _turn_back(chaser, known, moves.goto_m_s, references)
    chaser.state = replace(chaser.state, slew=turn)


def _again(chaser: ChaserMachine, move: Motion, now_s: float, moves: MovePlanner) -> Motion | None:
    """Return the rest of a ``move`` for a chaser that rests where it is; None for a way into a
    port, which can only begin at the corridor's entry.
    """
    match move:
        case Glide():
            return None
        case Circuit():
            return msgspec.structs.replace(move, start_s=now_s, from_m=chaser.position_m)
        case Escape():
            assert moves.escapes is not None
            known = chaser.relative
            return move if known is None else moves.escapes.escape(known, now_s)[0]
        case _:
            return moves.move(chaser, move.goal_m, now_s, moves.speed_m_s(chaser.phase))


def _turn_back(
    chaser: ChaserMachine, known: ChaserTick, speed_m_s: float, references: ReferenceBuilder
) -> Slew:
    """Return the turn of a chaser to its reference attitude. It is as fast as its line of sight in
    a move at ``speed_m_s``: if it has faced the target, it does so within some degrees on the way.
    """
    assert known.own is not None
    assert known.offset_m is not None
    _, q_ref, _ = references.pose(chaser, known.target, known.now_s)
    turn = rotations.log(rotations.multiply(rotations.conjugate(q_ref), known.own.q_wxyz))
    if chaser.scenario.chaser.is_planar:
        turn = turn * np.array([0.0, 0.0, 1.0])  # it cannot lean: that is an error of the estimate
    return slew(turn, known.now_s, length(known.offset_m), speed_m_s)
