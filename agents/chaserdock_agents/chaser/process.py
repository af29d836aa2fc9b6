# SPDX-License-Identifier: Apache-2.0
"""Run a chaser: receive one message at a time, have it handled, and publish what follows."""

from __future__ import annotations

import threading
from collections.abc import Callable

import cv2
import msgspec
from chaserdock_protocol import topics
from chaserdock_protocol.fault_injection import create_fault_layer
from chaserdock_protocol.messages import (
    Image,
    JoinReply,
    MissionEnd,
    Presence,
    Sighting,
    Tick,
)
from chaserdock_protocol.process import ProcessOptions, StopSignal
from chaserdock_protocol.scenario import flight_scenario_from_json
from chaserdock_protocol.scenario.faults import process_faults_from_json
from chaserdock_protocol.stall import DEFAULT_STALL_S
from chaserdock_protocol.transport import Node, ReceivedMessage
from chaserdock_protocol.transport.session import Heartbeat, create_health, run_member

from .core import ChaserCore
from .outbox import ChaserOutputs, Outbox

_RECEIVE_TIMEOUT_S = 0.2
"""Interval, s, at which the process looks whether it was stopped or the world is gone. The latter
must be asked at least twice a second (``Heartbeat.world_is_gone``).
"""


def main(options: ProcessOptions) -> int:
    """Run chaser ``options.chaser``; return 0 if the mission ended, 1 if stopped before, 2 if it
    could not join.
    """
    return run_chaser(options, lambda chaser: None)


def run_chaser(options: ProcessOptions, attach: Callable[[ChaserProcess], None]) -> int:
    """Run a chaser as ``main`` does; ``attach`` connects what its robot has of its own."""
    cv2.setNumThreads(1)
    number = int(options.chaser or 0)

    def work(node: Node, mission: JoinReply, instance: str, stop: StopSignal) -> int:
        scenario = flight_scenario_from_json(mission.scenario_json, "the world's scenario")
        faults = process_faults_from_json(mission.faults)
        realtime = mission.mode != "lockstep"
        node.message_filter = create_fault_layer(
            faults, node.name, scenario.timing, not realtime, node.host
        )
        core = ChaserCore(scenario, number, realtime, instance, faults.reported_failures)
        chaser = ChaserProcess(node, core, options.stall_s)
        attach(chaser)
        node.host.finish_startup()
        while not (chaser.ended or chaser.replaced or stop() or chaser.heartbeat.world_is_gone()):
            chaser.listen()
        if not chaser.replaced:
            chaser.publish_farewell()
        return 0 if chaser.ended else 1

    return run_member(f"chaser/{number}", "chaser", options, work)


class ChaserProcess:
    """Connect one chaser's core to the network.

    Advertises and subscribes the topics, then starts the heartbeat. ``replaced``: this process was
    lost, and the mission goes on with another one of its name. ``on_tick``: called with each tick.
    """

    def __init__(self, node: Node, core: ChaserCore, stall_s: float = DEFAULT_STALL_S) -> None:
        self.node, self.core = node, core
        self.ended = self.replaced = False
        self.on_tick: Callable[[Tick], None] = lambda tick: None
        i, latest = core.number, core.realtime
        for topic in (topics.SIGHTING, topics.ACTUATORS, topics.LEASE):
            node.advertise(topic, i)
        if core.thrusters is not None:
            node.advertise(topics.THRUSTERS, i)
        if core.assurance is not None:
            node.advertise(topics.ASSURANCE, i)
        if core.scenario.maps_target:
            node.advertise(topics.FEATURES, i)
            node.subscribe(topics.MAP)
        node.subscribe(topics.IMAGE, i, latest=latest)
        node.subscribe(topics.ODOMETRY, i, latest=latest)
        for topic in (topics.DOCKING, topics.PLAN, topics.WRENCH):
            node.subscribe(topic, i)
        for topic in (topics.TARGET, topics.TICK, topics.END):
            node.subscribe(topic)
        self._end_looking: Callable[[], None] = lambda: None
        if core.realtime:
            self._put_image, self._end_looking = node.host.worker(self._look)
            node.on_close(self._end_looking)
        self._publishing = threading.Lock()
        self.heartbeat = Heartbeat(node, core.instance, stall_s)

    def listen(self) -> None:
        """Wait for one message and handle it."""
        received = self.node.receive(_RECEIVE_TIMEOUT_S)
        self.heartbeat.report_waiting(received, self.core.missing_keys)
        if received is None:
            return
        match received.message:
            case Presence() as presence:
                self.heartbeat.take(presence)
            case MissionEnd():
                self.ended = True
            case Tick() as tick:
                self._begin_tick(tick, received)
            case Image() as image if self.core.realtime:
                self.look_at(image)
            case _:
                self._step(received)
                self._look_at_due()

    def look_at(self, image: Image) -> None:
        """Have an image looked at in the background, in real time, once it is due."""
        self.core.add_image(image)
        self._look_at_due()

    def _look_at_due(self) -> None:
        if self.core.realtime:
            for image in self.core.due_images():
                self._put_image(image)

    def warn(self, what: str, detail: str) -> None:
        """Publish a warning of what is attached to the process."""
        tick = self.core.inbox.tick
        stamp = (-1, 0) if tick is None else (tick.tick, tick.sim_time_ns)
        outbox = Outbox(self.core.number)  # of its own, as other threads may call this
        outbox.warn(what, detail, *stamp)
        self._publish(outbox.take(), 0.0)

    def _begin_tick(self, tick: Tick, received: ReceivedMessage) -> None:
        if self.core.inbox.is_outdated(tick):
            return
        self.replaced |= self.heartbeat.is_replaced(tick.chaser_instances.get(self.node.name))
        if self.replaced:
            return
        self.heartbeat.in_flight.set()
        self.on_tick(tick)
        self._step(received)
        if tick.revision == 0 and tick.tick % self.core.scenario.time.rate_hz == 0:
            health = create_health(self.node, tick.tick, tick.sim_time_ns)
            self.node.publish(topics.HEALTH, health, self.node.name)

    def _step(self, received: ReceivedMessage) -> None:
        started_s = self.node.host.now_s()
        if outputs := self.core.step(received, started_s):
            self._publish(outputs, self.node.host.now_s() - started_s)

    def _look(self, image: Image) -> None:
        """Look for the target in an image, in real time: beside the messages, as commands must not
        wait for it.
        """
        started_s = self.node.host.now_s()
        outputs = self.core.look(image)
        took_s = self.node.host.now_s() - started_s
        self._publish(outputs, took_s)
        self._publish(self.core.note_duration(image, took_s), took_s)

    def _publish(self, outputs: ChaserOutputs, took_s: float) -> None:
        node = self.node
        with self._publishing:
            node.counts.stale += outputs.stale
            if outputs.rejected:
                node.counts.rejected[outputs.rejected] += 1
            for topic, place, message in outputs.messages:
                if isinstance(message, Sighting):
                    message = msgspec.structs.replace(message, wall_estimate_s=took_s)
                node.publish(topic, message, place)

    def publish_farewell(self) -> None:
        """Publish the last messages of this process, once the image in hand has been looked at."""
        self._end_looking()
        tick = self.core.inbox.tick
        self.heartbeat.farewell(tick.tick if tick else -1, tick.sim_time_ns if tick else 0)
