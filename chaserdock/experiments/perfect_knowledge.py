# SPDX-License-Identifier: Apache-2.0
"""An estimator that knows a prescribed target exactly, so that the errors that remain are the
controller's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_controller.estimation.types import (
    EstimatorEvent,
    Matrix3,
    Measurement,
    Shock,
    TargetState,
)
from chaserdock_controller.guidance.reference import predict_target
from chaserdock_protocol.scenario.bodies import Target

_VARIANCE = 1e-12
"""Variance of every number (SI units): nothing, but positive, as a covariance must be."""


class PerfectEstimator:
    """The ``Estimator`` of a target with prescribed motion; it ignores measurements.

    Raises ValueError for a ``torque_free`` target, whose motion has no closed form.
    """

    accepted = gated = late_dropped = reinitialisations = 0

    def __init__(self, target: Target) -> None:
        if target.motion == "torque_free":
            raise ValueError("target.motion: a perfect estimate needs constant_rates or static")
        still = np.zeros(3)
        self._start = (np.array(target.position_m), np.array(target.q_wxyz))
        moves = target.motion == "constant_rates"
        self._velocity = np.array(target.velocity_m_s) if moves else still
        self._omega = np.array(target.omega_rad_s) if moves else still

    def estimate_at(self, time_ns: int) -> TargetState:
        """Return the state at any time, with a variance of 1e-12 (SI units) of every number."""
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

    def update(self, measurements: Sequence[Measurement], now_ns: int) -> TargetState:
        """Return the state now."""
        return self.estimate_at(now_ns)

    def disturb(self, shock: Shock) -> None:
        """Do nothing: a push does not move a prescribed target."""

    def change_body(self, inertia: Matrix3, centre_trf_m: tuple[float, float, float]) -> None:
        """Do nothing: a prescribed target moves the same with chasers attached."""

    def drain_events(self) -> list[EstimatorEvent]:
        """Return no events."""
        return []
