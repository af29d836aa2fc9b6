# SPDX-License-Identifier: Apache-2.0
"""Inspect: fly around the target, facing it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from chaserdock_protocol.messages import OperatorCommand

from .. import command_validation as validation
from ..chaser_machine import Activity, ChaserMachine
from ..chaser_state import Cause, ChaserGuidance, ChaserTick, TrackingErrors
from ..fleet import ChaserFleet
from ..phases import Phase, Trigger
from ..trajectories import Circuit, circuit


class InspectActivity(Activity):
    phases = (Phase.INSPECT,)
    commands = ("inspect",)

    def __init__(self, fleet: ChaserFleet) -> None:
        self._fleet = fleet

    def refuse(self, chaser: ChaserMachine, command: OperatorCommand, now_s: float) -> str:
        if reason := super().refuse(chaser, command, now_s):
            return reason
        scenario, path = chaser.scenario, _circuit(chaser, now_s)
        at_rest = chaser.state.move.over_at(now_s)
        if reason := validation.why_not_inspect(scenario, chaser.number, path.from_m, at_rest):
            return reason
        others = tuple(self._fleet.others(chaser))
        if any(o.phase is Phase.INSPECT and o.state.since_s != now_s for o in others):
            return "another chaser flies around the target already: command all of them at one time"
        places = path.at(np.linspace(now_s, now_s + path.duration_s, 181))[0]
        for other in others:
            if self._fleet.inspects(other):
                continue
            apart = float(np.linalg.norm(places - other.state.move.goal_m, axis=1).min())
            if apart < scenario.limits.min_distance_chasers_m:
                return (
                    f"the way around the target comes within {apart:.3g} m of chaser {other.number}"
                )
        return self._fleet.moves.why_not_safe(chaser, path.goal_m, now_s)

    def enter(self, chaser: ChaserMachine, begun: ChaserGuidance, cause: Cause) -> ChaserGuidance:
        return replace(begun, move=_circuit(chaser, cause.now_s), faces=True)

    def step(self, chaser: ChaserMachine, known: ChaserTick, errors: TrackingErrors) -> None:
        if chaser.state.move.over_at(known.now_s):
            chaser.fire(Trigger.INSPECTION_COMPLETE, known.now_s)


def _circuit(chaser: ChaserMachine, now_s: float) -> Circuit:
    section = chaser.scenario.inspection
    start = chaser.motion(now_s).at(np.array([now_s]))[0][0]
    return circuit(start, section.axis, section.distance_m, now_s, section.speed_m_s)
