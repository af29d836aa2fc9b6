# SPDX-License-Identifier: Apache-2.0
"""The scenario ``swap`` with perfect state: pairs on head-on courses pass each other around the
tumbling target.
"""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.estimation.composite_body import target_body
from chaserdock_controller.guidance.phases import Trigger
from chaserdock_controller.guidance.reference import predict_target
from chaserdock_controller.interfaces import TargetState
from chaserdock_controller.nmpc import kernels
from chaserdock_controller.nmpc.problem import model_of
from chaserdock_controller.parameters import nmpc_parameters
from chaserdock_models import rotations
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_protocol.scenario import load_scenario
from flight_cases import step
from harness import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st

TICK_S = 0.2


def fly_swap(seed: int, time_s: float = 100.0) -> tuple[float, float, float]:
    """Return the least chaser separation, the least target distance and the largest final error, m.

    The seed scatters the starts and the target's rotation axis; 0 is exactly head-on.
    """
    rng = np.random.default_rng(seed)
    scenario = load_scenario(ROOT / "scenarios/swap.toml")
    n, target = len(scenario.chasers), scenario.target
    velocity, omega = np.array(target.velocity_m_s), np.array(target.omega_rad_s)
    if seed:
        omega = rotations.rotate(rotations.normalize(rng.normal(size=4)), omega)
    flight = ControllerCore(scenario, lambda: 0.0)
    for chaser in flight.guidance.chasers:
        chaser.fire(Trigger.TARGET_ACQUIRED, 0.0)
    states = np.zeros((n, 13))
    for i in range(n):
        p, q = scenario.start_pose(i)
        states[i, :3] = p + (0.05 * rng.normal(size=3) if seed else 0.0)
        states[i, 6:10] = q
    model = model_of(nmpc_parameters(scenario), TICK_S / 4)
    least, nearest, ends = np.inf, np.inf, states[:, :3]
    at = np.zeros(3)
    for tick in range(round(time_s / TICK_S)):
        now_s = tick * TICK_S
        due = flight.guidance.fleet.due_commands(now_s)
        assert all(result.accepted for result in flight.guidance.fleet.apply(due, now_s))
        p, q = (a[0] for a in predict_target(at, velocity, [1.0, 0, 0, 0], omega, [now_s]))
        exact = TargetState(
            round(now_s * 1e9), p, velocity, q, omega, np.zeros((12, 12)), "tracking", n, ()
        )
        ids = tuple(range(n))
        horizon = flight.guidance.references.horizon(
            flight.guidance.chasers, exact, target_body(scenario), frozenset(), [None] * n
        )
        limits = np.tile(nmpc_parameters(scenario).input_limits(), (n, 1))
        problem = flight.planning.problem(horizon, states, limits)
        plan = flight.planning.solver.solve(problem, TICK_S if tick else 0.0, ids)
        assert "failed" not in plan.status
        x = np.empty((n, 5, 13))
        x[:, 0] = states
        held = np.repeat(plan.inputs[:, :1], 4, axis=1)
        kernels.roll(model, x, held)
        states = x[:, -1].copy()
        gaps = np.linalg.norm(states[:, None, :3] - states[None, :, :3], axis=-1) + 9.0 * np.eye(n)
        ends = problem.references[:, 0, :3]
        least = min(least, float(gaps.min()))
        nearest = min(nearest, float(np.linalg.norm(states[:, :3] - p, axis=-1).min()))
    for chaser in flight.guidance.chasers:
        step(chaser, time_s)
        assert chaser.phase == "hold"
    return least, nearest, float(np.linalg.norm(states[:, :3] - ends, axis=-1).max())


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_pairs_pass_each_other(seed: int) -> None:
    least, nearest, off = fly_swap(seed)
    assert least > 0.35
    assert nearest > 0.35
    assert off < 0.05


@settings(derandomize=True, deadline=None, max_examples=60)
@given(st.integers(0, 10_000), st.floats(0.2, 3.0))
def test_facing_attitude_keeps_line_of_sight_in_body_frame(seed: int, far: float) -> None:
    """The direction to the target in the body frame is the same at any offset."""
    rng = np.random.default_rng(seed)
    nominal, q = rng.normal(size=3), rotations.normalize(rng.normal(size=4))
    offsets = np.vstack([far * rng.normal(size=(3, 3)), -nominal, 2.0 * nominal])
    turned = facing_attitudes(nominal, q, offsets)
    before = rotations.rotate_inverse(q, nominal / np.linalg.norm(nominal))
    for offset, attitude in zip(offsets, turned, strict=True):
        after = rotations.rotate_inverse(attitude, offset / np.linalg.norm(offset))
        np.testing.assert_allclose(after, before, atol=1e-9)
    assert rotations.angle_between(turned[-1], q) < 1e-7
