# SPDX-License-Identifier: Apache-2.0
"""Default estimator: a multiplicative extended Kalman filter that applies measurements at their exposure time.

Mathematics: docs/estimation.md. Late measurements are inserted by rollback and replay over a short buffer, so the state
does not depend on the order of arrival.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .camera_calibration import ERRORS
from .filter_update import FilterState, apply_shocks, is_lost, mixture_covariance, process_exposure
from .hypothesis import POSE, predict
from .parameters import MekfParameters
from .types import (
    CameraError,
    EstimatorEvent,
    Matrix3,
    Measurement,
    Shock,
    TargetState,
    content_key,
    is_usable,
    no_estimate,
)


@dataclass
class Exposure:
    """The measurements of one exposure time (sorted by chaser) and the resulting state.

    ``parameters`` apply from the previous exposure to this one; ``shocks`` change the rates after it.
    """

    time_ns: int
    group: list[Measurement]
    parameters: MekfParameters
    shocks: list[Shock] = field(default_factory=list)
    state: FilterState | None = None
    events: tuple[EstimatorEvent, ...] = ()


class Mekf:
    """Estimate the target state from the measurements of all chasers.

    Counters: ``accepted`` and ``gated`` measurements, ``reinitialisations``; ``late_dropped`` (older
    than the buffer), ``early_dropped`` (exposed after ``now_ns``), ``invalid`` (not finite, wrong shape
    or not a covariance) and ``duplicates`` (same chaser and time as an earlier one).
    """

    def __init__(self, parameters: MekfParameters | None = None) -> None:
        self.parameters = parameters if parameters is not None else MekfParameters()
        self.late_dropped = 0
        self.early_dropped = 0
        self.invalid = 0
        self.duplicates = 0
        self._buffer: list[Exposure] = []
        self._base: FilterState | None = None  # the state just before the buffer
        self._pending: list[EstimatorEvent] = []  # events outside the buffer, not yet drained
        self._drained: set[EstimatorEvent] = set()  # events of the buffer already drained
        self._was_lost = False

    @property
    def accepted(self) -> int:
        """Measurements accepted so far."""
        state = self._newest()
        return state.accepted if state else 0

    @property
    def gated(self) -> int:
        """Measurements gated out so far."""
        state = self._newest()
        return state.gated if state else 0

    @property
    def reinitialisations(self) -> int:
        """Number of re-initializations that kept the rates."""
        state = self._newest()
        return state.reinitialisations if state else 0

    def update(self, measurements: Sequence[Measurement], now_ns: int) -> TargetState:
        """Add measurements with exposure times up to ``now_ns``, in any order, and return the estimate for ``now_ns``.

        Raises ValueError as ``estimate_at``.
        """
        newest = self._buffer[-1].time_ns if self._buffer else None
        horizon = None if newest is None else newest - self._buffer_ns
        first_changed: int | None = None
        for m in sorted(measurements, key=content_key):
            if m.time_ns > now_ns:
                self.early_dropped += 1
                self._pending.append(
                    EstimatorEvent(
                        now_ns, "info", f"chaser {m.chaser}: dropped a measurement exposed in the future"
                    )
                )
            elif (horizon is not None and m.time_ns < horizon) or (
                self._base is not None and m.time_ns <= self._base.time_ns
            ):
                self.late_dropped += 1
            elif not is_usable(m):
                self.invalid += 1
                self._pending.append(
                    EstimatorEvent(now_ns, "info", f"chaser {m.chaser}: dropped an unusable measurement")
                )
            elif self._insert(m):
                first_changed = m.time_ns if first_changed is None else min(first_changed, m.time_ns)
        if first_changed is not None:
            self._replay(first_changed)
            self._trim()
        estimate = self.estimate_at(now_ns)
        lost = estimate.status == "lost"
        if lost and not self._was_lost:
            self._pending.append(EstimatorEvent(now_ns, "info", "lost"))
        self._was_lost = lost
        return estimate

    def estimate_at(self, time_ns: int) -> TargetState:
        """Return the estimate for ``time_ns`` from the measurements exposed up to then; changes no state.

        Raises ValueError for a time before the oldest state still held in the buffer.
        """
        i = bisect_right(self._buffer, time_ns, key=lambda e: e.time_ns)
        state = self._buffer[i - 1].state if i > 0 else self._base
        if state is None or not state.hypotheses:
            return no_estimate(time_ns)
        if time_ns < state.time_ns:
            raise ValueError(f"no state for {time_ns} ns in the buffer; the oldest is {state.time_ns} ns")
        hypotheses = tuple(predict(b, time_ns, self.parameters) for b in state.hypotheses)
        best = hypotheses[0]
        if is_lost(best, self.parameters):
            status = "lost"
        elif time_ns - state.last_accepted_ns <= self.parameters.tracking_s * 1e9:
            status = "tracking"
        else:
            status = "predicting"
        covariance = mixture_covariance(hypotheses)
        covariance[np.ix_(POSE, POSE)] += state.considered
        return TargetState(
            time_ns,
            best.position_m.copy(),
            best.velocity_m_s.copy(),
            best.q_wxyz.copy(),
            best.omega_rad_s.copy(),
            covariance,
            status,
            len(state.seen),
            state.rejected,
        )

    def cameras(self) -> tuple[CameraError, ...]:
        """Return the estimated calibration errors of all cameras, sorted by chaser, at the newest exposure."""
        state = self._newest()
        if state is None or not state.hypotheses:
            return ()
        best, errors = state.hypotheses[0], []
        for k, (chaser, error) in enumerate(zip(best.cameras, best.bias, strict=True)):
            i = slice(12 + ERRORS * k, 12 + ERRORS * (k + 1))
            errors.append(CameraError(chaser, error[:3], error[3:6], float(error[6]), best.covariance[i, i]))
        return tuple(sorted(errors, key=lambda e: e.chaser))

    def disturb(self, shock: Shock) -> None:
        """Apply a sudden change of the target's rates after the newest exposure."""
        if self._buffer:
            newest = self._buffer[-1]
            newest.shocks.append(shock)
            if newest.state is not None:
                newest.state = apply_shocks(newest.state, [shock])

    def change_body(self, inertia: Matrix3, centre_trf_m: tuple[float, float, float]) -> None:
        """Model the target from the newest exposure on as a torque-free rigid body with other mass properties.

        ``inertia``: TRF, rows, about the centre of mass, up to a factor. ``centre_trf_m``: centre of mass in TRF.
        Raises ValueError for an inertia that no rigid body has.
        """
        self.parameters = replace(
            self.parameters,
            motion_model="torque_free",
            inertia_ratios=inertia,
            centre_of_mass_trf_m=centre_trf_m,
        )

    def drain_events(self) -> list[EstimatorEvent]:
        """Return the events since the last call, in order of time."""
        fresh = [e for x in self._buffer for e in x.events if e not in self._drained]
        self._drained.update(fresh)
        events = sorted([*self._pending, *fresh], key=lambda e: e[0])
        self._pending = []
        return events

    @property
    def _buffer_ns(self) -> int:
        return round(self.parameters.buffer_s * 1e9)

    def _newest(self) -> FilterState | None:
        return self._buffer[-1].state if self._buffer else self._base

    def _insert(self, m: Measurement) -> bool:
        i = bisect_left(self._buffer, m.time_ns, key=lambda e: e.time_ns)
        if i == len(self._buffer) or self._buffer[i].time_ns != m.time_ns:
            self._buffer.insert(i, Exposure(m.time_ns, [m], self.parameters))
            return True
        group = self._buffer[i].group
        if any(other.chaser == m.chaser for other in group):
            self.duplicates += 1
            return False
        group.append(m)
        group.sort(key=lambda other: other.chaser)
        return True

    def _replay(self, time_ns: int) -> None:
        i = bisect_left(self._buffer, time_ns, key=lambda e: e.time_ns)
        state = self._buffer[i - 1].state if i > 0 else self._base
        for exposure in self._buffer[i:]:
            state, exposure.events = process_exposure(
                state, exposure.time_ns, exposure.group, exposure.parameters
            )
            exposure.state = state = apply_shocks(state, exposure.shocks)

    def _trim(self) -> None:
        horizon = self._buffer[-1].time_ns - self._buffer_ns
        while self._buffer[0].time_ns < horizon:
            old = self._buffer.pop(0)
            self._base = old.state
            self._pending += [e for e in old.events if e not in self._drained]
            self._drained.difference_update(old.events)
