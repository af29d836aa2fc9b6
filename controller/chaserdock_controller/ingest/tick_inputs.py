# SPDX-License-Identifier: Apache-2.0
"""Collects the messages of a tick: which have arrived, which were lost, which are duplicates or
stale. No I/O.
"""

from __future__ import annotations

from collections.abc import Mapping

from chaserdock_protocol import topics
from chaserdock_protocol.extrapolation import extrapolate
from chaserdock_protocol.messages import (
    DockingStatus,
    Message,
    Odometry,
    OperatorCommand,
    Sighting,
    ThrusterReport,
    Tick,
)
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.topics import Topic

from chaserdock_controller.interfaces import LogEntry, TickInputs

from .odometry_validation import OdometryValidation

_REMEMBERED_TICKS = 256


class TickInputCollector:
    """The newest message of every chaser on every topic, the sightings since the tick before, and
    the lost messages.
    """

    def __init__(self, scenario: FlightScenario) -> None:
        self.odometry_validation = OdometryValidation(scenario)
        self._odometry: dict[int, Odometry] = {}
        self._thrusters: dict[int, ThrusterReport] = {}
        self._docking: dict[int, DockingStatus] = {}
        self._sightings: list[Sighting] = []
        self._received_sightings: set[tuple[int, int]] = set()
        self._usable_sightings: dict[tuple[int, int], bool] = {}
        self._forgotten_tick = 0
        self._lost: set[tuple[str, int, int]] = set()
        self._has_thrusters = scenario.chaser.actuation == "thrusters"
        self._has_port = [
            scenario.docking.port_of(i) is not None for i in range(len(scenario.chasers))
        ]
        self._extrapolation_ns = scenario.controller.command_lifetime_s * 1e9

    def add_odometry(self, odometry: Odometry, doubtful: bool = False) -> list[LogEntry] | None:
        """Add an odometry and return the events to log; None if one of that chaser as new is known.
        ``doubtful``: what was received before it may be wrong."""
        if _is_overtaken(odometry, self._odometry.get(odometry.chaser)):
            return None
        self._odometry[odometry.chaser], events = self.odometry_validation.update(
            odometry, doubtful
        )
        return events

    def add_docking(self, docking: DockingStatus) -> bool:
        """Add a docking status; return False if one of that chaser as new is known."""
        if _is_overtaken(docking, self._docking.get(docking.chaser)):
            return False
        self._docking[docking.chaser] = docking
        return True

    def add_thruster_report(self, report: ThrusterReport) -> bool:
        """Add a thruster report; return False if one of that chaser as new is known."""
        if _is_overtaken(report, self._thrusters.get(report.chaser)):
            return False
        self._thrusters[report.chaser] = report
        return True

    def add_sighting(self, sighting: Sighting) -> bool:
        """Add a sighting; return False for a duplicate, which must not count as evidence twice."""
        key = (sighting.tick, sighting.chaser)
        if sighting.solutions and self._usable_sightings.get(key):
            return False
        self._received_sightings.add(key)
        self._usable_sightings[key] = bool(sighting.solutions)
        self._sightings.append(sighting)
        return True

    def add_lost(self, topic: Topic, chaser: int, tick: int) -> None:
        """Note that a message of a tick will not arrive."""
        self._lost.add((topic.key, chaser, tick))

    def is_complete(self, tick: Tick) -> bool:
        """Return whether every message that a tick needs has arrived or is lost."""
        return not any(self._missing(tick, i) for i in tick.chasers)

    def missing_keys(self, tick: Tick) -> tuple[str, ...]:
        """Return the keys of the messages that a tick still needs."""
        return tuple(topic.key_of(i) for i in tick.chasers for topic in self._missing(tick, i))

    def _missing(self, tick: Tick, i: int) -> list[Topic]:
        missing = []
        if not self._has_arrived(topics.ODOMETRY, self._odometry, i, tick):
            missing.append(topics.ODOMETRY)
        if self._has_thrusters and not self._has_arrived(
            topics.THRUSTERS, self._thrusters, i, tick
        ):
            missing.append(topics.THRUSTERS)
        if self._has_port[i] and not self._has_arrived(topics.DOCKING, self._docking, i, tick):
            missing.append(topics.DOCKING)
        sighting = (tick.tick, i) in self._received_sightings or self._is_lost(
            topics.SIGHTING, i, tick
        )
        if tick.images and not sighting:
            missing.append(topics.SIGHTING)
        return missing

    def _has_arrived(
        self,
        topic: Topic,
        newest: Mapping[int, Odometry | ThrusterReport | DockingStatus],
        i: int,
        tick: Tick,
    ) -> bool:
        return (i in newest and newest[i].tick == tick.tick) or self._is_lost(topic, i, tick)

    def _is_lost(self, topic: Topic, i: int, tick: Tick) -> bool:
        return (topic.key, i, tick.tick) in self._lost

    def take(self, tick: Tick, commands: tuple[OperatorCommand, ...]) -> TickInputs:
        """Return the inputs of a tick and remove what only that tick uses."""
        odometry = self._odometry_at(tick)
        inputs = TickInputs(
            tick.tick,
            tick.sim_time_ns,
            odometry,
            # Equal inputs in any order of arrival give equal results.
            tuple(sorted(self._sightings, key=lambda s: (s.tick, s.chaser))),
            commands,
            dict(self._thrusters),
            {i: d for i, d in self._docking.items() if d.tick == tick.tick and i in tick.chasers},
            {
                i: o
                for i, o in sorted(self._odometry.items())
                if o.tick < tick.tick and i in tick.chasers
            },
        )
        self._sightings.clear()
        self._received_sightings = {key for key in self._received_sightings if key[0] > tick.tick}
        if tick.tick >= self._forgotten_tick + 2 * _REMEMBERED_TICKS:
            self._forgotten_tick = oldest = tick.tick - _REMEMBERED_TICKS
            self._usable_sightings = {
                k: usable for k, usable in self._usable_sightings.items() if k[0] > oldest
            }
        self._lost = {lost for lost in self._lost if lost[2] > tick.tick}
        return inputs

    def _odometry_at(self, tick: Tick) -> dict[int, Odometry]:
        """Return the odometry of a tick; a lost one is extrapolated for the lifetime of a command."""
        odometry = {
            i: o for i, o in self._odometry.items() if o.tick == tick.tick and i in tick.chasers
        }
        for i in tick.chasers:
            last = self._odometry.get(i)
            if i in odometry or last is None or not self._is_lost(topics.ODOMETRY, i, tick):
                continue
            if tick.sim_time_ns - last.sim_time_ns <= self._extrapolation_ns:
                odometry[i] = extrapolate(last, tick.tick, tick.sim_time_ns)
        return dict(sorted(odometry.items()))


def _is_overtaken(message: Message, known: Message | None) -> bool:
    """Return whether a message is a duplicate of the known one, or older."""
    return known is not None and message.tick <= known.tick
