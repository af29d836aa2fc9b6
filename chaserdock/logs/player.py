# SPDX-License-Identifier: Apache-2.0
"""Publishes a log again, byte for byte, in place of the world: for recorders, viewers and other
subscribers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import (
    JoinReply,
    JoinRequest,
    Presence,
    ScenarioReply,
    ScenarioRequest,
)
from chaserdock_protocol.recording.log import (
    FLIGHT_SCENARIO,
    SCENARIO_KIND,
    LogSource,
    read_scenario,
)
from chaserdock_protocol.recording.scan import VIEWER_PREFIX, log_files, stored_messages
from chaserdock_protocol.scenario import flight_scenario_json, scenario_from_json
from chaserdock_protocol.transport import Link, Node, RawSample


class PlayError(ChaserdockError):
    """No recorder joined."""


def stored_samples(log: LogSource) -> Iterator[tuple[int, RawSample]]:
    """Yield simulated time (ns) and content of all messages, in file order, without those of
    recorder and viewers.
    """
    for path in log_files(log):
        for channel, stored in stored_messages(path):
            if not channel.topic.startswith((VIEWER_PREFIX, "recorder/")):
                encoding = channel.metadata.get("zenoh_encoding", "")
                yield (
                    stored.log_time,
                    RawSample(channel.topic, encoding, stored.data, stored.publish_time),
                )


def play(
    log: LogSource,
    link: Link,
    speed: float | None,
    timeout_s: float,
    on_sent: Callable[[RawSample], None] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> int:
    """Wait for a recorder, then publish a whole log. Returns the number of messages.

    ``speed``: simulated over wall time; None for as fast as possible. ``on_sent``: called with each
    published message. Raises LogError, TransportError, or PlayError if no recorder joins within
    ``timeout_s``.
    """
    text, run = read_scenario(log)
    scenario = scenario_from_json(text, f"{log}: scenario")
    full = ScenarioReply(run_id=run.get("run_id", ""), scenario_json=text)
    node = Node("world", "analysis", link)
    try:
        node.subscribe(topics.PRESENCE)

        def admit(request: JoinRequest, reply: Callable[[JoinReply], None]) -> None:
            if request.process == "recorder":
                mode = "realtime" if run.get("mode") == "realtime" else "lockstep"
                answer = JoinReply(
                    accepted=True,
                    reason="",
                    run_id=full.run_id,
                    mode=mode,
                    scenario_json=flight_scenario_json(scenario),
                )
            else:
                answer = JoinReply(
                    accepted=False, reason="this is the playback of a log; only a recorder can join"
                )
            reply(answer)

        if run.get(SCENARIO_KIND) != FLIGHT_SCENARIO:  # or else the recorder has it by its join
            node.declare_queryable(
                topics.SCENARIO_KEY, ScenarioRequest, lambda _, reply: reply(full)
            )
        node.declare_queryable(topics.JOIN_KEY, JoinRequest, admit)
        _wait_for_recorder(node, timeout_s, stopped)
        number, start_s, first_ns = 0, time.monotonic(), None
        for time_ns, raw in stored_samples(log):
            if stopped():
                break
            first_ns = time_ns if first_ns is None else first_ns
            if speed is not None:
                due_s = start_s + (time_ns - first_ns) / 1e9 / speed
                time.sleep(max(0.0, due_s - time.monotonic()))
            node.publish_raw(raw)
            number += 1
            if on_sent is not None:
                on_sent(raw)
        return number
    finally:
        node.close()


def _wait_for_recorder(node: Node, timeout_s: float, stopped: Callable[[], bool]) -> None:
    """Wait for the recorder's presence, which it publishes after subscribing to everything."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline and not stopped():
        received = node.receive(0.1)
        match received.message if received is not None else None:
            case Presence(process="recorder"):
                return
            case _:
                continue
    if not stopped():
        raise PlayError(
            f"no recorder joined within {timeout_s:g} s; is it on the same namespace and endpoint?"
        )
