# SPDX-License-Identifier: Apache-2.0
"""Damp the tumble of a stack by one latched chaser whose controller is silent.

It uses the chaser's own odometry alone; no I/O. A thruster with unit force d at r fires against the
velocity of its own place, u = -d . (v + omega x r). The power that it gives to the stack is -f u,
never positive while u > 0: whatever the mass, the other chasers and their thrusters, the kinetic
energy falls. Thrusts are proportional to u, so that several chasers together do not overshoot;
below a deadband nothing fires.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.mounting import plume_free_thrusters
from chaserdock_protocol.scenario.thrusters import thrusts_max


@dataclass(frozen=True)
class DampingParameters:
    """Numbers of the damping law."""

    # Thrust per velocity of a thruster's place. Of 20, 60 and 120 the one that stopped two, three
    # and four chasers soonest.
    gain_N_s_per_m: float = 60.0
    # A thruster starts to fire above this velocity of its place (0.07 degrees/s at 0.4 m), or above
    # a multiple of the noise. Smaller: more propellant; larger: a faster residual tumble.
    fires_m_s: float = 0.0005
    # A thruster stops below this velocity: a fifth of the one above, so that it does not chatter.
    closes_m_s: float = 0.0001
    # Least start velocity, in standard deviations of the filtered velocity, so that noise fires
    # nothing.
    noise_share: float = 5.0
    # Velocity above which the filter is fast. Below it noise matters most, above it the delay does.
    slow_m_s: float = 0.005
    # Time constant of the slow filter.
    slow_s: float = 0.8
    # Time constant of the fast filter.
    fast_s: float = 0.3


_LAW = DampingParameters()


class LocalDamping:
    """Compute the damping thrusts of one chaser with a port.

    Call ``thrusts_N`` once a tick, and ``reset`` after a tick with another command.
    """

    def __init__(self, scenario: FlightScenario, chaser: int) -> None:
        body, errors = scenario.chaser, scenario.navigation.errors()
        ports = {p.chaser for p in scenario.docking.ports if p.chaser is not None}
        # It is not known which other chasers are latched: avoid the ports of all of them.
        self._free = plume_free_thrusters(scenario, ports)[chaser]
        self._wrenches = wrench_matrix(body.thrusters)
        self._full_N = thrusts_max(body.thrusters)
        arm_m = max(math.hypot(*t.position_m) for t in body.thrusters)
        noise_m_s = math.hypot(errors.velocity_noise_m_s, arm_m * errors.omega_noise_rad_s)
        share = _share(1.0 / scenario.time.rate_hz, _LAW.slow_s)
        filtered_m_s = noise_m_s * math.sqrt(share / (2.0 - share)) + arm_m * errors.gyro_bias_rad_s
        self.fires_m_s = max(_LAW.fires_m_s, _LAW.noise_share * filtered_m_s)
        self._closes_m_s = self.fires_m_s * _LAW.closes_m_s / _LAW.fires_m_s
        self.reset()

    def reset(self) -> None:
        """Forget the filtered motion."""
        self._rates: Array | None = None
        self._firing = np.zeros(len(self._full_N), dtype=bool)
        self._time_ns, self._thrusts_N = -1, np.zeros(len(self._full_N))

    def thrusts_N(self, odometry: Odometry) -> Array:
        """Return the thrusts (n,), N, that slow the stack; equal odometry gives equal thrusts."""
        if odometry.sim_time_ns == self._time_ns:
            return self._thrusts_N
        velocity = rotations.rotate_inverse(odometry.q_wxyz, odometry.velocity_m_s)
        rates = np.concatenate([velocity, odometry.omega_rad_s])
        if self._rates is not None:
            moving = float(np.abs(self._wrenches.T @ self._rates).max()) > _LAW.slow_m_s
            elapsed_s = (odometry.sim_time_ns - self._time_ns) * 1e-9
            share = _share(elapsed_s, _LAW.fast_s if moving else _LAW.slow_s)
            rates = self._rates + share * (rates - self._rates)
        # Velocity of a thruster's place along its force: d . (v + omega x r), by the transpose of
        # the wrench of unit thrusts.
        speeds = -self._wrenches.T @ rates
        self._firing = self._free & (
            speeds > np.where(self._firing, self._closes_m_s, self.fires_m_s)
        )
        thrusts = np.where(
            self._firing, np.minimum(_LAW.gain_N_s_per_m * speeds, self._full_N), 0.0
        )
        self._rates, self._time_ns, self._thrusts_N = rates, odometry.sim_time_ns, thrusts
        return thrusts


def _share(elapsed_s: float, constant_s: float) -> float:
    """Return the weight of a new sample in a first-order filter."""
    return 1.0 - math.exp(-elapsed_s / constant_s)
