# SPDX-License-Identifier: Apache-2.0
"""Explain why a lock-step tick does not end: who owes which message, and waits for what itself.

No I/O.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from chaserdock_protocol import topics

SILENT_S = 5.0
"""Age (s) of its last presence above which a process has stopped running, or is cut off."""
_MOST_NAMED = 12
"""Most sentences of an explanation. The causes come first, and the rest is counted."""


@dataclass(frozen=True)
class WaitReport:
    """State of a process by its last presence, received ``age_s`` ago.

    ``waiting_for``: keys of the messages that it waits for.
    """

    waiting_for: tuple[str, ...]
    age_s: float


def publisher_of(key: str, leader: str) -> str:
    """Return the process that publishes a key; ``leader``: the controller in command."""
    found = topics.topic_of_key(key)
    if found is None:
        return ""
    topic, place = found
    if topic.writer == "chaser":
        return f"chaser/{place}"
    return leader if topic.writer == "controller" else str(topic.writer)


def explain_stall(owed: Mapping[str, str], leader: str, processes: Mapping[str, WaitReport]) -> str:
    """Explain who owes which message; causes first.

    A cause is a process that was lost or waits for nothing else. ``owed``: keys of the messages
    that the world waits for, by process. ``processes``: living processes by name.
    """
    todo, seen = deque(owed.items()), set(owed.items())
    causes: list[str] = []
    waits: list[str] = []
    while todo:
        name, key = todo.popleft()
        progress = processes.get(name)
        if name == "world":
            # The world has published everything before it waits.
            causes.append(f"world published {key}, which was lost on its way")
            continue
        reason, next_keys = _state_of(progress)
        (waits if next_keys else causes).append(f"{name or 'no controller'} owes {key} ({reason})")
        for owner, wanted in ((publisher_of(k, leader), k) for k in next_keys):
            if (owner, wanted) not in seen:
                seen.add((owner, wanted))
                todo.append((owner, wanted))
    sentences = causes + waits
    more = len(sentences) - _MOST_NAMED
    return "; ".join(sentences[:_MOST_NAMED]) + (f"; and {more} more" if more > 0 else "")


def _state_of(progress: WaitReport | None) -> tuple[str, tuple[str, ...]]:
    """Return what a process does in place of publishing, and the keys that it waits for."""
    if progress is None:
        return "not running", ()
    if progress.age_s > SILENT_S:
        return f"hangs or is cut off: silent for {progress.age_s:.0f} s", ()
    own_tick = (topics.TICK.key_of(),)
    if progress.waiting_for == own_tick:
        return "waits for the next tick: the message was lost on its way, or the tick", ()
    if progress.waiting_for:
        return f"waits for {', '.join(progress.waiting_for)}", progress.waiting_for
    return "hangs: alive, and does not wait for a message", ()
