# SPDX-License-Identifier: Apache-2.0
"""Passive safety enforced: aborts onto safe coasts, moves as slow as safe coasts need, and what a
chaser does without them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from chaserdock_controller.bodies.target_body import TargetPath
from chaserdock_controller.guidance.escape import EscapePlanner, RelativeState
from chaserdock_controller.guidance.fleet import ChaserFleet
from chaserdock_controller.guidance.phases import Phase
from chaserdock_controller.guidance.reference import seen_from
from chaserdock_controller.guidance.trajectories import Escape, move_to, stay
from chaserdock_controller.interfaces import TargetState
from chaserdock_models import rotations
from chaserdock_models.orbit import OrbitalElements, propagate, state_of
from chaserdock_models.passive_safety import DisturbedMotion, disturbed
from chaserdock_models.relative_motion import propagate_relative
from chaserdock_protocol.messages import OperatorCommand, PassiveSafety
from chaserdock_protocol.scenario import Scenario, flight_scenario, parse_scenario
from flight_cases import drain, fleet_of, known, order
from flights.measured_poses import measurement_model
from hypothesis import given, settings
from hypothesis import strategies as st

from chaserdock.experiments.in_process import InProcessMission

GOOD = np.diag([2e-3**2] * 3 + [2e-5**2] * 3)
KEEP_OUT_M, FORCE_N = 2.0, 1e-8


def scenario(**changes: Any) -> Scenario:
    values: dict[str, Any] = {
        "name": "test",
        "duration_s": 40.0,
        "orbit": {"altitude_m": 4e5},
        "target": {
            "motion": "torque_free",
            "velocity_m_s": [0.0, 0.0, 0.0],
            "omega_rad_s": [0.0, 0.0, 0.0],
        },
        "approach": {"max_speed_m_s": 0.1},
        "estimator": {"target_acceleration_noise": 1e-8},
        "limits": {
            "passive_safety": "enforce",
            "passive_safety_force_N": FORCE_N,
            "min_distance_target_m": KEEP_OUT_M,
            "max_reference_distance_m": 300.0,
        },
        "chasers": [{"position_m": [0.0, -30.0, 0.0], "look_at": "target"}],
    }
    return parse_scenario(values | changes, "test")


def at_rest(
    q: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0), omega: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> TargetState:
    values = SimpleNamespace(q_wxyz=np.array(q), omega_rad_s=np.array(omega))
    return cast(TargetState, values)


def planner(**changes: Any) -> EscapePlanner:
    return EscapePlanner(flight_scenario(scenario(**changes)), 0.2)


def relative(state: np.ndarray, covariance: np.ndarray = GOOD) -> RelativeState:
    return RelativeState(state, disturbed(covariance, FORCE_N / 17.8), at_rest())


@pytest.mark.slow
@given(
    st.floats(0.0, 2.0 * math.pi),
    st.floats(-0.5, 0.5),
    st.floats(4.0, 150.0),
    st.tuples(*[st.floats(-0.05, 0.05)] * 3),
)
@settings(max_examples=12, deadline=None, derandomize=True)
def test_abort_certified_as_safe_stays_out_under_the_nonlinear_motion_with_j2(
    azimuth: float, height: float, distance: float, velocity: tuple[float, ...]
) -> None:
    direction = np.array([math.cos(azimuth), math.sin(azimuth), height])
    state = np.concatenate([distance * direction / np.linalg.norm(direction), velocity])
    escape, margin = planner().escape(relative(state), 5.0)
    assert margin >= 3.0  # from outside twice the keep-out there always is one
    burn_s = 5.0 + np.linspace(0.0, escape.burn_s, 20)
    assert np.linalg.norm(escape.at(burn_s)[0], axis=1).min() >= KEEP_OUT_M
    end = escape.burnt_out()
    orbit = state_of(OrbitalElements(6778136.3, inclination_rad=0.9))
    position, speed, nearest = end[:3], end[3:], math.inf
    for _ in range(92):
        position, speed = propagate_relative(orbit, position, speed, 120.0)
        orbit = propagate(orbit, 120.0)
        nearest = min(nearest, float(np.linalg.norm(position)))
    assert nearest >= KEEP_OUT_M


def test_small_burn_is_preferred_and_an_uncertain_state_needs_a_larger_one() -> None:
    state = np.array([0.0, -50.0, 0.0, 0.0, 0.0, 0.0])
    small = planner().escape(relative(state), 0.0)
    rough = planner().escape(relative(state, np.diag([0.5**2] * 3 + [4e-2**2] * 3)), 0.0)
    assert small[0].burn_s < rough[0].burn_s
    assert small[1] >= 4.5


@pytest.mark.parametrize("seed", range(4))
def test_abort_stays_out_under_a_known_force_that_would_push_it_in(seed: int) -> None:
    """In free space: the coast of the abort that is best without it would come back."""
    rng, keep_out_m, duration_s = np.random.default_rng(seed), 0.75, 250.0
    limits: dict[str, Any] = {
        "passive_safety_s": duration_s,
        "min_distance_target_m": keep_out_m,
    }
    base: dict[str, Any] = scenario().model_dump(exclude_unset=True)
    base.pop("orbit")
    base["limits"] |= limits
    found = EscapePlanner(flight_scenario(parse_scenario(base, "test")), 0.05)
    away, aside = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    state = np.concatenate([3.0 * away, 1e-3 * aside])
    best = found.escape(relative(state), 0.0)[0]
    # Against the burn of the best abort, with a turn-round of its coast at the target.
    end, speed_m_s = best.burnt_out(), best.impulse_m_s
    back_s = float(np.linalg.norm(end[:3])) / speed_m_s * 2.0
    push = -2.0 * (end[:3] + back_s * end[3:]) / back_s**2
    assert back_s < duration_s
    motion = DisturbedMotion(push, disturbed(GOOD, 1e-6).covariance)
    escape, margin = found.escape(replace(relative(state), disturbed=motion), 0.0)
    assert margin >= found.sigmas
    times = np.linspace(0.0, duration_s, 5001)
    nearest = []
    for chosen in (best, escape):
        x = chosen.burnt_out()
        coast = x[:3] + times[:, None] * x[3:] + 0.5 * times[:, None] ** 2 * push
        nearest.append(float(np.linalg.norm(coast, axis=1).min()))
    assert nearest[0] < 0.1
    assert nearest[1] > keep_out_m


def test_force_of_unknown_direction_needs_a_larger_burn_and_rules_out_near_goals() -> None:
    """0.3 uN/kg for two orbits is tens of metres along V-bar."""
    state = np.array([1.0, -12.0, -2.0, 0.0, 0.0, 0.0])
    small = EscapePlanner(flight_scenario(scenario()), 0.005)
    still = relative(state)
    unsure = replace(still, disturbed=disturbed(GOOD, 3e-7))
    least, larger = (small.escape(x, 0.0)[0].impulse_m_s for x in (still, unsure))
    assert larger > 1.5 * least

    def near(v: float) -> Any:
        return move_to(stay(state[:3], 0.0), (0.0, -11.0, 0.0), 0.0, v)

    assert planner().limited(still, near, 0.2, 0.0) is not None
    assert planner().limited(unsure, near, 0.2, 0.0) is None


def test_escape_is_a_continuous_motion_that_needs_its_acceleration_only_while_it_burns() -> None:
    known = relative(np.array([3.0, -20.0, 1.0, 0.02, 0.01, 0.0]))
    escape, h = planner().escape(known, 7.0)[0], 1e-3
    for t in (7.0, 7.0 + 0.4 * escape.burn_s, 7.0 + 2.0 * escape.burn_s, 900.0):
        p, v, a = escape.at(np.array([t, t + h]))
        np.testing.assert_allclose((p[1] - p[0]) / h, v.mean(axis=0), atol=1e-7)
        np.testing.assert_allclose((v[1] - v[0]) / h, a.mean(axis=0), atol=2e-5)
    p, v, a = escape.at(np.array([600.0]))
    gravity = np.array(
        [3 * 1.131e-3**2 * p[0, 0] + 2 * 1.131e-3 * v[0, 1], -2 * 1.131e-3 * v[0, 0]]
    )
    np.testing.assert_allclose(a[0, :2], gravity, rtol=2e-3, atol=1e-9)


def test_moves_are_as_slow_as_a_safe_coast_needs() -> None:
    """On V-bar a chaser that closes in at v passes at the height n d^2 / v above the target: nearer
    means slower.
    """
    state = np.array([0.0, -30.0, 0.0, 0.0, 0.0, 0.0])
    found, known = planner(), relative(state)
    speeds = []
    for goal in (-20.0, -12.0, -9.0):
        move = found.limited(
            known, lambda v, y=goal: move_to(stay(state[:3], 0.0), (0.0, y, 0.0), 0.0, v), 0.2, 0.0
        )
        assert move is not None
        times = np.linspace(0.0, move.duration_s, 200)
        speeds.append(float(np.linalg.norm(move.at(times)[1], axis=1).max()))
    assert 0.2 * 1.01 >= speeds[0] >= speeds[1] >= speeds[2]
    assert speeds[2] < 0.75 * speeds[0]

    # Through the keep-out, or to a place whose coast is not safe at any speed, there is no move.
    def through(v: float) -> Any:
        return move_to(stay(state[:3], 0.0), (0.0, 30.0, 0.0), 0.0, v)

    assert found.limited(known, through, 0.2, 0.0) is None


def test_final_corridor_is_exempt() -> None:
    state = np.array([0.0, -30.0, 0.0, 0.0, 0.0, 0.0])
    limits = {
        "passive_safety": "enforce",
        "passive_safety_force_N": FORCE_N,
        "min_distance_target_m": KEEP_OUT_M,
        "max_reference_distance_m": 300.0,
        "final_corridor_m": 31.0,
    }
    found = planner(limits=limits)
    move = found.limited(
        relative(state), lambda v: move_to(stay(state[:3], 0.0), (0.0, -3.0, 0.0), 0.0, v), 0.2, 0.0
    )
    assert move is not None
    assert move.duration_s == pytest.approx(1.875 * 27.0 / 0.2, rel=1e-6)


def holding(**changes: Any) -> ChaserFleet:
    machine = fleet_of(flight_scenario(scenario(**changes)), acquired_s=0.0)
    place = np.array([0.0, -30.0, 0.0])
    machine.chasers[0].position_m = place
    machine.chasers[0].relative = relative(np.concatenate([place, np.zeros(3)]))
    return machine


def test_unsafe_chaser_aborts_onto_a_safe_coast_and_takes_commands_from_there() -> None:
    machine = holding()
    machine.chasers[0].follow_safety(known(1.0, unsafe="the reason"))
    assert machine.chasers[0].phase is Phase.ABORT
    assert isinstance(machine.chasers[0].state.move, Escape)
    texts = [detail for _, _, detail in drain(machine)]
    assert any("onto a coast with a margin of" in text for text in texts)
    assert any("the reason" in text for text in texts)
    machine.chasers[0].follow_safety(known(2.0, unsafe="the reason"))  # once: it is on its way
    assert drain(machine) == []
    machine.chasers[0].position_m = np.array([0.5, -30.0, 0.0])
    assert order(machine, OperatorCommand(command="hold", chaser=0), 3.0).accepted
    np.testing.assert_allclose(
        machine.chasers[0].state.move.at(np.array([3.0]))[0][0], [0.5, -30.0, 0.0]
    )


def test_unsafe_chaser_in_the_final_corridor_continues() -> None:
    limits = {
        "passive_safety": "enforce",
        "passive_safety_force_N": FORCE_N,
        "min_distance_target_m": KEEP_OUT_M,
        "max_reference_distance_m": 300.0,
        "final_corridor_m": 40.0,
    }
    machine = holding(limits=limits)
    machine.chasers[0].follow_safety(known(1.0, unsafe="the reason"))
    assert machine.chasers[0].phase is Phase.HOLD


def test_goto_without_a_safe_move_is_refused() -> None:
    machine = holding()
    refused = order(
        machine, OperatorCommand(command="goto", chaser=0, offset_m=(0.0, 30.0, 0.0)), 1.0
    )
    assert not refused.accepted
    assert "no speed makes the move passively safe" in refused.reason
    assert order(
        machine, OperatorCommand(command="goto", chaser=0, offset_m=(0.0, -12.0, 0.0)), 2.0
    ).accepted


def test_motion_seen_from_a_turning_target_is_the_same_motion() -> None:
    rng = np.random.default_rng(5)
    omega, h = rng.normal(0.0, 0.3, 3), 1e-4
    times = np.array([-h, 0.0, h])
    q = rotations.exp(times[:, None] * omega)
    p0, v0, a0 = rng.normal(0.0, 1.0, (3, 3))
    p = p0 + times[:, None] * v0 + 0.5 * times[:, None] ** 2 * a0
    v, a = v0 + times[:, None] * a0, np.tile(a0, (3, 1))
    zeros = np.zeros((3, 3))
    seen = seen_from(TargetPath(zeros, q, zeros + omega, zeros, zeros), p, v, a)
    np.testing.assert_allclose((seen[0][2] - seen[0][0]) / (2 * h), seen[1][1], atol=1e-6)
    np.testing.assert_allclose((seen[1][2] - seen[1][0]) / (2 * h), seen[2][1], atol=1e-6)


@pytest.mark.slow
def test_flight_publishes_certificates_and_its_abort_coasts() -> None:
    """A chaser on V-bar is ordered to abort; after the burn its thrusters give next to nothing."""
    s = scenario(duration_s=14.0, navigation={"grade": "exact"})
    abort = (OperatorCommand(command="abort", chaser=0),)
    with InProcessMission(s, measurement_model(s, 1, 1e-3, 1e-3)) as mission:
        safeties, forces = [], []
        while mission.tick < s.ticks:
            record = mission.step(abort if mission.tick == 60 else ())
            assert record.outputs is not None
            safeties.append(record.outputs.safety.get(0))
            forces.append(float(np.linalg.norm(record.outputs.wrenches[0].force_N)))
        assert mission.phase(0) == "abort"
    last = safeties[-1]
    assert last is not None
    assert last.enforced
    assert last.safe
    assert last.abort_margin_sigmas is not None
    assert max(forces[60:80]) > 0.5
    assert np.mean(forces[-30:]) < 0.1


@pytest.mark.slow
def test_flight_3_m_away_under_3_mN_is_not_certified_although_it_holds_its_place() -> None:
    """It hardly moves, and without thrust it would be in the keep-out of 0.75 m within 200 s: the
    filter's estimate of the force tells.
    """
    limits = {
        "passive_safety": "monitor",
        "passive_safety_s": 200.0,
        "passive_safety_force_N": 3e-3,
        "min_distance_target_m": 0.75,
    }
    chaser = {"position_m": [-2.7, 1.1, -0.7], "look_at": "target"}
    found: list[PassiveSafety] = []
    for newtons in (3e-3, 0.0):
        towards = [newtons, 0.0, 0.0]  # body axes: the camera looks along X
        base: dict[str, Any] = scenario(
            duration_s=40.0, limits=limits, chasers=[chaser],
            truth={"values": [{"chaser": 0, "force_N": towards}]},
        ).model_dump(exclude_unset=True)  # fmt: skip
        base.pop("orbit")
        s = parse_scenario(base, "test")
        with InProcessMission(s, measurement_model(s, 1, 1e-3, 1e-3)) as mission:
            records = [mission.step() for _ in range(s.ticks)]
        outputs = records[-1].outputs
        assert outputs is not None
        found.append(outputs.safety[0])
    pushed, free = found
    assert not pushed.safe
    assert pushed.margin_sigmas < free.margin_sigmas - 0.5
    assert pushed.distance_m < free.distance_m - 1.0
