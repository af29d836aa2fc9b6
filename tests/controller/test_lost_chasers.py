# SPDX-License-Identifier: Apache-2.0
"""Lost chasers: obstacles at the extrapolated position whose margin grows with time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.ingest.lost_chasers import (
    ABSENT_S,
    FIRST_M,
    FORGOTTEN_S,
    GROWTH_M_S,
    MOST_M,
    LossWatch,
    margin_m,
)
from chaserdock_controller.nmpc import NmpcInput
from chaserdock_controller.nmpc.lost_chasers import coasting, with_lost_chasers
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import propagate
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Odometry, OperatorCommand
from chaserdock_protocol.scenario import Scenario, load_scenario
from flight_cases import tick_inputs
from nmpc_cases import PARAMS

from chaserdock.experiments.perfect_knowledge import PerfectEstimator

ROOT = Path(__file__).resolve().parents[2]
Q = (1.0, 0.0, 0.0, 0.0)
STILL = (
    "target.position_m=[0,0,0]",
    "target.q_wxyz=[1,0,0,0]",
    "target.velocity_m_s=[0,0,0]",
    "target.omega_rad_s=[0,0,0]",
    "approach.max_speed_m_s=0.1",
)


def odometry(
    i: int, time_s: float, position_m: Any, velocity_m_s: Any = (0.0, 0.0, 0.0)
) -> Odometry:
    return Odometry(
        tick=round(time_s * 15),
        sim_time_ns=round(time_s * 1e9),
        chaser=i,
        position_m=tuple(position_m),
        velocity_m_s=tuple(velocity_m_s),
        q_wxyz=Q,
        omega_rad_s=(0.0, 0.0, 0.0),
    )


def test_margin_grows_and_is_bounded() -> None:
    margins = [margin_m(s) for s in np.linspace(0.0, FORGOTTEN_S, 50)]
    assert margins == sorted(margins)
    assert margins[0] == FIRST_M
    assert margin_m(10.0) == pytest.approx(FIRST_M + 10.0 * GROWTH_M_S)
    assert margins[-1] == MOST_M


def test_position_is_extrapolated_at_constant_velocity() -> None:
    last = odometry(1, 1.0, (1.0, 2.0, 3.0), (0.1, 0.0, -0.1))
    places = coasting(last, 3_000_000_000, np.array([0.0, 1.0]))
    np.testing.assert_allclose(places, [[1.2, 2.0, 2.8], [1.3, 2.0, 2.7]])


def test_loss_expiry_and_return_are_each_reported_once() -> None:
    watch, events = LossWatch(1), []
    assert watch.update(odometry(1, 0.0, Q[1:]), 0) is None
    for k in range(1, 200):
        now_s = 0.4 * k
        event = watch.update(None, round(now_s * 1e9))
        events += [] if event is None else [(round(now_s, 1), *event)]
    assert [(level, text.split(":")[0]) for _, level, text in events] == [
        ("warning", "chaser 1")
    ] * 2
    assert "lost" in events[0][2]
    assert "no obstacle any more" in events[1][2]
    assert events[0][0] == pytest.approx(0.4)
    assert events[1][0] > FORGOTTEN_S


def test_return_of_a_lost_chaser_is_reported() -> None:
    watch = LossWatch(0)
    watch.update(odometry(0, 79.0, Q[1:]), round(79e9))
    watch.update(None, round(81e9))
    back = watch.update(odometry(0, 81.1, Q[1:]), round(81.1e9))
    assert back == ("info", "chaser 0: odometry received again")


def test_chaser_is_absent_until_its_next_odometry() -> None:
    """Also without ticks in between, as for a controller that received nothing."""
    watch = LossWatch(1)
    assert not watch.is_absent(10**9)
    watch.update(odometry(1, 0.5, Q[1:]), 10**9)
    back_ns = round((0.75 + ABSENT_S) * 1e9)
    assert watch.is_absent(back_ns)
    watch.update(odometry(1, 0.75 + ABSENT_S, Q[1:]), back_ns)
    assert not watch.is_absent(back_ns)
    assert watch.is_absent(round(100e9))


def test_short_interruption_is_not_a_loss() -> None:
    watch, now_ns = LossWatch(0), round((1.0 + 0.9 * ABSENT_S) * 1e9)
    watch.update(odometry(0, 1.0, Q[1:]), 10**9)
    assert watch.update(None, now_ns) is None
    assert watch.obstacle(now_ns) is None


def test_problem_is_unchanged_without_lost_chasers() -> None:
    problem: Any = object()
    assert with_lost_chasers(problem, PARAMS, (), 0) is problem


@pytest.mark.parametrize("between", [0.35, np.array([[0.0, 0.4], [0.4, 0.0]])])
def test_lost_chaser_becomes_a_row_without_constraints_of_its_own(between: Any) -> None:
    params, n = replace(PARAMS, horizon_s=0.5), 2
    stages = params.stages
    problem = NmpcInput(
        states=np.zeros((n, 13)),
        references=np.zeros((n, stages + 1, 7)),
        u_ref=np.zeros((n, stages, 6)),
        target_positions=np.zeros((stages + 1, 3)),
        min_distance_target_m=np.full(n, 0.5),
        min_distance_chasers_m=between,
        input_max=np.ones((n, 6)),
        corridors=np.ones((n, stages + 1, 5)),
    )
    last = odometry(7, 1.0, (1.0, 0.0, 0.0), (0.1, 0.0, 0.0))
    extended = with_lost_chasers(problem, params, (last,), 2_000_000_000)
    assert extended.states.shape == (3, 13)
    np.testing.assert_allclose(extended.states[2, :6], [1.1, 0.0, 0.0, 0.1, 0.0, 0.0])
    np.testing.assert_allclose(extended.references[2, -1, :3], [1.15, 0.0, 0.0])
    rows = np.asarray(extended.min_distance_chasers_m)
    np.testing.assert_allclose(rows[2, :2], np.max(between) + margin_m(1.5))
    np.testing.assert_array_equal(rows, rows.T)
    np.testing.assert_allclose(rows[0, 1], 0.35 if np.ndim(between) == 0 else 0.4)
    assert extended.min_distance_target_m[2] == 0.0
    assert extended.input_max[2].max() <= 1e-3
    assert extended.corridors is not None
    assert not extended.corridors[2].any()


def nearest_m(scenario: Scenario, blind: bool) -> tuple[float, list[str]]:
    """Return the least distance of chaser 0 from chaser 1, whose odometry ends after 1 s, and the
    events.

    ``blind`` removes lost chasers from the problem.
    """
    flight = ControllerCore(scenario, lambda: 0.0, PerfectEstimator(scenario.target))
    if blind:
        for chaser in flight.ingest.chasers:
            chaser.loss.obstacle = lambda now_ns: None  # type: ignore[method-assign]
    timing, rate_hz = scenario.timing, scenario.time.rate_hz
    # On chaser 0's path. Wrenches act without latency.
    lost = np.array([0.0, -0.8, -0.1])
    x: Array = np.array([-1.0, 0.0, 0.0, *np.zeros(3), *Q, *np.zeros(3)])
    near_m, events = np.inf, []
    for tick in range(25 * rate_hz):
        now_ns = timing.tick_time_ns(tick)
        mine = Odometry(
            tick=tick,
            sim_time_ns=now_ns,
            chaser=0,
            position_m=vector(x[:3]),
            velocity_m_s=vector(x[3:6]),
            q_wxyz=vector(x[6:10]),
            omega_rad_s=vector(x[10:]),
        )
        here = {0: mine}
        if tick < rate_hz:
            here[1] = odometry(1, now_ns / 1e9, lost)
        commands: tuple[OperatorCommand, ...] = ()
        if tick == 2 * rate_hz:
            commands = (OperatorCommand(command="goto", chaser=0, offset_m=(1.0, -1.6, 0.0)),)
        out = flight.step(tick_inputs(tick, now_ns, here, (), commands))
        assert set(out.wrenches) == set(here)
        assert out.solver is not None
        assert len(out.solver.status) == len(out.solver.chasers) == len(here)
        assert [r.accepted for r in out.replies] == [True] * len(commands)
        events += [e.what for e in out.events]
        wrench = np.array([*out.wrenches[0].force_N, *out.wrenches[0].torque_N_m])
        x = propagate(x, wrench, scenario.chaser, 1.0 / rate_hz)
        near_m = min(near_m, float(np.linalg.norm(x[:3] - lost)))
    return near_m, events


@pytest.mark.slow
def test_other_chasers_avoid_the_lost_chaser() -> None:
    scenario = load_scenario(
        ROOT / "scenarios" / "two-chaser-tracking.toml", (*STILL, "timeline=[]")
    )
    limit_m = scenario.limits.min_distance_chasers_m
    avoiding_m, events = nearest_m(scenario, blind=False)
    blind_m, _ = nearest_m(scenario, blind=True)
    assert avoiding_m > limit_m
    assert blind_m < 0.8 * limit_m
    assert any("chaser 1: lost" in text for text in events)
