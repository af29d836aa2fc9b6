# SPDX-License-Identifier: Apache-2.0
"""Parameters of the joint filter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from chaserdock_models.arrays import Vector3
from chaserdock_models.camera import Camera
from chaserdock_models.rigid_body import RigidBody
from chaserdock_protocol.scenario.navigation import NavigationErrors

from chaserdock_controller.estimation.parameters import GATE_CHI_SQUARE, MekfParameters

GATE_CHI_SQUARE_3 = 21.107513466160444
"""0.9999 quantile of the chi-square distribution with 3 degrees of freedom (tests compare with
SciPy).
"""

TARGET_NOISE = {"constant_rates": (5e-6, 5e-6), "torque_free": (1e-5, 1e-5)}


class SightingNoise(NamedTuple):
    """Errors of sightings as ratios to the stated sigma.

    white_ratio: of white noise with the same effect on an average over seconds as the true errors, half of which are correlated
        over about 0.5 s. view_ratio: of an error that persists while the view stays the same, with the time constant
        ``view_time_s``. units_time_s: the persistent error is a ratio to the mean of the stated covariances over so long; 0: to the
        newest one.
    """

    white_ratio: float
    view_ratio: float
    view_time_s: float
    units_time_s: float = 0.0


SINGLE_MARKER = SightingNoise(white_ratio=1.8, view_ratio=0.22, view_time_s=25.0)
SEVERAL_MARKERS = SightingNoise(white_ratio=0.85, view_ratio=1.3, view_time_s=3.0)
# Errors of geometry and shading change only with the view, and are alike in the images of several
# cameras (docs/markerless.md).
SHAPE = SightingNoise(white_ratio=1.0, view_ratio=1.6, view_time_s=30.0, units_time_s=15.0)
# Without images, range, bearing and attitude of `[ranging]` have white errors of the stated size.
RANGING = SightingNoise(white_ratio=1.0, view_ratio=0.0, view_time_s=1.0)
# A bearing from an image: light, markers and the pixel grid shift the centroid as long as the view
# stays the same.
BEARING = SightingNoise(white_ratio=1.0, view_ratio=1.0, view_time_s=25.0)


@dataclass(frozen=True)
class JointParameters:
    """Parameters of ``JointEstimator``; docs/estimation.md gives the reasons for the values.

    target: motion model, initial sigmas and thresholds of the target; the filter uses none of its camera errors and noises.
    body: assumed mass properties of the chasers. camera: as calibrated. navigation: errors of the chasers' sensors.
    control_force_share, control_torque_share: sigma of a commanded impulse's effect, as a share of it; control_arm_m:
        offset of the force from the centre of mass. They cover errors of thrust, mass, inertia and alignment, which are the
        same at every tick: as white noise they are larger.
    disturbance_*: force and torque on a chaser in its body axes: sigma at the start, and density of the random walk.
    centre_of_mass_m: sigma of a chaser's centre of mass from the origin of CRF, per axis.
    latched_*: white acceleration of a chaser whose latch holds the target.
    contact_*: sigma of the change of a chaser's rates by a contact.
    floor_*: sigmas added to stated odometry, so that exact odometry gives no singular covariance.
    target_noise: square roots of the spectral densities of the target's white acceleration (m/s²/√Hz) and angular acceleration
        (rad/s²/√Hz), by motion model. Of a torque-free target the inertia is estimated.
    stack_noise: the same of the disturbances that latched chasers exert on the target. A constant one of 10 mN on 170 kg, which is
        to be followed within 3 s, is like white acceleration of 1e-4 m/s²/√Hz.
    ratio_memory: exponent by which measurements of the inertia of a torque-free target lose weight with time.
    single_marker, several_markers: errors of a sighting with one marker, and with several smaller ones, whose corners depend
        more on the pixel grid. shape: errors of a sighting of the target's shape, without markers.
    unexpected_velocity_m_s, unexpected_omega_rad_s: sigma of a change of a chaser's rates within a tick that no command explains,
        as by a stuck thruster: for the velocity about a third of the greatest change under commands; for the rate all of it, as
        the torque of a stuck thruster exceeds that of commands. It is assumed only where velocity or rate does not fit otherwise.
    rejections_to_drop: a channel that is rejected this many times in a row is not used until it fits again as often.
    rejections_to_new_view: a chaser's sightings by shape that are rejected this many times in a row are taken for those of a new
        view, whose error is unknown, if they then fit: where the tracker renders its view again, its error can jump by several sigmas.
    collective_rejections: rejections in a row by most cameras after which the target's rates are widened.
    restart_after_s: a chaser whose odometry was missing, or whose estimate no measurement supported, for so long is started again
        from its odometry.
    iterated_updates, iterations: the first updates after a start of the target are iterated, as they are far from linear.
    mean_motion_rad_s: of the target's orbit; 0 in free space. Chasers move by Clohessy-Wiltshire; the target stays at the
        origin of the Hill frame, where these forces vanish.
    overconfident_ticks, overconfident_ratio: odometry is reported as overconfident when its squared normalized
        innovation, averaged over so many ticks, exceeds its expectation by this factor.
    """

    target: MekfParameters
    body: RigidBody
    camera: Camera
    navigation: NavigationErrors
    force_max_N: float = 1.0
    torque_max_N_m: float = 0.1
    control_force_share: float = 0.3
    control_torque_share: float = 0.5
    control_arm_m: float = 0.005
    disturbance_force_N: float = 0.01
    disturbance_torque_N_m: float = 0.001
    disturbance_force_N_sqrt_s: float = 1e-3
    disturbance_torque_N_m_sqrt_s: float = 1e-4
    centre_of_mass_m: float = 0.005
    latched_acceleration_m_s2: float = 0.05
    latched_acceleration_rad_s2: float = 0.1
    contact_velocity_m_s: float = 0.01
    contact_omega_rad_s: float = 0.02
    floor_position_m: float = 2e-5
    floor_velocity_m_s: float = 2e-5
    floor_attitude_rad: float = 1e-5
    floor_omega_rad_s: float = 1e-5
    floor_sighting_m: float = 2e-5
    floor_sighting_rad: float = math.radians(0.002)
    target_noise: Mapping[str, tuple[float, float]] = field(default_factory=lambda: TARGET_NOISE)
    stack_noise: tuple[float, float] = (1e-4, 2e-4)
    ratio_memory: float = 1.0
    single_marker: SightingNoise = SINGLE_MARKER
    several_markers: SightingNoise = SEVERAL_MARKERS
    shape: SightingNoise = SHAPE
    gate_sighting: float = GATE_CHI_SQUARE
    gate_odometry: float = GATE_CHI_SQUARE_3
    unexpected_velocity_m_s: float = 0.003
    unexpected_omega_rad_s: float = 0.05
    rejections_to_drop: int = 5
    rejections_to_new_view: int = 3
    collective_rejections: int = 3
    iterated_updates: int = 5
    iterations: int = 4
    overconfident_ticks: float = 30.0
    overconfident_ratio: float = 2.5
    restart_after_s: float = 1.0
    mean_motion_rad_s: float = 0.0
    camera_turn_rad: float = field(init=False)

    def __post_init__(self) -> None:
        """Derive the prior of the camera's turn: an error of the principal point acts as a turn, to
        first order.
        """
        n = self.navigation
        turn = math.hypot(n.camera_turn_rad, n.camera_centre_px / self.camera.fx_px)
        object.__setattr__(self, "camera_turn_rad", turn)

    def sighting_noise(self, markers: int) -> SightingNoise:
        """Return the errors of a sighting of this many markers, 0 for one by shape or by ranging."""
        if markers == 0:
            return self.shape
        return self.single_marker if markers == 1 else self.several_markers

    @property
    def inertia(self) -> Vector3:
        """Return the chasers' principal moments of inertia, kg m²."""
        return self.body.inertia
