# SPDX-License-Identifier: Apache-2.0
"""Links between the processes of a simulated mission: when, and how often, a message arrives.

They behave as Zenoh over TCP. Messages of one priority arrive in order, after the declarations sent
before them. A link that is cut or congested holds back what must not be lost and drops the rest.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from chaserdock_protocol.scenario.simulation import SimulationSection

from .scheduler import NEVER, Due, Scheduler, VirtualQueue

LINK_BYTES = 1 << 20
"""Bytes on a link above which it drops droppable messages, as Zenoh does with the options of
``transport.config``.
"""
_RETRY_S = 0.2
"""Time (s) after which a lost message that must not be lost is sent again, as TCP does in Linux
(TCP_RTO_MIN).
"""
_LATE_DELAYS = 4.0
"""Additional delay of a message that later ones overtake, in mean delays of a message. Larger: more
messages overtake it; smaller: fewer reorderings.
"""


@dataclass
class Traffic:
    """What the network has carried and lost. ``recorded``: messages that arrived at the recorder,
    by key. ``queues``: of the readers; their names begin with the process.
    """

    sent: int = 0
    lost: int = 0
    most_bytes: int = 0
    recorded: Counter[str] = field(default_factory=Counter)
    queues: dict[str, VirtualQueue] = field(default_factory=dict)


@dataclass
class MessageLink:
    """One direction between two processes: bytes in flight, and the last arrival time of each
    priority.
    """

    sender: str
    receiver: str
    bytes: int = 0
    last: dict[str, Due] = field(default_factory=dict)


class Links:
    """All links of a mission under its conditions. ``first_tick_s``: virtual time (s) from which
    the conditions apply, None before.

    ``lockstep``: as TCP guarantees, nothing is lost, duplicated or reordered on a link; conditions
    only delay.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        conditions: SimulationSection,
        seed: int,
        lockstep: bool,
        traffic: Traffic,
    ) -> None:
        self.conditions, self.lockstep, self.traffic = conditions, lockstep, traffic
        self.first_tick_s: float | None = None
        self._scheduler = scheduler
        self._latency_s, self._jitter_s = conditions.latency_s, conditions.jitter_s
        self._is_steady = not (conditions.jitter_s or conditions.partition)
        """Whether all messages that are not late take the same time."""
        self._random = random.Random(f"network {seed}")
        self._links: dict[tuple[str, str], MessageLink] = {}

    @property
    def mission_s(self) -> float:
        """Return the time since the first tick (s), to which conditions refer; negative before."""
        return -1.0 if self.first_tick_s is None else self._scheduler.now_s - self.first_tick_s

    def between(self, sender: str, receiver: str) -> MessageLink:
        """Return the link from one process to another."""
        link = self._links.get((sender, receiver))
        if link is None:
            link = self._links[sender, receiver] = MessageLink(sender, receiver)
        return link

    def send(
        self,
        link: MessageLink,
        size: int,
        qos: str,
        blocking: bool,
        arrive: Callable[..., None],
        args: tuple[Any, ...],
    ) -> None:
        """Send a message of ``size`` bytes over a link. ``blocking``: it must not be lost.

        ``arrive(*args)`` is called for each copy that arrives; it removes the copy and its bytes
        from the link.
        """
        copies, late_s, due_s = 1, 0.0, self._scheduler.now_s + self._latency_s
        if not self.lockstep:
            copies, late_s = self._draw_faults(link, size, not blocking)
        for _ in range(copies):
            link.bytes += size
            if link.bytes > self.traffic.most_bytes:
                self.traffic.most_bytes = link.bytes
            if late_s or not self._is_steady:
                due_s = self._due_s(link, late_s)
            self._call_in_order(link, due_s, arrive, qos, late_s, args)

    def deliver(
        self, sender: str, receiver: str, call: Callable[[], None], qos: str = "control"
    ) -> None:
        """Call ``call()`` when a message sent now arrives: after all earlier ones of its priority,
        and after all declarations.
        """
        link = self.between(sender, receiver)
        self._call_in_order(link, self._due_s(link, 0.0), call, qos, 0.0, ())

    def _draw_faults(self, link: MessageLink, size: int, droppable: bool) -> tuple[int, float]:
        """Return how many copies of a message arrive in real time, and their additional delay (s).
        If it is negative, later messages overtake this one.
        """
        c, late_s = self.conditions, 0.0
        if droppable and (link.bytes + size > LINK_BYTES or self._cut_until_s(link) > 0.0):
            self.traffic.lost += 1
            return 0, 0.0
        if self.first_tick_s is None:
            return 1, 0.0
        if c.loss and self._random.random() < c.loss:
            self.traffic.lost += droppable
            return (0, 0.0) if droppable else (1, _RETRY_S)
        if c.reorder and droppable and self._random.random() < c.reorder:
            late_s = -1.0
        copies = 2 if c.duplicate and droppable and self._random.random() < c.duplicate else 1
        return copies, late_s

    def _due_s(self, link: MessageLink, late_s: float) -> float:
        """Return when a message sent now arrives, regardless of those before it."""
        delay_s = self._latency_s
        if late_s > 0.0:
            delay_s += late_s
        if self._jitter_s:
            delay_s += self._random.expovariate(1.0 / self._jitter_s)
        if late_s < 0.0:
            delay_s += _LATE_DELAYS * (self._latency_s + self._jitter_s)
        due_s = self._scheduler.now_s + delay_s
        return max(due_s, self._cut_until_s(link)) if self.conditions.partition else due_s

    def _call_in_order(
        self,
        link: MessageLink,
        due_s: float,
        call: Callable[..., None],
        qos: str,
        late_s: float,
        args: tuple[Any, ...],
    ) -> None:
        if late_s < 0.0:
            self._scheduler.call_at(due_s, call, args=args)
            return
        last = link.last
        after, declared = last.get(qos, NEVER), last.get("control", NEVER)
        last[qos] = self._scheduler.call_at(
            due_s, call, after if after > declared else declared, args
        )

    def _cut_until_s(self, link: MessageLink) -> float:
        """Return when the partition across a link ends (virtual time, s); 0 without one."""
        now_s, end_s = self.mission_s, 0.0
        if now_s < 0.0:
            return 0.0
        for p in self.conditions.partition:
            is_now = p.at_s <= now_s < p.at_s + p.duration_s
            if is_now and p.separates(link.sender, link.receiver):
                end_s = max(end_s, p.at_s + p.duration_s)
        return end_s and end_s + (self.first_tick_s or 0.0)
