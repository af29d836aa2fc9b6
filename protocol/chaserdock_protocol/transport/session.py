"""Joining a mission, and the barrier before its first tick.

Declarations reach the others one by one, so a message published too early could miss its reader. Every process
therefore tells at intervals whose presence has reached it. Its presence subscription is declared after all others
of its own; whoever's presence a process hears must know that subscription, hence all those declared before it.
So once the reader of a topic has heard its writer, nothing that the writer publishes can miss it, whatever the
topology and start order. The world opens the first tick when all such pairs have heard each other.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable

from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import Farewell, Health, JoinReply, JoinRequest, Presence
from chaserdock_protocol.messages.fields import GREATEST_COUNT
from chaserdock_protocol.process import ProcessOptions, Stop, say
from chaserdock_protocol.topics import Role

from . import Node

EARLY_PERIOD_S = 0.05
STEADY_PERIOD_S = 1.0


class JoinRefused(ChaserdockError):
    """The world does not take this process; the text says why."""


def new_instance() -> str:
    """A name for one start of one process."""
    return uuid.uuid4().hex[:12]


def join(
    node: Node, instance: str, stopped: Callable[[], bool], patience_s: float | None = None
) -> JoinReply | None:
    """Asks the world for the mission until it answers; None when ``stopped``.

    Raises JoinRefused when the world refuses, or after ``patience_s`` of wall time without any answer.
    """
    begun = time.monotonic()
    while not stopped():
        reply = node.ask(topics.JOIN_KEY, JoinRequest(process=node.name, instance=instance), JoinReply, 0.5)
        if reply is not None:
            if not reply.accepted:
                raise JoinRefused(reply.reason)
            return reply
        if patience_s is not None and time.monotonic() - begun > patience_s:
            raise JoinRefused(
                f"no world answered within {patience_s:.0f} s; is it running, and on the same namespace?"
            )
        time.sleep(0.02)
    return None


def take_part(
    name: str, role: Role, options: ProcessOptions, work: Callable[[Node, JoinReply, str, Stop], int]
) -> int:
    """The main of every process but the world: opens its node, joins the mission, does its ``work``; its status.

    ``work(node, mission, instance, stop)`` is called once the world has answered. 1 when stopped before that, 2, with
    the reason said, for a ChaserdockError.
    """
    node: Node | None = None
    try:
        node = Node(name, role, options.link)
        stop, instance = Stop(options.watch_parent), new_instance()
        mission = join(node, instance, stop, options.patience_s)
        if mission is None:
            return 1
        node.waits = mission.mode == "lockstep"
        node.announce()  # at once: while it prepares itself (compiling, say) nobody else may take its place
        return work(node, mission, instance, stop)
    except ChaserdockError as error:
        say(name, str(error))
        return 2
    finally:
        if node is not None:
            node.close()


def partners_of(process: str, present: set[str]) -> set[str]:
    """Those among ``present`` that ``process`` must have heard, and that must have heard it, before it flies."""
    if process.startswith("chaser/"):
        return {"world", *topics.CONTROLLERS} & present
    return present - {process}


class Heartbeat:
    """Publishes this process' presence at intervals and collects the others'; a daemon thread of its own.

    Construct it after all other subscriptions of the node.
    """

    def __init__(self, node: Node, instance: str) -> None:
        self._node = node
        self._instance = instance
        self._heard: dict[str, str] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self.settled = threading.Event()
        """Set once flying: presence is then told once a second only."""
        node.advertise(topics.PRESENCE, node.name)
        node.subscribe(topics.PRESENCE)
        self._thread = threading.Thread(target=self._run, name="presence", daemon=True)
        self._thread.start()
        # On every way out: a thread caught in Zenoh while the interpreter ends takes the process down with it.
        node.before_close(self.stop)

    def take(self, message: Presence) -> None:
        """Notes a presence that the process' loop received."""
        with self._lock:
            self._heard[message.process] = message.instance

    def heard(self) -> dict[str, str]:
        """Processes heard so far, with the instance that was heard."""
        with self._lock:
            return dict(sorted(self._heard.items()))

    def forget(self, process: str) -> None:
        """A process is gone; it has to be heard again."""
        with self._lock:
            self._heard.pop(process, None)

    def _run(self) -> None:
        while not self._stop.is_set():
            message = Presence(process=self._node.name, instance=self._instance, heard=self.heard())
            self._node.publish(topics.PRESENCE, message, self._node.name)
            self._stop.wait(STEADY_PERIOD_S if self.settled.is_set() else EARLY_PERIOD_S)

    def stop(self) -> None:
        """Tells no more; returns when the thread has ended, which a blocked network may delay by its own patience."""
        self._stop.set()
        self._thread.join()

    def farewell(self, tick: int, time_ns: int) -> None:
        """Stops telling and publishes this process' last message: how many of each it has sent."""
        self.stop()
        health = health_of(self._node, tick, time_ns)
        self._node.publish(topics.HEALTH, health, self._node.name)
        last = Farewell(
            tick=tick, sim_time_ns=time_ns, process=self._node.name, published=self._node.published
        )
        self._node.publish(topics.FAREWELL, last, self._node.name)


def health_of(node: Node, tick: int, time_ns: int) -> Health:
    """What a node has refused and missed so far."""
    return Health(
        tick=tick,
        sim_time_ns=time_ns,
        process=node.name,
        rejected=dict(node.counts.rejected),
        lost=min(sum(node.counts.lost.values()), GREATEST_COUNT),
        stale=node.counts.stale,
    )
