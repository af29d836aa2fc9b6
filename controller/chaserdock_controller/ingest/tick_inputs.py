# SPDX-License-Identifier: Apache-2.0
"""Collects the messages of a tick and tracks which have arrived, are lost, duplicated or stale. No
I/O.
"""

from __future__ import annotations

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

from chaserdock_controller.interfaces import ChaserInputs, LogEntry, TickInputs

from .odometry_validation import OdometryValidation

_REMEMBERED_TICKS = 256
"""Ticks for which it is remembered whether their sightings could be used; memory is bounded by
twice as many.
"""


class Mailbox:
    """The newest messages of one chaser. ``validation``: removes jumps from its odometry."""

    def __init__(self, scenario: FlightScenario) -> None:
        self.validation = OdometryValidation(scenario)
        self.odometry: Odometry | None = None
        self.thrusters: ThrusterReport | None = None
        self.docking: DockingStatus | None = None


class TickInputCollector:
    """Collects the newest messages of the ``chasers``, the sightings since the previous tick, and
    which messages are lost. Refuses messages of chasers that are not in the mission.
    """

    def __init__(self, scenario: FlightScenario) -> None:
        self.chasers = tuple(Mailbox(scenario) for _ in scenario.chasers)
        self._sightings: list[Sighting] = []
        self._received_sightings: set[tuple[int, int]] = set()
        self._usable_sightings: dict[tuple[int, int, int], bool] = {}
        self._forgotten_tick = 0
        self._lost: set[tuple[str, int, int]] = set()
        self._has_thrusters = scenario.chaser.actuation == "thrusters"
        self._has_port = [
            scenario.docking.port_of(i) is not None for i in range(len(scenario.chasers))
        ]
        self._extrapolation_ns = scenario.controller.command_lifetime_s * 1e9

    def add_odometry(self, odometry: Odometry, doubtful: bool = False) -> list[LogEntry] | None:
        """Add odometry. Returns the events to log; None if the known odometry of that chaser is as
        new.

        ``doubtful``: its odometry before may be wrong.
        """
        own = self._mailbox(odometry.chaser)
        if own is None or _is_overtaken(odometry, own.odometry):
            return None
        own.odometry, events = own.validation.update(odometry, doubtful)
        return events

    def add_docking(self, docking: DockingStatus) -> bool:
        """Add a docking status; return False if the known one of that chaser is as new."""
        own = self._mailbox(docking.chaser)
        if own is None or _is_overtaken(docking, own.docking):
            return False
        own.docking = docking
        return True

    def add_thruster_report(self, report: ThrusterReport) -> bool:
        """Add a thruster report; return False if the known one of that chaser is as new."""
        own = self._mailbox(report.chaser)
        if own is None or _is_overtaken(report, own.thrusters):
            return False
        own.thrusters = report
        return True

    def _mailbox(self, chaser: int) -> Mailbox | None:
        return self.chasers[chaser] if chaser < len(self.chasers) else None

    def add_sighting(self, sighting: Sighting) -> bool:
        """Add a sighting; return False for a duplicate, which must not count twice as evidence."""
        key = (sighting.tick, sighting.sim_time_ns, sighting.chaser)
        if self._mailbox(sighting.chaser) is None:
            return False
        if sighting.solutions and self._usable_sightings.get(key):
            return False
        self._received_sightings.add((sighting.tick, sighting.chaser))
        self._usable_sightings[key] = bool(sighting.solutions)
        self._sightings.append(sighting)
        return True

    def add_lost(self, topic: Topic, chaser: int, tick: int) -> None:
        """Record that a message of a tick will not arrive."""
        self._lost.add((topic.key, chaser, tick))

    def is_complete(self, tick: Tick) -> bool:
        """Return whether every message that a tick needs has arrived or is lost."""
        return not any(self._missing(tick, i) for i in tick.chasers)

    def missing_keys(self, tick: Tick) -> tuple[str, ...]:
        """Return the keys of the messages that a tick still needs."""
        return tuple(topic.key_of(i) for i in tick.chasers for topic in self._missing(tick, i))

    def _missing(self, tick: Tick, i: int) -> list[Topic]:
        own, missing = self.chasers[i], []
        if not self._has_arrived(topics.ODOMETRY, own.odometry, i, tick):
            missing.append(topics.ODOMETRY)
        if self._has_thrusters and not self._has_arrived(topics.THRUSTERS, own.thrusters, i, tick):
            missing.append(topics.THRUSTERS)
        if self._has_port[i] and not self._has_arrived(topics.DOCKING, own.docking, i, tick):
            missing.append(topics.DOCKING)
        sighting = (tick.tick, i) in self._received_sightings or self._is_lost(
            topics.SIGHTING, i, tick
        )
        if tick.images and not sighting:
            missing.append(topics.SIGHTING)
        return missing

    def _has_arrived(self, topic: Topic, newest: Message | None, i: int, tick: Tick) -> bool:
        return (newest is not None and newest.tick == tick.tick) or self._is_lost(topic, i, tick)

    def _is_lost(self, topic: Topic, i: int, tick: Tick) -> bool:
        return (topic.key, i, tick.tick) in self._lost

    def take(self, tick: Tick, commands: tuple[OperatorCommand, ...]) -> TickInputs:
        """Return the inputs of a tick and drop what only that tick uses."""
        inputs = TickInputs(
            tick.tick,
            tick.sim_time_ns,
            tuple(self._inputs_of(i, own, tick) for i, own in enumerate(self.chasers)),
            # The order of arrival must not affect results.
            tuple(sorted(self._sightings, key=lambda s: (s.tick, s.chaser, s.sim_time_ns))),
            commands,
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

    def _inputs_of(self, i: int, own: Mailbox, tick: Tick) -> ChaserInputs:
        if i not in tick.chasers:
            return ChaserInputs(i, thrusters=own.thrusters)
        docking, newest = own.docking, own.odometry
        return ChaserInputs(
            i,
            odometry=self._odometry_at(i, newest, tick),
            outdated=newest if newest is not None and newest.tick < tick.tick else None,
            thrusters=own.thrusters,
            docking=docking if docking is not None and docking.tick == tick.tick else None,
        )

    def _odometry_at(self, i: int, newest: Odometry | None, tick: Tick) -> Odometry | None:
        """Return the odometry of a tick. A lost one is extrapolated for at most a command's
        lifetime.
        """
        if newest is None or newest.tick == tick.tick:
            return newest
        if not self._is_lost(topics.ODOMETRY, i, tick):
            return None
        recent = tick.sim_time_ns - newest.sim_time_ns <= self._extrapolation_ns
        return extrapolate(newest, tick.tick, tick.sim_time_ns) if recent else None


def _is_overtaken(message: Message, known: Message | None) -> bool:
    """Return whether a message is as old as the known one, or older."""
    return known is not None and message.tick <= known.tick
