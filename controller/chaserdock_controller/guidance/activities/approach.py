# SPDX-License-Identifier: Apache-2.0
"""Docking at a distance: approach along a line, and keep the docking distance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from chaserdock_models.arrays import length
from chaserdock_protocol.messages import OperatorCommand

from .. import command_validation as validation
from ..chaser_machine import Activity, ChaserMachine
from ..chaser_state import Cause, ChaserGuidance, ChaserTick, TrackingErrors
from ..phases import Phase, Trigger
from ..trajectories import move_to

_FOLLOWED_M = 0.0005
"""Shift of a docked place with its port from which the reference follows, m: well below what a
docked chaser may be off."""


class ApproachActivity(Activity):
    phases = (Phase.APPROACH, Phase.DOCKED)
    commands = ("approach",)
    by_capture = False

    def refuse(self, chaser: ChaserMachine, command: OperatorCommand, now_s: float) -> str:
        if reason := super().refuse(chaser, command, now_s):
            return reason
        if reason := validation.why_not_closed(chaser.scenario, chaser.sighted):
            return reason
        offset_m = chaser.motion(now_s).at(np.array([now_s]))[0][0]
        return validation.why_not_along(chaser.line, offset_m)

    def enter(self, chaser: ChaserMachine, begun: ChaserGuidance, cause: Cause) -> ChaserGuidance:
        if cause.trigger in (Trigger.COMMAND_APPROACH, Trigger.SIGHT_REGAINED):
            speed = chaser.scenario.approach.max_speed_m_s
            here, there = chaser.motion(cause.now_s), chaser.line.docked_m
            return replace(begun, move=move_to(here, there, cause.now_s, speed))
        return replace(begun, inside_since_s=chaser.state.inside_since_s)

    def step(self, chaser: ChaserMachine, known: ChaserTick, errors: TrackingErrors) -> None:
        state, now_s, approach = chaser.state, known.now_s, chaser.scenario.approach
        off_m = length(chaser.line.docked_m - state.move.goal_m)
        if chaser.port is not None and off_m > _FOLLOWED_M:  # the port has moved with its map
            move = move_to(state.move, chaser.line.docked_m, now_s, approach.max_speed_m_s)
            state = chaser.state = replace(state, move=move)
        if not state.over_at(now_s):
            return
        inside = (
            errors.position_m <= approach.docked_position_m
            and errors.angle_rad <= math.radians(approach.docked_angle_deg)
        )
        since = state.inside_since(inside, now_s)
        chaser.state = replace(state, inside_since_s=since)
        if since is None:
            chaser.fire(Trigger.OUTSIDE_TOLERANCE, now_s)
        elif now_s - since >= approach.docked_time_s:
            chaser.fire(Trigger.WITHIN_TOLERANCE, now_s)
