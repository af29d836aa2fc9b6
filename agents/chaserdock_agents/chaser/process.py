"""A chaser process: image -> sighting, wrench command -> actuators. It never sees the truth."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass

import cv2
import msgspec
from chaserdock_protocol import topics
from chaserdock_protocol.extrapolation import extrapolate
from chaserdock_protocol.fault_injection import LostMessage, create_fault_layer
from chaserdock_protocol.messages import (
    ActuatorCommand,
    DockingStatus,
    Event,
    Image,
    JoinReply,
    Level,
    MissionEnd,
    Odometry,
    Plan,
    Presence,
    Sighting,
    TargetEstimate,
    Tick,
    WrenchCommand,
)
from chaserdock_protocol.process import ProcessOptions, StopSignal, finish_startup
from chaserdock_protocol.scenario import Scenario, scenario_from_json
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import Node
from chaserdock_protocol.transport.session import Heartbeat, create_health, run_member

from chaserdock_agents.chaser.thrusters.controller import ThrusterController

from .command_gate import brake, own_command, passed_on, refusal, stale_term
from .fallback import Alone, LastWord, clear_m, goes_on, wrench_of
from .perception import make_perception
from .sighting import look, prediction_from


def main(options: ProcessOptions) -> int:
    """Runs chaser ``options.chaser``; 0 when the mission ended, 1 when stopped before, 2 when it could not join."""
    cv2.setNumThreads(1)
    number = int(options.chaser or 0)

    def work(node: Node, mission: JoinReply, instance: str, stop: StopSignal) -> int:
        chaser = Chaser(node, scenario_from_json(mission.scenario_json, "the world's scenario"), number)
        node.message_filter = create_fault_layer(
            chaser.scenario, node.name, lockstep=mission.mode == "lockstep"
        )
        chaser.open(instance, realtime=mission.mode == "realtime")
        finish_startup()
        while not (chaser.ended or stop()):
            chaser.listen()
        chaser.farewell()
        return 0 if chaser.ended else 1

    return run_member(f"chaser/{number}", "chaser", options, work)


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
        self._forgotten = self._refusing = self._stale = False
        self._term = 0
        self._plan: Plan | None = None
        self._target: TargetEstimate | None = None
        self._last = LastWord()
        self._heeded_tick = -1
        self._alone: Alone | None = None
        self._clear_m = clear_m(self.scenario, self.number)
        self._watched_tick = self._uncommanded = -1
        self._known_ns = 0
        self._looked: deque[int] = deque(maxlen=64)
        self._has_port = self.scenario.docking.port_of(self.number) is not None
        self._thrusters = (
            ThrusterController(self.scenario, self.number)
            if self.scenario.chaser.actuation == "thrusters"
            else None
        )
        self._perception = make_perception(self.scenario)

    def open(self, instance: str, realtime: bool) -> None:
        """Opens the topics, then tells its presence."""
        node, i = self.node, self.number
        self.realtime = realtime
        node.advertise(topics.SIGHTING, i)
        node.advertise(topics.ACTUATORS, i)
        if self._thrusters is not None:
            node.advertise(topics.THRUSTERS, i)
        node.subscribe(topics.IMAGE, i, latest=realtime)
        node.subscribe(topics.ODOMETRY, i, latest=realtime)
        node.subscribe(topics.DOCKING, i)
        for topic in (topics.PLAN, topics.WRENCH):
            node.subscribe(topic, i)
        node.subscribe(topics.TARGET)
        node.subscribe(topics.TICK)
        node.subscribe(topics.END)
        self.heartbeat = Heartbeat(node, instance)

    def listen(self) -> None:
        """Waits for one message and does what it asks for."""
        received = self.node.receive(0.2)
        match received.message if received is not None else None:
            case Image() as image:
                self._look(image)
            case Odometry() as odometry:
                self._known_ns = odometry.sim_time_ns
                self._know(odometry)
            case DockingStatus() as docking:
                self.docking = docking
                self._watch_thrusters()
            case Plan() as plan:
                self._plan = plan
                if plan.tick == self._heeded_tick:  # it came after its command
                    self._last = LastWord(plan, self._last.target)
            case TargetEstimate() as target:
                self._target = target
            case WrenchCommand() as command:
                self._fly(command)
            case Tick() as tick:
                self.tick = tick
                self.heartbeat.in_flight.set()
                self._watch_thrusters()
                self._brake_if_alone()
                if tick.revision == 0 and tick.tick % self.scenario.time.rate_hz == 0:
                    health = create_health(self.node, tick.tick, tick.sim_time_ns)
                    self.node.publish(topics.HEALTH, health, self.name)
            case Presence() as presence:
                self.heartbeat.take(presence)
            case MissionEnd():
                self.ended = True
            case LostMessage() as lost if received is not None:
                self._miss(received.topic, lost)

    def _know(self, odometry: Odometry) -> None:
        """Takes its own state, unless a newer one has come before it."""
        if self.odometry is not None and odometry.tick < self.odometry.tick:
            self.node.counts.stale += 1
            return
        self.odometry = odometry
        self._watch_thrusters()
        self._brake_if_alone()
        self._brake_if_forgotten(odometry)

    def _miss(self, topic: Topic, lost: LostMessage) -> None:
        """In lock-step: something has been lost on its way here, and the tick must be answered nevertheless."""
        if topic is topics.IMAGE:
            nothing = Sighting(
                tick=lost.tick,
                sim_time_ns=lost.sim_time_ns,
                chaser=self.number,
                status="bad_image",
                solutions=(),
                marker_ids=(),
                corners_px=(),
                rejected_ids=(),
                detail="no image came",
            )
            self.node.publish(topics.SIGHTING, nothing, self.number)
        elif topic is topics.ODOMETRY and self.odometry is not None:
            self._know(extrapolate(self.odometry, lost.tick, lost.sim_time_ns))
        elif topic is topics.DOCKING:
            before = self.docking
            still = (
                DockingStatus(chaser=self.number, contact=False, armed=False, latched=False)
                if before is None
                else msgspec.structs.replace(before, contact=False)
            )
            self.docking = msgspec.structs.replace(still, tick=lost.tick, sim_time_ns=lost.sim_time_ns)
            self._watch_thrusters()
        elif topic is topics.WRENCH:
            self._without_command(lost.tick)

    def _without_command(self, tick: int) -> None:
        """There is no command for a tick: the chaser answers it by itself, once it knows where it is."""
        self._uncommanded = max(tick, self._uncommanded)
        self._brake_if_alone()

    def _look(self, image: Image) -> None:
        if image.tick in self._looked:
            self.node.counts.stale += 1
            return
        self._looked.append(image.tick)
        begun_s = time.perf_counter()
        sighting = look(self._perception, image, prediction_from(self.sighting))
        took_s = time.perf_counter() - begun_s
        if sighting.status == "bad_image" and (self.sighting is None or self.sighting.status != "bad_image"):
            self._warn("bad image", sighting.detail, image.tick, image.sim_time_ns)
        self.sighting = sighting
        self.node.publish(
            topics.SIGHTING, msgspec.structs.replace(sighting, wall_estimate_s=took_s), self.number
        )

    def _watch_thrusters(self) -> None:
        """Tells the controller what the thrusters can do, and everyone what has been found of them.

        Once a tick that is open, when it has brought the odometry and, with a docking sensor, its word, in whatever
        order. The last odometry belongs to no open tick, and may come after the mission's end or before it.
        """
        tick, odometry, docking = self.tick, self.odometry, self.docking
        if self._thrusters is None or tick is None or odometry is None:
            return
        if odometry.tick != tick.tick or self._watched_tick >= tick.tick:
            return
        if self._has_port and (docking is None or docking.tick != tick.tick):
            return
        self._watched_tick = tick.tick
        touched = docking is not None and (docking.contact or docking.latched)
        self.node.publish(topics.THRUSTERS, self._thrusters.observe(odometry, touched), self.number)
        for level, what, detail in self._thrusters.drain_events():
            self._tell(level, what, detail, odometry.tick, odometry.sim_time_ns)

    def _fly(self, command: WrenchCommand) -> None:
        if command.mode == "none":
            if not self.realtime:  # there it flies on what it has, for a command's lifetime
                self._without_command(command.tick)
            return
        now_ns = self.odometry.sim_time_ns if self.odometry is not None else 0
        if stale := stale_term(command, self.tick, self._term):
            self.node.counts.rejected["wrench:stale term"] += 1
            if not self._stale:  # the first of a row
                self._warn("command refused", stale, command.tick, now_ns)
            self._stale = True
            return
        if command.tick == self.flown_tick and command.term > self._term:
            return  # said again by who took over in the middle of a tick
        why_not = refusal(command, self.number, self.scenario.chaser, self.flown_tick, now_ns)
        if why_not is None:
            self.flown_ns, self._forgotten, self._refusing = command.sim_time_ns, False, False
            self._term = command.term
            self._stale = False
            self._heed(command)
            if self._thrusters is not None:
                self._thrusters.apply_command(command)
            self._send(passed_on(command))
            return
        self.node.counts.stale += 1
        if not self._refusing:  # the first of a row; all are counted
            self._warn("command refused", why_not, command.tick, now_ns)
        self._refusing = True
        # A tick of the world must be answered, if not with this command then with a safe one.
        self._without_command(command.tick)

    def _heed(self, command: WrenchCommand) -> None:
        """Keeps what came with a command, for when there are none."""
        plan, target, self._heeded_tick = self._plan, self._target, command.tick
        self._last = LastWord(
            plan if plan is not None and plan.tick == command.tick else None,
            target if target is not None and target.tick == command.tick else self._last.target,
        )
        if self._alone is not None:
            self._tell("info", "commanded again", f"tick {command.tick}", command.tick, command.sim_time_ns)
        self._alone = None

    def _brake_if_alone(self) -> None:
        """Without a controller, or its command, the chaser answers the open tick itself."""
        tick, odometry = self.tick, self.odometry
        if tick is None or odometry is None or odometry.tick != tick.tick:
            return
        if tick.controller and self._uncommanded < tick.tick:
            return
        if self.number in tick.chasers and tick.tick > self.flown_tick:
            if tick.controller and not self._forgotten:
                self._forgotten = True
                self._warn("no command", "it was lost or refused", tick.tick, odometry.sim_time_ns)
            self._send(self._by_itself(odometry))

    def _brake_if_forgotten(self, odometry: Odometry) -> None:
        """In real time nobody waits for the controller: when its commands stop coming, the chaser flies by itself."""
        if not self.realtime:
            return
        if self.flown_ns is None:
            self.flown_ns = odometry.sim_time_ns
        silent_ns = odometry.sim_time_ns - self.flown_ns
        if silent_ns <= self.scenario.controller.command_lifetime_s * 1e9:
            return
        if not self._forgotten:
            self._forgotten = True
            self._warn("no command", f"for {silent_ns / 1e9:.2f} s", odometry.tick, odometry.sim_time_ns)
        # Not noted as this tick's answer: the controller's, should it still come, is better.
        self._actuate(self._by_itself(odometry))

    def _by_itself(self, odometry: Odometry) -> ActuatorCommand:
        """The chaser's own command: see ``alone``."""
        effective_ns = self.scenario.timing.effective_ns(odometry.tick)
        # Whoever does not know his own motion cannot brake it.
        lost_ns = odometry.sim_time_ns - self._known_ns
        latched = self.docking is not None and self.docking.latched
        body = self.scenario.chaser
        if latched or lost_ns > self.scenario.controller.command_lifetime_s * 1e9:
            return brake(odometry, body, effective_ns, latched=True)
        before, self._alone = (
            self._alone,
            goes_on(self._alone, odometry, effective_ns, self._last, self._clear_m),
        )
        if before is None or before.state != self._alone.state:
            what = f"alone: {self._alone.state}"
            self._warn(what, self._alone.text(), odometry.tick, odometry.sim_time_ns)
        wrench = wrench_of(self._alone, odometry, effective_ns, self._last, body)
        return own_command(odometry, effective_ns, self._alone.state, wrench)

    def _send(self, command: ActuatorCommand) -> None:
        self.flown_tick = command.tick
        self._actuate(command)

    def _actuate(self, command: ActuatorCommand) -> None:
        if self._thrusters is not None:
            command = self._thrusters.fly(command)
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
        self.heartbeat.farewell(tick.tick if tick else -1, tick.sim_time_ns if tick else 0)
