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
_MOST_KEYS = 4096
"""Keys whose publishers are kept: bounds the memory under forged ones; a mission of 64 chasers has
about a thousand.
"""


class ProcessSessions:
    """Sessions of the processes, as a node has heard of them. Used on the reader's thread."""

    def __init__(self) -> None:
        self._stated: dict[str, dict[str, str]] = {}
        self._listed: dict[str, str] = {}
        self._publishers_of = lru_cache(maxsize=_MOST_KEYS)(self._find_publishers)

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
        self._publishers_of.cache_clear()

    def list_instances(self, instances: Mapping[str, str]) -> None:
        """Note which instances the world lists, by process."""
        if not instances.items() <= self._listed.items():
            self._listed.update(instances)
            self._publishers_of.cache_clear()

    def is_foreign(self, key: str, source: str) -> bool:
        """Return whether a session is not one that publishes on a key; False while that is
        unknown.
        """
        known = self._publishers_of(key)
        return bool(source and known) and source not in known

    def _find_publishers(self, key: str) -> frozenset[str | None]:
        """Return the sessions that publish on a key; none while one of them is unknown."""
        known = [
            self._stated.get(name, {}).get(self._listed[name])
            for name in _owners_of(key)
            if name in self._listed
        ]
        return frozenset() if None in known else frozenset(known)


@lru_cache(maxsize=_MOST_KEYS)
def _owners_of(key: str) -> tuple[str, ...]:
    """Return the processes that publish on a key; none for presence, by which they are known."""
    parts = key.split("/")
    if key.endswith("/presence") or not topics.topic_of_key(key):
        return ()
    if parts[0] == "chaser":
        return ("/".join(parts[:2]),)
    return topics.CONTROLLERS if parts[0] in topics.CONTROLLERS else ()
