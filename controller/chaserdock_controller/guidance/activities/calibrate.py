# SPDX-License-Identifier: Apache-2.0
"""Calibrate: turn in a way that makes the errors of the camera's mounting observable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from chaserdock_protocol.messages import CameraCalibration, OperatorCommand

from .. import command_validation as validation
from ..chaser_machine import Activity, ChaserMachine
from ..chaser_state import Cause, ChaserGuidance, ChaserTick, TrackingErrors
from ..fleet import ChaserFleet
from ..phases import Phase, Trigger
from ..pointing import CALIBRATION_S


class CalibrateActivity(Activity):
    phases = (Phase.CALIBRATE,)
    commands = ("calibrate",)

    def __init__(self, fleet: ChaserFleet) -> None:
        self._notes = fleet.notes

    def refuse(self, chaser: ChaserMachine, command: OperatorCommand, now_s: float) -> str:
        at_rest = chaser.state.move.over_at(now_s)
        return validation.why_not_calibrate(chaser.scenario, chaser.phase, at_rest)

    def enter(self, chaser: ChaserMachine, begun: ChaserGuidance, cause: Cause) -> ChaserGuidance:
        return replace(begun, turns=True)

    def step(self, chaser: ChaserMachine, known: ChaserTick, errors: TrackingErrors) -> None:
        if known.now_s - chaser.state.since_s < CALIBRATION_S:
            return
        chaser.fire(Trigger.CALIBRATION_COMPLETE, known.now_s, "the manoeuvre is complete")
        if known.camera is not None:
            self._notes.append(("info", f"chaser {chaser.number}: {_describe(known.camera)}"))


def _describe(c: CameraCalibration) -> str:
    turn, sigma = (
        ", ".join(f"{np.degrees(v):.3f}" for v in x) for x in (c.turn_rad, c.turn_sigma_rad)
    )
    return f"camera calibrated: turned by ({turn}) deg in CRF, sigma ({sigma}) deg"
