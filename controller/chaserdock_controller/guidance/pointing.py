# SPDX-License-Identifier: Apache-2.0
"""Pointing: search pattern for the target, and manoeuvre that makes camera errors observable. Pure
functions of time; SI units, radians.
"""

from __future__ import annotations

import math

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, limited
from chaserdock_models.braking import brake_wrench
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario.bodies import Body
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import ArrayLike

SEARCH_RATE_RAD_S = math.radians(15.0)
"""Mean rate of the line of sight along a ring of the search."""
_RING_SHARE = 0.9
"""Each ring of the search is wider than the last by this share of the image's height, so that they
overlap.
"""
_WIDEST_RAD = math.radians(170.0)
_PAUSE_S, _BETWEEN_PAUSES_S = 8.0, 2.0
"""Longest pause of the turn while one image is searched, and least time of turning between two
pauses, s. An acquisition by shape takes up to 120 images; half a field of view passes in 2 s.
"""

CALIBRATION_S = 30.0
"""Duration of the calibration manoeuvre."""
_RAMP_S = 6.0
"""Time, s, in which the calibration's rotations grow and fade smoothly: a fifth of its duration."""
_ROLL, _YAW, _PITCH = math.radians(70.0), math.radians(12.0), math.radians(6.0)

# Attitude law of the search: a critically damped oscillator of 2 rad/s.
_STIFFNESS, _DAMPING = 4.0, 4.0
_STEP_S = 0.02
"""Interval, s, for the finite difference that gives the search's angular rate: 0.3 degrees at 15
degrees/s.
"""


def field_of_view(camera: Camera) -> tuple[float, float]:
    """Return width and height of the field of view, rad."""
    if camera.distorts:
        left, top, right, bottom = camera.angles_to_borders()
        return left + right, top + bottom
    return (
        2.0 * math.atan(camera.width_px / 2.0 / camera.fx_px),
        2.0 * math.atan(camera.height_px / 2.0 / camera.fy_px),
    )


def search_angles(time_s: float, width_rad: float, height_rad: float) -> tuple[float, float]:
    """Return yaw and pitch of the line of sight at ``time_s`` of a search, about Z and Y of the
    body at the start.

    The pattern is a sequence of ellipses about the first line of sight. After the k-th, everything
    within height/2 + k 0.9 height of it has been in the image. The last ellipse is repeated.
    """
    before, left_s, k = (0.0, 0.0), max(time_s, 0.0), 1
    while True:
        edge = min(height_rad * (0.5 + _RING_SHARE * k), _WIDEST_RAD)
        yaw, pitch = max(edge - width_rad / 2.0, 0.0), edge - height_rad / 2.0
        out_s = max(math.hypot(yaw - before[0], pitch - before[1]), 1e-6) / SEARCH_RATE_RAD_S
        # Circumference of an ellipse (S. Ramanujan, 1914).
        h = ((yaw - pitch) / (yaw + pitch)) ** 2
        round_s = (
            math.pi
            * (yaw + pitch)
            * (1.0 + 3.0 * h / (10.0 + math.sqrt(4.0 - 3.0 * h)))
            / SEARCH_RATE_RAD_S
        )
        if left_s < out_s:
            # Move out along the pitch axis, where the image is smallest.
            return 0.0, before[1] + (pitch - before[1]) * left_s / out_s
        left_s -= out_s
        if left_s < round_s or edge >= _WIDEST_RAD:
            phase = 2.0 * math.pi * left_s / round_s
            return yaw * math.sin(phase), pitch * math.cos(phase)
        left_s -= round_s
        before, k = (0.0, pitch), k + 1


def search_attitude(
    q_start_wxyz: ArrayLike, camera: Camera, time_s: float, planar: bool = False
) -> Array:
    """Return the attitude (4,), CRF to WRF, at ``time_s`` of a search that began at
    ``q_start_wxyz``.

    ``planar``: the chaser cannot pitch, and turns on about its Z.
    """
    yaw, pitch = SEARCH_RATE_RAD_S * time_s, 0.0
    if not planar:
        yaw, pitch = search_angles(time_s, *field_of_view(camera))
    return rotations.multiply(q_start_wxyz, rotations.exp([0.0, pitch, yaw]))


def facing(q_wxyz: ArrayLike, direction_w: ArrayLike) -> Array:
    """Return the attitude (4,), CRF to WRF, nearest to ``q_wxyz`` with +X along ``direction_w``
    (3,), which is not zero.
    """
    a = rotations.rotate(q_wxyz, [1.0, 0.0, 0.0])
    b = np.asarray(direction_w, dtype=float) / np.linalg.norm(np.asarray(direction_w, dtype=float))
    axis, cosine = rotations.cross(a, b), float(a @ b)
    size = float(np.linalg.norm(axis))
    if size < 1e-9:  # there already, or opposite: then about Z of the body
        axis, size = rotations.rotate(q_wxyz, [0.0, 0.0, 1.0]), 1.0
    angle = math.atan2(float(np.linalg.norm(rotations.cross(a, b))), cosine)
    return rotations.normalize(rotations.multiply(rotations.exp(axis / size * angle), q_wxyz))


def turning_wrench(odometry: Odometry, body: Body, q_wxyz: Array, q_soon_wxyz: Array) -> Array:
    """Return force and torque (6,), body axes, that brake and turn the chaser to ``q_wxyz`` (4,).
    The attitude moves to ``q_soon_wxyz`` in 0.02 s.
    """
    wrench = brake_wrench(odometry, body)
    error = rotations.log(rotations.multiply(rotations.conjugate(odometry.q_wxyz), q_wxyz))
    ahead = rotations.log(rotations.multiply(rotations.conjugate(q_wxyz), q_soon_wxyz)) / _STEP_S
    omega, inertia = np.array(odometry.omega_rad_s), np.array(body.inertia)
    torque = inertia * (_STIFFNESS * error + _DAMPING * (ahead - omega)) + rotations.cross(
        omega, inertia * omega
    )
    wrench[3:] = limited(torque, body.wrench_max[3:])
    return wrench


def search_wrench(
    odometry: Odometry, body: Body, camera: Camera, q_start_wxyz: Array, time_s: float
) -> Array:
    """Return force and torque (6,), body axes, of a chaser at ``time_s`` of its search."""
    now, soon = (
        search_attitude(q_start_wxyz, camera, time_s + dt, body.is_planar) for dt in (0.0, _STEP_S)
    )
    return turning_wrench(odometry, body, now, soon)


class SurveyPlace(Struct, frozen=True):
    """Where a chaser stays while an unknown target is mapped: position (3,) and attitude (4,), CRF
    to WRF, by its odometry.
    """

    position_m: Array
    q_wxyz: Array


class SearchProgress(Struct, frozen=True):
    """Progress of a chaser's search: the attitude at its beginning, and its pauses.

    ``paused_s``: total of all pauses. ``pause_s``: length of the present one. ``resumed_s``: end of
    the last one. ``updated_s``: time of this state.
    """

    q_start_wxyz: Array
    updated_s: float
    paused_s: float = 0.0
    pause_s: float = 0.0
    resumed_s: float = -math.inf

    def taken_up(self, now_s: float) -> SearchProgress:
        """Return the progress at ``now_s`` if the search has rested since the last update."""
        paused_s = self.paused_s + now_s - self.updated_s
        return replace(self, updated_s=now_s, paused_s=paused_s)

    def at(self, now_s: float, acquiring: bool | None) -> SearchProgress:
        """Return the progress at ``now_s``. ``acquiring``: the chaser searches an earlier image for
        the target.

        None: unknown, as no sighting has arrived; a pause continues.
        """
        step_s = now_s - self.updated_s
        if acquiring is None:
            acquiring = self.pause_s > 0.0
        begins = self.pause_s > 0.0 or now_s - self.resumed_s >= _BETWEEN_PAUSES_S
        if acquiring and begins and self.pause_s < _PAUSE_S:
            return replace(
                self,
                updated_s=now_s,
                paused_s=self.paused_s + step_s,
                pause_s=self.pause_s + step_s,
            )
        resumed_s = now_s if self.pause_s > 0.0 else self.resumed_s
        return replace(self, updated_s=now_s, pause_s=0.0, resumed_s=resumed_s)


def calibration_turns(times_s: ArrayLike) -> Array:
    """Return rotations (K, 4) of the body from its reference attitude at times (K,) of the
    calibration manoeuvre; identity before and after it.

    Rotation about the line of sight makes yaw and pitch of the mounting observable; small rotations
    about the other axes make roll observable. They are sines of one, two and three periods with
    smooth ends (fifth-degree polynomials).
    """
    t = np.clip(np.asarray(times_s, dtype=float), 0.0, CALIBRATION_S)
    x = np.clip(np.minimum(t, CALIBRATION_S - t) / _RAMP_S, 0.0, 1.0)
    window = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    phase = 2.0 * math.pi * t / CALIBRATION_S
    zero = np.zeros_like(t)
    roll = np.stack([window * _ROLL * np.sin(phase), zero, zero], axis=-1)
    aside = np.stack(
        [zero, window * _PITCH * np.sin(3.0 * phase), window * _YAW * np.sin(2.0 * phase)], axis=-1
    )
    return rotations.multiply(rotations.exp(roll), rotations.exp(aside))
