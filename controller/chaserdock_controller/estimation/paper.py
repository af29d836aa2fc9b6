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
from typing import NamedTuple

import numpy as np
from chaserdock_models import rotations
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import Odometry, Sighting

from chaserdock_controller.interfaces import TargetState

from .types import Estimate, Estimator, EstimatorEvent, EstimatorInputs, no_estimate

_ODOMETRY_KEPT_NS = 2_000_000_000
"""Time, ns, for which odometry is kept: twice the buffer of the joint filter. A sighting that
arrives later is not used.
"""


@dataclass(frozen=True)
class PaperParameters:
    """Window, limits and stated accuracy of ``PaperEstimator``. The paper states none of them.

    Raises ValueError for values that are not positive.
    """

    window: int = 5
    """Poses in the moving average."""
    rate_window: int = 11
    """Differences in the mean of the rates, as in the authors' code."""
    stale_s: float = 0.5
    """A chaser's latest pose is used for this long."""
    outlier_position_m: float = 0.2
    """Limit for outliers: distance of a pose from the median of at least three chasers, or of a
    combined pose from the moving average.
    """
    outlier_attitude_rad: float = math.radians(30.0)
    """Limit of the attitude for outliers."""
    outlier_patience: int = 10
    """After this many consecutive removals the history is dropped instead."""
    tracking_s: float = 0.25
    """Age of the newest combined pose beyond which the status is "predicting" (the pose is
    held).
    """
    lost_s: float = 5.0
    """Age of the newest combined pose beyond which the status is "lost"."""
    sigma_position_m: float = 0.02
    """Stated standard deviation, as are the next three; the method computes no covariance. Values:
    errors of averaged good poses in closed loop.
    """
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


class SightedTarget(NamedTuple):
    """Pose of the target in WRF, by one chaser's sighting at ``time_ns`` and its odometry."""

    time_ns: int
    position_m: Array
    q_wxyz: Array


class PaperEstimator(Estimator):
    """The paper's combiner. Odometry counts as exact; of an ambiguous view the first pose is used.

    A sighting counts once the odometry of its exposure is known, if it is newer than the newest
    combined pose. Pushes and latched chasers change nothing, since the rates are differences of
    poses.
    """

    def __init__(self, camera: Camera, parameters: PaperParameters | None = None) -> None:
        self.parameters = p = parameters if parameters is not None else PaperParameters()
        self._camera = camera
        self._odometry: dict[tuple[int, int], Odometry] = {}
        self._latest: dict[int, SightedTarget] = {}
        self._poses: deque[tuple[Array, Array]] = deque(maxlen=p.window)
        self._rates: deque[tuple[Array, Array]] = deque(maxlen=p.rate_window)
        self._mean: tuple[int, Array, Array] | None = None
        self._newest_ns: int | None = None
        self._removed_in_a_row = 0
        self._reinitialisations = 0
        self._seen = 0
        self._rejected: tuple[int, ...] = ()
        self._was_lost = False

    @property
    def reinitialisations(self) -> int:
        """Return how often the history was dropped."""
        return self._reinitialisations

    def update(self, inputs: EstimatorInputs) -> Estimate:
        """Combine the sightings of a tick."""
        events: list[EstimatorEvent] = []
        now_ns = inputs.time_ns
        self._keep_odometry(inputs)
        usable = [s for s in inputs.sightings if self._is_usable(s, now_ns)]
        usable.sort(key=lambda s: (s.sim_time_ns, s.chaser, len(s.solutions)))
        for time_ns, group in groupby(usable, key=lambda s: s.sim_time_ns):
            self._newest_ns = time_ns
            fresh: set[int] = set()
            for sighting in group:
                if sighting.chaser not in fresh:
                    fresh.add(sighting.chaser)
                    self._take(sighting)
            self._combine(time_ns, fresh, events)
        estimate = self.estimate_at(now_ns)
        if estimate.status == "lost" and not self._was_lost:
            events.append(EstimatorEvent(now_ns, "info", "lost"))
        self._was_lost = estimate.status == "lost"
        return Estimate(estimate, events=tuple(events))

    def estimate_at(self, time_ns: int) -> TargetState:
        """Return the newest combined pose, whatever the time: the method does not predict."""
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

    def _keep_odometry(self, inputs: EstimatorInputs) -> None:
        for c in inputs.chasers:
            for o in (c.odometry, c.outdated):
                if o is not None:
                    self._odometry[o.chaser, o.sim_time_ns] = o
        oldest_ns = inputs.time_ns - _ODOMETRY_KEPT_NS
        for key in [k for k in self._odometry if k[1] < oldest_ns]:
            del self._odometry[key]

    def _is_usable(self, sighting: Sighting, now_ns: int) -> bool:
        """Test whether a sighting is new, and the odometry of its exposure known."""
        newest = -1 if self._newest_ns is None else self._newest_ns
        time_ns = sighting.sim_time_ns
        return newest < time_ns <= now_ns and (sighting.chaser, time_ns) in self._odometry

    def _take(self, sighting: Sighting) -> None:
        """Store a sighting as the latest of its chaser."""
        if not sighting.solutions:
            self._latest.pop(sighting.chaser, None)
            return
        seen, camera = sighting.solutions[0], self._camera
        own = self._odometry[sighting.chaser, sighting.sim_time_ns]
        mounting = rotations.normalize(camera.q_crf_irf_wxyz)
        q_own, q_seen = rotations.normalize(own.q_wxyz), rotations.normalize(seen.q_wxyz)
        line = so3.to_matrix(mounting) @ np.array(seen.position_m)
        lever = np.array(camera.position_crf_m) + line
        self._latest[sighting.chaser] = SightedTarget(
            sighting.sim_time_ns,
            np.array(own.position_m) + so3.to_matrix(q_own) @ lever,
            rotations.normalize(rotations.multiply(q_own, rotations.multiply(mounting, q_seen))),
        )

    def _combine(self, time_ns: int, fresh: set[int], events: list[EstimatorEvent]) -> None:
        p = self.parameters
        horizon = time_ns - round(p.stale_s * 1e9)
        views = {
            c: (view.position_m, view.q_wxyz)
            for c, view in sorted(self._latest.items())
            if view.time_ns >= horizon
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

        kept = [views[c] for c in views if c not in removed]
        if kept:
            self._append(
                time_ns,
                np.mean([x for x, _ in kept], axis=0),
                average_quaternion([q for _, q in kept]),
                events,
            )

    def _append(
        self, time_ns: int, position: Array, q: Array, events: list[EstimatorEvent]
    ) -> None:
        p = self.parameters
        if self._mean is not None:
            _, mean_position, mean_q = self._mean
            far = float(np.linalg.norm(position - mean_position)) > p.outlier_position_m
            if far or _angle(mean_q, q) > p.outlier_attitude_rad:
                self._removed_in_a_row += 1
                if self._removed_in_a_row < p.outlier_patience:
                    self._seen = 0
                    return
                self._poses.clear()
                self._rates.clear()
                self._mean = None
                self._reinitialisations += 1
                events.append(EstimatorEvent(time_ns, "info", "re-initialised"))
        else:
            events.append(EstimatorEvent(time_ns, "info", "initialised"))
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
