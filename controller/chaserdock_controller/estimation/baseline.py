# SPDX-License-Identifier: Apache-2.0
"""The paper's estimation combiner, as a baseline for comparison.

The paper (Fourlas et al. 2023) averages the latest estimates of all chasers that see the target,
with "a moving average filter for noise reduction, outlier detection and removal methods". The
authors' code differentiates poses for the rates and averages 11 of them. Window, outlier limits and
age limit are unspecified there and parameters here. Weaknesses of the original that are kept: no
weighting, no latency compensation (the latest pose is returned for any time), rates from
differences. Averaging of Euler angles is replaced by a mean of attitudes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import groupby

import numpy as np
from chaserdock_models import scalar_rotations as so3

from .types import (
    Array,
    EstimatorEvent,
    Matrix3,
    Measurement,
    Shock,
    TargetState,
    content_key,
    is_usable,
    no_estimate,
)


@dataclass(frozen=True)
class PaperParameters:
    """Parameters of ``PaperEstimator``.

    window: poses in the moving average. rate_window: differences in the mean of the rates.
    stale_s: a chaser's latest estimate is used for this long.
    outlier_position_m, outlier_attitude_rad: a pose farther than this from the median of three and more
        chasers, or a combination farther than this from the moving average, is removed.
    outlier_patience: after this many removed combinations in a row the history is dropped instead.
    tracking_s, lost_s: age of the newest combination beyond which the status is "predicting" (the pose
        is held constant) and "lost".
    sigma_*: constant reported standard deviations, as the method computes no covariance; they match the errors of the
        averaging with good poses in closed loop.

    Raises ValueError for values that are not positive.
    """

    window: int = 5
    rate_window: int = 11
    stale_s: float = 0.5
    outlier_position_m: float = 0.2
    outlier_attitude_rad: float = math.radians(30.0)
    outlier_patience: int = 10
    tracking_s: float = 0.25
    lost_s: float = 5.0
    sigma_position_m: float = 0.02
    sigma_velocity_m_s: float = 0.02
    sigma_attitude_rad: float = math.radians(2.0)
    sigma_omega_rad_s: float = math.radians(5.0)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{field.name} is out of range: {value}")


def average_quaternion(quaternions: Sequence[Array]) -> Array:
    """Return the mean attitude (4,) of unit quaternions (4,) of any sign; scalar part not negative.

    The eigenvector of sum q q' with the largest eigenvalue. Source: Markley et al., "Averaging
    Quaternions", Journal of Guidance, Control, and Dynamics 30(4), 2007. Raises ValueError for
    none.
    """
    if not quaternions:
        raise ValueError("no quaternions to average")
    stack = np.stack(quaternions)
    q = np.linalg.eigh(stack.T @ stack)[1][:, -1]
    return -q if q[0] < 0.0 else q


class PaperEstimator:
    """The paper's combiner with the interface of ``Mekf``.

    ``late_dropped`` counts measurements not newer than the chaser's latest or than the newest
    combination, ``gated`` the poses removed as outliers, ``reinitialisations`` the dropped
    histories. For an ambiguous view the first hypothesis is used.
    """

    def __init__(self, parameters: PaperParameters | None = None) -> None:
        self.parameters = parameters if parameters is not None else PaperParameters()
        self.accepted = 0
        self.gated = 0
        self.late_dropped = 0
        self.early_dropped = 0
        self.invalid = 0
        self.reinitialisations = 0
        p = self.parameters
        self._latest: dict[int, Measurement] = {}
        self._poses: deque[tuple[Array, Array]] = deque(maxlen=p.window)
        self._rates: deque[tuple[Array, Array]] = deque(maxlen=p.rate_window)
        self._mean: tuple[int, Array, Array] | None = None
        self._newest_ns: int | None = None
        self._removed_in_a_row = 0
        self._seen = 0
        self._rejected: tuple[int, ...] = ()
        self._events: list[EstimatorEvent] = []
        self._was_lost = False

    def update(self, measurements: Sequence[Measurement], now_ns: int) -> TargetState:
        """Add measurements, in any order, and return the estimate for ``now_ns``."""
        usable: list[Measurement] = []
        for m in sorted(measurements, key=content_key):
            if m.time_ns > now_ns:
                self.early_dropped += 1
            elif self._newest_ns is not None and m.time_ns <= self._newest_ns:
                self.late_dropped += 1
            elif not is_usable(m):
                self.invalid += 1
                self._events.append(
                    EstimatorEvent(
                        now_ns, "info", f"chaser {m.chaser}: dropped an unusable measurement"
                    )
                )
            else:
                usable.append(m)
        for time_ns, group in groupby(usable, key=lambda m: m.time_ns):
            self._newest_ns = time_ns
            fresh: set[int] = set()
            for m in group:
                if m.chaser in fresh:
                    self.late_dropped += 1
                    continue
                fresh.add(m.chaser)
                self._latest[m.chaser] = m
            self._combine(time_ns, fresh)
        estimate = self.estimate_at(now_ns)
        if estimate.status == "lost" and not self._was_lost:
            self._events.append(EstimatorEvent(now_ns, "info", "lost"))
        self._was_lost = estimate.status == "lost"
        return estimate

    def estimate_at(self, time_ns: int) -> TargetState:
        """Return the newest combination for any time; the method does not predict."""
        if self._mean is None:
            return no_estimate(time_ns)
        p = self.parameters
        combined_ns, position, q = self._mean
        age_s = (time_ns - combined_ns) * 1e-9
        status = (
            "lost" if age_s > p.lost_s else "predicting" if age_s > p.tracking_s else "tracking"
        )
        velocity, omega = np.zeros(3), np.zeros(3)
        if self._rates:
            velocity = np.mean([v for v, _ in self._rates], axis=0)
            omega = np.mean([w for _, w in self._rates], axis=0)
        sigma = (
            p.sigma_position_m,
            p.sigma_velocity_m_s,
            p.sigma_attitude_rad,
            p.sigma_omega_rad_s,
        )
        covariance = np.diag(np.repeat(np.square(sigma), 3))
        return TargetState(
            time_ns,
            position.copy(),
            velocity,
            q.copy(),
            omega,
            covariance,
            status,
            self._seen,
            self._rejected,
        )

    def disturb(self, shock: Shock) -> None:
        """Do nothing: the rates are differences of poses."""

    def change_body(self, inertia: Matrix3, centre_trf_m: tuple[float, float, float]) -> None:
        """Do nothing: the method has no model of the body."""

    def drain_events(self) -> list[EstimatorEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def _combine(self, time_ns: int, fresh: set[int]) -> None:
        p = self.parameters
        horizon = time_ns - round(p.stale_s * 1e9)
        views = {
            c: (m.hypotheses[0].position_m, m.hypotheses[0].q_wxyz)
            for c, m in sorted(self._latest.items())
            if m.hypotheses and m.time_ns >= horizon
        }
        removed: set[int] = set()
        if len(views) > 2:
            middle = np.median([position for position, _ in views.values()], axis=0)
            removed = {
                c
                for c, (x, _) in views.items()
                if float(np.linalg.norm(x - middle)) > p.outlier_position_m
            }
            # Median attitude: the one with the smallest sum of angles to the others.
            centre = min(
                views, key=lambda c: (sum(_angle(views[c][1], q) for _, q in views.values()), c)
            )
            removed |= {
                c for c in views if _angle(views[centre][1], views[c][1]) > p.outlier_attitude_rad
            }
        self._rejected = tuple(sorted(removed & fresh))
        self._seen = len((views.keys() - removed) & fresh)
        self.gated += len(removed & fresh)
        self.accepted += self._seen
        kept = [views[c] for c in views if c not in removed]
        if kept:
            self._append(
                time_ns,
                np.mean([x for x, _ in kept], axis=0),
                average_quaternion([q for _, q in kept]),
            )

    def _append(self, time_ns: int, position: Array, q: Array) -> None:
        p = self.parameters
        if self._mean is not None:
            _, mean_position, mean_q = self._mean
            far = float(np.linalg.norm(position - mean_position)) > p.outlier_position_m
            if far or _angle(mean_q, q) > p.outlier_attitude_rad:
                self._removed_in_a_row += 1
                if self._removed_in_a_row < p.outlier_patience:
                    self.gated += self._seen
                    self.accepted -= self._seen
                    self._seen = 0
                    return
                self._poses.clear()
                self._rates.clear()
                self._mean = None
                self.reinitialisations += 1
                self._events.append(EstimatorEvent(time_ns, "info", "re-initialised"))
        else:
            self._events.append(EstimatorEvent(time_ns, "info", "initialised"))
        self._removed_in_a_row = 0
        self._poses.append((position, q))
        mean = (
            time_ns,
            np.mean([x for x, _ in self._poses], axis=0),
            average_quaternion([x for _, x in self._poses]),
        )
        if self._mean is not None:
            dt = (time_ns - self._mean[0]) * 1e-9
            omega = so3.log(so3.inverse_multiply(self._mean[2], mean[2])) / dt
            self._rates.append(((mean[1] - self._mean[1]) / dt, omega))
        self._mean = mean


def _angle(a: Array, b: Array) -> float:
    return float(np.linalg.norm(so3.log(so3.inverse_multiply(a, b))))
