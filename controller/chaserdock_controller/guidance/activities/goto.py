# SPDX-License-Identifier: Apache-2.0
"""Goto: fly to an offset from the target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from chaserdock_models.arrays import length
from chaserdock_protocol.messages import OperatorCommand
from numpy.typing import ArrayLike

from .. import command_validation as validation
from ..approach_line import approach_line
from ..chaser_machine import Activity, ChaserMachine
from ..chaser_state import Cause, ChaserGuidance, ChaserTick, TrackingErrors
from ..fleet import ChaserFleet
from ..phases import Phase, Trigger
from ..trajectories import move_to, stay

_NEARER_M = 0.05
"""A place nearer to the target than the chaser's reference position by more than this is near: a
survey drifts less."""


def goal_of(chaser: ChaserMachine, command: OperatorCommand) -> ArrayLike | None:
    """Return where a `goto` leads (3,), TRF: without an offset, to the entry of the chaser's chosen
    port; None without both.
    """
    sighted = chaser.sighted
    if command.offset_m is not None or sighted is None or sighted.port is None:
        return command.offset_m
    return approach_line(chaser.scenario, chaser.number, sighted.port).entry_m


class GotoActivity(Activity):
    phases = (Phase.GOTO,)
    commands = ("goto",)

    def __init__(self, fleet: ChaserFleet) -> None:
        self._fleet = fleet

    def refuse(self, chaser: ChaserMachine, command: OperatorCommand, now_s: float) -> str:
        if reason := super().refuse(chaser, command, now_s):
            return reason
        if chaser.in_corridor():
            return "the chaser is in its corridor: retreat or abort first"
        scenario, i = chaser.scenario, chaser.number
        goals_m, wanted_m = self._fleet.goals_besides(chaser), goal_of(chaser, command)
        if reason := validation.why_not_goto(scenario, i, wanted_m, goals_m):
            return reason
        goal_m = np.asarray(wanted_m)
        if length(goal_m) < length(chaser.nominal_m) - _NEARER_M and (
            reason := validation.why_not_closed(scenario, chaser.sighted)
        ):
            return reason
        moves = self._fleet.moves
        if command.offset_m is None and (reason := moves.why_not_past(chaser, goal_m, now_s)):
            return reason
        return validation.why_not_in_cone(scenario, i, goal_m) or moves.why_not_safe(
            chaser, goal_m, now_s
        )

    def start(self, chaser: ChaserMachine, command: OperatorCommand, now_s: float) -> None:
        goal_m = np.asarray(goal_of(chaser, command))
        if (sighted := chaser.sighted) is not None and sighted.port is not None:
            chaser.use_port(sighted.port)
        chaser.fire(Trigger.COMMAND_GOTO, now_s, place_m=goal_m)

    def enter(self, chaser: ChaserMachine, begun: ChaserGuidance, cause: Cause) -> ChaserGuidance:
        """Begin the commanded move. A chaser that has searched flies from its present place to its
        nominal offset and faces the target on the way.
        """
        moves, now_s = self._fleet.moves, cause.now_s
        assert cause.place_m is not None
        if cause.trigger is Trigger.TARGET_SETTLED:
            here = stay(cause.place_m, now_s)
            move = move_to(here, chaser.nominal_m, now_s, moves.goto_m_s)
            return replace(begun, move=move, faces=True)
        return replace(begun, move=moves.move(chaser, cause.place_m, now_s, moves.goto_m_s))

    def step(self, chaser: ChaserMachine, known: ChaserTick, errors: TrackingErrors) -> None:
        if chaser.state.move.over_at(known.now_s):
            chaser.fire(Trigger.MOVE_COMPLETE, known.now_s)
