# SPDX-License-Identifier: Apache-2.0
"""First stage of a tick: check the inputs and predict the chasers' own states."""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.interfaces import AppliedImpulse, Observation, TickInputs

from .latency_compensation import CommandHistory, predict_state, predict_state_with_impulse
from .lost_chasers import LostChasers
from .odometry_validation import why_invalid
from .thruster_reports import ThrusterReports


class IngestStage:
    """Keeps the newest thruster report and odometry of every chaser."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario = scenario
        self.thrusters = ThrusterReports(scenario)
        self.lost_chasers = LostChasers()

    def run(self, inputs: TickInputs, history: CommandHistory) -> Observation:
        """Return the checked inputs of a tick. ``history``: the commands sent so far."""
        invalid = {i: reason for i, o in inputs.odometry.items() if (reason := why_invalid(o))}
        odometry = {i: o for i, o in inputs.odometry.items() if i not in invalid}
        self.thrusters.update(inputs.thrusters)
        effective_ns = self._scenario.timing.effective_ns(inputs.tick)
        events = self.lost_chasers.update(odometry, inputs.time_ns)
        return Observation(
            tick=inputs.tick,
            time_ns=inputs.time_ns,
            effective_ns=effective_ns,
            odometry=odometry,
            invalid=invalid,
            lost=self.lost_chasers.obstacles(inputs.time_ns),
            sightings=inputs.sightings,
            commands=inputs.commands,
            docking=inputs.docking,
            impulses=self._impulses(odometry, inputs, history),
            predicted={i: self._predict(o, inputs.tick, effective_ns, history) for i, o in odometry.items()},
            input_limits={i: self.thrusters.limits(i) for i in inputs.odometry},
            events=tuple(events),
        )

    def _predict(self, odometry: Odometry, tick: int, effective_ns: int, history: CommandHistory) -> Array:
        body = self._scenario.chaser
        impulse = self.thrusters.coming(odometry.chaser, tick)
        if impulse is None:
            return predict_state(odometry, history, effective_ns, body)
        return predict_state_with_impulse(odometry, impulse, effective_ns, body)

    def _impulses(
        self, odometry: dict[int, Odometry], inputs: TickInputs, history: CommandHistory
    ) -> dict[int, AppliedImpulse]:
        measured = self.thrusters.given(inputs.tick)
        since_ns = inputs.time_ns - round(1e9 / self._scenario.time.rate_hz)
        impulses = {}
        for i in odometry:
            if i in measured:
                impulses[i] = AppliedImpulse(measured[i], measured=True)
                continue
            segments = history.segments(i, since_ns, inputs.time_ns)
            commanded = sum((w * ((end - begin) / 1e9) for begin, end, w in segments), np.zeros(6))
            impulses[i] = AppliedImpulse(commanded, measured=False)
        return impulses
