"""An estimator that knows the prescribed target exactly: what is left of an error then is the controller's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_protocol.scenario.bodies import Target

from chaserdock_controller.estimation.types import EstimatorEvent, Matrix3, Measurement, Shock, TargetState
from chaserdock_controller.guidance.reference import predict_target


class PerfectEstimator:
    """The `fusion.types.Estimator` of a target with prescribed motion, without any measurement.

    Raises ValueError for a ``torque_free`` target, whose motion has no closed form here.
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
        """The state at any time, with a covariance of 1e-12 (SI units) on the diagonal."""
        position, q = self._start
        positions, attitudes = predict_target(position, self._velocity, q, self._omega, [time_ns / 1e9])
        return TargetState(
            time_ns,
            positions[0],
            self._velocity,
            attitudes[0],
            self._omega,
            1e-12 * np.eye(12),
            "tracking",
            0,
            (),
        )

    def update(self, measurements: Sequence[Measurement], now_ns: int) -> TargetState:
        """The state now; measurements are not needed."""
        return self.estimate_at(now_ns)

    def disturb(self, shock: Shock) -> None:
        """Nothing to do: a prescribed target is not moved by a push."""

    def change_body(self, inertia: Matrix3, centre_trf_m: tuple[float, float, float]) -> None:
        """Nothing to do: a prescribed target moves the same whoever holds on to it."""

    def drain_events(self) -> list[EstimatorEvent]:
        """None, ever."""
        return []
