# SPDX-License-Identifier: Apache-2.0
"""Controller core: chasers join, leave and latch between ticks; latency compensation; starts inside
keep-out zones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.estimation import stage as estimation
from chaserdock_controller.guidance.phases import Phase
from chaserdock_controller.interfaces import TickOutputs
from chaserdock_controller.nmpc import stage as planning
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import DockingStatus
from chaserdock_protocol.scenario import Scenario, load_scenario, parse_scenario
from docking_cases import scenario as capture_scenario
from flight_cases import odometry, tick_inputs
from harness import ROOT

from chaserdock.experiments.flight_record import record_flight
from chaserdock.experiments.perfect_knowledge import PerfectEstimator


def three_chasers() -> Scenario:
    places = ([-1.0, 0.0, 0.0], [0.0, -1.2, 0.0], [0.0, 1.2, 0.0])
    chasers = [{"position_m": p, "q_wxyz": [1.0, 0.0, 0.0, 0.0]} for p in places]
    still = {"model": "servicer", "motion": "static"}
    return parse_scenario(
        {
            "name": "test",
            "duration_s": 60.0,
            "navigation": {"grade": "exact"},
            "target": still,
            "chasers": chasers,
        },
        "test",
    )


def step(
    flight: ControllerCore, tick: int, present: tuple[int, ...], **more: object
) -> TickOutputs:
    """Step with the chasers that are present, each at rest and 5 cm from its reference."""
    scenario, now_ns = flight.scenario, flight.scenario.timing.tick_time_ns(tick)
    here = {}
    for i in present:
        c = scenario.chasers[i]
        place = tuple(np.add(c.position_m, (0.0, 0.0, 0.05)).tolist())
        here[i] = odometry(
            i,
            tick,
            now_ns,
            position_m=place,
            q_wxyz=c.q_wxyz,
            velocity_m_s=(0.0,) * 3,
            omega_rad_s=(0.0,) * 3,
        )
    return flight.step(tick_inputs(tick, now_ns, here, (), **more))  # type: ignore[arg-type]


def test_joining_and_leaving_chasers_do_not_interrupt_planning(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every present chaser has a plan in every tick, including the first after a change; no solver
    is rebuilt.
    """
    mission = three_chasers()
    flight, single = (
        ControllerCore(mission, lambda: 0.0, PerfectEstimator(mission.target)) for _ in range(2)
    )
    monkeypatch.setattr(
        planning, "make_solver", lambda *_: pytest.fail("a solver was built in flight")
    )
    steady: dict[int, list[Array]] = {}
    for tick, present in enumerate([(0, 1, 2)] * 4 + [(0, 2)] * 4 + [(2,)] * 4 + [(0, 1, 2)] * 4):
        out = step(flight, tick, present)
        assert out.solver is not None
        assert out.solver.chasers == present
        assert out.solver.status == ("solved",) * len(present)
        assert all(out.wrenches[i].mode == "nmpc" for i in present)
        assert out.plans.keys() == set(present)
        steady.setdefault(2, []).append(np.array(out.wrenches[2].force_N))
    # The chasers are far apart: the plan of chaser 2 does not depend on the others.
    for tick, force in enumerate(steady[2]):
        np.testing.assert_allclose(
            np.array(step(single, tick, (2,)).wrenches[2].force_N), force, atol=1e-6
        )


def test_latched_chaser_coasts_while_the_other_is_planned() -> None:
    mission = capture_scenario(2)
    prescribed = mission.target.model_copy(update={"motion": "constant_rates"})
    flight = ControllerCore(mission, lambda: 0.0, PerfectEstimator(prescribed))
    contact, chaser = {"contact": True, "armed": True}, flight.guidance.chasers[0]
    for tick, latched in enumerate([False, False, True, True, False]):
        now_ns = mission.timing.tick_time_ns(tick)
        docking = {
            0: DockingStatus(tick=tick, sim_time_ns=now_ns, chaser=0, latched=latched, **contact),
            1: DockingStatus(
                tick=tick, sim_time_ns=now_ns, chaser=1, contact=False, armed=False, latched=False
            ),
        }
        if latched:
            chaser.state = replace(chaser.state, phase=Phase.LATCHED)
        elif tick == 4:
            chaser.state = replace(chaser.state, phase=Phase.RETREAT)
        out = step(flight, tick, (0, 1), docking=docking)
        assert out.wrenches[0].mode == ("coast" if latched else "nmpc")
        assert out.wrenches[1].mode == "nmpc"
        assert out.solver is not None
        assert "failed" not in out.solver.status
        assert out.solver.chasers == (0, 1)


LATE = ("navigation.grade=exact", "time.latency_s=0.2", "duration_s=50.0", "settling_s=40.0")


def latency_error_m() -> float:
    """Return the steady position error, m, at the paper's tumble with a latency of three ticks."""
    mission = load_scenario(
        ROOT / "scenarios/single.toml", (*LATE, "chasers.0.start_offset_m=[-0.1,0.0,0.0]")
    )
    trace = record_flight(mission)
    return float(np.sqrt(np.mean(trace.position_error_m[trace.time_s >= 40.0] ** 2)))


@pytest.mark.slow
def test_latency_compensation_predicts_the_state_at_actuation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With 0.2 s of latency tracking is as good as without; without the prediction it is not."""
    assert latency_error_m() < 5e-5

    def at_exposure(odometry, ahead, disturbance, body):  # type: ignore[no-untyped-def]
        return np.array(
            [*odometry.position_m, *odometry.velocity_m_s, *odometry.q_wxyz, *odometry.omega_rad_s]
        )

    monkeypatch.setattr(estimation, "predict_state", at_exposure)
    assert latency_error_m() > 5e-4


@pytest.mark.slow
def test_chasers_leave_keep_out_zones_in_which_they_start() -> None:
    """Chaser 0 starts 0.2 m from the target's centre, chasers 1 and 2 start 0.4 m apart with a
    limit of 0.6 m.
    """
    chasers = [
        {"position_m": p, "q_wxyz": [1.0, 0.0, 0.0, 0.0], "start_offset_m": o}
        for p, o in (
            ([-1.0, 0.0, 0.0], [0.8, 0.0, 0.0]),
            ([0.0, -1.2, 0.4], [0.0, 0.0, -0.2]),
            ([0.0, -1.2, -0.4], [0.0, 0.0, 0.2]),
        )
    ]
    mission = parse_scenario(
        {
            "name": "test",
            "duration_s": 20.0,
            "settling_s": 1.0,
            "navigation": {"grade": "exact"},
            "chasers": chasers,
            "limits": {"min_distance_chasers_m": 0.6},
        },
        "test",
    )
    trace = record_flight(mission)
    truth = PerfectEstimator(mission.target)
    there = np.array([truth.estimate_at(round(t * 1e9)).position_m for t in trace.time_s])
    own = np.linalg.norm(trace.states[:, 0, :3] - there, axis=1)
    gap = np.linalg.norm(trace.states[:, 1, :3] - trace.states[:, 2, :3], axis=1)
    for distance, limit in ((own, 0.35), (gap, 0.6)):
        outside = int(np.argmax(distance > limit))
        assert 0 < outside < 8 * mission.time.rate_hz
        assert (np.diff(distance[2:outside]) > 0.0).all()
        assert distance[outside:].min() > limit - 2e-3
    assert trace.failed_solves == 0
