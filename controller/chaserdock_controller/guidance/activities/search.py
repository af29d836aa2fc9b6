# SPDX-License-Identifier: Apache-2.0
"""Search: turn along the search pattern until the target is found and its motion is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.interfaces import DirectCommand, TargetState

from ..chaser_machine import Activity, ChaserMachine
from ..chaser_state import ChaserTick
from ..phases import Phase
from ..pointing import SearchProgress, facing, search_wrench, turning_wrench

# Largest sigmas of the target's rates at which a chaser leaves the search.
_SETTLED_M_S, _SETTLED_RAD_S = 0.01, 0.02


class SearchActivity(Activity):
    phases = (Phase.SEARCHING,)

    def __init__(self, scenario: FlightScenario) -> None:
        self._body, self._camera = scenario.chaser, scenario.camera_model()
        self._lifetime_s = scenario.controller.command_lifetime_s

    def command(self, chaser: ChaserMachine, known: ChaserTick) -> DirectCommand | None:
        """Turn along the search pattern, or towards the target once its pose is known.

        The pattern pauses while the target is being acquired in an earlier image, and goes on where
        it was after a time without these commands.
        """
        own, target, state = known.own, known.target, chaser.state
        assert own is not None
        if target.is_known:
            q = facing(own.q_wxyz, target.position_m - own.position_m)
            return DirectCommand("search", turning_wrench(own, self._body, q, q))
        now_s = own.sim_time_ns / 1e9
        before = state.search or SearchProgress(np.array(own.q_wxyz), now_s)
        if now_s - before.updated_s > self._lifetime_s:  # it did something else, or nothing
            before = before.taken_up(now_s)
        progress = before.at(now_s, known.acquiring)
        chaser.state = replace(state, search=progress)
        time_s = now_s - state.since_s - progress.paused_s
        wrench = search_wrench(own, self._body, self._camera, progress.q_start_wxyz, time_s)
        return DirectCommand("search", wrench)


def is_settled(target: TargetState) -> bool:
    """Return whether the target's rates are known well enough to fly relative to it."""
    v = target.covariance.diagonal().tolist()
    if v[3] + v[4] + v[5] < _SETTLED_M_S**2 and v[9] + v[10] + v[11] < _SETTLED_RAD_S**2:
        return True  # no eigenvalue is larger than the trace
    largest = [
        float(np.linalg.eigvalsh(target.covariance[i : i + 3, i : i + 3])[-1]) for i in (3, 9)
    ]
    return largest[0] < _SETTLED_M_S**2 and largest[1] < _SETTLED_RAD_S**2
