# SPDX-License-Identifier: Apache-2.0
"""Parameters of the joint filter; docs/estimation.md derives the values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np
from chaserdock_models.arrays import Array, Matrix3, Vector3
from chaserdock_models.camera import Camera
from chaserdock_models.passive_safety import CoastNoise
from chaserdock_models.rigid_body import RigidBody
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.navigation import NavigationErrors
from chaserdock_protocol.scenario.planar import up_in_target
from chaserdock_protocol.scenario.schema import EstimatorSection

from chaserdock_controller.estimation.composite_body import stated_properties

Matrix9 = tuple[tuple[float, ...], ...]
BodyPrior = tuple[Matrix3, Vector3, Matrix9]
"""Inertia, centre of mass and their covariance, as in ``TargetParameters``."""

MODELS = ("constant_rates", "torque_free")
"""Models of the target's motion."""
GATE_CHI_SQUARE = 27.85634123601289
"""0.9999 quantile of the chi-square distribution with 6 degrees of freedom (tests compare with
SciPy).
"""
GATE_CHI_SQUARE_3 = 21.107513466160444
"""0.9999 quantile of the chi-square distribution with 3 degrees of freedom (tests compare with
SciPy).
"""
TARGET_NOISE = {"constant_rates": (5e-6, 5e-6), "torque_free": (1e-5, 1e-5)}
"""Process noise of the target by motion model: square roots of the spectral densities of white
acceleration (m/s²/√Hz) and angular acceleration (rad/s²/√Hz). A free target has none; the
values bound the filter's memory.
"""


class SightingNoise(NamedTuple):
    """Errors of sightings as ratios to the stated sigma."""

    white_ratio: float
    """White noise that has, averaged over seconds, the same effect as the true errors, which are
    partly correlated over about 0.5 s.
    """
    view_ratio: float
    """Error that persists while the view stays the same."""
    view_time_s: float
    """Time constant of the view."""
    units_time_s: float = 0.0
    """Averaging time of the stated covariances that define the unit of the view error; 0: the
    newest one defines it.
    """


SINGLE_MARKER = SightingNoise(white_ratio=1.8, view_ratio=0.3, view_time_s=25.0)
SEVERAL_MARKERS = SightingNoise(white_ratio=1.0, view_ratio=0.25, view_time_s=3.0)
"""Sightings of several markers, whose errors differ: those of the view are averaged."""
SHAPE = SightingNoise(white_ratio=1.0, view_ratio=1.6, view_time_s=30.0, units_time_s=15.0)
"""Sightings by shape: errors of geometry and shading change only with the view and are alike in the
images of several cameras (docs/markerless.md).
"""
DRAWN = SightingNoise(white_ratio=1.0, view_ratio=0.0, view_time_s=1.0)
"""Sightings without images, of markers or by `[ranging]`: the perception ``statistical`` draws
white errors of the stated size.
"""
BEARING = SightingNoise(white_ratio=1.0, view_ratio=1.0, view_time_s=25.0)
"""Bearings from images: light, markers and the pixel grid shift the centroid as long as the view
stays the same.
"""


@dataclass(frozen=True)
class LevelFloor:
    """A level floor. ``up_trf`` (3,): vertical in TRF, unit vector.

    Sigmas of a tick. Errors of a real floor persist, so they are larger than those: a slope of
    0.2 mrad that lasts for 100 ticks counts as much as 2 mrad in each.
    """

    up_trf: Vector3
    lean_rad: float = 2e-3
    """Slope of the floor, and of the body on it, per axis."""
    vertical_m_s: float = 1e-3
    """Vertical speed of TRF's or CRF's origin: 2 mrad of slope at 0.5 m/s."""
    lean_rate_rad_s: float = 1e-3
    """Rate about horizontal axes."""


@dataclass(frozen=True)
class TargetParameters:
    """What the filter assumes of the target, and when it starts, restarts and loses it.

    Raises ValueError for values out of range and for an unknown motion model.
    """

    motion_model: str = "constant_rates"
    """"constant_rates", or "torque_free": its inertia and centre of mass are estimated."""
    inertia_ratios: Matrix3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Inertia tensor in TRF (rows), up to a common factor."""
    centre_of_mass_trf_m: Vector3 = (0.0, 0.0, 0.0)
    body_covariance: Matrix9 = ()
    """Covariance (9, 9), rows, of the centre of mass (m) and of the elements xx, yy, zz, xy, xz,
    yz of ``inertia_ratios``. Empty: both are exact."""
    initial_velocity_m_s: float = 0.1
    """Sigma of the unknown velocity at the first sighting: three times that of the paper's target.
    """
    initial_omega_rad_s: float = 0.2
    """Sigma of the unknown rate at the first sighting, per axis: covers tumbles of 20 degrees/s."""
    single_marker_scale: float = 3.0
    """Factor on the sigma of a first pose from one marker, whose attitude is nearly ambiguous."""
    reinitialised_velocity_m_s: float = 0.03
    """Sigma added to the velocity at a restart. Small, because the pose has jumped, not the
    velocity.
    """
    reinitialised_omega_rad_s: float = 0.06
    """Sigma added to the rate at a restart."""
    sustained_rejections: int = 10
    """Consecutive ticks with most cameras rejected after which the pose is restarted."""
    ambiguity_log_odds: float = 10.0
    """Log odds at which the less likely of two hypotheses is dropped: wrong in 1 of 20,000 cases.
    """
    ambiguity_timeout_s: float = 5.0
    """Time after which the less likely hypothesis is dropped in any case."""
    tracking_s: float = 0.25
    """Age of the last accepted sighting beyond which the status is "predicting": three images."""
    lost_position_m: float = 0.2
    """Largest standard deviation of the position beyond which the target is lost."""
    lost_attitude_rad: float = math.radians(15.0)
    """Largest standard deviation of the attitude beyond which the target is lost."""
    buffer_s: float = 1.0
    """Sightings at most this much older than the newest tick are processed at their exposure."""

    def __post_init__(self) -> None:
        if self.motion_model not in MODELS:
            raise ValueError(
                f"unknown motion model {self.motion_model!r}; known: {', '.join(MODELS)}"
            )
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, float | int) and not 0.0 < value < math.inf:
                raise ValueError(f"{f.name} is out of range: {value}")
        if not all(math.isfinite(x) for x in self.centre_of_mass_trf_m):
            raise ValueError(f"centre_of_mass_trf_m is out of range: {self.centre_of_mass_trf_m}")
        if self.single_marker_scale < 1.0:
            raise ValueError(f"single_marker_scale must be at least 1: {self.single_marker_scale}")
        inertia = np.array(self.inertia_ratios, dtype=float)
        if inertia.shape != (3, 3) or not np.allclose(inertia, inertia.T):
            raise ValueError("inertia_ratios must be a symmetric 3 x 3 tensor")
        principal = np.linalg.eigvalsh(inertia)
        if principal[0] <= 0.0 or principal[2] > (principal[0] + principal[1]) * (1.0 + 1e-9):
            raise ValueError(
                "inertia_ratios: principal moments of inertia violate the triangle inequality"
            )

    @property
    def body_prior(self) -> BodyPrior:
        """Return what is known of the target's body without measurements."""
        return self.inertia_ratios, self.centre_of_mass_trf_m, self.body_covariance


@dataclass(frozen=True)
class JointParameters:
    """What the filter assumes of target, chasers and sensors, and when it uses a measurement."""

    target: TargetParameters
    body: RigidBody
    """Assumed mass properties of the chasers."""
    camera: Camera
    """As calibrated."""
    navigation: NavigationErrors
    """Errors of the chasers' sensors."""
    tick_s: float = 0.1
    """Time between ticks."""
    force_max_N: float = 1.0
    torque_max_N_m: float = 0.1

    control_force_share: float = 0.3
    """Sigma of a commanded impulse's effect, as a share of it. Errors of thrust, mass, inertia and
    alignment repeat at every tick; modelled as white noise they need a larger sigma.
    """
    control_torque_share: float = 0.5
    control_arm_m: float = 0.005
    """Offset of the commanded force from the centre of mass."""
    disturbance_force_N: float = 0.01
    """Force on a chaser in its body axes: sigma at the start."""
    disturbance_torque_N_m: float = 0.001
    disturbance_force_N_sqrt_s: float = 1e-3
    """Density of the random walk of this force."""
    disturbance_torque_N_m_sqrt_s: float = 1e-4
    lasting_force_N: float = disturbance_force_N
    """Size of this force without thrust, as far as it is known beforehand: sigma."""
    centre_of_mass_m: float = 0.005
    """Sigma of a chaser's centre of mass from the origin of CRF, per axis."""
    latched_acceleration_m_s2: float = 0.05
    """White acceleration of a chaser whose latch holds the target."""
    latched_acceleration_rad_s2: float = 0.1
    contact_velocity_m_s: float = 0.01
    """Sigma of the change of a chaser's velocity by a contact."""
    contact_omega_rad_s: float = 0.02
    floor_position_m: float = 2e-5
    """Sigma added to stated odometry, so that exact odometry gives no singular covariance."""
    floor_velocity_m_s: float = 2e-5
    floor_attitude_rad: float = 1e-5
    floor_omega_rad_s: float = 1e-5
    floor_sighting_m: float = 2e-5
    floor_sighting_rad: float = math.radians(0.002)
    target_noise: Mapping[str, tuple[float, float]] = field(default_factory=lambda: TARGET_NOISE)
    """See ``TARGET_NOISE``."""
    stack_noise: tuple[float, float] = (1e-4, 2e-4)
    """Process noise while chasers are latched: disturbances that they exert on the target.
    Following a constant 10 mN on 170 kg within 3 s needs a white acceleration of 1e-4.
    """
    ratio_memory: float = 1.0
    """Exponent by which measurements of the inertia of a torque-free target lose weight with time.
    """
    single_marker: SightingNoise = SINGLE_MARKER
    several_markers: SightingNoise = SEVERAL_MARKERS
    shape: SightingNoise = SHAPE
    """Errors of a sighting without markers."""
    gate_sighting: float = GATE_CHI_SQUARE
    gate_odometry: float = GATE_CHI_SQUARE_3
    unexpected_velocity_m_s: float = 0.003
    """Sigma of a change of a chaser's velocity within a tick that no command explains, such as by a
    stuck thruster: a third of the greatest change under commands. It is assumed only where the
    velocity does not fit otherwise.
    """
    unexpected_omega_rad_s: float = 0.05
    """The same of its rate. All of the greatest change, as a stuck thruster's torque exceeds
    commanded ones.
    """
    rejections_to_drop: int = 5
    """Consecutive rejections after which a channel is dropped, until it has fitted as often."""
    rejections_to_new_view: int = 3
    """Consecutive rejections of a chaser's sightings by shape after which they count as sightings
    of a new view with unknown error, if they then fit. The error can jump by several sigmas where
    the tracker renders its view again.
    """
    collective_rejections: int = 3
    """Consecutive rejections by most cameras after which the target's rates are widened."""
    collective_cameras: int = 3
    """Cameras with a sighting from which on most of them can outvote the estimate of a chaser: with
    fewer, the error may as well be that of the only chaser that disagrees."""
    iterated_updates: int = 5
    """Number of updates after a start of the target that are iterated, because they are far from
    linear.
    """
    iterations: int = 4
    overconfident_ticks: float = 30.0
    """Number of ticks over which the squared normalized innovation of odometry is averaged. It is
    reported as overconfident when the average exceeds its expectation by ``overconfident_ratio``.
    """
    overconfident_ratio: float = 2.5
    restart_after_s: float = 1.0
    """Time without odometry, or without a measurement that supports the estimate, after which a
    chaser is restarted from its odometry.
    """
    mean_motion_rad_s: float = 0.0
    """Mean motion of the target's orbit; 0 in free space. Chasers move by Clohessy-Wiltshire. The
    target stays at the origin of the Hill frame, where these forces vanish.
    """
    most_dense_chasers: int = 16
    """Largest number of chasers with a covariance of all errors (``covariance``): up to it a tick
    fits its period, and the flights that the accuracy was measured in have no more.
    """
    floor: LevelFloor | None = None
    """Floor on which all bodies are; None in space."""
    camera_turn_rad: float = field(init=False)
    """Prior of the camera's turn. An error of the principal point acts as a turn, to first order.
    """

    def __post_init__(self) -> None:
        n = self.navigation
        turn = math.hypot(n.camera_turn_rad, n.camera_centre_px / self.camera.fx_px)
        object.__setattr__(self, "camera_turn_rad", turn)

    def sighting_noise(self, markers: int) -> SightingNoise:
        """Return the errors of a sighting with this many markers; 0: a sighting by shape or
        ranging.
        """
        if markers == 0:
            return self.shape
        return self.single_marker if markers == 1 else self.several_markers

    @property
    def coast_noise(self) -> CoastNoise:
        """Return the process noise of a coast: that of the target, and that of the force.

        Over a coast the random walk of the force is replaced by a Gauss-Markov process that begins
        with the same density and does not exceed the force's size.
        """
        varying_s = 2.0 * (self.disturbance_force_N / self.disturbance_force_N_sqrt_s) ** 2
        return CoastNoise(
            self.target_noise[self.target.motion_model][0],
            self.lasting_force_N / self.body.mass_kg,
            varying_s,
        )

    @property
    def inertia(self) -> Vector3:
        """Return the chasers' principal moments of inertia, kg m²."""
        return self.body.inertia


def parameters_of(scenario: FlightScenario) -> JointParameters:
    """Return the parameters for a scenario."""
    target, body = scenario.target, scenario.chaser
    rate_hz, orbit = scenario.time.rate_hz, scenario.orbit
    xx, xy, xz, _, yy, yz, _, _, zz = target.inertia_tensor.reshape(-1).tolist()
    lasting_N = scenario.limits.passive_safety_force_N
    parameters = JointParameters(
        target=TargetParameters(
            motion_model="torque_free" if target.motion == "torque_free" else "constant_rates",
            inertia_ratios=((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)),
            centre_of_mass_trf_m=target.centre_of_mass_m,
            body_covariance=rows_of(stated_properties(scenario).covariance[1:, 1:]),
        ),
        body=body,
        camera=scenario.camera_model(),
        navigation=scenario.navigation.errors(),
        tick_s=1.0 / rate_hz,
        force_max_N=body.force_max_N,
        torque_max_N_m=body.torque_max_N_m,
        unexpected_velocity_m_s=body.force_max_N / body.mass_kg / rate_hz / math.sqrt(3.0),
        unexpected_omega_rad_s=math.sqrt(3.0) * body.torque_max_N_m / min(body.inertia) / rate_hz,
        lasting_force_N=JointParameters.lasting_force_N if lasting_N is None else lasting_N,
        mean_motion_rad_s=0.0 if orbit is None else orbit.elements.mean_motion_rad_s,
        target_noise=_target_noise(scenario.estimator),
        shape=SHAPE if scenario.ranging is None else BEARING,
        floor=_floor(scenario),
    )
    return _of_drawn(parameters) if scenario.perception.name == "statistical" else parameters


def _floor(scenario: FlightScenario) -> LevelFloor | None:
    """Return the floor on which the scenario's bodies are; None in space."""
    up = up_in_target(scenario)
    if up is None:
        return None
    x, y, z = up.tolist()
    return LevelFloor((x, y, z))


def _target_noise(estimator: EstimatorSection) -> dict[str, tuple[float, float]]:
    """Return the process noise of the target by motion model: the scenario's, where it states one,
    else the default.
    """
    stated = (estimator.target_acceleration_noise, estimator.target_angular_noise)
    return {
        model: (stated[0] or default[0], stated[1] or default[1])
        for model, default in TARGET_NOISE.items()
    }


def _of_drawn(parameters: JointParameters) -> JointParameters:
    """Return the parameters for sightings that are drawn with the stated covariance. The floor
    stays: it covers what no covariance states, such as errors of exposure times.
    """
    return replace(parameters, single_marker=DRAWN, several_markers=DRAWN, shape=DRAWN)


def rows_of(matrix: Array) -> Matrix9:
    """Return a matrix as rows of tuples, so that parameters can be compared and hashed."""
    return tuple(tuple(row) for row in matrix.tolist())


def rows_3(matrix: Array) -> Matrix3:
    """Return a matrix (3, 3) as rows."""
    a, b, c = matrix.tolist()
    return tuple(a), tuple(b), tuple(c)
