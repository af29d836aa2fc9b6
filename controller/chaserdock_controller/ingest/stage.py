# SPDX-License-Identifier: Apache-2.0
"""First stage of a tick: check the inputs, and collect what acts on the chasers."""

from __future__ import annotations

from collections.abc import Container, Iterable

import msgspec
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.interfaces import AppliedImpulse, Observation, TickInputs

from .latency_compensation import CommandHistory
from .lost_chasers import LostChasers
from .odometry_validation import why_invalid
from .sighting_validation import valid_sightings
from .thruster_reports import ThrusterReports


class IngestStage:
    """Keeps the newest thruster report and odometry of every chaser."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario = scenario
        self.thrusters = ThrusterReports(scenario)
        self.lost_chasers = LostChasers()

    def run(self, inputs: TickInputs, history: CommandHistory) -> Observation:
        """Return the checked inputs of a tick. ``history``: the commands sent so far."""
        # What is extrapolated from an invalid state is invalid.
        sources = {i: inputs.outdated.get(i, o) for i, o in inputs.odometry.items()}
        invalid = {i: reason for i, o in sources.items() if (reason := why_invalid(o))}
        odometry = {i: o for i, o in inputs.odometry.items() if i not in invalid}
        self.thrusters.update(inputs.thrusters)
        interrupted = self.lost_chasers.absent(inputs.time_ns)
        effective_ns = self._scenario.timing.effective_ns(inputs.tick)
        sightings, events = valid_sightings(inputs.sightings)
        events += self.lost_chasers.update(odometry, inputs.time_ns)
        return Observation(
            tick=inputs.tick,
            time_ns=inputs.time_ns,
            effective_ns=effective_ns,
            odometry=odometry,
            outdated=self._outdated(inputs),
            invalid=invalid,
            lost=self.lost_chasers.obstacles(inputs.time_ns),
            sightings=sightings,
            commands=inputs.commands,
            docking=inputs.docking,
            impulses=self._impulses(odometry, inputs, history),
            last_commands=self._last_commands(odometry, inputs.time_ns, history),
            thruster_impulses=self.thrusters.given_by_thruster(inputs.tick),
            ahead={i: self._ahead(i, inputs, effective_ns, history) for i in odometry},
            input_limits={i: self.thrusters.limits(i) for i in inputs.odometry},
            isolated=self.thrusters.isolated(),
            events=tuple(events),
            interrupted=interrupted,
        )

    def _outdated(self, inputs: TickInputs) -> dict[int, Odometry]:
        """Return the valid odometry of earlier ticks, with the times of these: the clock of a
        chaser may be wrong.
        """
        tick_time_ns = self._scenario.timing.tick_time_ns
        return {
            i: msgspec.structs.replace(o, sim_time_ns=tick_time_ns(o.tick))
            for i, o in inputs.outdated.items()
            if not why_invalid(o)
        }

    def _ahead(
        self, i: int, inputs: TickInputs, effective_ns: int, history: CommandHistory
    ) -> tuple[tuple[float, Array], ...]:
        """Return what acts on a chaser until ``effective_ns``; an impulse of thrusters is spread
        evenly.
        """
        impulse = self.thrusters.coming(i, inputs.tick)
        if impulse is None:
            return history.ahead(i, inputs.time_ns, effective_ns)
        duration_s = (effective_ns - inputs.time_ns) / 1e9
        return ((duration_s, impulse / duration_s),) if duration_s > 0.0 else ()

    def _last_commands(
        self, heard: Container[int], time_ns: int, history: CommandHistory
    ) -> dict[int, Array]:
        silent = (i for i in range(len(self._scenario.chasers)) if i not in heard)
        return {i: history.segments(i, time_ns, time_ns + 1)[-1][2] for i in silent}

    def _impulses(
        self, chasers: Iterable[int], inputs: TickInputs, history: CommandHistory
    ) -> dict[int, AppliedImpulse]:
        measured = self.thrusters.given(inputs.tick)
        since_ns = inputs.time_ns - round(1e9 / self._scenario.time.rate_hz)
        impulses = {}
        for i in chasers:
            if i in measured:
                impulses[i] = AppliedImpulse(measured[i], measured=True)
                continue
            segments = history.segments(i, since_ns, inputs.time_ns)
            commanded = sum((w * ((end - begin) / 1e9) for begin, end, w in segments), np.zeros(6))
            impulses[i] = AppliedImpulse(commanded, measured=False)
        return impulses
