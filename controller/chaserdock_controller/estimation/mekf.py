# SPDX-License-Identifier: Apache-2.0
"""Default estimator: a multiplicative extended Kalman filter that applies measurements at their
exposure time.

Mathematics: docs/estimation.md. Late measurements are inserted by rollback and replay over a short
buffer, so the state does not depend on the order of arrival.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Matrix3, Vector3

from .camera_calibration import ERRORS
from .filter_update import FilterState, process_exposure
from .hypothesis import predict
from .parameters import Matrix9, MekfParameters
from .replay import ReplayingFilter, ReplayRecord
from .target_hypotheses import POSE, is_lost, mixture_covariance, target_state
from .types import (
    CameraError,
    EstimatorEvent,
    Measurement,
    TargetState,
    content_key,
    is_usable,
    no_estimate,
)


@dataclass(kw_only=True)
class Exposure(ReplayRecord[FilterState]):
    """The measurements of one exposure time, sorted by chaser."""

    group: list[Measurement]


class Mekf(ReplayingFilter[Exposure, FilterState]):
    """Estimate the target state from the measurements of all chasers.

    Counters besides those of ``ReplayingFilter``: ``early_dropped`` (exposed after ``now_ns``) and
    ``invalid`` (not finite, wrong shape or not a covariance).
    """

    def __init__(self, parameters: MekfParameters | None = None) -> None:
        super().__init__(parameters if parameters is not None else MekfParameters())
        self.early_dropped = 0
        self.invalid = 0
        self._updated_ns = 0
        # Earlier models of the target, each with the time until which it applies, in order of time.
        self._before: list[tuple[int, MekfParameters]] = []

    def update(self, measurements: Sequence[Measurement], now_ns: int) -> TargetState:
        """Add measurements with exposure times up to ``now_ns``, in any order, and return the
        estimate for ``now_ns``.

        Raises ValueError as ``estimate_at``.
        """
        self._updated_ns = now_ns
        records, base, pending = self._buffer.records, self._buffer.base, self._buffer.pending
        horizon = records[-1].time_ns - round(self.target.buffer_s * 1e9) if records else None
        first_changed: int | None = None
        for m in sorted(measurements, key=content_key):
            if m.time_ns > now_ns:
                self.early_dropped += 1
                text = f"chaser {m.chaser}: dropped a measurement exposed in the future"
                pending.append(EstimatorEvent(now_ns, "info", text))
            elif (horizon is not None and m.time_ns < horizon) or (
                base is not None and m.time_ns <= base.time_ns
            ):
                self.late_dropped += 1
            elif not is_usable(m):
                self.invalid += 1
                text = f"chaser {m.chaser}: dropped an unusable measurement"
                pending.append(EstimatorEvent(now_ns, "info", text))
            elif self._insert(m):
                first_changed = (
                    m.time_ns if first_changed is None else min(first_changed, m.time_ns)
                )
        if first_changed is not None:
            self._buffer.replay(self._buffer.find(first_changed)[0], self._process)
            self._buffer.trim(self.target.buffer_s)
            base = self._buffer.base
            self._before = [m for m in self._before if base is None or m[0] > base.time_ns]
        return self._reported(self.estimate_at(now_ns))

    def estimate_at(self, time_ns: int) -> TargetState:
        """Return the estimate for ``time_ns`` from the measurements exposed up to then; changes no
        state.

        Raises ValueError for a time before the oldest state still held in the buffer.
        """
        state, p = self._buffer.state_at(time_ns), self.target
        if state is None or not state.hypotheses:
            return no_estimate(time_ns)
        if time_ns < state.time_ns:
            raise ValueError(
                f"no state for {time_ns} ns in the buffer; the oldest is {state.time_ns} ns"
            )
        hypotheses = list(state.hypotheses)
        for end_ns, model in self._models_between(state.time_ns, time_ns):
            hypotheses = [predict(h, end_ns, model) for h in hypotheses]
        covariance = mixture_covariance(hypotheses, [h.covariance[:12, :12] for h in hypotheses])
        covariance[np.ix_(POSE, POSE)] += state.considered
        best = hypotheses[0]
        return target_state(state, time_ns, best, covariance, is_lost(best.covariance, p), p)

    def change_body(
        self, inertia: Matrix3, centre_trf_m: Vector3, covariance: Matrix9 = ()
    ) -> None:
        """As ``ReplayingFilter``, but from the time of the last update on: older measurements that
        arrive later keep the model before."""
        self._before.append((self._updated_ns, self.target))
        super().change_body(inertia, centre_trf_m, covariance)

    def cameras(self) -> tuple[CameraError, ...]:
        """Return the estimated calibration errors of all cameras, sorted by chaser, at the newest
        exposure.
        """
        state = self._buffer.newest
        if state is None or not state.hypotheses:
            return ()
        best, errors = state.hypotheses[0], []
        for k, (chaser, error) in enumerate(zip(best.cameras, best.bias, strict=True)):
            i = slice(12 + ERRORS * k, 12 + ERRORS * (k + 1))
            errors.append(
                CameraError(chaser, error[:3], error[3:6], float(error[6]), best.covariance[i, i])
            )
        return tuple(sorted(errors, key=lambda e: e.chaser))

    def _insert(self, m: Measurement) -> bool:
        i, exposure = self._buffer.find(m.time_ns)
        if exposure is None:
            added = Exposure(time_ns=m.time_ns, parameters=self._model_at(m.time_ns), group=[m])
            self._buffer.records.insert(i, added)
            return True
        if any(other.chaser == m.chaser for other in exposure.group):
            self.duplicates += 1
            return False
        exposure.group.append(m)
        exposure.group.sort(key=lambda other: other.chaser)
        return True

    def _model_at(self, time_ns: int) -> MekfParameters:
        return next((model for end_ns, model in self._before if time_ns <= end_ns), self.target)

    def _models_between(self, from_ns: int, to_ns: int) -> list[tuple[int, MekfParameters]]:
        """Return the models of the target from one time to another, each with the time at which it
        ends.
        """
        changes = [(end_ns, model) for end_ns, model in self._before if from_ns < end_ns < to_ns]
        return [*changes, (to_ns, self._model_at(to_ns))]

    def _process(
        self, before: FilterState | None, exposure: Exposure
    ) -> tuple[FilterState, tuple[EstimatorEvent, ...]]:
        if before is not None:
            for end_ns, model in self._models_between(before.time_ns, exposure.time_ns)[:-1]:
                before, _ = process_exposure(before, end_ns, [], model)
        return process_exposure(before, exposure.time_ns, exposure.group, exposure.parameters)
