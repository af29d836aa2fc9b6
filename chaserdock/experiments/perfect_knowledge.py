# SPDX-License-Identifier: Apache-2.0
"""Estimator that knows a prescribed target exactly, so that the remaining errors are the
controller's.
"""

from __future__ import annotations

import numpy as np
from chaserdock_controller.estimation.types import Estimate, Estimator, EstimatorInputs
from chaserdock_controller.guidance.reference import predict_target
from chaserdock_controller.interfaces import TargetState
from chaserdock_protocol.scenario.bodies import Target

_VARIANCE = 1e-12
"""Variance of every component (SI units): negligible, but positive, as a covariance requires."""


class PerfectEstimator(Estimator):
    """Returns the prescribed motion of the target, whatever is measured.

    Raises ValueError for a ``torque_free`` target, whose motion has no closed form.
    """

    def __init__(self, target: Target) -> None:
        if target.motion == "torque_free":
            raise ValueError("target.motion: a perfect estimate needs constant_rates or static")
        still = np.zeros(3)
        self._start = (np.array(target.position_m), np.array(target.q_wxyz))
        moves = target.motion == "constant_rates"
        self._velocity = np.array(target.velocity_m_s) if moves else still
        self._omega = np.array(target.omega_rad_s) if moves else still

    def estimate_at(self, time_ns: int) -> TargetState:
        """Return the state at any time, with ``_VARIANCE`` for every component."""
        position, q = self._start
        positions, attitudes = predict_target(
            position, self._velocity, q, self._omega, [time_ns / 1e9]
        )
        covariance = _VARIANCE * np.eye(12)
        return TargetState(
            time_ns,
            positions[0],
            self._velocity,
            attitudes[0],
            self._omega,
            covariance,
            "tracking",
            0,
            (),
        )

    def update(self, inputs: EstimatorInputs) -> Estimate:
        """Return the present state. Pushes and latched chasers do not move a prescribed target."""
        return Estimate(self.estimate_at(inputs.time_ns))
