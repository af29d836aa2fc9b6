# SPDX-License-Identifier: Apache-2.0
"""Base of filters that process their newest records again, so that a late measurement counts at its
exposure.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

from chaserdock_models.arrays import Matrix3, Vector3

from .parameters import Matrix9, MekfParameters
from .target_hypotheses import StateT, apply_shocks
from .types import EstimatorEvent, Shock, TargetState


@dataclass(kw_only=True)
class ReplayRecord(Generic[StateT]):
    """What a filter needs to process one time again, and the state and the events that result.

    ``parameters``, with the target's model, apply from the record before to this one; ``shocks``
    change the rates after it.
    """

    time_ns: int
    parameters: MekfParameters
    shocks: list[Shock] = field(default_factory=list)
    state: StateT | None = None
    events: tuple[EstimatorEvent, ...] = ()


RecordT = TypeVar("RecordT", bound=ReplayRecord[Any])


@dataclass
class ReplayBuffer(Generic[RecordT, StateT]):
    """Records in order of time.

    base: the state just before the records. pending: events of no record, not yet drained. drained:
    events of records that are.
    """

    records: list[RecordT] = field(default_factory=list)
    base: StateT | None = None
    pending: list[EstimatorEvent] = field(default_factory=list)
    drained: set[EstimatorEvent] = field(default_factory=set)

    @property
    def newest(self) -> StateT | None:
        """Return the state after the newest record."""
        return self.records[-1].state if self.records else self.base

    def state_at(self, time_ns: int) -> StateT | None:
        """Return the state after the records up to ``time_ns``."""
        i = bisect_right(self.records, time_ns, key=lambda r: r.time_ns)
        return self.records[i - 1].state if i > 0 else self.base

    def find(self, time_ns: int) -> tuple[int, RecordT | None]:
        """Return the record of ``time_ns``, or None, and the index at which it is or belongs."""
        i = bisect_left(self.records, time_ns, key=lambda r: r.time_ns)
        found = i < len(self.records) and self.records[i].time_ns == time_ns
        return i, self.records[i] if found else None

    def replay(
        self,
        first: int,
        process: Callable[[StateT | None, RecordT], tuple[StateT, tuple[EstimatorEvent, ...]]],
    ) -> None:
        """Process the records from index ``first`` on; ``process`` maps the state before and the
        record to the state after.
        """
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
        """Drop the records that are older than the newest by more than ``duration_s``; keep their
        events.
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

    def with_newest_only(self) -> ReplayBuffer[RecordT, StateT]:
        """Return the buffer with its newest record alone."""
        if len(self.records) < 2:
            return self
        newest, drained = (
            self.records[-1],
            {e for e in self.drained if e in self.records[-1].events},
        )
        return replace(self, records=[newest], base=self.records[-2].state, drained=drained)


class ReplayingFilter(Generic[RecordT, StateT]):
    """What both Kalman filters share: the model of the target, the buffer of what can be processed
    again, events, counters.

    target: model of the target, and parameters of its estimate. Counters: ``accepted`` and
    ``gated`` measurements, ``reinitialisations``; ``late_dropped`` (older than the buffer),
    ``duplicates`` (same chaser and time as an earlier one).
    """

    def __init__(self, target: MekfParameters) -> None:
        self.target = target
        self.late_dropped = 0
        self.duplicates = 0
        self._buffer = ReplayBuffer[RecordT, StateT]()
        self._was_lost = False

    @property
    def accepted(self) -> int:
        """Measurements accepted so far."""
        return self._buffer.newest.accepted if self._buffer.newest else 0

    @property
    def gated(self) -> int:
        """Measurements gated out so far."""
        return self._buffer.newest.gated if self._buffer.newest else 0

    @property
    def reinitialisations(self) -> int:
        """Number of re-initializations of the target's pose."""
        return self._buffer.newest.reinitialisations if self._buffer.newest else 0

    def disturb(self, shock: Shock) -> None:
        """Apply a sudden change of the target's rates after the newest record."""
        self._buffer.disturb(shock)

    def change_body(
        self, inertia: Matrix3, centre_trf_m: Vector3, covariance: Matrix9 = ()
    ) -> None:
        """Model the target from the newest record on as a torque-free rigid body with other mass
        properties.

        ``inertia``: TRF, rows, about the centre of mass, up to a factor. ``centre_trf_m``: centre
        of mass in TRF. ``covariance``: theirs, as ``MekfParameters.body_covariance``. Raises
        ValueError for an inertia that no rigid body has.
        """
        self.target = replace(
            self.target,
            motion_model="torque_free",
            inertia_ratios=inertia,
            centre_of_mass_trf_m=centre_trf_m,
            body_covariance=covariance,
        )

    def drain_events(self) -> list[EstimatorEvent]:
        """Return the events since the last call, in order of time."""
        return self._buffer.drain_events()

    def _reported(self, estimate: TargetState) -> TargetState:
        """Return the newest estimate; note an event if the target has just become lost."""
        lost = estimate.status == "lost"
        if lost and not self._was_lost:
            self._buffer.pending.append(EstimatorEvent(estimate.time_ns, "info", "lost"))
        self._was_lost = lost
        return estimate
