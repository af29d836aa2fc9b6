"""Who takes part: the world admits processes, sees them come and go, and knows who is joined up with whom."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from chaserdock_protocol import topics
from chaserdock_protocol.messages import JoinReply, JoinRequest, Presence
from chaserdock_protocol.transport import session as presence

JOINING_S = 5.0
"""Between being admitted and being seen alive a process has that long before another may take its place."""


@dataclass
class Membership:
    """The world's view of the processes of its mission; called from Zenoh's threads and from the loop."""

    chasers: int
    run_id: str
    mode: str
    scenario_json: str
    _alive: set[str] = field(default_factory=set)
    _admitted: dict[str, str] = field(default_factory=dict)
    instance: str = ""
    now_s: Callable[[], float] = time.monotonic
    _admitted_s: dict[str, float] = field(default_factory=dict)
    _heard: dict[str, dict[str, str]] = field(default_factory=dict)
    _instances: dict[str, str] = field(default_factory=dict)
    _left: list[str] = field(default_factory=list)
    flying: bool = False
    """From the first tick on; those who are joined up then no longer wait for somebody who is only just joining."""
    _joined_up: set[str] = field(default_factory=set)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def realtime(self) -> bool:
        """Whether the wall clock ends a tick."""
        return self.mode == "realtime"

    def admit(self, request: JoinRequest) -> JoinReply:
        """Answers a process that wants to join: refused with the reason, or told the mission."""
        reason = self._objection(request)
        if reason:
            return JoinReply(accepted=False, reason=reason)
        with self._lock:
            self._admitted[request.process] = request.instance
            self._admitted_s[request.process] = self.now_s()
        return JoinReply(
            accepted=True,
            reason="",
            run_id=self.run_id,
            mode="realtime" if self.realtime else "lockstep",
            scenario_json=self.scenario_json,
        )

    def _objection(self, request: JoinRequest) -> str:
        name = request.process
        if not topics.is_member_name(name):
            return f"{name!r} is no process of a mission"
        if name == "world":
            return "this mission has its world already; choose another --namespace for a second one"
        if name.startswith("chaser/") and int(name.partition("/")[2]) >= self.chasers:
            return f"there is no {name} in this mission; its chasers are 0 to {self.chasers - 1}"
        with self._lock:
            if self._admitted.get(name, request.instance) != request.instance:
                if name in self._alive:
                    return f"{name} is already running in this mission"
                if self.now_s() - self._admitted_s.get(name, -math.inf) < JOINING_S:
                    return f"another {name} is just joining this mission"
        return ""

    def alive_changed(self, name: str, alive: bool) -> None:
        """A liveliness token came or went."""
        with self._lock:
            if alive:
                self._alive.add(name)
            elif name in self._alive:
                self._alive.discard(name)
                self._heard.pop(name, None)
                self._joined_up.discard(name)
                self._admitted_s.pop(name, None)
                self._left.append(name)

    def presence_told(self, message: Presence) -> bool:
        """Notes whom a process has heard; False when it was never admitted under that instance."""
        with self._lock:
            if self._admitted.get(message.process) != message.instance:
                return False
            self._heard[message.process] = dict(message.heard)
            return True

    def who_left(self) -> list[str]:
        """Processes lost since the last call."""
        with self._lock:
            left, self._left = self._left, []
            return left

    def linked(self, world_heard: dict[str, str]) -> set[str]:
        """Processes that are alive and joined up with all they deal with; ``world_heard``: whom the world has heard.

        Only the instances that are here now count: whoever has heard an earlier start of a process has not heard it.
        Before the flight all pairs count for both. In flight a pair with a newcomer counts for the newcomer alone, so
        that nobody who flies is put out by one who joins.
        """
        with self._lock:
            here = {**self._admitted, "world": self.instance}
            known = {**self._heard, "world": world_heard}
            heard = {
                name: {o for o, instance in others.items() if here.get(o) == instance}
                for name, others in known.items()
                if name in self._alive or name == "world"
            }
            present = {"world", *(n for n in heard if n.startswith("chaser/") or n in topics.CONTROLLERS)}
            linked = {
                name
                for name in heard
                if name != "world"
                and all(
                    name in heard[o] and o in heard[name]
                    for o in presence.partners_of(name, present)
                    if o in heard and (name not in self._joined_up or o in {*self._joined_up, "world"})
                )
            }
            if self.flying:
                self._joined_up = set(linked)
            return linked

    def instance_of(self, name: str) -> str:
        """The start of a process that was admitted last; empty when none was."""
        with self._lock:
            return self._admitted.get(name, "")

    def alive(self) -> set[str]:
        """Processes whose liveliness token is there."""
        with self._lock:
            return set(self._alive)
