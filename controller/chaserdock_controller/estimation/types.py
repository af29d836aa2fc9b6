# SPDX-License-Identifier: Apache-2.0
"""The interface of estimators: what they get in a tick, and what they return. Arrays are float64;
SI units and radians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Level, Odometry, Sighting

from .body_shape import BodyShape
from .target_body import TargetBody


@dataclass(frozen=True)
class EstimatorInputs:
    """Inputs of a tick: measured odometry by chaser, and sightings, which may belong to earlier
    ticks.

    impulses (N, 6): N s and N m s, body axes, that the chasers' actuators gave in the last
    ``covered_s``. latched: chasers whose latch holds the target. contacts: chasers with a contact
    since the tick before. last_commands: last commands (6,), N and N m, of chasers without odometry
    in this tick, which fly by plans that the controller does not know. outdated: newest odometry of
    chasers that have none of this tick, with the times of the ticks at which it was measured.
    """

    time_ns: int
    odometry: Mapping[int, Odometry]
    sightings: tuple[Sighting, ...]
    impulses: Array
    covered_s: float
    latched: frozenset[int] = frozenset()
    contacts: frozenset[int] = frozenset()
    last_commands: Mapping[int, Array] = field(default_factory=dict)
    outdated: Mapping[int, Odometry] = field(default_factory=dict)


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


@dataclass(frozen=True, eq=False)
class ChaserMotion:
    """Estimated motion of a chaser, and of its camera.

    position_m, velocity_m_s (3,): WRF. q_wxyz (4,): CRF to WRF. omega_rad_s (3,): CRF. disturbance
    (6,): force and torque on it besides the commanded ones, body axes; zero on a latched chaser,
    whose motion is the target's. relative, motion_covariance: while the target is known; the latter
    (6, 6) of position and velocity relative to it, WRF. camera: once its errors are estimated.
    """

    chaser: int
    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array
    disturbance: Array
    relative: RelativePose | None
    motion_covariance: Array | None
    camera: CameraError | None


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of a tick. ``chasers``: those whose motion the estimator estimates, in order."""

    target: TargetState
    chasers: tuple[ChaserMotion, ...] = ()
    events: tuple[EstimatorEvent, ...] = ()


class Estimator(Protocol):
    """Estimates the target's motion, called once a tick with all inputs.

    Only ``update`` and ``estimate_at`` are required; a class that inherits from this one gets the
    others for a method without a model of the target's body or of the chasers.
    """

    def update(self, inputs: EstimatorInputs) -> Estimate:
        """Process a tick and return the estimates at its time. Ticks come in order."""
        ...

    def estimate_at(self, time_ns: int) -> TargetState:
        """Return the target's estimate for a time from the newest tick on; changes no state."""
        ...

    @property
    def shape(self) -> tuple[BodyShape, Array] | None:
        """Return the shape of the body that the target is from now on, as its motion shows it, and
        its covariance (8, 8); None if it is not estimated.
        """
        return None

    @property
    def reinitialisations(self) -> int:
        """Return how often the target was started again, for statistics."""
        return 0

    def without_drift(self, odometry: Odometry) -> Odometry:
        """Return odometry without the drift of its position that is estimated up to now."""
        return odometry

    def disturb(self, shock: Shock) -> None:
        """Take note that the target's rates change suddenly, after the newest tick."""

    def change_body(self, body: TargetBody, covariance: Array) -> None:
        """Take another body for the target from the newest tick on: it was latched or released, or
        is known better.

        covariance (9, 9): of its centre of mass (m) and of the elements xx, yy, zz, xy, xz, yz of
        its inertia (kg m²). Raises ValueError for an inertia that no rigid body has.
        """


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
