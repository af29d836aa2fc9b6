# SPDX-License-Identifier: Apache-2.0
"""Shape and centre of mass of a target that tumbles freely, from the poses that cameras measure. No I/O.

A free tumble shows the centre of mass and the ratios of the elements of the inertia, but not their scale. The filter is that of the
stack, without thrusters; every camera is fixed to TRF with a constant error, as those of chasers that keep their places are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario.navigation import NavigationErrors

from chaserdock_controller.estimation.types import Measurement

from .composite import CompositeIdentification, IdentificationParameters, MassProperties

_WALK_M, _WALK_RAD = 1e-4, 1e-4
"""Random walk of a camera's error per square root of a second."""
_FLOOR_RAD_S = 5e-6
"""Standard deviation of the change of the rate per tick, which covers the linearization over the first half turn."""
_GATE = 25.0
"""Largest squared distance of the better of two ambiguous poses in units of its covariance."""


class TumbleIdentification:
    """Filter for the free target; call ``step`` once per tick. ``start``: motion of TRF's origin, with errors of some mm/s."""

    def __init__(
        self,
        prior: MassProperties,
        cameras: Sequence[int],
        start: BodyState,
        errors: NavigationErrors,
        parameters: IdentificationParameters,
    ) -> None:
        mount_m = math.hypot(0.002, errors.camera_shift_m, 1.5 * errors.camera_turn_rad)
        mount_rad = math.hypot(0.002, errors.camera_turn_rad)
        parameters = replace(parameters, mount_m=mount_m, mount_rad=mount_rad, floor_omega_rad_s=_FLOOR_RAD_S)
        place = MountedChaser(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        self._filter = CompositeIdentification(
            prior,
            dict.fromkeys(cameras, place),
            dict.fromkeys(cameras, start),
            (),
            {i: np.zeros(0, dtype=bool) for i in cameras},
            replace(errors, gyro_bias_rad_s=0.0),
            parameters,
        )
        self._errors, self._share = errors, parameters.inertia_share
        self.nis = 0.0

    def step(self, measurements: Sequence[Measurement], step_s: float, first: bool = False) -> None:
        """Advance by ``step_s``, unless this is the first tick, and take the measurements of the tick."""
        if not first:
            self._filter.predict({}, step_s)
            self._filter.loosen_mounts(_WALK_M * math.sqrt(step_s), _WALK_RAD * math.sqrt(step_s))
        poses = {}
        for m in measurements:
            pose = self._pose(m)
            if pose is not None and m.chaser in self._filter.chasers:
                poses[m.chaser] = pose
        if self._filter.update_poses(poses) is not None:
            self.nis = self._filter.nis

    def disturb(self, velocity_m_s: float, omega_rad_s: float) -> None:
        """Widen the motion by an unknown shock with these standard deviations per axis."""
        self._filter.disturb(velocity_m_s, omega_rad_s)

    @property
    def target(self) -> MassProperties:
        """Return the mass properties of the target. Mass and scale of the inertia are those of the prior, as uncertain as in it:
        what the linearization seems to tell of the scale is removed."""
        found = self._filter.stack
        scale = np.concatenate([np.zeros(4), found.values[4:]])
        doubt = self._share**2 * np.outer(scale, scale)
        return MassProperties(found.body, found.covariance + doubt)

    @property
    def ratios(self) -> tuple[Array, Array]:
        """Return the inertia over its trace (6,), and the covariance (6, 6)."""
        return inertia_ratios(self._filter.stack)

    def _pose(self, m: Measurement) -> tuple[BodyState, Array] | None:
        """Return the measured pose of TRF that fits best, with the noise of the chaser's own pose; None if none fits."""
        e, motion = self._errors, self._filter.motion
        best, least = None, _GATE
        for h in m.hypotheses:
            range_m = float(np.linalg.norm(h.position_m - m.camera.position_m))
            turn = math.hypot(e.attitude_noise_rad, e.attitude_roll_noise_rad) / math.sqrt(2.0)
            own = np.square([*[math.hypot(e.position_noise_m, turn * range_m)] * 3, *[turn] * 3])
            covariance = h.covariance + np.diag(own) + 1e-12 * np.eye(6)
            state = BodyState(h.position_m, np.zeros(3), h.q_wxyz, np.zeros(3))
            cosine = min(1.0, abs(float(motion.q_wxyz @ h.q_wxyz)))
            far = (2.0 * math.acos(cosine)) ** 2 / (float(np.trace(covariance[3:, 3:])) + 0.02**2)
            if far < least:
                best, least = (state, covariance), far
        return best


def inertia_ratios(properties: MassProperties) -> tuple[Array, Array]:
    """Return the inertia over its trace (6,): xx, yy, zz, xy, xz, yz; and the covariance (6, 6)."""
    inertia = properties.values[4:]
    trace = float(inertia[:3].sum())
    jacobian = (np.eye(6) - np.outer(inertia / trace, [1.0, 1.0, 1.0, 0.0, 0.0, 0.0])) / trace
    return inertia / trace, jacobian @ properties.covariance[4:, 4:] @ jacobian.T
