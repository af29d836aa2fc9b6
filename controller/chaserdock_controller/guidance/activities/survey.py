# SPDX-License-Identifier: Apache-2.0
"""Survey: stay in place, by odometry alone, while an unknown target is mapped.

The chaser does not turn with the target, so that its camera sees all sides.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from chaserdock_models.setpoint_tracking import Setpoint, track_setpoint

from chaserdock_controller.interfaces import DirectCommand

from ..chaser_machine import Activity, ChaserMachine
from ..chaser_state import ChaserTick
from ..phases import Phase
from ..pointing import SurveyPlace


class SurveyActivity(Activity):
    phases = (Phase.SURVEY,)

    def command(self, chaser: ChaserMachine, known: ChaserTick) -> DirectCommand | None:
        """Return the wrench that keeps the chaser where it was when the survey began."""
        own, state = known.own, chaser.state
        assert own is not None
        place = state.survey
        if place is None:
            place = SurveyPlace(np.array(own.position_m), np.array(own.q_wxyz))
            chaser.state = replace(state, survey=place)
        setpoint = Setpoint(place.position_m, np.zeros(3), place.q_wxyz, np.zeros(3), np.zeros(6))
        return DirectCommand("track", track_setpoint(own, chaser.scenario.chaser, setpoint))
