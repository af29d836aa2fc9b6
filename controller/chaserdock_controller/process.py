"""The controller process: gathers what belongs to a tick, has it worked out, sends the answers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
from chaserdock_protocol import topics
from chaserdock_protocol.messages import (
    CommandReply,
    DockingStatus,
    JetReport,
    JoinReply,
    MissionEnd,
    Odometry,
    OperatorCommand,
    Presence,
    Sighting,
    Tick,
)
from chaserdock_protocol.presence import PresenceTeller, health_of, take_part
from chaserdock_protocol.runtime import ProcessOptions, Stop
from chaserdock_protocol.scenario import Scenario, scenario_from_json
from chaserdock_protocol.transport import Node

from .flight import Flight, Inputs, Outputs


def main(options: ProcessOptions) -> int:
    """Runs the controller; 0 when the mission ended, 1 when stopped before, 2 when it could not join."""

    def work(node: Node, mission: JoinReply, instance: str, stop: Stop) -> int:
        scenario = scenario_from_json(mission.scenario_json, "the world's scenario")
        controller = Controller(node, scenario, Flight(scenario, time.perf_counter))
        controller.open(instance)
        while not (controller.ended or stop()):
            controller.listen()
        controller.farewell()
        return 0 if controller.ended else 1

    return take_part("controller", "controller", options, work)


@dataclass
class Controller:
    """What has come for the open tick. A tick is worked out once all that it expects is here.

    In real time a tick that the next one overtakes is worked out with what is here.
    """

    node: Node
    scenario: Scenario
    flight: Flight
    ended: bool = False
    tick: Tick | None = None
    done_tick: int = -1
    _odometry: dict[int, Odometry] = field(default_factory=dict)
    _jets: dict[int, JetReport] = field(default_factory=dict)
    _docking: dict[int, DockingStatus] = field(default_factory=dict)
    _seen: set[tuple[int, int]] = field(default_factory=set)
    _sightings: list[Sighting] = field(default_factory=list)
    _asked: list[tuple[OperatorCommand, Callable[[CommandReply], None]]] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        s = self.scenario
        self._ports = [s.docking.port_of(i) for i in range(len(s.chasers))]

    def open(self, instance: str) -> None:
        """Opens the topics, then tells its presence."""
        node = self.node
        for topic in (topics.TARGET, topics.SOLVER, topics.COMMAND, topics.OPERATED):
            node.advertise(topic)
        for i in range(len(self.scenario.chasers)):
            for topic in (topics.WRENCH, topics.REFERENCE, topics.PLAN):
                node.advertise(topic, i)
        told = (topics.TICK, topics.END, topics.ODOMETRY, topics.DOCKING, topics.SIGHTING, topics.JETS)
        for topic in told:
            node.subscribe(topic)
        node.answer(topics.OPERATE_KEY, OperatorCommand, self.operate)
        self.teller = PresenceTeller(node, instance)

    def listen(self) -> None:
        """Waits for one message; works the tick out when it was the last missing."""
        received = self.node.receive(0.2)
        match received.message if received is not None else None:
            case Tick() as tick:
                if self.tick is not None and tick.tick > self.tick.tick > self.done_tick:
                    self._work_out(self.tick)
                self.tick = tick
                self.teller.settled.set()
            case Odometry() as odometry:
                self._odometry[odometry.chaser] = odometry
            case DockingStatus() as docking:
                self._docking[docking.chaser] = docking
            case Sighting() as sighting:
                self._sightings.append(sighting)
                self._seen.add((sighting.tick, sighting.chaser))
            case JetReport() as report:
                self._jets[report.chaser] = report
            case Presence() as presence:
                self.teller.take(presence)
            case MissionEnd():
                self.ended = True
        if self.tick is not None and self.tick.tick > self.done_tick and self._complete(self.tick):
            self._work_out(self.tick)

    def _complete(self, tick: Tick) -> bool:
        if self.scenario.chaser.actuation == "thrusters" and any(
            i not in self._jets or self._jets[i].tick != tick.tick for i in tick.chasers
        ):
            return False
        return all(
            i in self._odometry
            and self._odometry[i].tick == tick.tick
            and (not tick.pictures or (tick.tick, i) in self._seen)
            and (self._ports[i] is None or (i in self._docking and self._docking[i].tick == tick.tick))
            for i in tick.chasers
        )

    def _work_out(self, tick: Tick) -> None:
        begun_s = time.perf_counter()
        here = {i: o for i, o in self._odometry.items() if o.tick == tick.tick and i in tick.chasers}
        with self._lock:
            asked, self._asked = self._asked, []
        docking = {i: d for i, d in self._docking.items() if d.tick == tick.tick and i in tick.chasers}
        commands = tuple(c for c, _ in asked)
        out = self.flight.step(
            Inputs(
                tick.tick, tick.sim_time_ns, here, tuple(self._sightings), commands, dict(self._jets), docking
            )
        )
        for (command, answer), reply in zip(asked, out.replies[len(out.replies) - len(asked) :], strict=True):
            answer(reply)
            known = msgspec.structs.replace(command, tick=tick.tick, sim_time_ns=tick.sim_time_ns)
            self.node.publish(topics.OPERATED, known)
        self._publish(out, time.perf_counter() - begun_s)
        self._sightings.clear()
        self._seen = {key for key in self._seen if key[0] > tick.tick}
        self.done_tick = tick.tick
        if tick.tick % self.scenario.time.rate_hz == 0:
            health = health_of(self.node, tick.tick, tick.sim_time_ns)
            self.node.publish(topics.HEALTH, health, "controller")

    def _publish(self, out: Outputs, took_s: float) -> None:
        node = self.node
        for i, wrench in out.wrenches.items():
            node.publish(topics.WRENCH, wrench, i)
        node.publish(topics.TARGET, out.target)
        for i, reference in out.references.items():
            node.publish(topics.REFERENCE, reference, i)
        for i, plan in out.plans.items():
            node.publish(topics.PLAN, plan, i)
        for reply in out.replies:
            node.publish(topics.COMMAND, reply)
        for event in out.events:
            node.publish(topics.EVENT, event, "controller")
        # Last: its arrival tells the recorder that it has all of this tick.
        if out.solver is not None:
            node.publish(topics.SOLVER, msgspec.structs.replace(out.solver, wall_tick_s=took_s))

    def operate(self, command: OperatorCommand, reply: Callable[[CommandReply], None]) -> None:
        """An operator asks; answered when the next tick has been worked out. Runs on Zenoh's thread."""
        with self._lock:
            self._asked.append((command, reply))

    def farewell(self) -> None:
        """The last messages of this process."""
        self.teller.farewell(self.done_tick, self.tick.sim_time_ns if self.tick else 0)
