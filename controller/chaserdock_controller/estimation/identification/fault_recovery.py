# SPDX-License-Identifier: Apache-2.0
"""Identification that recovers from a failed thruster by filtering again from before the failure.
No I/O.

Until a failure is detected, the filter attributes the missing or surplus impulse to mass properties
and thrust errors. Widening their covariance afterwards does not undo that. Therefore the inputs of
the last seconds are kept, with the filter's state once a second. After a detection the filter
restarts from a state before the failure, with the impulses that the failed thruster really gave.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from chaserdock_models.arrays import Array, BoolArray
from chaserdock_models.rigid_body import BodyState

from .composite import CompositeFilterState, CompositeIdentification
from .faults import DetectorState, StackFault, StackFaultDetector

_KEPT_S = 15.0
"""Time, s, for which inputs are kept. A failure can be corrected if it began within this time."""
_SAVE_EVERY_S = 1.0
"""Time, s, between two saved states. The filter repeats at most this much more than needed."""
_UNCERTAIN_S = 2.0
"""Time, s, before the likeliest begin of a failure in which the thruster may already have
failed.
"""
_CLOSING_S = 0.4
"""Time, s, after a detection in which the shut-off valve may still be open."""


@dataclass(frozen=True, eq=False)
class _TickRecord:
    """Inputs of the filter in one tick, named as in ``predict`` and ``update``. ``before``: the
    filter's state before them, if it was saved.
    """

    before: CompositeFilterState | None
    step_s: float
    given_N_s: Mapping[int, Array]
    unknown_N_s: Mapping[int, Array]
    shock: tuple[float, float] | None
    states: Mapping[int, BodyState] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RecoveryState:
    """State of filter and detection for a standby controller. It does not include the inputs of the
    last seconds.
    """

    composite: CompositeFilterState
    detector: DetectorState
    closing: list[StackFault]


class FaultTolerantIdentification:
    """Identifies a stack with ``filter`` and detects thrusters that are stuck off or on.

    ``full_N`` (n,): full thrusts of a chaser's thrusters. Call ``predict`` and ``update`` once a
    tick.
    """

    def __init__(self, identification: CompositeIdentification, full_N: Array) -> None:
        self.filter, self._full_N = identification, full_N
        full = np.array([full_N[thruster] for _, thruster in identification.usable])
        self._detector = StackFaultDetector(
            identification.usable, len(identification.covariance), full
        )
        self._records: deque[_TickRecord] = deque()
        self._closing: list[StackFault] = []

    def predict(
        self,
        given_N_s: Mapping[int, Array],
        step_s: float,
        unknown_N_s: Mapping[int, Array] | None = None,
        shock: tuple[float, float] | None = None,
    ) -> None:
        """Advance by ``step_s``; impulses as in ``CompositeIdentification.predict``.

        ``shock``: standard deviations per axis of an unknown change of velocity (m/s) and rate
        (rad/s) at the end of the step.
        """
        tick = _TickRecord(None, step_s, given_N_s, unknown_N_s or {}, shock)
        for fault in self._closing:
            tick = self._with_fault(tick, fault, certain=fault.kind == "stuck_off")
        self._closing = [
            replace(f, ticks=f.ticks + 1) for f in self._closing if f.ticks * step_s < _CLOSING_S
        ]
        self._predict(tick, self._detector)

    def update(self, states: Mapping[int, BodyState], suspects: BoolArray) -> StackFault | None:
        """Correct the filter by the chasers' measured states. Returns a thruster that is proven to
        have failed, or None.

        ``suspects`` (u,): thrusters that are tested.
        """
        if self._records:
            self._records[-1] = replace(self._records[-1], states=states)
        innovation = self.filter.update(states)
        found = None if innovation is None else self._detector.update(innovation, suspects)
        if found is not None:
            self._repeat(found)
            self._closing.append(replace(found, ticks=0))
        return found

    def restart_detection(self) -> None:
        """Restart all failure tests."""
        self._detector.reset()

    def save(self) -> RecoveryState:
        """Return the state for a standby controller."""
        return RecoveryState(self.filter.save(), self._detector.save(), list(self._closing))

    def load(self, state: RecoveryState) -> None:
        """Replace the state by a saved one of the same stack."""
        self.filter.load(state.composite)
        self._detector.load(state.detector)
        self._records.clear()
        self._closing = list(state.closing)

    def _predict(self, tick: _TickRecord, detector: StackFaultDetector | None = None) -> None:
        """Advance the filter and record the tick."""
        records = self._records
        every = max(1, round(_SAVE_EVERY_S / tick.step_s))
        saved = next((k for k, r in enumerate(reversed(records)) if r.before is not None), every)
        records.append(replace(tick, before=self.filter.save() if saved >= every - 1 else None))
        while len(records) * tick.step_s > _KEPT_S or records[0].before is None:
            records.popleft()
        prediction = self.filter.predict(tick.given_N_s, tick.step_s, tick.unknown_N_s)
        if detector is not None:
            detector.predict(prediction)
        if tick.shock is not None:
            self.filter.disturb(*tick.shock)

    def _repeat(self, fault: StackFault) -> None:
        """Restart the filter from before a failure and process the recorded ticks again."""
        ticks = list(self._records)
        begin = len(ticks) - fault.ticks
        early = begin - round(_UNCERTAIN_S / ticks[-1].step_s) if ticks else 0
        saved = [(k, tick.before) for k, tick in enumerate(ticks) if tick.before is not None]
        if not saved:
            return
        first, state = next(((k, before) for k, before in reversed(saved) if k <= early), saved[0])
        self.filter.load(state)
        self._records = deque(ticks[:first])
        for k, tick in enumerate(ticks[first:], first):
            self._predict(self._with_fault(tick, fault, certain=k >= begin))
            self._records[-1] = replace(self._records[-1], states=tick.states)
            self.filter.update(tick.states)

    def _with_fault(self, tick: _TickRecord, fault: StackFault, certain: bool) -> _TickRecord:
        """Return a tick's inputs with the impulses of a failed thruster corrected.

        ``certain``: the thruster had certainly failed in this tick; it then gave nothing (stuck
        off) or full thrust (stuck on). Otherwise its impulse is uncertain between that and the
        commanded one.
        """
        if fault.chaser not in tick.given_N_s:
            return tick
        given = tick.given_N_s[fault.chaser].copy()
        unknown = np.array(tick.unknown_N_s.get(fault.chaser, np.zeros(len(given))))
        failed = (
            0.0 if fault.kind == "stuck_off" else float(self._full_N[fault.thruster]) * tick.step_s
        )
        if certain:
            given[fault.thruster] = failed
        else:
            between = (
                (given[fault.thruster] + failed) / 2.0,
                abs(given[fault.thruster] - failed) / 2.0,
            )
            given[fault.thruster] = between[0]
            unknown[fault.thruster] = np.hypot(unknown[fault.thruster], between[1])
        return replace(
            tick,
            given_N_s={**tick.given_N_s, fault.chaser: given},
            unknown_N_s={**tick.unknown_N_s, fault.chaser: unknown},
        )
