# SPDX-License-Identifier: Apache-2.0
"""Run one chaser without I/O: images to sightings, wrench commands to actuator commands.

It has no access to ground truth.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

import msgspec
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.failure_watch import FailureWatch
from chaserdock_protocol.fault_injection import LostMessage
from chaserdock_protocol.messages import (
    ActuatorCommand,
    DockingStatus,
    Image,
    LandmarkMap,
    Message,
    Odometry,
    Plan,
    Sighting,
    TargetEstimate,
    Tick,
    WrenchCommand,
)
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.thrusters import ThrusterFailure
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import ReceivedMessage

from .assurance.assurance import Assurance
from .command_gate import CommandGate, passed_on
from .fallback_control import FallbackControl
from .inbox import ChaserInbox
from .outbox import ChaserOutputs, Outbox
from .thrusters.controller import ThrusterController
from .thrusters.failure_reports import FailureReports
from .vision import REMEMBERED_IMAGES, Vision
from .visions import make_vision


class ChaserCore:
    """Handle the messages of one chaser, and keep its state between them.

    ``realtime``: the world waits for no reply, and a command stays valid for its lifetime.
    ``instance``: identity of the process, which its actuator commands state. ``failures``: thruster
    failures that the test bed reports in place of the hardware. ``vision`` replaces the scenario's
    perception.
    """

    def __init__(
        self,
        scenario: FlightScenario,
        number: int,
        realtime: bool = False,
        instance: str = "",
        failures: Iterable[ThrusterFailure] = (),
        vision: Vision | None = None,
    ) -> None:
        self.scenario, self.number = scenario, number
        self.realtime, self.instance = realtime, instance
        self.outbox, self._seen = Outbox(number), Outbox(number)
        self.inbox = ChaserInbox()
        self.vision = vision or make_vision(scenario, number)
        self._images: deque[Image] = deque(maxlen=REMEMBERED_IMAGES)
        self._perception_watch = FailureWatch(scenario.perception.name)
        self.gate = CommandGate(scenario, number, realtime, self.outbox)
        self.fallback = FallbackControl(scenario, number, self.outbox)
        has_thrusters = scenario.chaser.actuation == "thrusters"
        self.thrusters = ThrusterController(scenario, number) if has_thrusters else None
        self.assurance = None if scenario.assurance is None else Assurance(scenario, number)
        self._waiting: WrenchCommand | None = None
        self._reports = FailureReports(failures)
        self._has_port = scenario.docking.port_of(number) is not None
        self._observed_tick = self._uncommanded_tick = -1

    def step(self, received: ReceivedMessage, now_s: float = 0.0) -> ChaserOutputs:
        """Handle one message and return what to publish.

        ``now_s``: the clock of ``received.arrived_s``, for real time. In lock-step, a
        ``LostMessage`` stands for a message that will not arrive.
        """
        inbox, message = self.inbox, received.message
        match message:
            case Tick():
                self._begin_tick(message)
            case Odometry():
                self.vision.take(message)
                if self._is_new(inbox.add_odometry(message, received.arrived_s)):
                    self._continue_tick(message)
            case DockingStatus():
                if self._is_new(inbox.add_docking(message)):
                    self._observe_thrusters()
                    self._execute_waiting()
            case Image():
                self.add_image(message)
            case LandmarkMap():
                self.vision.take(message)
            case Plan():
                self._is_new(self.fallback.add_plan(message))
            case TargetEstimate():
                self._is_new(self.fallback.add_target(message))
            case WrenchCommand():
                self._take_command(message, inbox.time_ns(now_s if self.realtime else None))
            case LostMessage():
                self._replace_lost(received.topic, message)
        return self._with_due_images(self.outbox.take())

    def _with_due_images(self, outputs: ChaserOutputs) -> ChaserOutputs:
        """Look at the images that are due; in real time the process does, in the background."""
        for image in () if self.realtime else self.due_images():
            outputs.follow(self.look(image))
        return outputs

    def add_image(self, image: Image) -> None:
        """Take an image, to be looked at once it is due; in real time it replaces one that waits
        still.
        """
        if self.realtime:
            self._images.clear()
        self._images.append(image)

    def due_images(self) -> Iterator[Image]:
        """Yield the images for which all has arrived that is needed to look at them."""
        while self._images:
            if self.vision.missing(self._images[0], self.inbox.tick, self.realtime):
                return
            yield self._images.popleft()

    def missing_keys(self) -> tuple[str, ...]:
        """Return the keys of the messages that this chaser needs to reply to the open tick, or to
        get the next one.
        """
        tick = self.inbox.tick
        if tick is None or tick.tick <= self.gate.executed_tick or self.number not in tick.chasers:
            return (topics.TICK.key_of(),)
        latest: dict[Topic, Message | None] = {topics.ODOMETRY: self.inbox.odometry}
        if self._has_port:
            latest[topics.DOCKING] = self.inbox.docking
        missing = [topic for topic, last in latest.items() if last is None or last.tick < tick.tick]
        if tick.images and not self.vision.has_processed(tick.tick):
            waiting = self._images[0] if self._images else None
            needed = waiting and self.vision.missing(waiting, tick, self.realtime)
            if needed is topics.MAP:
                return (topics.MAP.key_of(),)
            missing.append(topics.IMAGE)
        return tuple(topic.key_of(self.number) for topic in missing or [topics.WRENCH])

    # -- messages of the world ---------------------------------------------------------------------

    def _is_new(self, new: bool) -> bool:
        """Return ``new``; count the message as stale if it is not."""
        if not new:
            self.outbox.count_stale()
        return new

    def _begin_tick(self, tick: Tick) -> None:
        if self.inbox.is_outdated(tick):
            return
        self.inbox.tick = tick
        self.gate.begin_tick(tick)
        self._observe_thrusters()
        self._reply_without_command()

    def _continue_tick(self, odometry: Odometry) -> None:
        """Do what had to wait for the chaser's own state of this tick."""
        self._observe_thrusters()
        self._execute_waiting()
        self._reply_without_command()
        if self.realtime:
            self._check_command_timeout(odometry)

    def _replace_lost(self, topic: Topic, lost: LostMessage) -> None:
        """Handle the loss of a message in lock-step, so that the chaser still replies to
        the tick.
        """
        inbox = self.inbox
        if topic is topics.IMAGE:
            no_image = Sighting(
                tick=lost.tick,
                sim_time_ns=lost.sim_time_ns,
                chaser=self.number,
                status="bad_image",
                solutions=(),
                marker_ids=(),
                corners_px=(),
                rejected_ids=(),
                detail="image lost",
            )
            self.vision.without_image(no_image)
            self._publish_sighting(self.outbox, no_image)
        elif topic is topics.ODOMETRY and inbox.odometry is not None:
            if self._is_new(inbox.extrapolate_odometry(lost)):
                self.vision.take(inbox.odometry)
                self._continue_tick(inbox.odometry)
        elif topic is topics.DOCKING and inbox.assume_docking(lost, self.number):
            self._observe_thrusters()
            self._execute_waiting()
        elif topic is topics.WRENCH and lost.sender in ("", self.gate.leases.holder):
            self._mark_uncommanded(lost.tick)

    def look(self, image: Image) -> ChaserOutputs:
        """Look for the target in an image. It may run in a thread beside ``step``, with
        ``note_duration``.
        """
        before = self.vision.sighting
        sighting = self.vision.look(image)
        if self.vision.refused:
            self._seen.warn("geometry refused", self.vision.refused, image.tick, image.sim_time_ns)
        if sighting is None:
            self._seen.count_stale()
            return self._seen.take()
        if sighting.status == "bad_image" and (before is None or before.status != "bad_image"):
            self._seen.warn("bad image", sighting.detail, image.tick, image.sim_time_ns)
        self._watch_perception("perception failed", self.vision.failure, image)
        self._publish_sighting(self._seen, sighting)
        return self._seen.take()

    def _publish_sighting(self, outbox: Outbox, sighting: Sighting) -> None:
        if self.vision.tracks is not None:
            outbox.publish(topics.FEATURES, self.vision.tracks)
        outbox.publish(topics.SIGHTING, sighting)

    def note_duration(self, image: Image, took_s: float) -> ChaserOutputs:
        """Return what to publish of the time that an image took, in real time: a warning if no
        command would stay valid as long.
        """
        valid_s = self.scenario.controller.command_lifetime_s
        late = f"{took_s:.2f} s for an image, longer than a command is valid ({valid_s:g} s)"
        self._watch_perception("perception late", late if took_s > valid_s else "", image)
        return self._seen.take()

    def _watch_perception(self, what: str, detail: str, image: Image) -> None:
        """Count, and report, what went wrong in an image; nothing if ``detail`` is empty."""
        if detail:
            self._seen.count_rejected(f"image:{what}")
        if (report := self._perception_watch.update(what, detail)) is not None:
            self._seen.event(*report, image.tick, image.sim_time_ns)

    def _observe_thrusters(self) -> None:
        """Publish the thrusters' capability and the events of fault detection.

        Runs once per open tick, when its odometry and, with a docking sensor, the sensor's status
        have arrived in any order. The last odometry belongs to no open tick and may arrive before
        or after the mission's end.
        """
        tick, odometry, docking = self.inbox.tick, self.inbox.odometry, self.inbox.docking
        if self.thrusters is None or tick is None or odometry is None:
            return
        if odometry.tick != tick.tick or self._observed_tick >= tick.tick:
            return
        if self._has_port and (docking is None or docking.tick != tick.tick):
            return
        self._observed_tick = tick.tick
        self._reports.deliver(self.thrusters, odometry.sim_time_ns)
        touched = docking is not None and (docking.contact or docking.latched)
        report = self.thrusters.observe(odometry, touched)
        if self.assurance is not None:
            self.assurance.limit_by(report)
        self.outbox.publish(topics.THRUSTERS, report)
        for level, what, detail in self.thrusters.drain_events():
            self.outbox.event(level, what, detail, odometry.tick, odometry.sim_time_ns)

    # -- commands ----------------------------------------------------------------------------------

    def _take_command(self, command: WrenchCommand, now_ns: int) -> None:
        decision = self.gate.decide(command, self.inbox.tick, now_ns)
        if decision.execute is not None:
            self._waiting = decision.execute
            self._execute_waiting()
        elif decision.uncommanded_tick is not None:
            self._mark_uncommanded(decision.uncommanded_tick)

    def _execute_waiting(self) -> None:
        """Execute the command that waits, once what is to be known of its tick has arrived.

        In lock-step a command is checked by the state of its own tick, in whatever order they
        arrive.
        """
        command, inbox = self._waiting, self.inbox
        if command is None:
            return
        if self.assurance is not None and not self.realtime:
            known = [inbox.odometry, *([inbox.docking] if self._has_port else [])]
            if any(message is None or message.tick < command.tick for message in known):
                return
        self._waiting = None
        self._execute(command)

    def _execute(self, command: WrenchCommand) -> None:
        # Only the estimate that came with the previous command is certain to have arrived.
        known = self.fallback.last.target
        self.fallback.end(command)
        if self.assurance is not None:
            self.assurance.add_estimate(known)
        if known is not None:
            self.vision.take(known)
        # Before the reply: in lock-step the next image follows it, and is to be seen with this
        # geometry.
        if (refused := self.vision.inform(command)) is not None:
            self.outbox.warn("geometry refused", refused, command.tick, command.sim_time_ns)
        if self.thrusters is not None:
            self.thrusters.avoid_plumes(known)
            self.thrusters.apply_command(command)
        self._reply(passed_on(command), np.array(command.thrusts_N) if command.thrusts_N else None)

    def _mark_uncommanded(self, tick: int) -> None:
        """Record that no command arrives for a tick; the chaser replies itself once it knows its
        state.
        """
        self._uncommanded_tick = max(tick, self._uncommanded_tick)
        self._reply_without_command()

    def _reply_without_command(self) -> None:
        """Reply to the open tick by a fallback command, if no controller commands it."""
        tick, odometry = self.inbox.tick, self.inbox.odometry
        if tick is None or odometry is None or odometry.tick != tick.tick:
            return
        commanded = self.gate.leases.is_held_at(tick)
        if commanded and self._uncommanded_tick < tick.tick:
            return
        if self.number in tick.chasers and tick.tick > self.gate.executed_tick:
            if commanded:
                self.fallback.report_missing("lost or refused", odometry)
            self._reply(*self._fallback_command(odometry))

    def _check_command_timeout(self, odometry: Odometry) -> None:
        """Real time: start the fallback when no command has arrived for its lifetime."""
        silent_ns = self.fallback.silence_ns(odometry)
        if silent_ns <= self.scenario.controller.command_lifetime_s * 1e9:
            return
        self.fallback.report_missing(f"for {silent_ns / 1e9:.2f} s", odometry)
        # Not recorded as the reply to this tick: a command that still arrives takes precedence.
        self._actuate(*self._fallback_command(odometry))

    def _fallback_command(self, odometry: Odometry) -> tuple[ActuatorCommand, Array | None]:
        age_ns = self.inbox.odometry_age_ns(odometry.sim_time_ns)
        return self.fallback.command(odometry, self.inbox.latched, age_ns)

    def _reply(self, command: ActuatorCommand, thrusts_N: Array | None = None) -> None:
        """Publish the actuator command that is the reply to its tick."""
        self.gate.executed_tick = command.tick
        self._actuate(command, thrusts_N)

    def _actuate(self, command: ActuatorCommand, thrusts_N: Array | None = None) -> None:
        if self.assurance is not None and self.inbox.odometry is not None:
            self.assurance.add_odometry(self.inbox.odometry)
            assured = self.assurance.assure(command, thrusts_N, self.inbox.latched)
            command, thrusts_N = assured.command, assured.thrusts_N
            self.outbox.publish(topics.ASSURANCE, assured.status)
            if assured.event is not None:
                self.outbox.event(*assured.event, command.tick, command.sim_time_ns)
        if self.thrusters is not None:
            command = self.thrusters.add_pulses(command, thrusts_N)
        own = msgspec.structs.replace(command, instance=self.instance)
        self.outbox.publish(topics.ACTUATORS, own)
