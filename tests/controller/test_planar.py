# SPDX-License-Identifier: Apache-2.0
"""A controller of bodies on a floor: estimates, references, plans and commands stay in the plane,
with target axes that lean, a yaw and a rate.
"""

from __future__ import annotations

import math
from dataclasses import replace as changed
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.estimation.joint.floor import keep_on_floor, rows_of_bodies
from chaserdock_controller.estimation.joint.parameters import LevelFloor, parameters_of
from chaserdock_controller.estimation.joint.state import CHASER, TARGET, JointState, inject
from chaserdock_controller.guidance.escape import EscapePlanner
from chaserdock_controller.guidance.horizon import ReferenceBuilder
from chaserdock_controller.guidance.phases import Phase
from chaserdock_controller.guidance.pointing import search_attitude, search_wrench, turning_wrench
from chaserdock_controller.guidance.trajectories import Escape, Motion, circuit, move_to, stay
from chaserdock_controller.interfaces import TargetState
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.braking import brake_wrench
from chaserdock_models.plane import UP, levelled
from chaserdock_models.setpoint_tracking import Setpoint, track_setpoint
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import flight_scenario
from flight_cases import fleet_of, known, order
from general_position import BODY, covariance, matrix, moving_odometry, relative_pose
from joint_cases import joint_state
from msgspec.structs import replace
from nmpc_cases import PARAMS, fixed_problem, fresh
from planar_cases import HEIGHT_M, RATE_RAD_S, UP_TRF, scenario, target_attitude

SEEDS = pytest.mark.parametrize("seed", range(3))
FLOOR = LevelFloor((float(UP_TRF[0]), float(UP_TRF[1]), float(UP_TRF[2])))
NOW_S = 3.2


# -- estimates -------------------------------------------------------------------------------------


def bodies_of(state: JointState) -> list[tuple[Array, Array, Array, Array]]:
    """Return attitude, velocity, rate and up axis of the target and of each chaser."""
    target = (state.q_wxyz, state.velocity_m_s, state.omega_rad_s, UP_TRF)
    motions = zip(state.attitudes_wxyz, state.velocities_m_s, state.omegas_rad_s, strict=True)
    return [target, *((*motion, UP) for motion in motions)]


def off_floor(state: JointState) -> Array:
    """Return by definition how each body leaves the plane (5 N,): vertical speed, horizontal parts
    of its up axis, and horizontal parts of its rate at a level attitude, all in world axes.
    """
    out = []
    for q, velocity, omega, up in bodies_of(state):
        level = matrix(levelled(q, up))
        out += [velocity[2], *(matrix(q) @ up)[:2], *(level @ omega)[:2]]
    return np.array(out)


@SEEDS
def test_rows_are_the_derivatives_of_their_residuals(seed: int) -> None:
    """Central differences by all errors, of a state that is nearly level."""
    s, e = level_state(np.random.default_rng(seed), 0.02), 1e-6
    rows = list(rows_of_bodies(s, FLOOR))
    derivatives = np.zeros((len(rows), len(s.covariance)))
    for row, (components, values, _, _) in zip(derivatives, rows, strict=True):
        row[components] = values
    for k in range(len(s.covariance)):
        error = np.zeros(len(s.covariance))
        error[k] = e
        plus, minus = (
            np.array([r[2] for r in rows_of_bodies(inject(s, sign * error), FLOOR)])
            for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose(derivatives[:, k], (minus - plus) / (2.0 * e), atol=1e-6)


def level_state(rng: np.random.Generator, lean_rad: float) -> JointState:
    """Return a state in general position whose bodies lean by about ``lean_rad``."""
    s = joint_state(rng)

    def upright(q: Array, up: Array) -> Array:
        return rotations.multiply(levelled(q, up), rotations.exp(rng.normal(0.0, lean_rad, 3)))

    attitudes = np.array([upright(q, UP) for q in s.attitudes_wxyz])
    return replace(s, q_wxyz=upright(s.q_wxyz, UP_TRF), attitudes_wxyz=attitudes)


@SEEDS
def test_a_level_floor_takes_every_motion_out_of_the_plane_and_keeps_what_is_in_it(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    before = level_state(rng, 0.02)
    # Independent and equal errors: what the floor tells of the vertical says nothing of the plane.
    before = replace(before, covariance=np.eye(len(before.covariance)) * 0.02**2)
    state = before
    for _ in range(400):
        state = keep_on_floor(state, FLOOR)
    assert np.abs(off_floor(before)).max() > 0.02
    assert np.abs(off_floor(state)).max() < 5e-4
    for old, new in zip(bodies_of(before), bodies_of(state), strict=True):
        assert new[1][:2] == pytest.approx(old[1][:2], abs=1e-12)
        assert new[2] @ new[3] == pytest.approx(old[2] @ old[3], abs=1e-3)
        turned = rotations.multiply(new[0], rotations.conjugate(levelled(old[0], old[3])))
        assert rotations.log(turned) == pytest.approx(np.zeros(3), abs=1e-3)
    assert np.allclose(state.covariance, state.covariance.T, atol=0.0)
    assert np.linalg.eigvalsh(state.covariance)[0] > 0.0
    sigmas = np.sqrt(np.diag(state.covariance)[[5, TARGET + 5, TARGET + CHASER + 5]])
    assert sigmas == pytest.approx([FLOOR.vertical_m_s / 20.0] * 3, rel=0.01)


@SEEDS
def test_the_update_is_the_least_squares_estimate_of_state_and_floor(seed: int) -> None:
    """With correlations, one update minimizes the sum of both squared normalized residuals."""
    s = level_state(np.random.default_rng(seed), 1e-5)
    rows = list(rows_of_bodies(s, FLOOR))
    h = np.zeros((len(rows), len(s.covariance)))
    for line, (components, values, _, _) in zip(h, rows, strict=True):
        line[components] = values
    residual, variance = (np.array([r[k] for r in rows]) for k in (2, 3))
    gain = s.covariance @ h.T @ np.linalg.inv(h @ s.covariance @ h.T + np.diag(variance))
    after = keep_on_floor(s, FLOOR)
    np.testing.assert_allclose(
        after.covariance, s.covariance - gain @ h @ s.covariance, atol=1e-9 * 3e-3**2
    )
    expected = inject(s, gain @ residual)
    for old, new in zip(bodies_of(expected), bodies_of(after), strict=True):
        for a, b in zip(old, new, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-10)


def test_of_two_poses_the_floor_tells_the_leaning_one() -> None:
    """A single marker leaves two attitudes, which lean by tens of degrees against each other."""
    s = level_state(np.random.default_rng(1), 1e-4)
    lean = rotations.multiply(s.q_wxyz, rotations.exp((0.5, 0.0, 0.0)))
    right, wrong = (keep_on_floor(x, FLOOR) for x in (s, replace(s, q_wxyz=lean)))
    assert right.log_likelihood > wrong.log_likelihood + 10.0


def test_a_target_that_is_not_known_and_chasers_that_are_not_seen_are_left_alone() -> None:
    s = level_state(np.random.default_rng(2), 0.02)
    s = replace(s, target_known=False, alive=np.array([True, False]))
    after = keep_on_floor(s, FLOOR)
    assert len(list(rows_of_bodies(s, FLOOR))) == 5
    assert after.velocities_m_s[0, 2] != s.velocities_m_s[0, 2]


def test_only_planar_scenarios_have_a_floor() -> None:
    floor = parameters_of(scenario()).floor
    assert floor is not None
    assert floor.up_trf == pytest.approx(UP_TRF)
    tetra = {"body": "tetra12", "actuation": "thrusters", "size_m": [0.14, 0.3, 0.3]}
    assert parameters_of(scenario(chaser=tetra)).floor is None


# -- references ------------------------------------------------------------------------------------


def target(rng: np.random.Generator) -> TargetState:
    """Return the target of the cases, which drifts and turns in the plane."""
    sigmas = [2e-3] * 3 + [1e-3] * 3 + [3e-3] * 3 + [2e-3] * 3
    motion = np.array([0.4, -0.3, 0.25]), np.array([0.02, -0.03, 0.0])
    omega = RATE_RAD_S * UP_TRF
    errors = covariance(rng, sigmas)
    return TargetState(
        round(NOW_S * 1e9), *motion, target_attitude(), omega, errors, "tracking", 2, ()
    )


def moves(rng: np.random.Generator) -> dict[str, Motion]:
    """Return motions that leave the plane, as of estimated places with errors."""
    begun = move_to(stay(rng.uniform(-1.0, 1.0, 3), 0.0), rng.uniform(-1.5, 1.5, 3), 0.9, 0.07)
    coast = np.concatenate([rng.uniform(-2.0, 2.0, 3), rng.uniform(-0.05, 0.05, 3)])
    return {
        "move": move_to(begun, rng.uniform(-1.5, 1.5, 3), 2.3, 0.07),
        "circuit": circuit(rng.uniform(-1.0, 1.0, 3), rng.normal(size=3), 2.0, NOW_S - 9.0, 0.12),
        "escape": Escape(NOW_S - 1.0, coast, rng.uniform(-0.02, 0.02, 3), 1.9, 0.011, 300.0),
    }


@pytest.mark.parametrize("kind", ["move", "circuit", "escape"])
@pytest.mark.parametrize("faces", [False, True])
@SEEDS
def test_references_stay_at_the_chasers_height_and_level(kind: str, faces: bool, seed: int) -> None:
    """Over the horizon and now, with the feed-forward; what is in the plane is as without it."""
    rng = np.random.default_rng(seed)
    s, start, move = scenario(), target(rng), moves(rng)[kind]
    fleet = fleet_of(flight_scenario(s), 0.0)
    for c in fleet.chasers:
        c.state = changed(c.state, phase=Phase.HOLD, move=move, faces=faces)
    builder, level = ReferenceBuilder(s), start.position_m[2] + HEIGHT_M
    body = changed(BODY, inertia_kg_m2=np.eye(3), centre_trf_m=np.zeros(3))
    relative = [relative_pose(rng) for _ in fleet.chasers]
    found = builder.horizon(fleet.chasers, start, body, frozenset(), relative)
    assert found.references[:, :, 2] == pytest.approx(np.full(found.references.shape[:2], level))
    for pose in found.references.reshape(-1, 7):
        assert matrix(pose[3:]) @ UP == pytest.approx(UP, abs=1e-9)
    assert found.u_ref[:, :, 2:5] == pytest.approx(np.zeros((*found.u_ref.shape[:2], 3)), abs=1e-9)
    assert np.abs(found.u_ref[:, :, :2]).max() > 1e-4

    position, q, offset = builder.pose(fleet.chasers[1], start, NOW_S)
    assert position == pytest.approx(found.references[1, 0, :3])
    assert rotations.angle_between(q, found.references[1, 0, 3:]) < 1e-7
    assert offset @ UP_TRF == pytest.approx(HEIGHT_M)
    place = move.at([NOW_S])[0][0]
    free = place if kind == "escape" else matrix(start.q_wxyz) @ place
    assert (position - start.position_m)[:2] == pytest.approx(free[:2])


@pytest.mark.parametrize("command", ["calibrate", "inspect", "identify", "detumble"])
def test_commands_that_lead_out_of_the_plane_are_refused(command: Any) -> None:
    fleet = fleet_of(flight_scenario(scenario()), 0.0)
    result = order(fleet, OperatorCommand(command=command, chaser=0), 1.0)
    assert not result.accepted
    assert "needs six degrees of freedom" in result.reason


def test_a_goto_off_the_floor_is_refused_and_one_on_it_is_not() -> None:
    fleet = fleet_of(flight_scenario(scenario()), 0.0)
    s = scenario()
    on_floor = 1.3 * np.array(s.chasers[1].position_m)
    on_floor += (HEIGHT_M - on_floor @ UP_TRF) * UP_TRF
    for offset, accepted in ((on_floor + 0.01 * UP_TRF, False), (on_floor, True)):
        x, y, z = offset.tolist()
        command = OperatorCommand(command="goto", chaser=1, offset_m=(x, y, z))
        result = fleet.apply([command], 1.0)[0]
        assert result.accepted == accepted, result.reason
    assert known(1.0).own is not None


def test_a_chaser_that_searches_turns_on_about_its_vertical() -> None:
    s, q = scenario(), levelled(rotations.exp((0.3, -0.2, 1.1)), UP)
    yaws = []
    for time_s in (0.0, 3.0, 9.0, 23.0):
        turned = search_attitude(q, s.camera_model(), time_s, planar=True)
        assert matrix(turned) @ UP == pytest.approx(UP, abs=1e-12)
        yaws.append(rotations.log(rotations.multiply(rotations.conjugate(q), turned))[2])
    assert np.diff(yaws)[:2] == pytest.approx(np.radians([45.0, 90.0]))

    own, camera = moving_odometry(np.random.default_rng(3), 0, 3, 10**9), s.camera_model()
    now, soon = (search_attitude(q, camera, t, planar=True) for t in (7.0, 7.02))
    wrench = search_wrench(own, s.chaser, camera, q, 7.0)
    assert wrench == pytest.approx(turning_wrench(own, s.chaser, now, soon))


@SEEDS
def test_no_law_commands_a_wrench_out_of_the_plane(seed: int) -> None:
    rng = np.random.default_rng(seed)
    s, own = scenario(), moving_odometry(rng, 0, 3, 10**9)
    body, q = s.chaser, rotations.exp(rng.normal(size=3))
    place, speed, rate = rng.normal(size=(3, 3))
    pushed = Setpoint(place, speed, q, rate, rng.normal(size=6))
    for wrench in (
        brake_wrench(own, body),
        track_setpoint(own, body, pushed),
        turning_wrench(own, body, q, q),
        search_wrench(own, body, s.camera_model(), q, 4.0),
    ):
        assert not wrench[[2, 3, 4]].any()
        assert wrench[[0, 1, 5]].all()


def test_aborts_burn_in_the_plane_with_the_force_that_the_body_has() -> None:
    limits = {"passive_safety": "enforce", "min_distance_target_m": 0.75}
    planner = EscapePlanner(flight_scenario(scenario(limits=limits)), 0.2)
    assert len(planner._directions) == 8
    assert not planner._directions[:, 2].any()
    assert planner._acceleration_m_s2 == pytest.approx(0.4 * 1.5 / 17.8)


# -- plans -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["rti", "ipopt"])
def test_plans_have_no_wrench_out_of_the_plane_and_reach_a_goal_in_it(name: str) -> None:
    """The reference is out of the plane and leans; the keep-out pushes up."""
    start = np.array([[-1.0, 0.1, -0.05]])
    goal = np.array([[-0.9, -0.05, 0.1]])
    lean = rotations.exp((0.1, -0.1, 0.2))
    states = np.concatenate([start, np.zeros((1, 3)), [[1.0, 0, 0, 0]], np.zeros((1, 3))], axis=1)
    limits = np.array([[1.5, 1.5, 0.0, 0.0, 0.0, 0.15]])
    problem = changed(fixed_problem(states, goal, lean), input_max=limits)
    plan = fresh(name, 1).solve(problem, 0.0)
    assert plan.status[0] in ("solved", "iteration_limit")
    assert not plan.inputs[:, :, 2:5].any()
    assert plan.states[0, :, 2] == pytest.approx(np.full(PARAMS.stages + 1, -0.05))
    end = plan.states[0, -1]
    assert np.linalg.norm(end[:2] - goal[0, :2]) < 0.6 * np.linalg.norm(start[0, :2] - goal[0, :2])
    assert math.degrees(rotations.log(end[6:10])[2]) > 3.0
