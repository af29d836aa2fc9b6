# SPDX-License-Identifier: Apache-2.0
"""The queue between threads keeps order and is bounded."""

from __future__ import annotations

import queue

import pytest
from chaserdock_protocol.transport.bounded_queue import BoundedQueue


def test_queue_keeps_order_and_drops_when_full() -> None:
    inbox: BoundedQueue[str] = BoundedQueue(max_bytes=10)
    assert [inbox.put(text, len(text)) for text in ("1234", "56789", "ab", "c")] == [
        True,
        True,
        False,
        True,
    ]
    assert inbox.dropped == 1
    assert [inbox.get(0), inbox.get(0)] == ["1234", "56789"]
    assert inbox.put("0123456789", 9)
    assert [inbox.get(0), inbox.get(0.01)] == ["c", "0123456789"]
    assert inbox.empty()
    for timeout_s in (0, 0.01):
        with pytest.raises(queue.Empty):
            inbox.get(timeout_s)


def test_number_of_items_is_bounded() -> None:
    inbox: BoundedQueue[int] = BoundedQueue(max_items=3)
    assert [inbox.put(k, 0) for k in range(5)] == [True, True, True, False, False]
    assert inbox.dropped == 2
