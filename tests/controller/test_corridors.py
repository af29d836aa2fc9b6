# SPDX-License-Identifier: Apache-2.0
"""Approach corridors in flight: who is planned in one, when, and what it does to the plan."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.guidance.approach_cone import (
    BESIDE_LINE_M,
    Cone,
    cone_about,
    cone_of,
    corridor_rows,
)
from chaserdock_controller.guidance.fleet import ChaserFleet
from chaserdock_controller.guidance.phases import Phase
from chaserdock_controller.interfaces import TickOutputs
from chaserdock_models import rotations
from chaserdock_protocol.messages import OperatorCommand
from docking_cases import scenario as capture_scenario
from docking_cases import senses
from flight_cases import fleet_of, odometry, order, quick, scenario, tick_inputs
from hypothesis import given
from hypothesis import strategies as st
from nmpc_cases import PARAMS, at_rest, fixed_problem, fresh

from chaserdock.experiments.flight_record import record_flight
from chaserdock.experiments.perfect_knowledge import PerfectEstimator

LIMIT_M = 0.35
NEAR = {"approach": {"dock_distance_m": 0.25, "max_speed_m_s": 0.03}}


@given(st.integers(0, 10_000))
@quick
def test_the_cone_is_the_one_that_the_solver_keeps(seed: int) -> None:
    """Turned with the target, the row gives the solver the same room as the cone has in the
    target's frame.
    """
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    cone = cone_about(
        axis / np.linalg.norm(axis), rng.uniform(0.2, 0.8), 0.1, rng.uniform(0.1, 1.3)
    )
    target, q, offsets = (
        rng.normal(size=3),
        rotations.normalize(rng.normal(size=4)),
        rng.normal(size=(2, 3)),
    )
    places = target + rotations.rotate(q, offsets)
    problem = fixed_problem(
        np.array([at_rest(p) for p in places]), places, d_target=0.0, d_chasers=0.0
    )
    rows = corridor_rows([None, cone], np.tile(q, (2, 1)))
    assert rows is not None
    assert not rows[0].any()
    problem = replace(
        problem,
        references=problem.references[:, :2],
        u_ref=problem.u_ref[:, :1],
        target_positions=np.tile(target, (2, 1)),
        corridors=rows,
    )
    deep = fresh("rti", 2, replace(PARAMS, horizon_s=0.1)).solve(problem, 0.0).max_violation_m
    assert deep[0] == 0.0
    assert deep[1] == pytest.approx(max(0.0, -cone.room_m(offsets[1])), abs=1e-6)


def test_the_cone_is_as_wide_as_said_where_said() -> None:
    cone = cone_about([0.0, 1.0, 0.0], 0.4, 0.1, math.radians(20.0))
    assert cone.room_m([0.1, 0.4, 0.0]) == pytest.approx(0.0, abs=1e-12)
    assert cone.room_m([0.0, 0.4, 0.0]) > 0.0
    assert cone.room_m([0.0, -0.4, 0.0]) < 0.0
    wider = 0.1 + 0.6 * math.tan(math.radians(20.0))
    assert cone.room_m([0.0, 1.0, wider]) == pytest.approx(0.0, abs=1e-12)
    assert corridor_rows([None, None], np.zeros((2, 4))) is None


@pytest.mark.parametrize(("axis", "angle"), [([0, 2, 0], 0.3), ([0, 1, 0], 0.0), ([0, 1, 0], 1.6)])
def test_invalid_cones_are_refused(axis: list[float], angle: float) -> None:
    with pytest.raises(ValueError, match="must"):
        cone_about(axis, 0.4, 0.1, angle)


def test_every_way_into_a_port_lies_in_its_cone() -> None:
    """From the entry to behind the port, with the corridor's own tolerance about it."""
    mission = capture_scenario(4)
    for i, port in enumerate(mission.docking.ports):
        cone, axis = cone_of(mission, i), np.asarray(port.axis)
        aside = np.cross(axis, [0.6, 0.48, 0.64])
        aside *= mission.docking.corridor.lateral_m / np.linalg.norm(aside)
        for gap in np.linspace(-mission.docking.overdrive_m, mission.docking.entry_m, 9):
            centre = np.asarray(port.position_m) + axis * (mission.chaser.probe_reach_m + gap)
            assert min(cone.room_m(centre + aside), cone.room_m(centre - aside)) > 0.0


def approaching(**changes: Any) -> ChaserFleet:
    guidance = fleet_of(scenario(**NEAR | changes), acquired_s=0.0)
    assert order(guidance, OperatorCommand(command="approach", chaser=0), 1.0).accepted
    return guidance


def test_approaching_chaser_has_a_corridor_and_others_the_spherical_keep_out() -> None:
    guidance = approaching()
    assert guidance.chasers[0].corridor() is None  # nobody knows yet where it is
    for i, place in enumerate(([-1.0, 0.0, 0.0], [0.0, -1.2, 0.0])):
        guidance.chasers[i].position_m = np.array(place)
    assert isinstance(guidance.chasers[0].corridor(), Cone)
    assert guidance.chasers[0].min_distance_target_m() == pytest.approx(0.25 - 0.03)
    assert guidance.chasers[1].corridor() is None
    assert guidance.chasers[1].min_distance_target_m() == LIMIT_M


def test_chaser_that_left_its_corridor_keeps_the_spherical_keep_out() -> None:
    guidance = approaching()
    for aside, inside in ((BESIDE_LINE_M, True), (0.35, False)):
        guidance.chasers[0].position_m = np.array([-0.4, aside, 0.0])
        assert (guidance.chasers[0].corridor() is not None) == inside
        assert (guidance.chasers[0].min_distance_target_m() < LIMIT_M) == inside


@pytest.mark.parametrize("what", ["hold", "retreat", "abort"])
def test_the_corridor_lasts_until_the_way_out_is_over(what: Any) -> None:
    guidance = approaching()
    guidance.chasers[0].position_m = np.array([-0.3, 0.0, 0.0])
    assert order(guidance, OperatorCommand(command=what, chaser=0), 30.0).accepted
    assert guidance.chasers[0].corridor() is not None
    guidance.chasers[0].position_m = np.array([-0.36, 0.0, 0.0])
    assert guidance.chasers[0].corridor() is None
    assert guidance.chasers[0].min_distance_target_m() == LIMIT_M


def test_by_capture_the_corridor_is_there_in_the_corridor_and_gone_when_latched() -> None:
    guidance = fleet_of(capture_scenario(2), acquired_s=0.0)
    chaser = guidance.chasers[0]
    place = np.array([-0.7, 0.0, -0.05])
    seen: dict[str, bool] = {}
    for phase in map(
        Phase, ("hold", "align", "approach", "final", "contact", "latched", "verified", "retreat")
    ):
        chaser.state = replace(chaser.state, phase=phase)
        outside = np.array([-1.0, 0.0, -0.05])
        at = outside if phase in ("hold", "align") else place
        chaser.position_m, chaser.seen = at, senses(at)
        seen[phase] = chaser.corridor() is not None
        assert guidance.chasers[1].corridor() is None
    assert [phase for phase, there in seen.items() if there] == [
        "approach",
        "final",
        "contact",
        "retreat",
    ]


def step(flight: ControllerCore, tick: int, **changes: Any) -> TickOutputs:
    """One tick with chaser 0 as given and chaser 1 at its place."""
    timing = flight.scenario.timing
    here = {
        0: odometry(0, tick, timing.tick_time_ns(tick), **changes),
        1: odometry(
            1, tick, timing.tick_time_ns(tick), position_m=(0.0, -1.2, 0.0), velocity_m_s=(0.0,) * 3
        ),
    }
    return flight.step(tick_inputs(tick, timing.tick_time_ns(tick), here, ()))


@pytest.mark.parametrize("order", ["approach", "hold"])
def test_in_flight_the_plan_stays_in_the_corridor(order: Any) -> None:
    """Pushed sideways at 6 cm/s near the edge: only with a corridor does a lazy plan brake hard
    enough.
    """
    still = {"motion": "static", "model": "paper"}
    lazy = {"weight_position": 1.0, "weight_final_position": 1.0}
    timeline = [{"at_s": 0.0, "command": order, "chasers": [0]}]
    mission = scenario(target=still, timeline=timeline, controller=lazy, **NEAR)
    flight = ControllerCore(mission, lambda: 0.0, PerfectEstimator(mission.target))
    now = {
        "position_m": (-0.6, 0.19, 0.0),
        "velocity_m_s": (0.0, 0.06, 0.0),
        "q_wxyz": (1.0, 0.0, 0.0, 0.0),
        "omega_rad_s": (0.0, 0.0, 0.0),
    }
    out = [step(flight, tick, **now) for tick in range(4)][
        -1
    ]  # the same moment again: the plan converges
    positions = np.reshape(out.plans[0].positions_m, (-1, 3))
    cone = cone_of(mission, 0)
    room = min(cone.room_m(p) for p in positions)
    assert out.solver is not None
    assert (room > -1e-3) == (order == "approach")
    assert out.references[0].min_distance_target_m == pytest.approx(
        0.22 if order == "approach" else LIMIT_M
    )


@pytest.mark.slow
def test_a_chaser_docks_nearer_than_the_others_may_come() -> None:
    """The docking distance lies within the ball that everybody keeps; only the way in along the
    corridor leads there.
    """
    timeline = [{"at_s": 1.0, "command": "approach", "chasers": [0]}]
    mission = scenario(duration_s=60.0, settling_s=1.0, timeline=timeline, **NEAR)
    trace = record_flight(mission)
    truth = PerfectEstimator(mission.target)
    there = [truth.estimate_at(round(t * 1e9)) for t in trace.time_s]
    own, other = (
        np.array(
            [
                rotations.rotate_inverse(e.q_wxyz, x[i, :3] - e.position_m)
                for e, x in zip(there, trace.states, strict=True)
            ]
        )
        for i in (0, 1)
    )
    assert np.linalg.norm(own[-1] - [-0.25, 0.0, 0.0]) < 2e-3
    assert min(cone_of(mission, 0).room_m(p) for p in own) > 0.0
    assert np.linalg.norm(other, axis=1).min() > 1.0
    assert trace.failed_solves == 0
