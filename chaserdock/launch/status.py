# SPDX-License-Identifier: Apache-2.0
"""Observes a running mission: processes, tick, speed, phases."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import (
    Event,
    LandmarkMap,
    MissionEnd,
    Presence,
    Reference,
    TargetEstimate,
    Tick,
)
from chaserdock_protocol.process import print_status
from chaserdock_protocol.transport import Link, Node
from chaserdock_protocol.transport.session import find_world, ignore_foreign_publishers
from rich.table import Table

from .reach import STATUS_TOPICS, TO_OBSERVE, check_rights, is_reachable, why_silent

DISCOVERY_S = 20.0
"""Wall time, s, in which the processes of a mission at a reachable address are found. Longer: a
wrong namespace is noticed later; shorter: missions on loaded machines are denied.
"""


class StatusError(ChaserdockError):
    """No process is on the network."""


@dataclass
class MissionStatus:
    """What was received while observing; processes by name."""

    alive: set[str] = field(default_factory=set[str])
    presence: dict[str, Presence] = field(default_factory=dict[str, Presence])
    ticks: list[Tick] = field(default_factory=list[Tick])
    received_s: list[float] = field(default_factory=list[float])
    phases: dict[int, Reference] = field(default_factory=dict[int, Reference])
    target: TargetEstimate | None = None
    map: LandmarkMap | None = None
    ended: MissionEnd | None = None
    events: list[Event] = field(default_factory=list[Event])

    def update(self, message: object, now_s: float) -> None:
        """Apply a message received at ``now_s`` (monotonic)."""
        match message:
            case Presence():
                self.presence[message.process] = message
            case Tick():
                self.ticks.append(message)
                self.received_s.append(now_s)
            case Reference():
                self.phases[message.chaser] = message
            case TargetEstimate():
                self.target = message
            case LandmarkMap():
                self.map = message
            case MissionEnd():
                self.ended = message
            case Event():
                self.events.append(message)
            case _:
                pass

    @property
    def speed(self) -> float | None:
        """Return simulated over wall time between the first and the last tick; None with fewer than
        two ticks.
        """
        if len(self.ticks) < 2 or self.received_s[-1] <= self.received_s[0]:
            return None
        simulated_s = (self.ticks[-1].sim_time_ns - self.ticks[0].sim_time_ns) / 1e9
        return simulated_s / (self.received_s[-1] - self.received_s[0])

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON. ``expected`` of a process: the open tick waits for it."""
        tick = self.ticks[-1] if self.ticks else None
        return {
            "tick": tick.tick if tick else None,
            "sim_time_s": tick.sim_time_ns / 1e9 if tick else None,
            "speed": self.speed,
            "ended": self.ended.reason if self.ended else None,
            "target": self.target.status if self.target else None,
            "map": self.map.status if self.map else None,
            "map_closed": self.map.closed if self.map else None,
            "processes": {
                name: {
                    "instance": self.presence[name].instance if name in self.presence else None,
                    "heard": sorted(self.presence[name].heard) if name in self.presence else None,
                    "expected": expected(name, tick),
                }
                for name in sorted(self.alive)
            },
            "phases": {str(i): r.phase for i, r in sorted(self.phases.items())},
        }


def expected(name: str, tick: Tick | None) -> bool | None:
    """Return whether a tick waits for this process; None without a tick, and for a process for
    which none ever does.
    """
    if tick is None:
        return None
    if name in topics.CONTROLLERS:
        return name in tick.controllers
    head, _, number = name.partition("/")
    return int(number) in tick.chasers if head == "chaser" else None


def observe(link: Link, seconds: float) -> MissionStatus:
    """Listen for ``seconds`` of wall time without joining the mission, from the first process on.
    Raises StatusError when there is no process, RightsError.

    Until the first process, listen for up to ``DISCOVERY_S`` if an endpoint accepts connections: on
    a loaded machine discovery takes longer than any status.
    """
    check_rights(link, "status", TO_OBSERVE)
    status, found = MissionStatus(), False
    patience_s = max(seconds, DISCOVERY_S)
    connect_s = patience_s if is_reachable(link) else seconds
    node = Node("operator", "operator", replace(link, connect_timeout_s=connect_s))
    try:

        def changed(process: str, alive: bool) -> None:
            (status.alive.add if alive else status.alive.discard)(process)

        for topic in STATUS_TOPICS:
            node.subscribe(topic)
        node.watch_liveliness(changed)
        if world := find_world(node):
            ignore_foreign_publishers(
                node,
                world,
                lambda detail, _: print_status("status", f"foreign publisher: {detail}"),
            )
        begun_s, deadline = time.monotonic(), time.monotonic() + seconds
        while time.monotonic() < deadline:
            received = node.receive(0.05)
            if received is not None:
                status.update(received.message, time.monotonic())
            if status.alive and not found:
                found, deadline = True, time.monotonic() + seconds
            if not found and time.monotonic() >= deadline and is_reachable(link):
                deadline = min(time.monotonic() + seconds, begun_s + patience_s)
    finally:
        node.close()
    if not found:
        waited_s = round(time.monotonic() - begun_s, 1)
        raise StatusError(f"no process found within {waited_s:g} s; {why_silent(link)}")
    return status


def table_of(status: MissionStatus) -> Table:
    """Return the status as a table of text."""
    tick = status.ticks[-1] if status.ticks else None
    speed = f", {status.speed:.2f} x real time" if status.speed is not None else ""
    head = f"{tick.sim_time_ns / 1e9:.2f} s, tick {tick.tick}{speed}" if tick else "no tick"
    if status.target is not None:
        head += f"; target: {status.target.status}"
    if status.map is not None:
        head += f"; map: {status.map.status}"
        if status.map.motion is not None:
            head += ", loop closed" if status.map.closed else ", loop open"
    if status.ended is not None:
        head += f"; ended: {status.ended.reason}"
    table = Table(title=head)
    for column in ("process", "instance", "in the tick", "phase", "connected to"):
        table.add_column(column)
    for name in sorted(status.alive):
        presence, in_tick = status.presence.get(name), expected(name, tick)
        phase = (
            status.phases.get(int(name.partition("/")[2])) if name.startswith("chaser/") else None
        )
        table.add_row(
            name,
            presence.instance if presence else "-",
            {True: "yes", False: "no", None: "-"}[in_tick],
            f"{phase.phase} for {phase.phase_time_s:.1f} s" if phase else "-",
            ", ".join(sorted(presence.heard)) if presence else "-",
        )
    return table
