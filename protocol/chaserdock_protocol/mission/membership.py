# SPDX-License-Identifier: Apache-2.0
"""Admit processes to a mission, and track which are alive and have discovered each other."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from chaserdock_protocol import topics
from chaserdock_protocol.messages import JoinReply, JoinRequest, Presence
from chaserdock_protocol.transport.session import required_peers

from .stall import WaitReport

JOIN_TIMEOUT_S = 5.0
"""Time, s, for which the first process that joins by a free name has it to itself: several times
what a process takes to its liveliness token, of which a second one then learns.
"""
_MOST_JOINING = 50_000
"""Most instances that are remembered as admitted: what a flood of joins brings in the seconds in
which a process starts, in 10 MB.
"""
_LONGEST_INSTANCE = 100
"""Characters of an instance; ours have 32."""


@dataclass
class Membership:
    """Track the processes of a mission as the world knows them.

    A join alone proves nothing, as anybody on a network without keys may ask for any name. So it
    turns no other process away: the first that joins by a free name keeps it for `JOIN_TIMEOUT_S`,
    in which others get no reply and ask again; after that all who ask are admitted until one of
    them is alive. The instance of a name is the first admitted one that publishes its presence.

    Thread-safe: called from Zenoh's threads and the main loop. ``instance`` and ``source``: the
    world's own instance and session. ``flying``: set at the first tick; from then on connected
    processes no longer wait for processes that are only joining (see ``connected``).
    ``resumed``: the mission goes on with a new world. ``scenario_json``: the flight scenario.
    ``faults_of``: JSON of the faults to inject at a process, by its name.
    """

    chasers: int
    run_id: str
    mode: str
    scenario_json: str
    faults_of: Callable[[str], str] = lambda process: "{}"
    instance: str = ""
    source: str = ""
    now_s: Callable[[], float] = time.monotonic
    flying: bool = False
    resumed: bool = False
    _alive: set[str] = field(default_factory=set)
    _admitted: dict[tuple[str, str], None] = field(default_factory=dict)
    _asked_s: dict[str, float] = field(default_factory=dict)
    _instances: dict[str, str] = field(default_factory=dict)
    _heard: dict[str, dict[str, str]] = field(default_factory=dict)
    _reports: dict[str, tuple[tuple[str, ...], float]] = field(default_factory=dict)
    _departed: list[str] = field(default_factory=list)
    _connected: set[str] = field(default_factory=set)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def realtime(self) -> bool:
        """Whether the wall clock ends a tick."""
        return self.mode == "realtime"

    def admit(self, request: JoinRequest) -> JoinReply | None:
        """Admit a process and return the mission, or refuse it with a reason. None: it is to ask
        again, because another process is joining by its name.
        """
        reason = self._refusal(request)
        if reason:
            return JoinReply(accepted=False, reason=reason, source=self.source)
        name, instance = request.process, request.instance
        with self._lock:
            if instance != self._instances.get(name) and (name, instance) not in self._admitted:
                # In a mission that goes on, a process may live before it is known.
                known = not self.resumed or name in self._instances
                if name in self._alive and known:
                    text = f"{name} is already running in this mission"
                    return JoinReply(accepted=False, reason=text, source=self.source)
                if self.now_s() - self._asked_s.get(name, -math.inf) < JOIN_TIMEOUT_S:
                    return None
                self._asked_s.setdefault(name, self.now_s())
                self._instances.pop(name, None)  # it was lost, and is replaced
                self._admitted[name, instance] = None
                if len(self._admitted) > _MOST_JOINING:
                    del self._admitted[next(iter(self._admitted))]
        return JoinReply(
            accepted=True,
            reason="",
            run_id=self.run_id,
            mode="realtime" if self.realtime else "lockstep",
            scenario_json=self.scenario_json,
            faults=self.faults_of(request.process),
            source=self.source,
        )

    def _refusal(self, request: JoinRequest) -> str:
        name = request.process
        if not topics.is_member_name(name):
            return f"{name!r} is no process of a mission"
        if name == "world":
            return "this mission has a world already; choose another --namespace for a second one"
        if name.startswith("chaser/") and int(name.partition("/")[2]) >= self.chasers:
            return f"there is no {name} in this mission; its chasers are 0 to {self.chasers - 1}"
        if len(request.instance) > _LONGEST_INSTANCE:
            return f"an instance has at most {_LONGEST_INSTANCE} characters"
        return ""

    def set_alive(self, name: str, alive: bool) -> None:
        """Record that a liveliness token appeared or disappeared."""
        with self._lock:
            if alive:
                self._alive.add(name)
            elif name in self._alive:
                self._alive.discard(name)
                self._heard.pop(name, None)
                self._reports.pop(name, None)
                self._connected.discard(name)
                self._forget_joining(name)
                self._departed.append(name)

    def update_presence(self, message: Presence) -> bool:
        """Record which processes a process has heard; return False if that instance is not
        admitted, or another one was first.
        """
        with self._lock:
            name, instance = message.process, message.instance
            if self._instances.get(name) != instance:
                if name in self._instances or (name, instance) not in self._admitted:
                    return False
                self._instances[name] = instance
            self._heard[message.process] = dict(message.heard)
            self._reports[message.process] = (message.waiting_for, self.now_s())
            return True

    def _forget_joining(self, name: str) -> None:
        """Forget who has joined by a name, so that the next one has it to itself."""
        self._asked_s.pop(name, None)
        self._admitted = {key: None for key in self._admitted if key[0] != name}

    def progress(self) -> dict[str, WaitReport]:
        """Return what each living process waits for by its last presence, and the age of that
        presence.
        """
        with self._lock:
            now_s = self.now_s()
            return {
                name: WaitReport(keys, now_s - at_s) for name, (keys, at_s) in self._reports.items()
            }

    def take_departed(self) -> list[str]:
        """Return the processes lost since the last call."""
        with self._lock:
            departed, self._departed = self._departed, []
            return departed

    def connected(self, heard_by_world: dict[str, str]) -> set[str]:
        """Return the processes that are alive and have discovered, and been discovered by, all
        their partners.

        ``heard_by_world``: processes that the world has heard, with their instances. Only current
        instances count: a process that restarts has to be heard again. Before the flight a pair
        that is not connected holds back both processes. In flight a pair of a flying and a joining
        process holds back the joining one only, so that no process drops out of the flight because
        another one joins.
        """
        with self._lock:
            current = {**self._instances, "world": self.instance}
            heard = {
                name: {
                    other for other, instance in others.items() if current.get(other) == instance
                }
                for name, others in {**self._heard, "world": heard_by_world}.items()
                if name in self._alive or name == "world"
            }
            present = {
                "world",
                *(n for n in heard if n.startswith("chaser/") or n in topics.CONTROLLERS),
            }
            settled = {*self._connected, "world"}

            def pair_is_connected(name: str, partner: str) -> bool:
                if partner not in heard or (name in self._connected and partner not in settled):
                    return True
                return name in heard[partner] and partner in heard[name]

            connected = {
                name
                for name in heard
                if name != "world"
                and all(pair_is_connected(name, p) for p in required_peers(name, present))
            }
            if self.flying:
                self._connected = set(connected)
            return connected

    def instance_of(self, name: str) -> str:
        """Return the instance of a process, empty before its first presence."""
        with self._lock:
            return self._instances.get(name, "")
