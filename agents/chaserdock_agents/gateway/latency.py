# SPDX-License-Identifier: Apache-2.0
"""What a gateway adds to the latency of a flight. No I/O; times in ns by one clock."""

from __future__ import annotations

from collections import defaultdict, deque
from typing import Literal

import numpy as np

Passage = Literal["images", "references", "commands"]
"""What passes the gateway: images and references from their arrival until they are published,
commands of wrenches from when they arrived and were due until they are sent.
"""
_MOST = 100_000
"""Delays of each kind that are remembered: of half an hour of two cameras at 30 Hz."""


class AddedLatency:
    """Delays of what passes a gateway."""

    def __init__(self) -> None:
        self._delays_ns: dict[Passage, deque[int]] = defaultdict(lambda: deque(maxlen=_MOST))

    def note(self, passage: Passage, arrived_ns: int, passed_ns: int) -> None:
        """Note that something that arrived, or was due, has passed."""
        self._delays_ns[passage].append(passed_ns - arrived_ns)

    def __str__(self) -> str:
        """Return median and 99th percentile of each kind; empty without any."""
        found = []
        for passage, delays_ns in self._delays_ns.items():
            p50, p99 = np.percentile(delays_ns, (50, 99)) / 1e6
            found.append(f"{passage} {p50:.2f} ms, p99 {p99:.2f} ms of {len(delays_ns)}")
        return "; ".join(found)
