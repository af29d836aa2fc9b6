# SPDX-License-Identifier: Apache-2.0
"""Detect messages that a log lacks, by the gaps in their sequence numbers."""

from __future__ import annotations

from collections import Counter


class SequenceGaps:
    """Counts missing messages by key. ``lost``: number of missing messages of each key."""

    def __init__(self) -> None:
        self.lost: Counter[str] = Counter()
        self._last: dict[str, int] = {}

    def update(self, key: str, seq: int) -> None:
        """Take the sequence number of a message into account, in order of arrival.

        A restarted publisher counts from zero. Presence is published before the recorder has
        subscribed: what precedes its first message is not lost.
        """
        first = seq - 1 if key.endswith("/presence") else -1
        self.lost[key] += max(0, seq - self._last.get(key, first) - 1)
        self._last[key] = seq
