"""Gauss-Newton with Levenberg's damping on the weighted reprojection error of a pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_protocol.rotations import Array

# Refinement ends when a step has lowered the squared error by no more than the first share of it, or promises
# to lower it by no more than the second.
_LEAST_GAIN, _LEAST_PROMISE = 1e-5, 2e-6
_ZERO = np.zeros(3)


@dataclass(frozen=True)
class Pose:
    """Where a target is in the camera: ``position`` (3,) in IRF, metres; ``rotation`` (3, 3), TRF -> IRF."""

    position: Array
    rotation: Array


def rotation_matrix(rotation_vector: object) -> Array:
    """Rotation matrix (3, 3) of a rotation vector of three numbers, radians."""
    return np.asarray(cv2.Rodrigues(np.asarray(rotation_vector, dtype=float))[0], dtype=float)


def residual_of(
    matrix: Array, points: Array, pixels: Array, weight: Array, pose: Pose
) -> tuple[Array, Array] | None:
    """Weighted reprojection error (2n,) and its Jacobian (2n, 6) by a turn phi in the camera's axes and by
    position, R_true = exp([phi]x) R; None for points behind the camera.

    ``matrix`` (3, 3) of the camera; ``points`` (n, 3) in TRF, metres; ``pixels`` (n, 2), ideal; ``weight``
    (2n,): of each of their numbers.
    """
    turned = points @ pose.rotation.T
    if not float(turned[:, 2].min()) + float(pose.position[2]) > 1e-6:
        return None
    # Points turned beforehand: OpenCV's derivative by the rotation vector, taken at zero, is that by phi.
    projected, jacobian = cv2.projectPoints(turned, _ZERO, pose.position, matrix, None)
    return (np.ravel(projected) - pixels.ravel()) * weight, jacobian[:, :6] * weight[:, None]


def refine(matrix: Array, points: Array, pixels: Array, weight: Array, pose: Pose) -> Pose | None:
    """The pose of least weighted squared error near ``pose``; None when that has points behind the camera.
    Arguments as for `residual_of`."""
    found = residual_of(matrix, points, pixels, weight, pose)
    cost = math.inf if found is None else float(found[0] @ found[0])
    if found is None or not math.isfinite(cost):
        return None
    residual, jacobian = found
    damping = 1e-7
    for _ in range(20):
        gradient = residual @ jacobian
        information = jacobian.T @ jacobian
        information.ravel()[::7] = information.diagonal() * (1.0 + damping) + 1e-12
        step = -np.linalg.solve(information, gradient)
        trial = Pose(pose.position + step[3:], rotation_matrix(step[:3]) @ pose.rotation)
        # The gain that the linear model promises. A step, not one shortened by damping, that promises next to
        # nothing is the last one, and too short to be wrong: it need not be tried.
        if damping < 1e-3 and -float(step @ gradient) <= _LEAST_PROMISE * cost + 1e-12:
            return trial
        found = residual_of(matrix, points, pixels, weight, trial)
        new_cost = math.inf if found is None else float(found[0] @ found[0])
        if found is not None and new_cost <= cost:
            gain = cost - new_cost
            pose, cost = trial, new_cost
            residual, jacobian = found
            damping = max(damping * 0.1, 1e-9)
            if gain <= _LEAST_GAIN * cost + 1e-12:
                break
        else:
            damping *= 100.0
            if damping > 1e9:
                break
    return pose
