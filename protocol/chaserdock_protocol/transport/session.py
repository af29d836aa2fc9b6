# SPDX-License-Identifier: Apache-2.0
"""Join a mission, and hold its first tick until all processes have discovered each other.

Zenoh propagates declarations one by one, so that a message published too early may miss a
subscriber. Every process therefore publishes at intervals from which processes it has received
``Presence``. It declares its presence subscription after all its other subscriptions. A writer
whose presence reaches a reader hence knows all subscriptions of that reader, and no later message
is lost, for any topology and start order. The world opens the first tick when all pairs that
exchange messages have received each other's presence.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import (
    MAX_COUNT,
    Event,
    Farewell,
    Health,
    JoinReply,
    JoinRequest,
    Message,
    Presence,
    ScenarioReply,
    ScenarioRequest,
)
from chaserdock_protocol.process import ProcessOptions, StopSignal, print_status
from chaserdock_protocol.recording.provenance import blas_in_use
from chaserdock_protocol.stall import DEFAULT_STALL_S, StallTimer
from chaserdock_protocol.topics import Role

from . import Node, ReceivedMessage

EARLY_PERIOD_S = 0.05
"""Interval of presence before the first tick, s: the discovery barrier ends about two of them after
the last declaration.
"""
_MOST_REPLACED = 256
"""Instances that are remembered as replaced: more than any mission restarts processes; bounds the
memory under forged ones.
"""
SUCCESSOR_AFTER_S = 2.0
"""Silence of the world, s, after which a process asks once a second whether another one has taken
up its mission: two presences are missing.
"""
STEADY_PERIOD_S = 1.0
"""Interval of presence in flight, s: a fifth of ``stall.SILENT_S``, after which a process counts as
silent.
"""


class JoinRefused(ChaserdockError):
    """The world rejects this process. The text gives the reason."""


class NoFullScenario(JoinRefused):
    """The world gives no full scenario, or not to this process."""


def join(
    node: Node, instance: str, stopped: Callable[[], bool], patience_s: float | None = None
) -> JoinReply | None:
    """Query the world for the mission until it replies. Return None if ``stopped``.

    Raises JoinRefused if the world rejects the process, or after ``patience_s`` of wall time
    without a reply.
    """
    begun = node.host.now_s()
    while not stopped():
        reply = node.query(
            topics.JOIN_KEY, JoinRequest(process=node.name, instance=instance), JoinReply, 0.5
        )
        if reply is not None:
            if not reply.accepted:
                raise JoinRefused(reply.reason)
            return reply
        if patience_s is not None and node.host.now_s() - begun > patience_s:
            raise JoinRefused(
                f"no world answered within {patience_s:.0f} s; is it running, and on the same "
                "namespace?"
            )
        node.host.sleep(0.02)
    return None


def request_scenario(
    node: Node, mission: JoinReply, stopped: Callable[[], bool], patience_s: float = 10.0
) -> str | None:
    """Return the JSON of the mission's full scenario, which flight processes may not have. Return
    None if ``stopped``.

    Raises NoFullScenario when the world gives none within ``patience_s`` of wall time.
    """
    begun = node.host.now_s()
    while not stopped():
        reply = node.query(
            topics.SCENARIO_KEY, ScenarioRequest(process=node.name), ScenarioReply, 0.5
        )
        if reply is not None and reply.run_id == mission.run_id:
            return reply.scenario_json
        if node.host.now_s() - begun > patience_s:
            raise NoFullScenario(
                f"the world gave no scenario on {topics.SCENARIO_KEY} within {patience_s:.0f} s; "
                f"may {node.name} read it?"
            )
        node.host.sleep(0.02)
    return None


def run_member(
    name: str,
    role: Role,
    options: ProcessOptions,
    work: Callable[[Node, JoinReply, str, StopSignal], int],
) -> int:
    """Run a process other than the world: open its node, join the mission, and return the status of
    ``work``.

    ``work(node, mission, instance, stop)`` runs once the world has replied. Return 1 if stopped
    before, or print the text of a ChaserdockError and return 2.
    """
    node: Node | None = None
    try:
        node = Node(name, role, options.link)
        stop, instance = options.stop_signal(), node.host.unique_id()
        mission = join(node, instance, stop, options.patience_s)
        if mission is None:
            return 1
        node.blocking, node.run_id = mission.mode == "lockstep", mission.run_id
        watch_for_foreign_publishers(node, mission.source)
        # before the start-up work (compilation): reserves the process' name
        node.declare_liveliness()
        print_status(name, f"joined mission {mission.run_id} ({mission.mode})")
        status = work(node, mission, instance, stop)
        print_status(name, f"ended with status {status}")
        return status
    except ChaserdockError as error:
        print_status(name, str(error))
        return 2
    finally:
        if node is not None:
            node.close()


def ask_as_world(node: Node) -> JoinReply | None:
    """Return how the world of this namespace refuses a second one; None without a world.

    Reserves no name.
    """
    request = JoinRequest(process="world", instance=node.host.unique_id())
    return node.query(topics.JOIN_KEY, request, JoinReply, 0.5)


def find_world(node: Node) -> str | None:
    """Return the identity of the world's session without joining its mission, or None without a
    world.
    """
    reply = ask_as_world(node)
    return None if reply is None else reply.source


def ignore_foreign_publishers(
    node: Node, world_source: str, warn: Callable[[str, Message | None], None]
) -> None:
    """Make a node ignore messages on the world's keys that are not the world's.

    ``warn(detail, newest)`` runs on the reader's thread for each session that publishes such
    messages; ``detail`` names it. ``newest``: the last valid message.
    """

    def on_foreign(key: str, source: str, newest: Message | None) -> None:
        who = "a session without time stamps" if source == node.source else f"session {source}"
        warn(
            f"{who} publishes on {key}, which is the world's (session {world_source}); ignored",
            newest,
        )

    node.expect_world(world_source, on_foreign)


def watch_for_foreign_publishers(node: Node, world_source: str) -> None:
    """Make a node ignore messages of other sessions on the world's keys.

    Publishes a warning about each such session.
    """

    def warn(detail: str, newest: Message | None) -> None:
        print_status(node.name, f"foreign publisher: {detail}")
        stamp = (-1, 0) if newest is None else (newest.tick, newest.sim_time_ns)
        warning = Event(
            tick=stamp[0],
            sim_time_ns=stamp[1],
            process=node.name,
            level="warning",
            what="foreign publisher",
            detail=detail,
        )
        node.publish(topics.EVENT, warning, node.name)

    ignore_foreign_publishers(node, world_source, warn)


def required_peers(process: str, present: set[str]) -> set[str]:
    """Return the processes among ``present`` with which ``process`` must exchange presence before
    it flies.
    """
    if process.startswith("chaser/"):
        return {"world", *topics.CONTROLLERS} & present
    return present - {process}


class Heartbeat:
    """Publish this process' presence at intervals in the background, and collect that of the
    others.

    Construct it after all other subscriptions of the node. ``waiting_for``: see ``Presence``.
    ``stall_s``: after so long without the world's presence the world is gone.
    """

    def __init__(self, node: Node, instance: str, stall_s: float = DEFAULT_STALL_S) -> None:
        self._node = node
        self._instance = instance
        self._stall_s, self._without_world = stall_s, StallTimer(node.host.now_s)
        self._ask_at_s = SUCCESSOR_AFTER_S
        self.waiting_for: tuple[str, ...] = ()
        self.hangs: Callable[[], bool] = lambda: False
        """Whether the process' loop has stopped: its presence, published in the background, then
        stops, too.
        """
        self._heard: dict[str, str] = {}
        self._newest: dict[str, str] = {}
        self._replaced: deque[str] = deque(maxlen=_MOST_REPLACED)
        self._listed: dict[str, str] = {}
        self._lock = threading.Lock()
        self.in_flight = threading.Event()
        """Set at the first tick: presence is then published once a second only."""
        node.advertise(topics.PRESENCE, node.name)
        node.subscribe(topics.PRESENCE)
        self.stop = node.host.repeat(self._publish)
        """Stops publishing, and waits for a publication that has begun."""
        # A thread inside Zenoh while the interpreter shuts down crashes the process.
        node.on_close(self.stop)

    def take(self, message: Presence) -> None:
        """Record a presence that the process' loop received.

        Ignores that of an earlier mission in this namespace, and that of a process that was
        replaced and goes on. Which instance of a process counts is what the world lists, as it has
        admitted it: a forged presence shuts no process out.
        """
        own = self._node.world_source
        if own and message.world and message.world != own:
            return
        if message.process == "world":
            self.world_heard()
        with self._lock:
            if message.process == "world":
                self._listed = message.heard
            listed = self._listed.get(message.process)
            if message.instance != listed and (listed or message.instance in self._replaced):
                return
            before = self._newest.get(message.process, message.instance)
            if message.instance != before:
                self._replaced.append(before)
            self._newest[message.process] = self._heard[message.process] = message.instance

    def report_waiting(
        self, received: ReceivedMessage | None, missing_keys: Callable[[], tuple[str, ...]]
    ) -> None:
        """Let presence name the messages that the process waits for, from when it receives none
        (``received`` is None).
        """
        if received is None:
            self.waiting_for = missing_keys()
        elif received.topic is not topics.PRESENCE:
            self.waiting_for = ()

    def world_heard(self) -> None:
        """Note that the world has sent a message."""
        self._without_world.reset()
        self._ask_at_s = SUCCESSOR_AFTER_S

    def world_is_gone(self) -> bool:
        """Return, and print, whether the world has been silent for too long. In real time another
        one may take up its mission meanwhile. Call it at least twice a second.
        """
        silent_s = self._without_world.update()
        if silent_s >= self._ask_at_s and not self._node.blocking:
            self._ask_at_s = silent_s + STEADY_PERIOD_S
            if self._find_successor():
                return False
        gone = silent_s >= self._stall_s
        if gone:
            print_status(
                self._node.name, f"the world is gone: no presence of it for {self._stall_s:g} s"
            )
        return gone

    def _find_successor(self) -> bool:
        """Return, and print, whether another world has taken up the mission; it is then this
        process' world.
        """
        node = self._node
        request = JoinRequest(process=node.name, instance=self._instance)
        reply = node.query(topics.JOIN_KEY, request, JoinReply, 0.5)
        if reply is None or not reply.accepted or not node.run_id:
            return False
        if reply.run_id != node.run_id or reply.source == node.world_source:
            return False
        watch_for_foreign_publishers(node, reply.source)
        with self._lock:
            self._listed = {}
        self.world_heard()
        print_status(node.name, "the world is back, and the mission goes on")
        return True

    def heard(self) -> dict[str, str]:
        """Return the processes whose presence was received, with their instances."""
        with self._lock:
            return dict(sorted(self._heard.items()))

    def is_replaced(self, listed: str | None) -> bool:
        """Return, and print, whether the world lists another instance of this process, which was
        lost and started again.
        """
        replaced = listed is not None and listed != self._instance
        if replaced:
            print_status(
                self._node.name, f"another {self._node.name} has replaced this one, which was lost"
            )
        return replaced

    def forget(self, process: str) -> None:
        """Forget a process that was lost."""
        with self._lock:
            self._heard.pop(process, None)

    def _publish(self) -> float:
        """Publish the presence unless the process hangs; return after how many seconds to publish
        the next.
        """
        if self.hangs():
            return STEADY_PERIOD_S
        message = Presence(
            process=self._node.name,
            instance=self._instance,
            heard=self.heard(),
            waiting_for=self.waiting_for,
            world=self._node.world_source,
        )
        self._node.publish(topics.PRESENCE, message, self._node.name)
        return STEADY_PERIOD_S if self.in_flight.is_set() else EARLY_PERIOD_S

    def farewell(self, tick: int, time_ns: int) -> None:
        """Stop the heartbeat and publish this process' last messages: health, and the message count
        of each key.
        """
        self.stop()
        health = create_health(self._node, tick, time_ns)
        self._node.publish(topics.HEALTH, health, self._node.name)
        last = Farewell(
            tick=tick, sim_time_ns=time_ns, process=self._node.name, published=self._node.published
        )
        self._node.publish(topics.FAREWELL, last, self._node.name)


def create_health(node: Node, tick: int, time_ns: int) -> Health:
    """Return the health message of a node: its traffic counters, and the BLAS of its process."""
    return Health(
        tick=tick,
        sim_time_ns=time_ns,
        process=node.name,
        rejected=dict(node.counts.rejected),
        lost=min(sum(node.counts.lost.values()), MAX_COUNT),
        stale=node.counts.stale,
        blas=blas_in_use(),
    )
