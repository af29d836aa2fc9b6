# SPDX-License-Identifier: Apache-2.0
"""Know which session publishes as which process of a mission.

A process states its instance in its presence; the world lists the instances that it has admitted.
The session that stated a listed instance first is the process'. What another session publishes on
the process' keys is ignored, so that one without keys cannot shut it out.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

from chaserdock_protocol import topics

_MOST_STATED = 64
"""Instances of a process whose sessions are kept, the newest: bounds the memory under forged ones.
A process that is forgotten states its instance again within a second.
"""


class ProcessSessions:
    """Sessions of the processes, as a node has heard of them. Used on the reader's thread."""

    def __init__(self) -> None:
        self._stated: dict[str, dict[str, str]] = {}
        self._listed: dict[str, str] = {}

    def note(self, process: str, instance: str, source: str) -> None:
        """Note that a session stated to be an instance of a process."""
        if not topics.is_member_name(process):
            return
        stated = self._stated.setdefault(process, {})
        if instance in stated:
            return
        while len(stated) >= _MOST_STATED:
            stated.pop(next(i for i in stated if i != self._listed.get(process)))
        stated[instance] = source

    def list_instances(self, instances: Mapping[str, str]) -> None:
        """Note which instances the world lists, by process."""
        self._listed.update(instances)

    def is_foreign(self, key: str, source: str) -> bool:
        """Return whether a session is not one that publishes on a key; False while that is
        unknown.
        """
        known = [
            self._stated.get(name, {}).get(self._listed[name])
            for name in _owners_of(key)
            if name in self._listed
        ]
        return bool(source) and len(known) > 0 and None not in known and source not in known


@lru_cache(maxsize=4096)
def _owners_of(key: str) -> tuple[str, ...]:
    """Return the processes that publish on a key; none for presence, by which they are known."""
    parts = key.split("/")
    if key.endswith("/presence") or not topics.topic_of_key(key):
        return ()
    if parts[0] == "chaser":
        return ("/".join(parts[:2]),)
    return topics.CONTROLLERS if parts[0] in topics.CONTROLLERS else ()
