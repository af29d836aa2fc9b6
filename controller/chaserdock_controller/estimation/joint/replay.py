# SPDX-License-Identifier: Apache-2.0
"""Buffer of the newest ticks of the filter. They are processed again when a sighting of one of them
arrives late.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from chaserdock_protocol.messages import Odometry, Sighting

from chaserdock_controller.estimation.types import EstimatorEvent, MeasuredChaser, Shock

from .hypotheses import FilterState, apply_shocks
from .parameters import TargetParameters

TickFunction = Callable[
    [FilterState | None, "FilterTick"], tuple[FilterState, tuple[EstimatorEvent, ...]]
]
"""Maps the state before a tick, and its record, to the state after it."""


@dataclass(kw_only=True)
class FilterTick:
    """What the filter needs to process a tick again, with the state and the events that result.

    ``parameters``: with the target's model, valid from the tick before to this one. ``shocks``:
    change the rates after it. ``chasers``, ``covered_s``: as in ``EstimatorInputs``, without
    outdated odometry. ``sightings``: exposed at the tick, by chaser. ``between``: exposed since the
    tick before, in order of time.
    """

    time_ns: int
    parameters: TargetParameters
    covered_s: float
    chasers: tuple[MeasuredChaser, ...]
    sightings: dict[int, Sighting] = field(default_factory=dict)
    between: list[Sighting] = field(default_factory=list)
    shocks: list[Shock] = field(default_factory=list)
    state: FilterState | None = None
    events: tuple[EstimatorEvent, ...] = ()

    @property
    def odometry(self) -> dict[int, Odometry]:
        """Return the odometry of the tick, by chaser."""
        return {c.chaser: c.odometry for c in self.chasers if c.odometry is not None}

    def insert_between(self, sighting: Sighting) -> bool:
        """Add a sighting exposed before the tick; return False for one that is known."""

        def order(s: Sighting) -> tuple[int, int]:
            return s.sim_time_ns, s.chaser

        i = bisect_left(self.between, order(sighting), key=order)
        if i < len(self.between) and order(self.between[i]) == order(sighting):
            return False
        self.between.insert(i, sighting)
        return True


@dataclass
class ReplayBuffer:
    """Records of ticks in order of time.

    ``base``: the state just before the first record. ``pending``: events of dropped records that
    were not drained. ``drained``: events of kept records that were.
    """

    records: list[FilterTick] = field(default_factory=list)
    base: FilterState | None = None
    pending: list[EstimatorEvent] = field(default_factory=list)
    drained: set[EstimatorEvent] = field(default_factory=set)

    @property
    def newest(self) -> FilterState | None:
        """Return the state after the newest record."""
        return self.records[-1].state if self.records else self.base

    def state_at(self, time_ns: int) -> FilterState | None:
        """Return the state after the last record not later than ``time_ns``."""
        i = bisect_right(self.records, time_ns, key=lambda r: r.time_ns)
        return self.records[i - 1].state if i > 0 else self.base

    def find(self, time_ns: int) -> tuple[int, FilterTick | None]:
        """Return the index at which a record of ``time_ns`` is or belongs, and the record, None if
        there is none.
        """
        i = bisect_left(self.records, time_ns, key=lambda r: r.time_ns)
        found = i < len(self.records) and self.records[i].time_ns == time_ns
        return i, self.records[i] if found else None

    def replay(self, first: int, process: TickFunction) -> None:
        """Process the records from index ``first`` on."""
        state = self.records[first - 1].state if first > 0 else self.base
        for record in self.records[first:]:
            state, record.events = process(state, record)
            record.state = state = apply_shocks(state, record.shocks)

    def disturb(self, shock: Shock) -> None:
        """Apply a sudden change of the target's rates after the newest record."""
        if self.records:
            newest = self.records[-1]
            newest.shocks.append(shock)
            if newest.state is not None:
                newest.state = apply_shocks(newest.state, [shock])

    def trim(self, duration_s: float) -> None:
        """Drop the records that are more than ``duration_s`` older than the newest; their events
        stay pending.
        """
        horizon = self.records[-1].time_ns - round(duration_s * 1e9)
        while self.records[0].time_ns < horizon:
            old = self.records.pop(0)
            self.base = old.state
            self.pending += [e for e in old.events if e not in self.drained]
            self.drained.difference_update(old.events)

    def drain_events(self) -> list[EstimatorEvent]:
        """Return the events since the last call, in order of time."""
        fresh = [e for r in self.records for e in r.events if e not in self.drained]
        self.drained.update(fresh)
        events = sorted([*self.pending, *fresh], key=lambda e: e.time_ns)
        self.pending = []
        return events

    def with_newest_only(self) -> ReplayBuffer:
        """Return a buffer with the newest record only."""
        if len(self.records) < 2:
            return self
        newest, drained = (
            self.records[-1],
            {e for e in self.drained if e in self.records[-1].events},
        )
        return replace(self, records=[newest], base=self.records[-2].state, drained=drained)
