# SPDX-License-Identifier: Apache-2.0
"""What the mapper reads and finds.

TRF is fixed to the target and has the axes of WRF at the reference time of its motion. Its origin
lies on the axis of rotation; where along the axis is a convention.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class ImageTracks:
    """Points of one image of a chaser.

    ``position_w_m`` (3,), ``rotation`` (3, 3), IRF to WRF: optical centre and attitude of the
    camera by odometry and calibration. ``ids`` (n,): of tracks, per chaser. ``rays`` (n, 2):
    normalized coordinates of their ideal pixels. ``ages_s`` (n,): how long each was followed.
    """

    chaser: int
    time_s: float
    position_w_m: Array
    rotation: Array
    ids: IntArray
    rays: Array
    ages_s: Array


@dataclass(frozen=True)
class CameraUncertainty:
    """Standard deviations of a chaser's camera: constant errors against its calibration, and
    noise of its odometry, each per axis.
    """

    turn_rad: float
    shift_m: float
    focal_share: float
    attitude_noise_rad: float
    position_noise_m: float


@dataclass(frozen=True, eq=False)
class ConstantRates:
    """Motion at constant rates: at ``time_s`` the origin of TRF is at ``position_w_m`` (3,) and its
    axes are those of WRF. ``velocity_m_s`` (3,); ``omega_rad_s`` (3,), in WRF and in TRF alike.
    """

    time_s: float
    position_w_m: Array
    velocity_m_s: Array
    omega_rad_s: Array

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Return positions (n, 3), WRF, and rotations (n, 3, 3), TRF to WRF, at times (n,)."""
        after = np.asarray(time_s, dtype=float)[:, None] - self.time_s
        turned = rotations.to_matrix(rotations.exp(self.omega_rad_s * after))
        return self.position_w_m + self.velocity_m_s * after, turned

    def vector(self) -> Array:
        """Return position, velocity and rate (9,)."""
        return np.concatenate([self.position_w_m, self.velocity_m_s, self.omega_rad_s])

    def moved(self, step: Array) -> ConstantRates:
        """Return the motion whose `vector` differs by ``step`` (9,)."""
        p, v, w = np.split(self.vector() + step, 3)
        return ConstantRates(self.time_s, p, v, w)


class CameraViews(NamedTuple):
    """The m images of an adjustment: chaser (m,), time (m,), optical centre (m, 3), rotation
    (m, 3, 3), IRF to WRF.
    """

    chaser: IntArray
    time_s: Array
    position_w_m: Array
    rotation: Array


class Observations(NamedTuple):
    """The k points of an adjustment, by view: view (k,), landmark (k,), normalized coordinates
    (k, 2), key of the track (k,), weight (k,): standard deviation of a new point over that of this
    one, age (k,), s.
    """

    view: IntArray
    landmark: IntArray
    rays: Array
    track: IntArray
    weight: Array
    age_s: Array

    def part(self, chosen: NDArray[np.bool_]) -> Observations:
        """Return the chosen observations."""
        return Observations(
            self.view[chosen],
            self.landmark[chosen],
            self.rays[chosen],
            self.track[chosen],
            self.weight[chosen],
            self.age_s[chosen],
        )

    def by_landmark(self, place: IntArray, kept: NDArray[np.bool_]) -> Observations:
        """Return the observations of ``kept`` (n,) landmarks, with their places among these."""
        part = self.part(kept[self.landmark])
        return part._replace(landmark=place[part.landmark])


@dataclass(frozen=True, eq=False)
class MapEstimate:
    """Unknowns of an adjustment.

    ``cameras`` (chasers, 9): turn (3,) and shift (3,) in IRF, share of the focal length, against
    the calibration, and mean slide (2,) of the points that it follows, px/s. ``turns`` (m, 3): of
    each view against odometry, IRF. ``landmarks_m`` (n, 3), TRF. ``slides_px_s`` (q, 2): of the
    tracks of an adjustment, in the order of their keys, beside the mean slide.
    """

    motion: ConstantRates
    cameras: Array
    turns: Array
    landmarks_m: Array
    slides_px_s: Array = field(default_factory=lambda: np.zeros((0, 2)))
