# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of target state estimation. Arrays are float64; SI units and radians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from chaserdock_models.arrays import Array, Matrix3
from chaserdock_protocol.messages import Level


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """One possible pose of the target.

    position_m: (3,) origin of TRF in WRF, m.
    q_wxyz: (4,) unit quaternion, TRF to WRF.
    covariance: (6, 6), order (position in WRF axes, m; dtheta in TRF axes, rad) with
        q_true = q (x) exp(dtheta).
    """

    position_m: Array
    q_wxyz: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class CameraPose:
    """Nominal pose of a camera at an exposure: optical centre (3,) in WRF and rotation (4,) IRF to
    WRF.
    """

    position_m: Array
    q_wxyz: Array


@dataclass(frozen=True, eq=False)
class Measurement:
    """Measurement of one chaser in one exposure.

    time_ns: simulated time of the exposure. markers: number of markers used.
    hypotheses: one pose, two for the planar ambiguity of a single marker (the likelier first), none
        if the target is not visible. camera: its nominal pose.
    """

    chaser: int
    time_ns: int
    hypotheses: tuple[PoseHypothesis, ...]
    markers: int
    camera: CameraPose


@dataclass(frozen=True, eq=False)
class CameraError:
    """Estimated calibration error of a chaser's camera.

    turn_rad: (3,) rotation vector from nominal to true camera axes, in nominal IRF. shift_m: (3,)
    of the optical centre, in IRF. focal_share: relative error of the focal length. covariance: (7,
    7) in that order.
    """

    chaser: int
    turn_rad: Array
    shift_m: Array
    focal_share: float
    covariance: Array


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Estimated pose of a chaser relative to the target.

    position_m: (3,) origin of CRF in TRF. q_wxyz: (4,) CRF to TRF. covariance: (6, 6), order
    (position in TRF axes, m; dtheta in CRF axes, rad).
    """

    chaser: int
    position_m: Array
    q_wxyz: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class TargetState:
    """Estimated state of the target at ``time_ns``.

    position_m, velocity_m_s: (3,) WRF. q_wxyz: (4,) TRF to WRF. omega_rad_s: (3,) TRF axes.
    covariance: (12, 12), order (position WRF, velocity WRF, dtheta TRF, omega TRF).
    status: "none" (no measurement yet: pose and rates are zero, the covariance is 1e6 times identity),
        "tracking" (a measurement was accepted recently), "predicting" (motion model only), "lost" (too
        uncertain to use).
    sightings: number of chasers whose measurements were accepted at the newest exposure.
    rejected: chasers whose measurements were gated out at the newest exposure.
    """

    time_ns: int
    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array
    covariance: Array
    status: str
    sightings: int
    rejected: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Shock:
    """A sudden change of the target's rates.

    sigma_*: standard deviation of the unknown part. velocity_m_s (3,) of TRF's origin in WRF and
    omega_rad_s (3,) in TRF: the known part.
    """

    sigma_velocity_m_s: float
    sigma_omega_rad_s: float
    velocity_m_s: Array = field(default_factory=lambda: np.zeros(3))
    omega_rad_s: Array = field(default_factory=lambda: np.zeros(3))


class EstimatorEvent(NamedTuple):
    """A change in the estimator that an operator should know, at simulated time ``time_ns``."""

    time_ns: int
    level: Level
    text: str


class Estimator(Protocol):
    """Interface of estimators; ``mekf.Mekf`` documents the members."""

    @property
    def accepted(self) -> int: ...

    @property
    def gated(self) -> int: ...

    @property
    def late_dropped(self) -> int: ...

    @property
    def reinitialisations(self) -> int: ...

    def update(self, measurements: Sequence[Measurement], now_ns: int) -> TargetState: ...

    def estimate_at(self, time_ns: int) -> TargetState: ...

    def disturb(self, shock: Shock) -> None: ...

    def change_body(self, inertia: Matrix3, centre_trf_m: tuple[float, float, float]) -> None: ...

    def drain_events(self) -> list[EstimatorEvent]: ...


NO_ESTIMATE_VARIANCE = 1e6


def no_estimate(time_ns: int) -> TargetState:
    """Return the estimate with status "none" at ``time_ns``."""
    return TargetState(
        time_ns,
        np.zeros(3),
        np.zeros(3),
        np.array([1.0, 0.0, 0.0, 0.0]),
        np.zeros(3),
        NO_ESTIMATE_VARIANCE * np.eye(12),
        "none",
        0,
        (),
    )


def is_usable(measurement: Measurement) -> bool:
    """Check camera pose and hypotheses: shapes, finite numbers, unit quaternions (to 1e-3), and
    symmetric positive definite covariances."""
    camera = measurement.camera
    if (
        camera.position_m.shape != (3,)
        or camera.q_wxyz.shape != (4,)
        or not np.isfinite(camera.position_m).all()
    ):
        return False
    if not abs(float(camera.q_wxyz @ camera.q_wxyz) - 1.0) < 1e-3:
        return False
    for h in measurement.hypotheses:
        if h.position_m.shape != (3,) or h.q_wxyz.shape != (4,) or h.covariance.shape != (6, 6):
            return False
        if not (np.isfinite(h.position_m).all() and np.isfinite(h.covariance).all()):
            return False
        # This form rejects NaN as well.
        if not abs(float(h.q_wxyz @ h.q_wxyz) - 1.0) < 1e-3:
            return False
        scale = float(np.abs(h.covariance).max())
        if float(np.abs(h.covariance - h.covariance.T).max()) > 1e-6 * scale:
            return False
        try:
            np.linalg.cholesky(h.covariance)
        except np.linalg.LinAlgError:
            return False
    return True


def content_key(m: Measurement) -> tuple[int, int, int, int, bytes]:
    """Return a sort key (time, chaser, content) that makes results independent of the order of
    arrival.
    """
    content = m.camera.position_m.tobytes() + m.camera.q_wxyz.tobytes()
    content += b"".join(
        h.position_m.tobytes() + h.q_wxyz.tobytes() + h.covariance.tobytes() for h in m.hypotheses
    )
    return m.time_ns, m.chaser, len(m.hypotheses), m.markers, content
