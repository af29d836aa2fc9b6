# SPDX-License-Identifier: Apache-2.0
"""First stage of a tick: check the inputs, collect the wrenches that act on the chasers."""

from __future__ import annotations

from collections.abc import Sequence

from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.interfaces import ChaserInputs, Observation, TickInputs

from .chaser import ChaserIngest
from .latency_compensation import CommandHistory
from .sighting_validation import valid_sightings


class IngestStage:
    """Runs ingest for all ``chasers``."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._timing = scenario.timing
        self.chasers = tuple(ChaserIngest(scenario, i) for i in range(len(scenario.chasers)))

    def run(self, inputs: TickInputs, sent: Sequence[CommandHistory]) -> Observation:
        """Return the checked inputs of a tick. ``sent``: the commands to each chaser so far."""
        sightings, events = valid_sightings(inputs.sightings)
        received = {c.chaser: c for c in inputs.chasers}
        observed, returned, lost = [], [], []
        for chaser, commands in zip(self.chasers, sent, strict=True):
            own = received.get(chaser.chaser, ChaserInputs(chaser.chaser))
            found, event = chaser.observe(own, inputs.tick, inputs.time_ns, commands)
            observed.append(found)
            if event is not None:
                (returned if found.lost is None else lost).append(event)
        return Observation(
            tick=inputs.tick,
            time_ns=inputs.time_ns,
            effective_ns=self._timing.effective_ns(inputs.tick),
            chasers=tuple(observed),
            sightings=sightings,
            commands=inputs.commands,
            events=(*events, *returned, *lost),
        )
