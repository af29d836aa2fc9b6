# SPDX-License-Identifier: Apache-2.0
"""Chasers come, go and latch between two ticks, limits change, commands act late: the flight code takes it in its stride."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.guidance.phases import Phase
from chaserdock_controller.ingest import stage as ingest
from chaserdock_controller.interfaces import TickInputs, TickOutputs
from chaserdock_controller.nmpc import stage as planning
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import DockingStatus
from chaserdock_protocol.scenario import Scenario, load_scenario, parse_scenario
from docking_cases import scenario as capture_scenario
from flight_cases import odometry
from harness import ROOT

from chaserdock.evaluation.flight_record import record_flight
from chaserdock.evaluation.perfect_knowledge import PerfectEstimator


def three() -> Scenario:
    places = ([-1.0, 0.0, 0.0], [0.0, -1.2, 0.0], [0.0, 1.2, 0.0])
    chasers = [{"position_m": p, "q_wxyz": [1.0, 0.0, 0.0, 0.0]} for p in places]
    still = {"model": "servicer", "motion": "static"}
    return parse_scenario({"name": "test", "duration_s": 60.0, "target": still, "chasers": chasers}, "test")


def step(flight: ControllerCore, tick: int, there: tuple[int, ...], **more: object) -> TickOutputs:
    """A tick of those who are there, each 5 cm beside its place and at rest."""
    scenario, now_ns = flight.scenario, flight.scenario.timing.tick_time_ns(tick)
    here = {}
    for i in there:
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
    return flight.step(TickInputs(tick, now_ns, here, (), **more))  # type: ignore[arg-type]


def test_who_comes_and_goes_costs_nobody_a_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everyone who is there has a plan in every tick, the first after a change included, and no solver is rebuilt."""
    mission = three()
    flight, alone = (ControllerCore(mission, lambda: 0.0, PerfectEstimator(mission.target)) for _ in range(2))
    monkeypatch.setattr(planning, "make_solver", lambda *_: pytest.fail("a solver was built in flight"))
    steady: dict[int, list[Array]] = {}
    for tick, there in enumerate([(0, 1, 2)] * 4 + [(0, 2)] * 4 + [(2,)] * 4 + [(0, 1, 2)] * 4):
        out = step(flight, tick, there)
        assert out.solver is not None
        assert out.solver.chasers == there
        assert out.solver.status == ("solved",) * len(there)
        assert all(out.wrenches[i].mode == "nmpc" for i in there)
        assert out.plans.keys() == set(there)
        steady.setdefault(2, []).append(np.array(out.wrenches[2].force_N))
    # Nobody is near: what the others do leaves no trace in the plan of the one that stays.
    for tick, force in enumerate(steady[2]):
        np.testing.assert_allclose(np.array(step(alone, tick, (2,)).wrenches[2].force_N), force, atol=1e-6)


def test_who_latches_is_quiet_at_once_and_the_others_have_their_plans() -> None:
    mission = capture_scenario(2)
    prescribed = mission.target.model_copy(update={"motion": "constant_rates"})
    flight = ControllerCore(mission, lambda: 0.0, PerfectEstimator(prescribed))
    felt = {"contact": True, "armed": True}
    for tick, latched in enumerate([False, False, True, True, False]):
        now_ns = mission.timing.tick_time_ns(tick)
        docking = {
            0: DockingStatus(tick=tick, sim_time_ns=now_ns, chaser=0, latched=latched, **felt),
            1: DockingStatus(
                tick=tick, sim_time_ns=now_ns, chaser=1, contact=False, armed=False, latched=False
            ),
        }
        if latched:
            flight.guidance.chasers[0] = replace(flight.guidance.chasers[0], phase=Phase.LATCHED)
        elif tick == 4:
            flight.guidance.chasers[0] = replace(flight.guidance.chasers[0], phase=Phase.RETREAT)
        out = step(flight, tick, (0, 1), docking=docking)
        assert out.wrenches[0].mode == ("coast" if latched else "nmpc")
        assert out.wrenches[1].mode == "nmpc"
        assert out.solver is not None
        assert "failed" not in out.solver.status
        assert out.solver.chasers == (0, 1)


LATE = ("time.latency_s=0.2", "duration_s=50.0", "settling_s=40.0")


def late_error_m() -> float:
    """Steady position error, m, at the paper's tumble when a command takes effect three ticks after its exposure."""
    mission = load_scenario(
        ROOT / "scenarios/single.toml", (*LATE, "chasers.0.start_offset_m=[-0.1,0.0,0.0]")
    )
    trace = record_flight(mission)
    return float(np.sqrt(np.mean(trace.position_error_m[trace.time_s >= 40.0] ** 2)))


def test_the_state_is_predicted_to_when_the_command_acts(monkeypatch: pytest.MonkeyPatch) -> None:
    """With 0.2 s of latency it tracks as without; the same code on the state at exposure does not."""
    assert late_error_m() < 5e-5

    def at_exposure(odometry, history, until_ns, body):  # type: ignore[no-untyped-def]
        return np.array(
            [*odometry.position_m, *odometry.velocity_m_s, *odometry.q_wxyz, *odometry.omega_rad_s]
        )

    monkeypatch.setattr(ingest, "predict_state", at_exposure)
    assert late_error_m() > 5e-4


def test_who_starts_where_nobody_may_be_comes_out_and_hurts_nobody() -> None:
    """Chaser 0 begins 0.2 m from the target's centre, chasers 1 and 2 0.4 m apart where 0.6 m are kept."""
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
        out = int(np.argmax(distance > limit))
        assert 0 < out < 8 * mission.time.rate_hz
        assert (np.diff(distance[2:out]) > 0.0).all()
        assert distance[out:].min() > limit - 2e-3
    assert trace.failed_solves == 0
