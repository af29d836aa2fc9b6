# SPDX-License-Identifier: Apache-2.0
"""Control a mission in real time by wrenches of ROS 2: one topic per chaser.

This process takes the controller's place and name. It estimates and plans nothing: a chaser for
which no wrench arrives has no commands, and does what it does without a controller
(docs/faults.md). As every controller it commands a tick while a majority of the chasers has granted
it their leases.
"""

from __future__ import annotations

import math
import threading
from collections import Counter
from functools import partial
from typing import Any

import msgspec
from chaserdock_models.clock import Timing
from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.lease_holder import LeaseHolder
from chaserdock_protocol.leases import defect_of, no_command
from chaserdock_protocol.messages import JoinReply, Lease, MissionEnd, Presence, Tick, WrenchCommand
from chaserdock_protocol.process import ProcessOptions, StopSignal, print_status
from chaserdock_protocol.scenario import flight_scenario_from_json
from chaserdock_protocol.transport import Node
from chaserdock_protocol.transport.session import Heartbeat, run_member

from .conversion import chaser_frame
from .rmw_zenoh import RosNode, open_ros

NAME = "controller"
ROS_NODE = "chaserdock_control"
WRENCH_TYPE = "geometry_msgs/msg/WrenchStamped"
_LIFETIME_NS = 500_000_000
"""Lifetime of a wrench, ns: the default of ``controller.command_lifetime_s``."""
_RECEIVE_S = 0.1
"""Longest wait for a message, s, before the process looks whether it was stopped."""
_PATIENCE_TICKS = 0.5
"""Share of a tick's period after which chasers without a wrench get a message without command."""


class ControlError(ChaserdockError):
    """The mission cannot be controlled by wrenches of ROS 2."""


def command_topic(chaser: int) -> str:
    """Return the topic on which a chaser's wrenches are expected."""
    return f"/{chaser_frame(chaser)}/wrench_command"


def why_invalid(wrench: Any, chaser: int) -> str | None:
    """Return why a ``WrenchStamped`` is no command of a chaser, or None. Its frame must be the
    chaser's, or empty.
    """
    frame = wrench.header.frame_id
    if frame not in ("", chaser_frame(chaser)):
        return f"frame {frame!r}, must be {chaser_frame(chaser)!r}"
    force, torque = wrench.wrench.force, wrench.wrench.torque
    if not all(map(math.isfinite, (force.x, force.y, force.z, torque.x, torque.y, torque.z))):
        return "force or torque is not finite"
    return None


def wrench_command(
    wrench: Any, chaser: int, tick: Tick, timing: Timing, term: int, instance: str
) -> WrenchCommand:
    """Return the command of a valid wrench, on the newest tick; it expires after half a second."""
    force, torque = wrench.wrench.force, wrench.wrench.torque
    return WrenchCommand(
        tick=tick.tick,
        sim_time_ns=tick.sim_time_ns,
        chaser=chaser,
        effective_time_ns=timing.effective_ns(tick.tick),
        expires_ns=tick.sim_time_ns + _LIFETIME_NS,
        mode="nmpc",
        force_N=(force.x, force.y, force.z),
        torque_N_m=(torque.x, torque.y, torque.z),
        term=term,
        commander=NAME,
        instance=instance,
    )


def main(options: ProcessOptions) -> int:
    """Command one mission; return 0 at its end, 1 if stopped before or the world is gone, 2 on an
    error.
    """

    def work(node: Node, mission: JoinReply, instance: str, stop: StopSignal) -> int:
        if mission.mode != "realtime":
            raise ControlError(
                "--control: the mission is in lock-step; start the world with --mode realtime"
            )
        ros = open_ros(options.ros, ROS_NODE)
        try:
            return WrenchControl(node, ros, mission, instance, options.stall_s).run(stop)
        finally:
            ros.close()

    return run_member(NAME, "controller", options, work)


class WrenchControl:
    """Command each chaser at most once a tick, by the first wrench that arrives in it."""

    def __init__(
        self, node: Node, ros: RosNode, mission: JoinReply, instance: str, stall_s: float
    ) -> None:
        scenario = flight_scenario_from_json(mission.scenario_json, "the world's scenario")
        self._node, self._timing, self._instance = node, scenario.timing, instance
        self._lock = threading.Lock()
        self._tick: Tick | None = None
        self._leases = LeaseHolder(NAME, instance)
        self._commanded: dict[int, int] = {}
        self._expires_ns, self._deadline_s = 0, math.inf
        self._leads = self._replaced = False
        self._refused: Counter[str] = Counter()
        for i in range(len(scenario.chasers)):
            node.advertise(topics.WRENCH, i)
            ros.subscribe(command_topic(i), WRENCH_TYPE, partial(self._command, i))
        for topic in (topics.TICK, topics.END, topics.LEASE):
            node.subscribe(topic)
        self._heartbeat = Heartbeat(node, instance, stall_s)

    def run(self, stop: StopSignal) -> int:
        """Command until the mission ends; return the exit status."""
        ended = False
        while not (ended or self._replaced or stop() or self._heartbeat.world_is_gone()):
            received = self._node.receive(
                max(0.0, min(_RECEIVE_S, self._deadline_s - self._node.host.now_s()))
            )
            with self._lock:
                if received is not None:
                    ended = self._take(received.message)
                if self._node.host.now_s() >= self._deadline_s:
                    self._complete_tick()
        tick = self._tick
        if not self._replaced:
            self._heartbeat.farewell(tick.tick if tick else -1, tick.sim_time_ns if tick else 0)
        for reason, number in self._refused.items():
            print_status(NAME, f"{number} wrenches not commanded: {reason}")
        return 0 if ended else 1

    def _take(self, message: object) -> bool:
        """Take a message of the mission; return whether it ends it."""
        match message:
            case Tick() as tick:
                self._replaced |= self._heartbeat.is_replaced(tick.controllers.get(NAME))
                if self._replaced:
                    return False
                self._heartbeat.in_flight.set()
                self._tick = tick
                self._leases.add_tick(tick)
                self._deadline_s = self._node.host.now_s() + _PATIENCE_TICKS / self._timing.rate_hz
            case Lease() as lease if not defect_of(lease, self._timing.rate_hz):
                self._leases.add(lease)
            case Presence() as presence:
                self._heartbeat.take(presence)
            case MissionEnd():
                return True
        return False

    def _command(self, chaser: int, wrench: Any) -> None:
        """Command a chaser at once, on Zenoh's thread of the session with ROS 2."""
        with self._lock:
            self._command_now(chaser, wrench)

    def _command_now(self, chaser: int, wrench: Any) -> None:
        tick, reason = self._tick, why_invalid(wrench, chaser)
        if reason is None and (tick is None or chaser not in tick.chasers):
            reason = f"chaser {chaser} does not fly"
        if reason is None and tick is not None and not self._leases.claim(tick):
            reason = "no majority of the chasers has granted its lease"
        if reason is not None or tick is None:
            self._refused[reason or ""] += 1
            return
        if self._commanded.get(chaser, -1) >= tick.tick:
            return
        self._set_leads(True)
        self._commanded[chaser] = tick.tick
        command = wrench_command(
            wrench, chaser, tick, self._timing, self._leases.term, self._instance
        )
        self._expires_ns = command.expires_ns
        self._node.publish(topics.WRENCH, command, chaser)

    def _complete_tick(self) -> None:
        """Renew the leases of chasers without a wrench until the newest wrench of any has expired.

        Without a majority, give the leases back.
        """
        self._deadline_s, tick, leases = math.inf, self._tick, self._leases
        if tick is None:
            return
        if not leases.claim(tick):
            self._set_leads(False)
            for i, (term, gives_back) in leases.take_idle(tick).items():
                self._publish_without_wrench(i, tick, "yield" if gives_back else "wait", term)
        elif tick.sim_time_ns < self._expires_ns:
            for i in tick.chasers:
                if self._commanded.get(i) != tick.tick:
                    self._publish_without_wrench(i, tick, "none", leases.term)

    def _publish_without_wrench(self, chaser: int, tick: Tick, mode: str, term: int) -> None:
        head = {"mode": mode, "term": term, "commander": NAME, "instance": self._instance}
        self._node.publish(
            topics.WRENCH, msgspec.structs.replace(no_command(chaser, tick), **head), chaser
        )

    def _set_leads(self, leads: bool) -> None:
        """Note, and print, whether this process commands."""
        if leads and not self._leads:
            self._node.restart_numbering()
        if leads != self._leads:
            print_status(NAME, f"commands in term {self._leases.term}" if leads else "stands by")
        self._leads = leads
