"""The viewer on a running mission: follows it, draws it, passes on commands. A process of its own.

It looks on: of each topic it keeps the newest few messages, the rest is dropped inside Zenoh, so that a browser that
hangs holds up nobody. When the mission is over it waits for the next one.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import viser
from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import CommandReply, JoinReply, JoinRequest, OperatorCommand
from chaserdock_protocol.process import StopSignal, print_status
from chaserdock_protocol.scenario import scenario_from_json
from chaserdock_protocol.transport import Link, Node, ReceivedMessage
from chaserdock_protocol.transport.session import new_instance

from .address import DEFAULT_HOST, url_of
from .history import History, answer_text
from .page import Page
from .server import page_server
from .snapshot import OF_CHASERS, Now

PERIOD_S = 0.1
_STATES, _EVENTS = 16, 256
_ANSWER_S = 5.0
_SILENT_S = 3.0
_ASK_S = 2.0
_RECONNECT_S = 10.0
_DRAWING_NICE = 10
_WAITING = "no mission answers yet"


@dataclass(frozen=True)
class ViewOptions:
    """How the page is served and what it may show. ``truth``: read ground truth, as far as rights let this process."""

    host: str = DEFAULT_HOST
    port: int | None = None
    dark: bool = False
    truth: bool = True


def view_live(link: Link, options: ViewOptions, watch_parent: bool = False) -> int:
    """Serves the page until stopped; 0. Raises ViewError or TransportError when it cannot begin."""
    stop = StopSignal(watch_parent)
    with ThreadPoolExecutor(1, "ears") as ears:
        ears.submit(int).result()
        # Drawing gives way to those who fly. Listening does not: Zenoh's threads inherit the priority of the one that
        # opens the session (nice(2) counts for a thread), and a link that is not read would hold up its publishers.
        os.nice(_DRAWING_NICE)

        def listen() -> Node:
            return ears.submit(Node, "viewer", "viewer", link).result()

        with page_server(options.host, options.port) as server:
            print_status(
                "viewer", f"{url_of(options.host, server.get_port())} shows the mission; Ctrl-C ends this"
            )
            run_id = ""
            while not stop():
                mission = _next_mission(listen, server, run_id, stop)
                if mission is not None:
                    run_id = mission.run_id
                    _Watch(listen, server, mission, options).run(stop)
    return 0


# One viewer, however often it asks: the world takes another instance for somebody who is in its place.
_INSTANCE = new_instance()


def _ask(node: Node) -> JoinReply | None:
    return node.query(topics.JOIN_KEY, JoinRequest(process="viewer", instance=_INSTANCE), JoinReply, 0.5)


def _next_mission(
    listen: Callable[[], Node], server: viser.ViserServer, past: str, stop: StopSignal
) -> JoinReply | None:
    """Waits for a mission other than the ``past`` one; None when stopped. The page says what it waits for."""
    said = None
    notice = server.gui.add_markdown("") if not past else None
    node = listen()
    try:
        while not stop():
            reply = _ask(node)
            if reply is not None and reply.accepted and reply.run_id != past:
                return reply
            text = _WAITING if reply is None or reply.accepted else reply.reason
            if notice is not None and text != said:
                notice.content = said = text
            time.sleep(0.2)
        return None
    finally:
        node.close()


@dataclass
class _Feed:
    """What is followed of a mission, in an order in which nothing comes before what it follows from."""

    takers: list[Callable[[], list[ReceivedMessage]]] = field(default_factory=list)

    @classmethod
    def of(cls, node: Node, chasers: int, truth: bool) -> _Feed:
        feed = cls([node.subscribe_newest(topics.TICK, _STATES)])
        if truth:
            bodies = ["target", *(f"chaser/{i}" for i in range(chasers))]
            feed.takers += [node.subscribe_newest(topics.TRUTH_BODY, _STATES, body) for body in bodies]
        for topic in OF_CHASERS:
            depth = 1 if topic is topics.IMAGE else _STATES
            feed.takers += [node.subscribe_newest(topic, depth, i) for i in range(chasers)]
        feed.takers += [node.subscribe_newest(topic, _STATES) for topic in (topics.TARGET, topics.SOLVER)]
        told = (topics.COMMAND, topics.EVENT, topics.HEALTH, topics.END)
        feed.takers += [node.subscribe_newest(topic, _EVENTS) for topic in told]
        return feed

    def new(self) -> list[ReceivedMessage]:
        """What has come since the last call."""
        return [received for take in self.takers for received in take()]


class _Watch:
    """One mission, from the moment it was found until there is another one."""

    def __init__(
        self, listen: Callable[[], Node], server: viser.ViserServer, mission: JoinReply, options: ViewOptions
    ) -> None:
        self._listen, self._mission, self._truth = listen, mission, options.truth
        scenario = scenario_from_json(mission.scenario_json, "the world's scenario")
        chasers = len(scenario.chasers)
        self._now, self._history = Now.of(chasers), History(chasers)
        self._seen: set[str] = set()
        self._alive: set[str] = set()
        self._paces: deque[tuple[float, float]] = deque(maxlen=50)
        self._heard_s = time.monotonic()
        self._connect()
        self._commands: queue.Queue[tuple[str, int] | None] = queue.Queue(maxsize=8)
        self._page = Page(
            server,
            scenario,
            dark=options.dark,
            truth=options.truth,
            command=self._command,
            timeline=None,
        )

    def run(self, stop: StopSignal) -> None:
        """Follows and draws at most ten times a second, and never more than half of the time."""
        operator = threading.Thread(target=self._operate, name="operator", daemon=True)
        operator.start()
        asked_s = connected_s = time.monotonic()
        try:
            while not stop():
                begun_s = time.monotonic()
                self._follow()
                if self._page.watched:
                    self._page.draw(self._now, self._history, self._mission.mode, self._speed(), self._lost())
                silent = self._now.ended is not None or begun_s - self._heard_s > _SILENT_S
                if silent and begun_s - asked_s > _ASK_S:
                    asked_s = begun_s
                    reply = _ask(self._node)
                    if reply is not None and reply.accepted and reply.run_id != self._mission.run_id:
                        return
                    if reply is None and begun_s - connected_s > _RECONNECT_S:
                        # Between peers nobody opens a link again that was closed for not being read.
                        connected_s = begun_s
                        self._node.close()
                        self._connect()
                took_s = time.monotonic() - begun_s
                time.sleep(max(PERIOD_S - took_s, took_s))
        finally:
            self._commands.put(None)
            operator.join(timeout=_ANSWER_S + 1.0)
            self._node.close()

    def _connect(self) -> None:
        self._alive.clear()
        self._node = self._listen()
        self._feed = _Feed.of(self._node, len(self._now.chasers), self._truth)
        self._node.watch_liveliness(self._changed)

    def _follow(self) -> None:
        tick = self._now.tick
        for received in self._feed.new():
            self._now.take(received.topic, received.message)
            self._history.take(received.topic, received.message, received.sent_ns)
        if self._now.tick is not tick:
            self._heard_s = time.monotonic()
            self._paces.append((self._heard_s, self._now.time_s()))

    def _speed(self) -> float | None:
        """Simulated over wall time in the last few seconds."""
        if len(self._paces) < 2:
            return None
        (begin, first), (end, last) = self._paces[0], self._paces[-1]
        return (last - first) / max(1e-9, end - begin)

    def _changed(self, process: str, alive: bool) -> None:
        if alive:
            self._seen.add(process)
            self._alive.add(process)
        else:
            self._alive.discard(process)

    def _lost(self) -> set[str]:
        """Who flew and is gone; nobody once the mission is over."""
        return set() if self._now.ended is not None else self._seen - self._alive - {"operator"}

    # -- commands -----------------------------------------------------------------------------------------

    def _command(self, what: str, chaser: int) -> None:
        try:
            self._commands.put_nowait((what, chaser))
        except queue.Full:
            self._page.answer(
                f"⚠ {what} chaser {chaser}: not sent, {self._commands.maxsize} commands wait for answers"
            )

    def _operate(self) -> None:
        while (wish := self._commands.get()) is not None:
            what, chaser = wish
            self._page.answer(f"{what} chaser {chaser}: asked …")
            command = OperatorCommand(command=what, chaser=chaser, operator="viewer")  # type: ignore[arg-type]
            try:
                reply = self._node.query(topics.OPERATE_KEY, command, CommandReply, _ANSWER_S)
            except ChaserdockError as error:
                self._page.answer(f"⚠ {what} chaser {chaser}: {error}")
                continue
            if reply is None:
                self._page.answer(f"⚠ {what} chaser {chaser}: no controller answered within {_ANSWER_S:g} s")
            else:
                self._page.answer(("✓ " if reply.accepted else "⚠ ") + answer_text(reply))
