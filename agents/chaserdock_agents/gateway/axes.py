# SPDX-License-Identifier: Apache-2.0
"""Convert poses of devices to WRF and to CRF or TRF, and wrenches to the axes of a robot.

WRF is a world with z up (ENU), CRF a body with x forward and z up (FLU). No I/O.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario.lab import LabPose

from .devices import PoseSample

_ENU_OF_NED = rotations.normalize([0.0, 1.0, 1.0, 0.0])
"""Rotation NED to ENU: half a turn about the line between north and east."""
_FLU_OF_FRD = np.array([0.0, 1.0, 0.0, 0.0])
"""Rotation FRD to FLU: half a turn about the x axis."""


@dataclass(frozen=True, eq=False)
class MeasuredPose:
    """Measured pose of a body at ``time_ns`` of the host's clock.

    position_m (3,) in WRF, q_wxyz (4,) CRF (or TRF) to WRF, velocity_m_s (3,) of its origin in WRF
    and omega_rad_s (3,) in CRF, None where not measured. Covariances (3, 3): of position in WRF, of
    attitude in CRF.
    """

    time_ns: int
    position_m: Array
    q_wxyz: Array
    position_covariance_m2: Array
    attitude_covariance_rad2: Array
    velocity_m_s: Array | None = None
    omega_rad_s: Array | None = None


def why_unusable(sample: PoseSample) -> str:
    """Return why a sample is no pose; empty if it is one."""
    parts = (sample.position_m, sample.q_wxyz, sample.velocity_m_s, sample.omega_rad_s)
    shapes = ((3,), (4,), (3,), (3,))
    for part, shape in zip(parts, shapes, strict=True):
        if part is not None and (np.shape(part) != shape or not np.isfinite(part).all()):
            return "not finite numbers of the right count"
    length = float(np.linalg.norm(sample.q_wxyz))
    if abs(length - 1.0) > 1e-2:
        return f"its quaternion has length {length:.3g}, not 1"
    if sample.covariance is not None and np.shape(sample.covariance) != (6, 6):
        return f"its covariance has shape {np.shape(sample.covariance)}, not (6, 6)"
    return ""


def body_pose(sample: PoseSample, device: LabPose, time_ns: int) -> MeasuredPose:
    """Return a usable sample in WRF and CRF (or TRF), at a time of the host's clock."""
    to_world = _ENU_OF_NED if device.world_axes == "ned" else rotations.IDENTITY
    to_flu = _FLU_OF_FRD if device.body_axes == "frd" else rotations.IDENTITY
    # Measured body's own axes to WRF; the mounting is stated in these axes.
    q_body = rotations.multiply(to_world, rotations.normalize(sample.q_wxyz))
    mount_m, q_mount = np.array(device.position_m), np.array(device.q_wxyz)
    q = rotations.multiply(q_body, rotations.multiply(rotations.conjugate(to_flu), q_mount))
    arm_m = rotations.rotate(rotations.conjugate(to_flu), mount_m)
    position = rotations.rotate(to_world, sample.position_m) + rotations.rotate(q_body, arm_m)
    velocity, omega = sample.velocity_m_s, sample.omega_rad_s
    if velocity is not None:
        velocity = rotations.rotate(to_world, velocity)
        if omega is not None:
            velocity = velocity + rotations.rotate(q_body, np.cross(omega, arm_m))
    to_crf = rotations.conjugate(rotations.multiply(rotations.conjugate(to_flu), q_mount))
    position_noise, attitude_noise = _noise(sample, device, to_world, to_crf)
    return MeasuredPose(
        time_ns,
        position,
        q,
        position_noise,
        attitude_noise,
        velocity,
        None if omega is None else rotations.rotate(to_crf, omega),
    )


def _noise(
    sample: PoseSample, device: LabPose, to_world: Array, to_crf: Array
) -> tuple[Array, Array]:
    """Return the covariances of position (WRF) and attitude (CRF): the device's, or the
    scenario's where it states none that is positive.
    """
    stated = sample.covariance
    if stated is None or not (np.isfinite(stated).all() and (np.diag(stated) > 0.0).all()):
        attitude = np.radians(device.sigma_deg) ** 2
        return np.eye(3) * device.sigma_m**2, np.eye(3) * attitude
    world, crf = rotations.to_matrix(to_world), rotations.to_matrix(to_crf)
    return world @ stated[:3, :3] @ world.T, crf @ stated[3:, 3:] @ crf.T


def robot_axes(body_axes: str) -> Callable[[Array], Array]:
    """Return the function that turns a vector (3,) in CRF to the axes of a robot."""
    if body_axes == "flu":
        return lambda vector: vector
    return lambda vector: vector * np.array([1.0, -1.0, -1.0])
