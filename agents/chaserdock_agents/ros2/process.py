# SPDX-License-Identifier: Apache-2.0
"""Show a mission to ROS 2, and serve its operator commands. Needs no ROS.

It observes: the mission does not wait for it, and receives nothing from it but the commands of its
services.
"""

from __future__ import annotations

from collections import Counter

from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import CommandReply, JoinReply, MissionEnd, OperatorCommand
from chaserdock_protocol.process import ProcessOptions, StopSignal, print_status
from chaserdock_protocol.scenario import FlightScenario, flight_scenario_from_json
from chaserdock_protocol.stall import StallTimer
from chaserdock_protocol.transport import Node
from chaserdock_protocol.transport.session import ignore_foreign_publishers, join

from . import wrench_control
from .conversion import Converter, InvalidImage, topic_types
from .rmw_zenoh import RosNode, open_ros
from .services import handler, services

NAME = "bridge"
ROS_NODE = "chaserdock"
_REPLY_TIMEOUT_S = 5.0
"""Longest wait for the controller's reply to an operator command, s of wall time: it replies in the
next tick, unless a standby is taking over.
"""
SOURCES = (
    topics.TICK,
    topics.IMAGE,
    topics.ODOMETRY,
    topics.TARGET,
    topics.WRENCH,
    topics.PLAN,
    topics.REFERENCE,
    topics.END,
)
"""Topics that have counterparts in ROS 2, and the end of the mission."""


def main(options: ProcessOptions) -> int:
    """Bridge one mission, or control it by wrenches (``options.ros.control``).

    Return 0 at its end, 1 if stopped before or the world is gone, 2 on an error.
    """
    if options.ros.control:
        return wrench_control.main(options)
    node: Node | None = None
    ros: RosNode | None = None
    try:
        ros = open_ros(options.ros, ROS_NODE)
        node = Node(NAME, "bridge", options.link)
        stop = options.stop_signal()  # until here Ctrl-C ends the wait for a router
        mission = join(node, node.host.unique_id(), stop, options.patience_s)
        if mission is None:
            return 1
        print_status(NAME, f"joined mission {mission.run_id} ({mission.mode})")
        status = Bridge(node, ros, mission).run(stop, options.stall_s)
        print_status(NAME, f"ended with status {status}")
        return status
    except ChaserdockError as error:
        print_status(NAME, str(error))
        return 2
    finally:
        if ros is not None:
            ros.close()
        if node is not None:
            node.close()


class Bridge:
    """Topics and services of one mission."""

    def __init__(self, node: Node, ros: RosNode, mission: JoinReply) -> None:
        scenario: FlightScenario = flight_scenario_from_json(
            mission.scenario_json, "the world's scenario"
        )
        self._node, chasers = node, len(scenario.chasers)
        ignore_foreign_publishers(
            node,
            mission.source,
            lambda detail, _: print_status(NAME, f"foreign publisher: {detail}"),
        )
        self._converter = Converter(scenario)
        self._invalid: Counter[str] = Counter()
        # In lock-step every message arrives; in real time slow readers miss some, as within a
        # mission.
        lockstep = mission.mode == "lockstep"
        self._publishers = {
            topic: ros.publisher(topic, kind, blocking=lockstep)
            for topic, kind in topic_types(chasers).items()
        }
        for name, kind, verb, chaser in services(chasers):
            ros.serve(name, kind, handler(kind, verb, chaser, self._ask))
        for topic in SOURCES:
            node.subscribe(topic, latest=topic is topics.IMAGE and not lockstep)

    def _ask(self, command: OperatorCommand) -> CommandReply | None:
        return self._node.query(topics.OPERATE_KEY, command, CommandReply, _REPLY_TIMEOUT_S)

    def run(self, stop: StopSignal, stall_s: float) -> int:
        """Convert messages until the mission ends; return the exit status."""
        silence = StallTimer(self._node.host.now_s)
        while not stop():
            received = self._node.receive(0.2)
            if received is None:
                if silence.update() >= stall_s:
                    print_status(NAME, f"the world is gone: no message of it for {stall_s:g} s")
                    return 1
                continue
            silence.reset()
            if isinstance(received.message, MissionEnd):
                self._report()
                return 0
            self._forward(received.message)
        return 1

    def _forward(self, message: object) -> None:
        try:
            for part in self._converter.convert(message):  # type: ignore[arg-type]
                self._publishers[part.topic].publish(part.message)
        except InvalidImage as error:
            self._invalid[str(error)] += 1

    def _report(self) -> None:
        """Print what could not be shown."""
        for reason, number in (self._invalid + self._node.counts.rejected).items():
            print_status(NAME, f"{number} messages not shown: {reason}")
