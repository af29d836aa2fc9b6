# SPDX-License-Identifier: Apache-2.0
"""What a log lacks at its beginning."""

from __future__ import annotations

from chaserdock_protocol import topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.messages import Tick

from .scan import VIEWER_PREFIX, LogSource, log_files, stored_messages
from .schema_migrations import decode_logged


def late_begin_s(source: LogSource) -> float | None:
    """Return the simulated time, s, at which a log begins that lacks earlier messages; None for one
    that begins with its mission. Raises LogError.

    A channel whose first message is not number 0, or a first tick that is not the mission's, tells.
    Reads no further than the first tick.
    """
    first_s: float | None = None
    seen: set[str] = set()
    for channel, stored in stored_messages(log_files(source)[0]):
        key = channel.topic
        if key.startswith(VIEWER_PREFIX):
            continue
        first_s = stored.log_time / 1e9 if first_s is None else first_s
        if key not in seen and stored.sequence > 0:
            return first_s
        seen.add(key)
        if key == topics.TICK.key_of():
            encoding = channel.metadata.get("zenoh_encoding", "")
            try:
                tick = decode_logged(Tick, stored.data, encoding)
            except Rejected:
                continue
            return first_s if tick.seq > 0 else None
    return None


def late_begin_line(begin_s: float) -> str:
    """Return the line that says that a log lacks its beginning."""
    return f"begins at {round(begin_s, 2)} s; earlier messages are missing"
