"""The controller process: gathers what belongs to a tick, has it worked out, sends the answers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
from chaserdock_protocol import topics
from chaserdock_protocol.extrapolation import extrapolate
from chaserdock_protocol.fault_injection import LostMessage, create_fault_layer
from chaserdock_protocol.messages import (
    CommandReply,
    ControllerState,
    DockingStatus,
    Event,
    JoinReply,
    Level,
    MissionEnd,
    Odometry,
    OperatorCommand,
    Presence,
    Sighting,
    ThrusterReport,
    Tick,
)
from chaserdock_protocol.process import ProcessOptions, StopSignal, finish_startup
from chaserdock_protocol.scenario import Scenario, scenario_from_json
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import Node, ReceivedMessage
from chaserdock_protocol.transport.session import Heartbeat, create_health, run_member

from chaserdock_controller.ingest.odometry_validation import OdometryValidation
from chaserdock_controller.ingest.sensor_consistency import SensorConsistency
from chaserdock_controller.output.message_builders import no_command
from chaserdock_controller.redundancy.checkpoint import Checkpoint, CheckpointError
from chaserdock_controller.redundancy.standby import HotStandby

from .core import ControllerCore, TickInputs, TickOutputs

_REMEMBERED_TICKS = 256
_IDLE = 5
"""Waits in vain after which, in lock-step, nothing more is on its way here."""
_PATIENCE_TICKS = 0.5
"""In real time a tick waits so much of its period for its sightings; a later one serves the next tick."""


def main(options: ProcessOptions) -> int:
    """Runs the controller; 0 when the mission ended, 1 when stopped before, 2 when it could not join."""

    def work(node: Node, mission: JoinReply, instance: str, stop: StopSignal) -> int:
        scenario = scenario_from_json(mission.scenario_json, "the world's scenario")
        flight = ControllerCore(scenario, time.perf_counter, realtime=mission.mode == "realtime")
        controller = Controller(node, scenario, flight, mission.mode == "realtime")
        node.message_filter = create_fault_layer(scenario, node.name, lockstep=mission.mode == "lockstep")
        controller.open(instance)
        finish_startup()
        while not (controller.ended or stop()):
            controller.listen()
        controller.farewell()
        return 0 if controller.ended else 1

    return run_member("standby" if options.standby else "controller", "controller", options, work)


@dataclass
class Controller:
    """What has come for the open tick. A tick is worked out once all that it expects is here.

    In real time a tick is worked out with what is here when its patience is over, by ``now_s``, or the next one's first
    odometry overtakes it. While another controller commands, this one works out the same and keeps it to itself
    (``shadow``). ``replaying``: every tick is this one's to answer.
    """

    node: Node
    scenario: Scenario
    flight: ControllerCore
    realtime: bool = False
    replaying: bool = False
    ended: bool = False
    tick: Tick | None = None
    done_tick: int = -1
    now_s: Callable[[], float] = time.monotonic
    _odometry: dict[int, Odometry] = field(default_factory=dict)
    _thrusters: dict[int, ThrusterReport] = field(default_factory=dict)
    _docking: dict[int, DockingStatus] = field(default_factory=dict)
    _seen: set[tuple[int, int]] = field(default_factory=set)
    _used: dict[tuple[int, int], bool] = field(default_factory=dict)
    _agreement: SensorConsistency = field(default_factory=SensorConsistency)
    _missed: set[tuple[str, int, int]] = field(default_factory=set)
    _sightings: list[Sighting] = field(default_factory=list)
    _asked: list[tuple[OperatorCommand, Callable[[CommandReply], None]]] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        s = self.scenario
        self._watch = OdometryValidation(s)
        self._ports = [s.docking.port_of(i) for i in range(len(s.chasers))]
        self.name = self.node.name
        self.shadow = HotStandby(self.name, self.realtime, self.replaying)
        self._memory = Checkpoint(self.flight, self._watch, self._agreement)
        self._answered: tuple[Tick, TickOutputs, float] | None = None
        self._given_state_to: dict[str, str] = {}
        self._idle = 0
        self._on_network = False
        self._patience_s = _PATIENCE_TICKS / s.time.rate_hz
        self._due_s = 0.0

    def open(self, instance: str) -> None:
        """Opens the topics, then tells its presence."""
        node = self.node
        self.shadow.instance, self._on_network = instance, True
        for topic in (topics.TARGET, topics.SOLVER, topics.COMMAND, topics.OPERATED, topics.STATE):
            node.advertise(topic)
        for i in range(len(self.scenario.chasers)):
            for topic in (topics.WRENCH, topics.REFERENCE, topics.PLAN):
                node.advertise(topic, i)
        told = (topics.TICK, topics.END, topics.ODOMETRY, topics.DOCKING, topics.SIGHTING, topics.THRUSTERS)
        for topic in (*told, topics.STATE):
            node.subscribe(topic)
        self.heartbeat = Heartbeat(node, instance)

    def listen(self) -> None:
        """Waits for one message; works the tick out when it was the last missing."""
        due = self.shadow.due(self.done_tick)
        received = due or self.node.receive(self._timeout_s())
        self._idle = 0 if received is not None else self._idle + 1
        if due is not None:
            self._take(due)
        elif received is not None and not self._is_about_command(received.message):
            if self.shadow.holds_back(received, self.done_tick):
                return
            self._take(received)
        tick = self.tick
        if tick is not None and tick.tick > self.done_tick and self._may_work_out(tick):
            self._work_out(tick)

    def _waits_for(self) -> Tick | None:
        """In real time: the tick that is still to be worked out."""
        tick = self.tick
        open_ = self.realtime and not self.replaying and tick is not None and tick.tick > self.done_tick
        return tick if open_ else None

    def _timeout_s(self) -> float:
        if self._waits_for() is None:
            return 0.2
        return min(0.2, max(0.0, self._due_s - self.now_s()))

    def _is_about_command(self, message: Any) -> bool:
        """Takes what says who commands, as soon as it comes; whether it was nothing else."""
        if isinstance(message, ControllerState):
            if message.process != self.name:
                self._hear_word(message)
            return True
        if isinstance(message, Tick):
            before = self.shadow.commands
            for text in self.shadow.note(message):
                self._tell("warning", text, message.tick, message.sim_time_ns)
            self.heartbeat.in_flight.set()
            if self.shadow.commands != before:
                self._take_or_leave_command(message)
        return False

    def _take_or_leave_command(self, tick: Tick) -> None:
        if self._on_network and self.shadow.commands:
            self.node.restart_numbering()
            self.node.declare_queryable(topics.OPERATE_KEY, OperatorCommand, self.operate)
        elif self._on_network:
            self.node.undeclare_queryable(topics.OPERATE_KEY)
            self._refuse_what_is_asked(tick)
        if tick.term > 1:
            text = f"commands in term {tick.term}" if self.shadow.commands else "stands by"
            self._tell("info", text, tick.tick, tick.sim_time_ns)
        answered = self._answered
        if self.shadow.commands and answered is not None and answered[0].tick == tick.tick:
            # Worked out already, in the shadow of one that cannot send its own any more.
            self._publish(tick, answered[1], answered[2], ())

    def _refuse_what_is_asked(self, tick: Tick) -> None:
        with self._lock:
            asked, self._asked = self._asked, []
        reason = f"{tick.commander or 'nobody'} commands now: ask again"
        for command, answer in asked:
            head = {"command": command.command, "chaser": command.chaser, "operator": command.operator}
            answer(
                CommandReply(
                    tick=tick.tick, sim_time_ns=tick.sim_time_ns, accepted=False, reason=reason, **head
                )
            )

    def _hear_word(self, word: ControllerState) -> None:
        """The commander has worked a tick out; now and then it says all that it knows after it."""
        if not word.state:
            self.shadow.words[word.tick] = word.operated
        elif self.shadow.wants_state(word.tick, self.done_tick):
            try:
                self._memory.restore(word.state)
            except CheckpointError as error:
                self.node.counts.rejected["controller/state:format"] += 1
                self._tell(
                    "error",
                    f"the state of the commanding controller cannot be restored: {error}",
                    word.tick,
                    word.sim_time_ns,
                )
                return
            self.done_tick = max(self.done_tick, word.tick)
            self.shadow.caught_up(word.tick)
            self._tell("info", "follows the commander's state", word.tick, word.sim_time_ns)

    def _may_work_out(self, tick: Tick) -> bool:
        """Whether all is here that a tick waits for: its inputs and, in another's shadow, the commander's word."""
        if not self.shadow.follows():
            return False
        if self._complete(tick) and self.shadow.has_word(tick.tick):
            return True
        if self._waits_for() is not None:
            return self.now_s() >= self._due_s
        return self._idle >= _IDLE and not self.realtime and self.shadow.idle(tick.tick)

    def _take(self, received: ReceivedMessage) -> None:
        match received.message:
            case Tick() as tick:
                if self.tick is not None and tick.tick > self.tick.tick > self.done_tick:
                    self._work_out(self.tick)
                self.tick, self._due_s = tick, self.now_s() + self._patience_s
            case Odometry() as odometry:
                late = self._waits_for()
                if late is not None and odometry.tick > late.tick:
                    self._work_out(late)  # while its own odometry is still the newest
                self._know(odometry)
            case DockingStatus() as docking:
                self._docking[docking.chaser] = docking
            case Sighting() as sighting:
                self._see(sighting)
            case ThrusterReport() as report:
                self._thrusters[report.chaser] = report
            case Presence() as presence:
                self.heartbeat.take(presence)
            case MissionEnd():
                self.ended = True
            case LostMessage(tick=tick):
                self._miss(received.topic, int(received.place or 0), tick)

    def _know(self, odometry: Odometry) -> None:
        """Takes an odometry, unless a newer one of that chaser has come before it."""
        known = self._odometry.get(odometry.chaser)
        if known is None or odometry.tick > known.tick:
            self._odometry[odometry.chaser], told = self._watch.believed(odometry)
            for level, text in told:
                if self.shadow.commands:
                    self._tell(level, text, odometry.tick, odometry.sim_time_ns)

    def _tell(self, level: Level, text: str, tick: int, time_ns: int) -> None:
        event = Event(tick=tick, sim_time_ns=time_ns, process=self.name, level=level, what=text)
        self.node.publish(topics.EVENT, event, self.name)

    def _see(self, sighting: Sighting) -> None:
        """Takes a sighting, each image's once: twice the same is no more evidence."""
        key = (sighting.tick, sighting.chaser)
        if sighting.solutions and self._used.get(key):
            self.node.counts.stale += 1
            return
        self._seen.add(key)
        self._used[key] = bool(sighting.solutions)
        self._sightings.append(sighting)

    def _miss(self, topic: Topic, chaser: int, tick: int) -> None:
        """What a tick waits for has been lost on its way."""
        self._missed.add((topic.key, chaser, tick))

    def _complete(self, tick: Tick) -> bool:
        def there(
            topic: Topic, known: Mapping[int, Odometry | ThrusterReport | DockingStatus], i: int
        ) -> bool:
            return (i in known and known[i].tick == tick.tick) or (topic.key, i, tick.tick) in self._missed

        thrusters = self.scenario.chaser.actuation == "thrusters"
        return all(
            there(topics.ODOMETRY, self._odometry, i)
            and (not thrusters or there(topics.THRUSTERS, self._thrusters, i))
            and (self._ports[i] is None or there(topics.DOCKING, self._docking, i))
            and (
                not tick.images
                or (tick.tick, i) in self._seen
                or (topics.SIGHTING.key, i, tick.tick) in self._missed
            )
            for i in tick.chasers
        )

    def _known_at(self, tick: Tick) -> dict[int, Odometry]:
        """Odometry of the chasers at a tick. One that was lost is reckoned from the last, for a command's lifetime."""
        known = {i: o for i, o in self._odometry.items() if o.tick == tick.tick and i in tick.chasers}
        for i in tick.chasers:
            last = self._odometry.get(i)
            if i in known or last is None or (topics.ODOMETRY.key, i, tick.tick) not in self._missed:
                continue
            # What was seen from a place that is only reckoned is no measurement.
            self._sightings = [s for s in self._sightings if (s.chaser, s.tick) != (i, tick.tick)]
            if tick.sim_time_ns - last.sim_time_ns <= self.scenario.controller.command_lifetime_s * 1e9:
                known[i] = extrapolate(last, tick.tick, tick.sim_time_ns)
        return dict(sorted(known.items()))

    def _work_out(self, tick: Tick) -> None:
        begun_s = time.perf_counter()
        here = self._known_at(tick)
        commands_it = self.shadow.commands_at(tick.tick)
        with self._lock:
            asked, self._asked = self._asked, []
        if not commands_it:
            asked = [(command, lambda _: None) for command in self.shadow.operated(tick.tick)]
        docking = {i: d for i, d in self._docking.items() if d.tick == tick.tick and i in tick.chasers}
        commands = tuple(c for c, _ in asked)
        out = self.flight.step(
            TickInputs(
                tick.tick,
                tick.sim_time_ns,
                here,
                tuple(self._sightings),
                commands,
                dict(self._thrusters),
                docking,
            )
        )
        for (command, answer), reply in zip(asked, out.replies[len(out.replies) - len(asked) :], strict=True):
            answer(reply)
            known = msgspec.structs.replace(command, tick=tick.tick, sim_time_ns=tick.sim_time_ns)
            if commands_it:
                self.node.publish(topics.OPERATED, known)
        verdicts = self._agreement.observe(tick.sim_time_ns / 1e9, out.target.accepted, out.target.rejected)
        for level, text in verdicts:
            out.events.append(
                Event(
                    tick=tick.tick, sim_time_ns=tick.sim_time_ns, process="controller", level=level, what=text
                )
            )
        for i in tick.chasers:
            if i not in out.wrenches:
                out.wrenches[i] = no_command(i, tick)
        took_s = time.perf_counter() - begun_s
        self._answered = (tick, out, took_s)
        self._sightings.clear()
        self._seen = {key for key in self._seen if key[0] > tick.tick}
        self._used = {key: used for key, used in self._used.items() if key[0] > tick.tick - _REMEMBERED_TICKS}
        self._missed = {missed for missed in self._missed if missed[2] > tick.tick}
        self.done_tick = tick.tick
        if commands_it:
            self._publish(tick, out, took_s, commands)
        if tick.tick % self.scenario.time.rate_hz == 0:
            health = create_health(self.node, tick.tick, tick.sim_time_ns)
            self.node.publish(topics.HEALTH, health, self.name)

    def _publish(
        self, tick: Tick, out: TickOutputs, took_s: float, operated: tuple[OperatorCommand, ...]
    ) -> None:
        node, newest = self.node, self.shadow.newest or tick
        if newest.standing_by and not self.replaying:
            # Before the commands: who hears of a tick that was answered has heard what it was answered with.
            self._say_word(tick, ControllerState(process=self.name, term=newest.term, operated=operated))
        node.publish(topics.TARGET, out.target)
        for i, wrench in out.wrenches.items():
            if i in out.plans:
                node.publish(topics.PLAN, out.plans[i], i)
            head = {"term": newest.term, "commander": newest.commander, "instance": newest.instance}
            node.publish(topics.WRENCH, msgspec.structs.replace(wrench, **head), i)
        for i, reference in out.references.items():
            node.publish(topics.REFERENCE, reference, i)
        for reply in out.replies:
            node.publish(topics.COMMAND, reply)
        for event in out.events:
            node.publish(topics.EVENT, msgspec.structs.replace(event, process=self.name), self.name)
        # Last: its arrival tells the recorder that it has all of this tick.
        if out.solver is not None:
            node.publish(topics.SOLVER, msgspec.structs.replace(out.solver, wall_tick_s=took_s))
        new = newest.standing_by != self._given_state_to
        if newest.standing_by and not self.replaying and (new or tick.tick % self.scenario.time.rate_hz == 0):
            self._say_state(tick, newest)

    def _say_state(self, tick: Tick, newest: Tick) -> None:
        """All that this controller knows after a tick, for one that came late."""
        self._given_state_to = dict(newest.standing_by)
        try:
            state = self._memory.save()
        except CheckpointError as error:
            self._tell("warning", f"the state cannot be serialized: {error}", tick.tick, tick.sim_time_ns)
            return
        self._say_word(tick, ControllerState(process=self.name, term=newest.term, state=state))

    def _say_word(self, tick: Tick, word: ControllerState) -> None:
        stamped = msgspec.structs.replace(word, tick=tick.tick, sim_time_ns=tick.sim_time_ns)
        self.node.publish(topics.STATE, stamped)

    def operate(self, command: OperatorCommand, reply: Callable[[CommandReply], None]) -> None:
        """An operator asks; answered when the next tick has been worked out. Runs on Zenoh's thread."""
        with self._lock:
            self._asked.append((command, reply))

    def farewell(self) -> None:
        """The last messages of this process."""
        self.heartbeat.farewell(self.done_tick, self.tick.sim_time_ns if self.tick else 0)
