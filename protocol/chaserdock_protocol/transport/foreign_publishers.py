# SPDX-License-Identifier: Apache-2.0
"""Detect sessions that publish on the world's keys without being the mission's world."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable

from chaserdock_protocol import topics
from chaserdock_protocol.messages import Message

from .network import RawSample

MOST_REPORTED = 16
"""Sessions that are reported at most: whoever forges an identity per message must not fill the log.
"""


class ForeignPublishers:
    """Recognize samples of other sessions than the world's, and report each such session once.

    ``world_source``: session of the world; empty accepts all. ``rejected``: counts foreign samples
    by key. Samples are checked on any thread, reports are made on the reader's.
    """

    def __init__(self, rejected: Counter[str]) -> None:
        self.world_source = ""
        self._rejected = rejected
        self._report: Callable[[str, str, Message | None], None] = lambda key, source, newest: None
        self._known: set[str] = set()
        self._unreported: deque[tuple[str, str]] = deque()

    def expect(self, source: str, report: Callable[[str, str, Message | None], None]) -> None:
        """Accept only what the session ``source`` publishes on the world's keys; see
        ``Node.expect_world``.
        """
        self.world_source, self._report = source, report

    def sent(self, raw: RawSample) -> bool:
        """Return whether a foreign session has sent a sample on a key of the world, and count
        it.
        """
        if raw.source == self.world_source or not self.world_source:
            return False
        if not raw.key.startswith(topics.WORLD_BRANCHES):
            return False
        if raw.source not in self._known and len(self._known) < MOST_REPORTED:
            self._known.add(raw.source)
            self._unreported.append((raw.key, raw.source))
        self._rejected[f"{raw.key}:foreign publisher"] += 1
        return True

    def report_next(self, newest: Message | None) -> None:
        """Report one session that is not reported yet. ``newest``: the last valid message."""
        if self._unreported:
            self._report(*self._unreported.popleft(), newest)
