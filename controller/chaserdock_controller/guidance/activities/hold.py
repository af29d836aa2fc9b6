# SPDX-License-Identifier: Apache-2.0
"""Hold: stay at an offset from the target, before it is known and between other activities."""

from __future__ import annotations

from dataclasses import replace

from ..chaser_machine import Activity, ChaserMachine
from ..chaser_state import Cause, ChaserGuidance
from ..phases import Phase, Trigger
from ..trajectories import Move, stay, stop


def rest(chaser: ChaserMachine, now_s: float) -> Move:
    """Return the motion that brings a chaser to rest; inside a port's corridor the reference stops
    at once, as there is no room.
    """
    if chaser.seen is not None and chaser.in_corridor():
        return stay(chaser.seen.offset_m, now_s)
    return stop(chaser.motion(now_s), now_s)


class HoldActivity(Activity):
    phases = (Phase.ACQUIRE, Phase.HOLD)
    commands = ("hold",)

    def enter(self, chaser: ChaserMachine, begun: ChaserGuidance, cause: Cause) -> ChaserGuidance:
        now_s = cause.now_s
        match cause.trigger:
            case Trigger.COMMAND_HOLD:
                return replace(begun, move=rest(chaser, now_s))
            case Trigger.TARGET_LOST | Trigger.SIGHT_LOST:
                return replace(begun, move=stop(chaser.motion(now_s), now_s))
            case Trigger.INSPECTION_COMPLETE:
                return replace(begun, move=stay(begun.move.goal_m, now_s), faces=False)
            case Trigger.MOVE_COMPLETE:
                return replace(begun, faces=False)
            case _:
                return begun
