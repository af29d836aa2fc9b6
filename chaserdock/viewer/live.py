# SPDX-License-Identifier: Apache-2.0
"""Viewer of a running mission: receives messages, draws, sends commands. Runs as a process of its
own.

It keeps only the newest messages of each topic; Zenoh drops the rest. A blocked browser therefore
never delays the mission. After the end of a mission it waits for the next one.
"""

from __future__ import annotations

import math
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import viser
from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import (
    CommandReply,
    JoinReply,
    JoinRequest,
    OperatorCommand,
    PortRequest,
)
from chaserdock_protocol.process import StopSignal, print_status
from chaserdock_protocol.recording.log import LogError, read_log
from chaserdock_protocol.scenario import flight_scenario_from_json
from chaserdock_protocol.transport import Link, Node, NoRouterError, ReceivedMessage
from chaserdock_protocol.transport.network import unique_id
from chaserdock_protocol.transport.session import ignore_foreign_publishers

from chaserdock.exit_codes import STOPPED
from chaserdock.launch.mission_address import ADDRESS_FILE
from chaserdock.launch.reach import (
    TO_CHOOSE_PORTS,
    TO_COMMAND,
    TO_VIEW,
    Rights,
    check_rights,
)

from .address import page_token, url_of
from .history import History, Line, reply_text
from .page import PERIOD_S, Page, ViewOptions
from .player import show_flown
from .port_dialog import NAME as CLICK
from .port_dialog import ImageClicks, PortDialogs
from .report_page import NAME, ReportPage
from .server import page_server
from .snapshot import EVENT_TOPICS, OF_CHASERS, MissionState

_STATES, _EVENTS = 16, 256
"""Messages of a state, and of events, that may wait for drawing: 16 states are 1.6 s at 10 Hz.
Larger: after a pause old states are shown first; smaller: messages of a slow drawing are lost.
"""
_REPLY_TIMEOUT_S = 5.0
"""Time (s) that a controller has to answer a command of the page. Larger: a missing answer is
reported later; smaller: answers of busy machines are missed.
"""
_SILENCE_S = 3.0
"""Time (s) without messages after which a new mission is searched. Smaller: pauses of a mission
pass for its end.
"""
_JOIN_PERIOD_S = 2.0
"""Time (s) between two attempts to find a mission. Larger: it is shown later; smaller: more
requests.
"""
_RECONNECT_S = 10.0
"""Time (s) without an answer after which the session is opened again: several attempts."""
_DRAWING_NICE = 10
"""Priority (nice) of drawing: half of the range below that of missions on the same machine."""
_ATTEMPT_S = 2.0
"""Longest time (s) of one attempt to connect to a router."""
_LEFT_S = 10.0
"""Time (s) without a tab after which a page that `chaserdock run` started ends. Smaller: loading
the page again ends it on a slow machine.
"""
_PAST_PERIOD_S = 2.0
"""Time (s) between two attempts to read the events before the viewer joined: the recorder writes
its log to disk every 0.5 s.
"""
_WAITING = "no mission is running"


def view_live(link: Link, options: ViewOptions, watch_parent: bool = False) -> int:
    """Serve the page until stopped; return ``STOPPED``. Raise ViewError, RightsError or
    TransportError if it cannot start.
    """
    check_rights(link, "view", TO_VIEW)
    stop, token = StopSignal(watch_parent), page_token()
    with ThreadPoolExecutor(1, "session") as opener:
        opener.submit(int).result()
        # Only drawing has a low priority. Zenoh's threads inherit the priority of the thread that
        # opens the session (nice(2) applies to a thread), and a link that is read too slowly would
        # delay its publishers.
        os.nice(_DRAWING_NICE)

        def connect() -> Node:
            return opener.submit(
                Node, "viewer", "viewer", replace(link, connect_timeout_s=_ATTEMPT_S)
            ).result()

        report, place = ReportPage(), f"/{token}/{NAME}"
        clicks = ImageClicks(token)
        documents = {NAME: report, CLICK: clicks}
        with page_server(options.host, options.port, token, documents) as server:
            print_status(
                "viewer",
                f"{url_of(options.host, server.get_port(), token)} shows the mission; Ctrl-C ends "
                "this",
            )

            def ended() -> bool:
                return stop() or (options.folder is not None and _is_flown(options.folder))

            patient, run_id = _Patience(connect, ended), ""
            with suppress(_Stopped):
                while not ended():
                    mission = _next_mission(patient, server, run_id, ended)
                    if mission is None:
                        continue
                    run_id = mission.run_id
                    _MissionView(patient, server, mission, options, link, clicks).run(ended)
            if options.folder is not None and not stop():
                closed = _Unwatched(server, stop) if watch_parent else stop
                show_flown(server, options, report, place, closed)
    return STOPPED


def _is_flown(folder: Path) -> bool:
    """Return whether the mission of a folder has ended and its log is complete."""
    return not (folder / ADDRESS_FILE).exists()


class _Unwatched:
    """Tells whether no tab has shown the page for ``_LEFT_S``, or none when it was first asked, or
    whether ``stop`` does.
    """

    def __init__(self, server: viser.ViserServer, stop: Callable[[], bool]) -> None:
        self._server, self._stop, self._watched_s = server, stop, -math.inf

    def __call__(self) -> bool:
        if self._server.get_clients():
            self._watched_s = time.monotonic()
        return self._stop() or time.monotonic() - self._watched_s > _LEFT_S


class _Stopped(Exception):
    """The viewer was stopped while it waited for a router."""


class _Patience:
    """Opens a node as soon as a router accepts the connection; reports once that none does.

    An attempt takes at most ``_ATTEMPT_S``, in native code, where no signal is handled. Raises
    _Stopped.
    """

    def __init__(self, connect: Callable[[], Node], stop: Callable[[], bool]) -> None:
        self._connect, self._stop, self._reported = connect, stop, False

    def __call__(self) -> Node:
        while not self._stop():
            try:
                return self._connect()
            except NoRouterError as error:
                if not self._reported:
                    print_status("viewer", f"{error} The viewer waits for it.")
                self._reported = True
        raise _Stopped


# One instance for all join requests: the world would treat another one as a replacement.
_INSTANCE = unique_id()


def _join(node: Node) -> JoinReply | None:
    return node.query(
        topics.JOIN_KEY, JoinRequest(process="viewer", instance=_INSTANCE), JoinReply, 0.5
    )


def _next_mission(
    connect: Callable[[], Node],
    server: viser.ViserServer,
    past: str,
    stop: Callable[[], bool],
) -> JoinReply | None:
    """Wait for a mission other than ``past`` and show the status on the page. Returns None when
    stopped.
    """
    shown = None
    notice = server.gui.add_markdown("") if not past else None
    node = connect()
    try:
        while not stop():
            reply = _join(node)
            if reply is not None and reply.accepted and reply.run_id != past:
                return reply
            text = _WAITING if reply is None or reply.accepted else reply.reason
            if notice is not None and text != shown:
                notice.content = shown = text
            time.sleep(0.2)
        return None
    finally:
        node.close()


@dataclass
class _Feed:
    """Subscriptions of a mission, ordered so that no message comes before its cause."""

    subscriptions: list[Callable[[], list[ReceivedMessage]]] = field(default_factory=list)

    @classmethod
    def of(cls, node: Node, chasers: int, truth: bool) -> _Feed:
        feed = cls([node.subscribe_newest(topics.TICK, _STATES)])
        if truth:
            bodies = ["target", *(f"chaser/{i}" for i in range(chasers))]
            feed.subscriptions += [
                node.subscribe_newest(topic, _STATES, body)
                for topic in (topics.TRUTH_BODY, topics.BODY_REFERENCE)
                for body in bodies
            ]
            feed.subscriptions += [
                node.subscribe_newest(topics.TRUTH_LOAD, _STATES, i) for i in range(chasers)
            ]
            feed.subscriptions.append(node.subscribe_newest(topics.TRUTH_DRAWN, 1))
        for topic in OF_CHASERS:
            depth = 1 if topic is topics.IMAGE else _STATES
            feed.subscriptions += [node.subscribe_newest(topic, depth, i) for i in range(chasers)]
        feed.subscriptions += [
            node.subscribe_newest(topic, _STATES)
            for topic in (topics.TARGET, topics.MAP, topics.STACK, topics.SOLVER)
        ]
        feed.subscriptions += [node.subscribe_newest(topic, _EVENTS) for topic in EVENT_TOPICS]
        return feed

    def new(self) -> list[ReceivedMessage]:
        """Return the messages received since the last call."""
        return [received for take in self.subscriptions for received in take()]


def past_lines(log: Path, chasers: int, until_s: float) -> list[Line] | None:
    """Return the event lines of a log that is being written, up to a tick; None if it does not yet
    reach that tick. Raise LogError.
    """
    past, reached_s = History(chasers), -1.0
    processes = ("world", *topics.CONTROLLERS, *(f"chaser/{i}" for i in range(chasers)))
    keys = [topics.TICK.key_of(), topics.COMMAND.key_of(), topics.END.key_of()]
    keys += [topics.EVENT.key_of(process) for process in processes]
    for record in read_log(log, keys):
        if record.topic is topics.TICK:
            reached_s = max(reached_s, record.message.sim_time_ns / 1e9)
        else:
            past.update(record.topic, record.message, 0)
    return past.lines_until(until_s, len(past.lines))[::-1] if reached_s >= until_s else None


class _MissionView:
    """Shows one mission until another one starts."""

    def __init__(
        self,
        connect: Callable[[], Node],
        server: viser.ViserServer,
        mission: JoinReply,
        options: ViewOptions,
        link: Link,
        clicks: ImageClicks,
    ) -> None:
        self._open_node, self._mission, self._truth = connect, mission, options.truth
        self._link = link
        self._folder = options.folder
        self._read_past_s = -math.inf
        scenario = flight_scenario_from_json(mission.scenario_json, "the world's scenario")
        chasers = len(scenario.chasers)
        self._state, self._history = MissionState.empty(chasers), History(chasers)
        self._seen: set[str] = set()
        self._alive: set[str] = set()
        self._paces: deque[tuple[float, float]] = deque(maxlen=50)
        self._received_s = time.monotonic()
        self._connect()
        self._commands: queue.Queue[Order | None] = queue.Queue(maxsize=8)
        self._page = Page(
            server,
            scenario,
            dark=options.dark,
            truth=options.truth,
            command=self._command,
            timeline=None,
            ports=PortDialogs(clicks, self._choose_port),
        )

    def run(self, stop: Callable[[], bool]) -> None:
        """Receive and draw at most ten times per second, for at most half of the time, until
        another mission starts.
        """
        operator = threading.Thread(target=self._operate, name="operator", daemon=True)
        operator.start()
        joined_s = connected_s = time.monotonic()
        try:
            while not stop():
                begun_s = time.monotonic()
                self._receive()
                self._add_past()
                if self._page.watched:
                    self._page.draw(
                        self._state, self._history, self._mission.mode, self._speed(), self._lost()
                    )
                silent = self._state.ended is not None or begun_s - self._received_s > _SILENCE_S
                if silent and begun_s - joined_s > _JOIN_PERIOD_S:
                    joined_s = begun_s
                    reply = _join(self._node)
                    if (
                        reply is not None
                        and reply.accepted
                        and reply.run_id != self._mission.run_id
                    ):
                        return
                    if reply is None and begun_s - connected_s > _RECONNECT_S:
                        # Between peers Zenoh does not reopen a link that it closed because it was
                        # not read.
                        connected_s = begun_s
                        self._node.close()
                        self._connect()
                took_s = time.monotonic() - begun_s
                time.sleep(max(PERIOD_S - took_s, took_s))
        finally:
            self._commands.put(None)
            operator.join(timeout=_REPLY_TIMEOUT_S + 1.0)
            self._node.close()

    def _connect(self) -> None:
        self._alive.clear()
        self._node = self._open_node()
        ignore_foreign_publishers(
            self._node,
            self._mission.source,
            lambda detail, _: print_status("viewer", f"foreign publisher: {detail}"),
        )
        self._feed = _Feed.of(self._node, len(self._state.chasers), self._truth)
        self._node.watch_liveliness(self._on_liveliness)

    def _receive(self) -> None:
        tick = self._state.tick
        for received in self._feed.new():
            self._state.update(received.topic, received.message)
            self._history.update(received.topic, received.message, received.sent_ns)
        if tick is None:
            self._history.begins_s = self._state.time_s()
        if self._state.tick is not tick:
            self._received_s = time.monotonic()
            self._paces.append((self._received_s, self._state.time_s()))

    def _add_past(self) -> None:
        """Add the events before the first tick seen, as soon as the log holds them."""
        now_s, begins_s = time.monotonic(), self._history.begins_s
        if self._folder is None or not begins_s or now_s - self._read_past_s < _PAST_PERIOD_S:
            return
        self._read_past_s, chasers = now_s, len(self._state.chasers)
        with suppress(LogError):  # not yet written
            if (lines := past_lines(self._folder, chasers, begins_s)) is not None:
                self._history.add_past(lines)

    def _speed(self) -> float | None:
        """Return simulated over wall time during the last seconds; None if unknown."""
        if len(self._paces) < 2:
            return None
        (begin, first), (end, last) = self._paces[0], self._paces[-1]
        return (last - first) / max(1e-9, end - begin)

    def _on_liveliness(self, process: str, alive: bool) -> None:
        if alive:
            self._seen.add(process)
            self._alive.add(process)
        else:
            self._alive.discard(process)

    def _lost(self) -> set[str]:
        """Return the processes that have disappeared; none after the end of the mission. All leave
        after the world.
        """
        if self._state.ended is not None:
            return set()
        lost = self._seen - self._alive - {"operator"}
        return {"world"} if "world" in lost else lost

    # -- commands ----------------------------------------------------------------------------------

    def _command(self, what: str, chaser: int) -> None:
        command = OperatorCommand(
            command=what,  # type: ignore[arg-type]
            chaser=chaser,
            operator="viewer",
        )
        self._queue(Order(what, TO_COMMAND, "controller", command, self._page.show_reply))

    def _choose_port(self, request: PortRequest, show: Callable[[str], None]) -> None:
        self._queue(Order("port", TO_CHOOSE_PORTS, "mapper", request, show))

    def _queue(self, order: Order) -> None:
        try:
            self._commands.put_nowait(order)
        except queue.Full:
            order.show(f"⚠ {order.name}: not sent, {self._commands.maxsize} commands are pending")

    def _operate(self) -> None:
        while (order := self._commands.get()) is not None:
            order.show(f"{order.name}: sent")
            order.show(outcome_of(order, self._link, self._node))


@dataclass(frozen=True)
class Order:
    """A command of the page: what it is, the rights that it needs, who receives it, the message,
    and the function that shows what became of it.
    """

    what: str
    rights: Rights
    receiver: str
    message: OperatorCommand | PortRequest
    show: Callable[[str], None]

    @property
    def name(self) -> str:
        """What it is, and of which chaser."""
        return f"{self.what} chaser {self.message.chaser}"


def outcome_of(order: Order, link: Link, node: Node) -> str:
    """Send an order and return what became of it."""
    (key,) = order.rights.queries
    try:
        check_rights(link, order.what, order.rights)
        reply = node.query(key, order.message, CommandReply, _REPLY_TIMEOUT_S)
    except ChaserdockError as error:
        return f"⚠ {order.name}: {error}"
    if reply is None:
        silence = f"no reply from the {order.receiver} within {_REPLY_TIMEOUT_S:g} s"
        return f"⚠ {order.name}: {silence}"
    return ("✓ " if reply.accepted else "⚠ ") + reply_text(reply)
