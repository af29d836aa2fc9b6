# SPDX-License-Identifier: Apache-2.0
"""Builders shared by the tests of trajectories, guidance and prediction."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from chaserdock_controller.guidance.phase_machine import PhaseMachine
from chaserdock_controller.guidance.trajectories import Motion
from chaserdock_controller.interfaces import Observation
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Odometry, Sighting
from chaserdock_protocol.scenario import Scenario, parse_scenario
from hypothesis import settings
from hypothesis import strategies as st

quick = settings(derandomize=True, deadline=None, max_examples=60)
points = st.tuples(*[st.floats(-3.0, 3.0, allow_subnormal=False)] * 3)
HALF = math.sqrt(0.5)


def scenario(**changes: Any) -> Scenario:
    values: dict[str, Any] = {
        "name": "test",
        "duration_s": 100.0,
        "navigation": {"grade": "exact"},
        "approach": {"dock_distance_m": 0.4, "max_speed_m_s": 0.03},
        "chasers": [
            {"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
            {"position_m": [0.0, -1.2, 0.0], "q_wxyz": [HALF, 0.0, 0.0, HALF]},
        ],
    }
    return parse_scenario(values | changes, "test")


def at(move: Motion, t: float) -> tuple[Array, Array, Array]:
    p, v, a = move.at(np.array([t]))
    return p[0], v[0], a[0]


def drain(guidance: PhaseMachine) -> list[tuple[int, str, str]]:
    """Return the phase changes since the last call: chaser, phase, detail."""
    return [(c.chaser, c.phase, c.detail) for c in guidance.drain_changes()]


def odometry(chaser: int = 0, tick: int = 0, time_ns: int = 0, **changes: Any) -> Odometry:
    values: dict[str, Any] = {
        "position_m": (1.0, 2.0, 3.0),
        "velocity_m_s": (0.03, -0.06, 0.0),
        "q_wxyz": (0.5, 0.5, 0.5, 0.5),
        "omega_rad_s": (0.01, 0.0, -0.02),
    }
    return Odometry(tick=tick, sim_time_ns=time_ns, chaser=chaser, **(values | changes))


def start(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=13)
    x[6:10] = rotations.normalize(x[6:10])
    return x


def observation_of(
    time_ns: int,
    odometry: Mapping[int, Odometry],
    sightings: tuple[Sighting, ...] = (),
    outdated: Mapping[int, Odometry] | None = None,
) -> Observation:
    """Return an observation of chasers without docking, thrusters or commands."""
    return Observation(
        tick=0, time_ns=time_ns, effective_ns=time_ns, odometry=odometry, invalid={}, lost={}, sightings=sightings,
        commands=(), docking={}, impulses={}, ahead=dict.fromkeys(odometry, ()), input_limits={}, isolated={}, events=(),
        thruster_impulses={}, last_commands={}, outdated=outdated or {},
    )  # fmt: skip
