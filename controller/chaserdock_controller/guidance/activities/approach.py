# SPDX-License-Identifier: Apache-2.0
"""Docking at a distance: approach along a line, and keep the docking distance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import OperatorCommand

from .. import command_validation as validation
from ..chaser_machine import Activity, ChaserMachine
from ..chaser_state import Cause, ChaserGuidance, ChaserTick, TrackingErrors
from ..phases import Phase, Trigger
from ..trajectories import move_to


def docked_offset_m(chaser: ChaserMachine) -> Array:
    """Return the centre (3,), TRF, of a chaser at its docking distance."""
    distance_m = chaser.scenario.approach.dock_distance_m
    return chaser.nominal_m / np.linalg.norm(chaser.nominal_m) * distance_m


class ApproachActivity(Activity):
    phases = (Phase.APPROACH, Phase.DOCKED)
    commands = ("approach",)
    by_capture = False

    def refuse(self, chaser: ChaserMachine, command: OperatorCommand, now_s: float) -> str:
        if reason := super().refuse(chaser, command, now_s):
            return reason
        offset_m = chaser.motion(now_s).at(np.array([now_s]))[0][0]
        return validation.why_not_along(chaser.scenario, chaser.number, offset_m)

    def enter(self, chaser: ChaserMachine, begun: ChaserGuidance, cause: Cause) -> ChaserGuidance:
        if cause.trigger in (Trigger.COMMAND_APPROACH, Trigger.SIGHT_REGAINED):
            speed = chaser.scenario.approach.max_speed_m_s
            here, there = chaser.motion(cause.now_s), docked_offset_m(chaser)
            return replace(begun, move=move_to(here, there, cause.now_s, speed))
        return replace(begun, inside_since_s=chaser.state.inside_since_s)

    def step(self, chaser: ChaserMachine, known: ChaserTick, errors: TrackingErrors) -> None:
        state, now_s, approach = chaser.state, known.now_s, chaser.scenario.approach
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
