"""The queue between threads: in order, and bounded."""

from __future__ import annotations

import queue

import pytest
from chaserdock_protocol.transport.bounded_queue import Inbox


def test_in_order_until_full_and_room_again() -> None:
    inbox: Inbox[str] = Inbox(most_bytes=10)
    assert [inbox.put(text, len(text)) for text in ("1234", "56789", "ab", "c")] == [True, True, False, True]
    assert inbox.dropped == 1
    assert [inbox.get(0), inbox.get(0)] == ["1234", "56789"]
    assert inbox.put("0123456789", 9)
    assert [inbox.get(0), inbox.get(0.01)] == ["c", "0123456789"]
    assert inbox.empty()
    for timeout_s in (0, 0.01):
        with pytest.raises(queue.Empty):
            inbox.get(timeout_s)


def test_bounded_in_number_too() -> None:
    inbox: Inbox[int] = Inbox(most_items=3)
    assert [inbox.put(k, 0) for k in range(5)] == [True, True, True, False, False]
    assert inbox.dropped == 2
