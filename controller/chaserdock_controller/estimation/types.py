# SPDX-License-Identifier: Apache-2.0
"""Interface of estimators: inputs and results of a tick. Arrays are float64; SI units and
radians.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.passive_safety import DisturbedMotion
from chaserdock_protocol.messages import Innovation, Level, Odometry, Sighting

from chaserdock_controller.bodies.body_shape import BodyShape
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.interfaces import AppliedImpulse, RelativePose, TargetState


@dataclass(frozen=True, eq=False)
class MeasuredChaser:
    """What is measured and known of one chaser in a tick.

    ``odometry``: measured in this tick, else None. ``outdated``: then the newest one, with the time
    of its tick. ``impulse``: given by its actuators in the last ``EstimatorInputs.covered_s``.
    ``last_command`` (6,): N and N m, of a chaser without odometry in this tick; the plan that it
    flies is unknown to the controller. ``latched``: its latch holds the target. ``contact``: it has
    touched the target since the previous tick.
    """

    chaser: int
    impulse: AppliedImpulse
    odometry: Odometry | None = None
    outdated: Odometry | None = None
    last_command: Array | None = None
    latched: bool = False
    contact: bool = False


@dataclass(frozen=True)
class EstimatorInputs:
    """Inputs of a tick. ``chasers``: one for every chaser of the mission, in order. ``sightings``:
    may belong to earlier ticks.
    """

    time_ns: int
    covered_s: float
    chasers: tuple[MeasuredChaser, ...]
    sightings: tuple[Sighting, ...] = ()


@dataclass(frozen=True, eq=False)
class CameraError:
    """Estimated calibration error of a camera.

    turn_rad: (3,) rotation vector from nominal to true camera axes, in nominal IRF. shift_m: (3,)
    of the optical centre, in IRF. focal_share: relative error of the focal length. covariance: (7,
    7) in that order.
    """

    turn_rad: Array
    shift_m: Array
    focal_share: float
    covariance: Array


@dataclass(frozen=True, eq=False)
class Shock:
    """A sudden change of the target's rates.

    velocity_m_s (3,) of TRF's origin in WRF, omega_rad_s (3,) in TRF: the known part. sigma_*:
    standard deviations of the unknown part.
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
    """Estimated motion of a chaser and errors of its camera.

    position_m, velocity_m_s (3,): WRF. q_wxyz (4,): CRF to WRF. omega_rad_s (3,): CRF. disturbance
    (6,): force and torque besides the commanded ones, body axes; zero on a latched chaser, whose
    motion is the target's. relative: pose relative to the target, while that is known.
    camera: once its errors are estimated.
    """

    chaser: int
    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array
    disturbance: Array
    relative: RelativePose | None
    camera: CameraError | None


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of a tick. ``chasers``: those whose motion the estimator estimates, in order.
    ``innovations``: of the tick's sightings; None if the estimator states none.
    """

    target: TargetState
    chasers: tuple[ChaserMotion, ...] = ()
    events: tuple[EstimatorEvent, ...] = ()
    innovations: tuple[Innovation, ...] | None = None


class Estimator(Protocol):
    """Estimates the target's motion; called once a tick with all inputs.

    Only ``update`` and ``estimate_at`` are required. A class that inherits from this one gets
    defaults for the others, which suit a method without a model of the target's body or of the
    chasers.
    """

    def update(self, inputs: EstimatorInputs) -> Estimate:
        """Process a tick and return the estimates at its time. Ticks arrive in order."""
        ...

    def estimate_at(self, time_ns: int) -> TargetState:
        """Return the target's estimate for a time not before the newest tick. The state is
        unchanged.
        """
        ...

    @property
    def shape(self) -> tuple[BodyShape, Array] | None:
        """Return the shape of the target's present body, as its motion shows it, and its covariance
        (8, 8); None if it is not estimated.
        """
        return None

    @property
    def reinitialisations(self) -> int:
        """Return how often the target's estimate was restarted, for statistics."""
        return 0

    @property
    def failed(self) -> bool:
        """Return whether a call since the update before the newest has failed. An installed
        estimator is guarded, so that its failures are events."""
        return False

    def disturbed_motion(self, chaser: int) -> DisturbedMotion | None:
        """Return what decides where a chaser coasts besides its position and velocity, after the
        newest tick; None if it or the target is unknown. Needed for passive safety only.
        """
        return None

    def without_drift(self, odometry: Odometry) -> Odometry:
        """Return odometry less the drift of its position, as estimated up to now."""
        return odometry

    def disturb(self, shock: Shock) -> None:
        """Account for a sudden change of the target's rates after the newest tick."""

    def change_body(self, body: TargetBody, covariance: Array) -> None:
        """Use another body for the target from the newest tick on, after a latch change or a
        refinement of its mass properties.

        covariance (9, 9): of the centre of mass (m) and the inertia (kg m²; xx, yy, zz, xy, xz,
        yz). Raises ValueError for an inertia that no rigid body has.
        """


NO_ESTIMATE_VARIANCE = 1e6
"""Variance of each component without an estimate, m² or rad²: nothing is known within 1 km."""


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
