# SPDX-License-Identifier: Apache-2.0
"""Run the mapper: receive the chasers' tracks, publish maps of a target of unknown shape."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from chaserdock_protocol import topics
from chaserdock_protocol.fault_injection import create_fault_layer
from chaserdock_protocol.messages import (
    CommandReply,
    JoinReply,
    MissionEnd,
    PortRequest,
    Presence,
    Tick,
)
from chaserdock_protocol.process import ProcessOptions, StopSignal
from chaserdock_protocol.scenario import flight_scenario_from_json
from chaserdock_protocol.scenario.faults import process_faults_from_json
from chaserdock_protocol.stall import DEFAULT_STALL_S
from chaserdock_protocol.transport import Node, ReceivedMessage
from chaserdock_protocol.transport.session import Heartbeat, create_health, run_member

from .core import MapperCore

NAME = "mapper"
_RECEIVE_TIMEOUT_S = 0.2
"""Interval, s, at which the process looks whether it was stopped or the world is gone."""


def main(options: ProcessOptions) -> int:
    """Run the mapper; return 0 if the mission ended, 1 if stopped before, 2 if it could not
    join.
    """

    def work(node: Node, mission: JoinReply, instance: str, stop: StopSignal) -> int:
        scenario = flight_scenario_from_json(mission.scenario_json, "the world's scenario")
        faults = process_faults_from_json(mission.faults)
        realtime = mission.mode != "lockstep"
        node.message_filter = create_fault_layer(
            faults, node.name, scenario.timing, not realtime, node.host
        )
        core = MapperCore(scenario, realtime, instance)
        mapper = MapperProcess(node, core, realtime, options.stall_s)
        node.host.finish_startup()
        while not (mapper.ended or mapper.replaced or stop() or mapper.heartbeat.world_is_gone()):
            mapper.listen()
        if not mapper.replaced:
            mapper.farewell()
        return 0 if mapper.ended else 1

    return run_member(NAME, "mapper", options, work)


class MapperProcess:
    """Connect the mapper's core to the network.

    In real time maps are made in the background, as messages must not wait for them.
    """

    def __init__(
        self, node: Node, core: MapperCore, realtime: bool, stall_s: float = DEFAULT_STALL_S
    ) -> None:
        self.node, self.core = node, core
        self.ended = self.replaced = False
        node.advertise(topics.MAP)
        for topic in (topics.FEATURES, topics.TICK, topics.END):
            node.subscribe(topic)
        self._map, self._end_mapping = self._map_target, lambda: None
        if realtime:
            self._map, self._end_mapping = node.host.worker(self._map_target)
            node.on_close(self._end_mapping)
        self.heartbeat = Heartbeat(node, core.instance, stall_s)
        self._requests: deque[tuple[PortRequest, Callable[[CommandReply], None]]] = deque()
        node.declare_queryable(
            topics.PORT_KEY, PortRequest, lambda *request: self._requests.append(request)
        )

    def listen(self) -> None:
        """Answer operators, then wait for one message and handle it."""
        while self._requests:
            request, reply = self._requests.popleft()
            answer, event = self.core.choose(request)
            reply(answer)
            if event is not None:
                self.node.publish(topics.EVENT, event, NAME)
        received = self.node.receive(_RECEIVE_TIMEOUT_S)
        self.heartbeat.report_waiting(received, self.core.collector.missing_keys)
        if received is None:
            return
        match received.message:
            case Presence() as presence:
                self.heartbeat.take(presence)
            case MissionEnd():
                self.ended = True
            case _:
                self._step(received)

    def _step(self, received: ReceivedMessage) -> None:
        message, core, node = received.message, self.core, self.node
        if isinstance(message, Tick):
            self.replaced |= self.heartbeat.is_replaced(message.mapper or None)
            if self.replaced:
                return
            self.heartbeat.in_flight.set()
        stale = core.collector.stale
        due = core.step(message)
        node.counts.stale += core.collector.stale - stale
        if due is not None:
            self._map(due)
        if not isinstance(message, Tick) or message.revision:
            return
        if message.tick % core.scenario.time.rate_hz == 0:
            health = create_health(node, message.tick, message.sim_time_ns)
            node.publish(topics.HEALTH, health, NAME)

    def _map_target(self, tick: int) -> None:
        for topic, place, message in self.core.map_target(tick):
            self.node.publish(topic, message, place)

    def farewell(self) -> None:
        """Publish the last messages of this process, once the map in hand is made."""
        self._end_mapping()
        tick = self.core.collector.tick
        self.heartbeat.farewell(tick.tick if tick else -1, tick.sim_time_ns if tick else 0)
