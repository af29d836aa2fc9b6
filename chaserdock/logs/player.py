"""A log sent over the network again, byte for byte, in the world's place: to recorders, viewers and whoever listens."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import JoinReply, JoinRequest, Presence
from chaserdock_protocol.recording.log import LogSource, read_scenario
from chaserdock_protocol.recording.scan import VIEWER_PREFIX, log_files, stored_messages
from chaserdock_protocol.transport import Link, Node, RawSample


class PlayError(ChaserdockError):
    """The log could not be sent."""


def sent_again(log: LogSource) -> Iterator[tuple[int, RawSample]]:
    """Simulated time (ns) and content of every message but the recorder's own and the viewers', in file order."""
    for path in log_files(log):
        for channel, stored in stored_messages(path):
            if not channel.topic.startswith((VIEWER_PREFIX, "recorder/")):
                encoding = channel.metadata.get("zenoh_encoding", "")
                yield stored.log_time, RawSample(channel.topic, encoding, stored.data, stored.publish_time)


def play(
    log: LogSource,
    link: Link,
    speed: float | None,
    patience_s: float,
    sent: Callable[[RawSample], None] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> int:
    """Waits for a recorder, then sends all of a log; how many messages.

    ``speed``: simulated over wall time, None for as fast as it goes. ``sent`` is told each message that was handed to
    the network. Raises LogError, TransportError, or PlayError when no recorder comes within ``patience_s``.
    """
    text, run = read_scenario(log)
    node = Node("world", "analysis", link)
    try:
        node.subscribe(topics.PRESENCE)

        def admit(request: JoinRequest, reply: Callable[[JoinReply], None]) -> None:
            if request.process == "recorder":
                mode = "realtime" if run.get("mode") == "realtime" else "lockstep"
                answer = JoinReply(
                    accepted=True, reason="", run_id=run.get("run_id", ""), mode=mode, scenario_json=text
                )
            else:
                answer = JoinReply(accepted=False, reason="a log is played here; only a recorder can join")
            reply(answer)

        node.declare_queryable(topics.JOIN_KEY, JoinRequest, admit)
        _wait_for_recorder(node, patience_s, stopped)
        number, begun_s, first_ns = 0, time.monotonic(), None
        for time_ns, raw in sent_again(log):
            if stopped():
                break
            first_ns = time_ns if first_ns is None else first_ns
            if speed is not None:
                due_s = begun_s + (time_ns - first_ns) / 1e9 / speed
                time.sleep(max(0.0, due_s - time.monotonic()))
            node.publish_raw(raw)
            number += 1
            if sent is not None:
                sent(raw)
        return number
    finally:
        node.close()


def _wait_for_recorder(node: Node, patience_s: float, stopped: Callable[[], bool]) -> None:
    """Its presence comes after its subscription: from then on it hears everything."""
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline and not stopped():
        received = node.receive(0.1)
        match received.message if received is not None else None:
            case Presence(process="recorder"):
                return
    if not stopped():
        raise PlayError(
            f"no recorder came within {patience_s:g} s; is it on the same namespace and endpoint?"
        )
