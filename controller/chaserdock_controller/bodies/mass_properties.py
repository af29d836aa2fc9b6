# SPDX-License-Identifier: Apache-2.0
"""Mass, centre of mass and inertia of a body with their covariance; bodies are attached and
detached. Pure functions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.rigid_body import RigidBody

from .body_shape import INERTIA_ROWS, BodyShape, mass_covariance
from .target_body import TargetBody, attach_bodies

_BASIS = np.zeros((6, 3, 3))
for _k, (_i, _j) in enumerate(INERTIA_ROWS):
    _BASIS[_k, _i, _j] = _BASIS[_k, _j, _i] = 1.0


@dataclass(frozen=True, eq=False)
class MassProperties:
    """Mass properties of a body with the covariance (10, 10) of mass (kg), centre of mass (m) and
    inertia (xx, yy, zz, xy, xz, yz; kg m²).
    """

    body: TargetBody
    covariance: Array

    @property
    def values(self) -> Array:
        """Return mass, centre and inertia (10,), in the order of the covariance."""
        return properties_of(self.body)


def properties_of(body: TargetBody) -> Array:
    """Return mass, centre and inertia (10,) of a body."""
    inertia = [body.inertia_kg_m2[i, j] for i, j in INERTIA_ROWS]
    return np.array([body.mass_kg, *body.centre_trf_m, *inertia])


def body_of(values: Array) -> TargetBody:
    """Return the body with this mass, centre and inertia (10,)."""
    return TargetBody(float(values[0]), np.tensordot(values[4:], _BASIS, 1), values[1:4].copy())


def attach(
    target: MassProperties, chasers: Sequence[MountedChaser], body: RigidBody
) -> MassProperties:
    """Return the mass properties of a target with chasers fixed to it. Those of the chasers count
    as exact.

    Centre and inertia of the stack are not linear in the target's mass. With centre and inertia
    ratios well known and the mass to 30 %, the second-order term moves the centre by centimetres.
    The covariance contains that term about the estimate, 3 c c', where c is the curvature per sigma
    of the logarithm of the mass, the parameter that the filter of the stack estimates.
    """
    parts = _parts(chasers, body, 1.0)
    stack = _transformed(target, parts)
    variance = float(target.covariance[0, 0])
    if not parts or variance == 0.0:
        return stack
    sigma = math.sqrt(variance)
    by_mass, share = target.covariance[:, 0] / sigma, sigma / target.body.mass_kg
    ends = []
    for h in (math.sqrt(3.0), -math.sqrt(3.0)):
        values = target.values + h * by_mass
        values[0] = target.body.mass_kg * math.exp(h * share)
        ends.append(properties_of(attach_bodies(body_of(values), parts)))
    begin = stack.values
    curvature = (ends[0] + ends[1] - 2.0 * begin) / 6.0
    curvature[0] = begin[0] * math.log(ends[0][0] * ends[1][0] / begin[0] ** 2) / 6.0
    return MassProperties(stack.body, stack.covariance + 3.0 * np.outer(curvature, curvature))


def covariance_by_chasers(
    target: TargetBody,
    chasers: Sequence[MountedChaser],
    body: RigidBody,
    mass_share: float,
    centre_m: float,
) -> Array:
    """Return the covariance (10, 10) that uncertain chasers add to the mass properties of a stack.

    ``mass_share``: standard deviation of a chaser's mass, as a share. ``centre_m``: of its centre
    of mass, per axis.
    """
    total = np.zeros((10, 10))
    for k in range(len(chasers)):
        for change in (*np.diag([centre_m] * 3), None):
            ends = []
            for sign in (1.0, -1.0):
                parts = _parts(chasers, body, 1.0)
                mass, inertia, place, q = parts[k]
                if change is None:
                    scale = 1.0 + sign * mass_share
                    parts[k] = (scale * mass, scale * inertia, place, q)
                else:
                    parts[k] = (mass, inertia, place + sign * change, q)
                ends.append(properties_of(attach_bodies(target, parts)))
            half = (ends[0] - ends[1]) / 2.0
            total += np.outer(half, half)
    return total


def detach(
    stack: MassProperties, chasers: Sequence[MountedChaser], body: RigidBody
) -> MassProperties:
    """Return the mass properties of the target alone: those of the stack less its chasers."""
    return _transformed(stack, _parts(chasers, body, -1.0))


def _parts(
    chasers: Sequence[MountedChaser], body: RigidBody, sign: float
) -> list[tuple[float, Array, Array, Array]]:
    inertia = sign * np.asarray(body.inertia)
    return [(sign * body.mass_kg, inertia, c.position_m, c.q_wxyz) for c in chasers]


def _transformed(
    properties: MassProperties, parts: Sequence[tuple[float, Array, Array, Array]]
) -> MassProperties:
    values = properties.values
    steps = np.array([1e-3 * values[0], *[1e-4] * 3, *[1e-3] * 6])
    jacobian = np.empty((10, 10))
    for k, step in enumerate(steps):
        shift = np.zeros(10)
        shift[k] = step
        ends = [
            properties_of(attach_bodies(body_of(values + s * shift), parts)) for s in (1.0, -1.0)
        ]
        jacobian[:, k] = (ends[0] - ends[1]) / (2.0 * step)
    body = attach_bodies(properties.body, parts)
    return MassProperties(body, jacobian @ properties.covariance @ jacobian.T)


def prior_of(
    target: TargetBody, mass_share: float, inertia_share: float, centre_m: float
) -> MassProperties:
    """Return the stated mass properties of a target with a diagonal covariance.

    Standard deviations: ``mass_share`` of the mass; ``inertia_share`` of each element of the
    inertia, as a share of the mean moment; ``centre_m`` of the centre of mass per axis.
    """
    moment = float(np.trace(target.inertia_kg_m2)) / 3.0
    sigmas = [mass_share * target.mass_kg, *[centre_m] * 3]
    return MassProperties(target, np.diag(np.square([*sigmas, *[inertia_share * moment] * 6])))


def inertia_ratios(properties: MassProperties) -> tuple[Array, Array]:
    """Return the inertia over its trace (6,): xx, yy, zz, xy, xz, yz; and the covariance (6, 6)."""
    inertia = properties.values[4:]
    trace = float(inertia[:3].sum())
    jacobian = (np.eye(6) - np.outer(inertia / trace, [1.0, 1.0, 1.0, 0.0, 0.0, 0.0])) / trace
    return inertia / trace, jacobian @ properties.covariance[4:, 4:] @ jacobian.T


def with_shape(known: MassProperties, shape: BodyShape, covariance: Array) -> MassProperties:
    """Replace centre of mass and inertia ratios by those of ``shape``, with its ``covariance`` (8,
    8).

    Mass and trace of the inertia stay those of ``known``. The relative sigma of the trace is that
    of a moment in ``known``.
    """
    inertia = known.body.inertia_kg_m2
    trace = float(np.trace(inertia))
    values = known.values
    values[1:4] = shape.centre_m
    values[4:] = [trace * shape.inertia[row] for row in INERTIA_ROWS]
    total = np.zeros((10, 10))
    total[0, 0] = known.covariance[0, 0]
    total[1:, 1:] = mass_covariance(covariance, trace)
    share = 3.0 / trace * float(np.sqrt(np.mean(np.diag(known.covariance)[4:7])))
    total[4:, 4:] += share**2 * np.outer(values[4:], values[4:])
    return MassProperties(body_of(values), total)
