"""A chaser process: picture -> sighting, wrench command -> actuators. It never sees the truth."""

from __future__ import annotations

import time
from dataclasses import dataclass

import cv2
import msgspec
from chaserdock_protocol import topics
from chaserdock_protocol.messages import (
    ActuatorCommand,
    DockingStatus,
    Event,
    Image,
    JoinReply,
    Level,
    MissionEnd,
    Odometry,
    Presence,
    Sighting,
    Tick,
    WrenchCommand,
)
from chaserdock_protocol.presence import PresenceTeller, health_of, take_part
from chaserdock_protocol.runtime import ProcessOptions, Stop
from chaserdock_protocol.scenario import Scenario, scenario_from_json
from chaserdock_protocol.transport import Node

from chaserdock_agents.perception import make_perception
from chaserdock_agents.thrusters.pilot import JetPilot

from .eye import look, prediction_from
from .pilot import brake, passed_on, refusal


def main(options: ProcessOptions) -> int:
    """Runs chaser ``options.chaser``; 0 when the mission ended, 1 when stopped before, 2 when it could not join."""
    cv2.setNumThreads(1)
    number = int(options.chaser or 0)

    def work(node: Node, mission: JoinReply, instance: str, stop: Stop) -> int:
        chaser = Chaser(node, scenario_from_json(mission.scenario_json, "the world's scenario"), number)
        chaser.open(instance, realtime=mission.mode == "realtime")
        while not (chaser.ended or stop()):
            chaser.listen()
        chaser.farewell()
        return 0 if chaser.ended else 1

    return take_part(f"chaser/{number}", "chaser", options, work)


@dataclass
class Chaser:
    """The state of one chaser process: what it last knew, saw and flew."""

    node: Node
    scenario: Scenario
    number: int
    ended: bool = False
    odometry: Odometry | None = None
    docking: DockingStatus | None = None
    sighting: Sighting | None = None
    tick: Tick | None = None
    flown_tick: int = -1
    flown_ns: int | None = None
    realtime: bool = False

    def __post_init__(self) -> None:
        self.name = f"chaser/{self.number}"
        self._forgotten = self._refusing = False
        self._watched_tick = -1
        self._has_port = self.scenario.docking.port_of(self.number) is not None
        self._jets = (
            JetPilot(self.scenario, self.number) if self.scenario.chaser.actuation == "thrusters" else None
        )
        self._perception = make_perception(self.scenario)

    def open(self, instance: str, realtime: bool) -> None:
        """Opens the topics, then tells its presence."""
        node, i = self.node, self.number
        self.realtime = realtime
        node.advertise(topics.SIGHTING, i)
        node.advertise(topics.ACTUATORS, i)
        if self._jets is not None:
            node.advertise(topics.JETS, i)
        node.subscribe(topics.IMAGE, i, latest=realtime)
        node.subscribe(topics.ODOMETRY, i, latest=realtime)
        node.subscribe(topics.DOCKING, i)
        node.subscribe(topics.WRENCH, i)
        node.subscribe(topics.TICK)
        node.subscribe(topics.END)
        self.teller = PresenceTeller(node, instance)

    def listen(self) -> None:
        """Waits for one message and does what it asks for."""
        received = self.node.receive(0.2)
        match received.message if received is not None else None:
            case Image() as image:
                self._look(image)
            case Odometry() as odometry:
                self.odometry = odometry
                self._watch_jets()
                self._brake_if_alone()
                self._brake_if_forgotten(odometry)
            case DockingStatus() as docking:
                self.docking = docking
                self._watch_jets()
            case WrenchCommand() as command:
                self._fly(command)
            case Tick() as tick:
                self.tick = tick
                self.teller.settled.set()
                self._watch_jets()
                self._brake_if_alone()
                if tick.revision == 0 and tick.tick % self.scenario.time.rate_hz == 0:
                    health = health_of(self.node, tick.tick, tick.sim_time_ns)
                    self.node.publish(topics.HEALTH, health, self.name)
            case Presence() as presence:
                self.teller.take(presence)
            case MissionEnd():
                self.ended = True

    def _look(self, image: Image) -> None:
        begun_s = time.perf_counter()
        sighting = look(self._perception, image, prediction_from(self.sighting))
        took_s = time.perf_counter() - begun_s
        if sighting.status == "bad_picture" and (
            self.sighting is None or self.sighting.status != "bad_picture"
        ):
            self._warn("bad picture", sighting.detail, image.tick, image.sim_time_ns)
        self.sighting = sighting
        self.node.publish(
            topics.SIGHTING, msgspec.structs.replace(sighting, wall_estimate_s=took_s), self.number
        )

    def _watch_jets(self) -> None:
        """Tells the controller what the jets can do, and everyone what has been found of them.

        Once a tick that is open, when it has brought the odometry and, with a docking sensor, its word, in whatever
        order. The last odometry belongs to no open tick, and may come after the mission's end or before it.
        """
        tick, odometry, docking = self.tick, self.odometry, self.docking
        if self._jets is None or tick is None or odometry is None:
            return
        if odometry.tick != tick.tick or self._watched_tick >= tick.tick:
            return
        if self._has_port and (docking is None or docking.tick != tick.tick):
            return
        self._watched_tick = tick.tick
        touched = docking is not None and (docking.contact or docking.latched)
        self.node.publish(topics.JETS, self._jets.observe(odometry, touched), self.number)
        for level, what, detail in self._jets.drain_events():
            self._tell(level, what, detail, odometry.tick, odometry.sim_time_ns)

    def _fly(self, command: WrenchCommand) -> None:
        now_ns = self.odometry.sim_time_ns if self.odometry is not None else 0
        why_not = refusal(command, self.number, self.scenario.chaser, self.flown_tick, now_ns)
        if why_not is None:
            self.flown_ns, self._forgotten, self._refusing = command.sim_time_ns, False, False
            if self._jets is not None:
                self._jets.heed(command)
            self._send(passed_on(command))
            return
        self.node.counts.stale += 1
        if not self._refusing:  # the first of a row; all are counted
            self._warn("command refused", why_not, command.tick, now_ns)
        self._refusing = True
        # A tick of the world must be answered, if not with this command then with a safe one.
        if self.odometry is not None and command.tick == self.odometry.tick > self.flown_tick:
            self._send(self._braking(self.odometry))

    def _brake_if_alone(self) -> None:
        """Without a controller the chaser answers the open tick itself, by coming to rest."""
        tick, odometry = self.tick, self.odometry
        if tick is None or odometry is None or tick.controller or odometry.tick != tick.tick:
            return
        if self.number in tick.chasers and tick.tick > self.flown_tick:
            self._send(self._braking(odometry))

    def _brake_if_forgotten(self, odometry: Odometry) -> None:
        """In real time nobody waits for the controller: when its commands stop coming, the chaser comes to rest."""
        if not self.realtime:
            return
        if self.flown_ns is None:
            self.flown_ns = odometry.sim_time_ns
        silent_ns = odometry.sim_time_ns - self.flown_ns
        if silent_ns <= self.scenario.controller.command_lifetime_s * 1e9:
            return
        if not self._forgotten:
            self._forgotten = True
            self._warn(
                "no command, braking", f"for {silent_ns / 1e9:.2f} s", odometry.tick, odometry.sim_time_ns
            )
        # Not noted as this tick's answer: the controller's, should it still come, is better.
        self._actuate(self._braking(odometry))

    def _braking(self, odometry: Odometry) -> ActuatorCommand:
        effective_ns = self.scenario.timing.effective_ns(odometry.tick)
        latched = self.docking is not None and self.docking.latched
        return brake(odometry, self.scenario.chaser, effective_ns, latched)

    def _send(self, command: ActuatorCommand) -> None:
        self.flown_tick = command.tick
        self._actuate(command)

    def _actuate(self, command: ActuatorCommand) -> None:
        if self._jets is not None:
            command = self._jets.fly(command)
        self.node.publish(topics.ACTUATORS, command, self.number)

    def _warn(self, what: str, detail: str, tick: int, time_ns: int) -> None:
        self._tell("warning", what, detail, tick, time_ns)

    def _tell(self, level: Level, what: str, detail: str, tick: int, time_ns: int) -> None:
        event = Event(
            tick=tick,
            sim_time_ns=time_ns,
            process=self.name,
            level=level,
            what=what,
            detail=detail,
        )
        self.node.publish(topics.EVENT, event, self.name)

    def farewell(self) -> None:
        """The last messages of this process."""
        tick = self.tick
        self.teller.farewell(tick.tick if tick else -1, tick.sim_time_ns if tick else 0)
