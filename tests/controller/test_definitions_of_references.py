# SPDX-License-Identifier: Apache-2.0
"""Published references and their feed-forward are what their definitions say, in general position:
a target that tumbles about an axis of its own, its centre of mass aside, chasers in any attitude
and in every kind of motion. The right sides are finite differences of paths in small steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from chaserdock_controller.guidance.approach_cone import cone_of
from chaserdock_controller.guidance.chaser_machine import ChaserMachine
from chaserdock_controller.guidance.docking import dock_of
from chaserdock_controller.guidance.horizon import ReferenceBuilder
from chaserdock_controller.guidance.phases import Phase
from chaserdock_controller.guidance.pointing import calibration_turns, turning_wrench
from chaserdock_controller.guidance.trajectories import (
    Escape,
    Motion,
    circuit,
    glide,
    move_to,
    stay,
    stop,
)
from chaserdock_controller.interfaces import HorizonReference, RelativePose, TargetState
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_models.docking_geometry import view_of
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.docking import Port
from docking_cases import scenario as docking_scenario
from flight_cases import fleet_of, scenario
from general_position import (
    BODY,
    INERTIA,
    FreeTarget,
    attitude,
    matrix,
    moving_odometry,
    relative_pose,
    target_state,
    turn_between,
)

MASS_KG, NOW_S = 17.8, 3.2
STEP_S, STAGES = 0.2, 4
KINDS = ("move", "circuit", "calibration", "escape", "glide", "corridor")
PLACES = ((-1.0, 0.3, 0.5), (0.9, -0.8, 0.4), (0.2, 1.1, -0.9), (1.2, 0.7, -0.3), (-0.5, -1.1, 0.8),
          (0.6, 0.7, 1.3))  # fmt: skip


def mission(rng: np.random.Generator) -> Scenario:
    return scenario(
        chaser={"mass_kg": MASS_KG, "inertia_kg_m2": list(INERTIA)},
        target={
            "model": "servicer",
            "motion": "torque_free",
            "mass_kg": BODY.mass_kg,
            "inertia_kg_m2": [1.1, 1.7, 2.2],
        },
        controller={"dt_s": STEP_S, "horizon_s": STEP_S * STAGES},
        limits={"min_distance_shape_m": 0.1},
        chasers=[{"position_m": list(p), "q_wxyz": attitude(rng).tolist()} for p in PLACES],
    )


def motions(rng: np.random.Generator) -> dict[str, Motion]:
    """A motion of each kind, none of them at rest at ``NOW_S``."""
    begun = move_to(stay(PLACES[0], 0.0), rng.uniform(-1.5, 1.5, 3), 0.9, 0.07)
    burn = rng.uniform(-0.02, 0.02, 3)
    coast = np.concatenate([rng.uniform(-2.0, 2.0, 3), rng.uniform(-0.05, 0.05, 3)])
    along = rng.normal(size=3)
    return {
        "move": move_to(begun, rng.uniform(-1.5, 1.5, 3), 2.3, 0.07),
        "circuit": circuit(PLACES[1], rng.normal(size=3), 2.0, NOW_S - 9.0, 0.12),
        "calibration": stay(PLACES[2], 0.0),
        "escape": Escape(NOW_S - 1.0, coast, burn, 1.9, 0.011, 300.0),
        "glide": glide(PLACES[4], along / np.linalg.norm(along), 2.4, (0.2, 0.05), (0.3, 0.01)),
        "corridor": move_to(stay(PLACES[5], 0.0), 0.4 * np.array(PLACES[5]), 1.1, 0.05),
    }


class Flight:
    """Chasers in every kind of motion around a tumbling target, and their references by
    definition.
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.scenario = mission(rng)
        self.start, self.moves = target_state(rng, round(NOW_S * 1e9)), motions(rng)
        self.chasers = fleet_of(self.scenario, 0.0).chasers
        for c, (kind, move) in zip(self.chasers, self.moves.items(), strict=True):
            phase = Phase.APPROACH if kind == "corridor" else Phase.HOLD
            c.position_m = np.array(PLACES[c.number])
            c.state = replace(
                c.state, phase=phase, move=move, since_s=NOW_S - 7.3,
                faces=kind == "circuit", turns=kind == "calibration",
            )  # fmt: skip
        self.relative = [relative_pose(rng) for _ in self.chasers]
        self.target = FreeTarget(self.start)
        self.builder = ReferenceBuilder(self.scenario)

    def horizon(self, relative: Sequence[RelativePose | None] | None = None) -> HorizonReference:
        known = self.relative if relative is None else relative
        return self.builder.horizon(self.chasers, self.start, BODY, frozenset(), known)

    def attitude_off(self, c: ChaserMachine, time_s: float) -> Array:
        """Attitude (3, 3), CRF to TRF."""
        nominal, own = (
            self.scenario.chasers[c.number],
            matrix(self.scenario.chasers[c.number].q_wxyz),
        )
        if c.state.turns:
            return own @ matrix(calibration_turns(NOW_S + time_s - c.state.since_s))
        if c.state.faces:
            offset = c.state.move.at([NOW_S + time_s])[0]
            return matrix(facing_attitudes(nominal.position_m, nominal.q_wxyz, offset)[0])
        return own

    def place(self, c: ChaserMachine, time_s: float) -> Array:
        """Reference position (3,), WRF, after ``time_s``."""
        position, r, _ = self.target.at(time_s)
        offset = c.state.move.at([NOW_S + time_s])[0][0]
        return position + (offset if isinstance(c.state.move, Escape) else r @ offset)


@pytest.fixture(params=range(2))
def flight(request: pytest.FixtureRequest) -> Flight:
    return Flight(request.param)


def test_horizon_has_the_references_at_its_times(flight: Flight) -> None:
    found = flight.horizon()
    for k in range(STAGES + 1):
        position, r, _ = flight.target.at(k * STEP_S)
        np.testing.assert_allclose(found.target_positions[k], position, atol=1e-8)
        for c in flight.chasers:
            pose = found.references[c.number, k]
            np.testing.assert_allclose(pose[:3], flight.place(c, k * STEP_S), atol=1e-8)
            np.testing.assert_allclose(
                matrix(pose[3:]), r @ flight.attitude_off(c, k * STEP_S), atol=1e-8
            )


def test_facing_chaser_sees_the_target_where_it_does_from_its_nominal_place(
    flight: Flight,
) -> None:
    found, row = flight.horizon(), KINDS.index("circuit")
    nominal = flight.scenario.chasers[row]
    line = matrix(nominal.q_wxyz).T @ -np.array(nominal.position_m)
    for k in range(STAGES + 1):
        pose = found.references[row, k]
        seen = matrix(pose[3:]).T @ (found.target_positions[k] - pose[:3])
        np.testing.assert_allclose(
            seen / np.linalg.norm(seen), line / np.linalg.norm(line), atol=1e-9
        )


def test_reference_now_is_the_beginning_of_the_horizon(flight: Flight) -> None:
    _, r, _ = flight.target.at(0.0)
    for c in flight.chasers:
        position, q, offset = flight.builder.pose(c, flight.start, NOW_S)
        here = flight.place(c, 0.0)
        np.testing.assert_allclose(position, here, atol=1e-9)
        np.testing.assert_allclose(matrix(q), r @ flight.attitude_off(c, 0.0), atol=1e-9)
        np.testing.assert_allclose(offset, r.T @ (here - flight.start.position_m), atol=1e-9)


def test_feed_forward_is_the_wrench_of_the_reference_in_the_middle_of_a_stage(
    flight: Flight,
) -> None:
    """Second differences of position and first differences of the rate, in the chaser's axes."""
    u_ref, h, inertia = flight.horizon().u_ref, 0.01, np.diag(INERTIA)
    for k in range(STAGES):
        middle_s = (k + 0.5) * STEP_S
        path = [flight.target.at(middle_s + d) for d in (-h, 0.0, h)]
        _, r, omega = path[1]
        alpha = (path[2][2] - path[0][2]) / (2 * h)
        for c in flight.chasers:
            places = [flight.place(c, middle_s + d) for d in (-h, 0.0, h)]
            acceleration = (places[0] - 2 * places[1] + places[2]) / h**2
            off = flight.attitude_off(c, middle_s)
            own_rate, own_alpha = off.T @ omega, off.T @ alpha
            torque = inertia @ own_alpha + np.cross(own_rate, inertia @ own_rate)
            force = MASS_KG * (r @ off).T @ acceleration
            np.testing.assert_allclose(u_ref[c.number, k, :3], force, atol=3e-5)
            np.testing.assert_allclose(u_ref[c.number, k, 3:], torque, atol=1e-7)


def test_uniform_rotation_is_predicted_as_such(flight: Flight) -> None:
    """A target with constant rates in place of a free one."""
    steady = flight.scenario.target.model_copy(update={"motion": "constant_rates"})
    flight.scenario = flight.scenario.model_copy(update={"target": steady})
    found = ReferenceBuilder(flight.scenario).horizon(
        flight.chasers[:1], flight.start, BODY, frozenset(), [None]
    )
    start, size = flight.start, float(np.linalg.norm(flight.start.omega_rad_s))
    axis = start.omega_rad_s / size
    for k in range(STAGES + 1):
        t = k * STEP_S
        turned = matrix([math.cos(size * t / 2), *(math.sin(size * t / 2) * axis)])
        r, position = matrix(start.q_wxyz) @ turned, start.position_m + t * start.velocity_m_s
        offset = flight.moves["move"].at([NOW_S + t])[0][0]
        np.testing.assert_allclose(found.references[0, k, :3], position + r @ offset, atol=1e-9)


def test_shape_and_corridor_turn_with_the_target(flight: Flight) -> None:
    found, row = flight.horizon(), KINDS.index("corridor")
    assert found.boxes is not None
    assert found.corridors is not None
    boxes = flight.scenario.target_model().boxes
    axis = np.array(PLACES[row]) / np.linalg.norm(PLACES[row])
    for k in range(STAGES + 1):
        position, r, _ = flight.target.at(k * STEP_S)
        np.testing.assert_allclose(found.corridors[row, k, :3], r @ axis, atol=1e-8)
        for box, moved in zip(boxes, found.boxes[k], strict=True):
            np.testing.assert_allclose(
                moved[:3], position + r @ np.array(box.position_m), atol=1e-8
            )
            np.testing.assert_allclose(moved[3:12].reshape(3, 3), r @ matrix(box.q_wxyz), atol=1e-8)


def test_distance_grows_by_the_largest_standard_deviation_of_the_position(
    flight: Flight,
) -> None:
    """The largest over many directions; the covariance has unequal axes."""
    directions = np.random.default_rng(9).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    limits = flight.scenario.limits
    for known in (flight.relative, [None] * len(flight.chasers)):
        found = flight.horizon(known)
        for c, pose in zip(flight.chasers, known, strict=True):
            spread = (flight.start if pose is None else pose).covariance[:3, :3]
            sigma = math.sqrt(max(np.einsum("ki,ij,kj->k", directions, spread, directions)))
            wider = found.min_distance_target_m[c.number] - c.min_distance_target_m()
            assert wider == pytest.approx(limits.estimate_margin_sigmas * sigma, rel=5e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_velocity_and_acceleration_are_the_derivatives_of_the_position(kind: str) -> None:
    rng = np.random.default_rng(5)
    move, h = motions(rng)[kind], 1e-3
    times_s = move.start_s + rng.uniform(0.05, 0.95, 25) * min(move.duration_s, 40.0)
    before, here, after = (move.at(times_s + d) for d in (-h, 0.0, h))
    np.testing.assert_allclose(here[1], (after[0] - before[0]) / (2 * h), atol=1e-6)
    smooth = np.ones(25, dtype=bool)
    if isinstance(move, Escape):  # its acceleration ends with the burn
        smooth = np.abs(times_s - move.start_s - move.burn_s) > 2 * h
    np.testing.assert_allclose(
        here[2][smooth], ((after[1] - before[1]) / (2 * h))[smooth], atol=1e-5
    )


@pytest.mark.parametrize("kind", ["move", "circuit", "glide"])
def test_a_new_move_continues_the_present_motion(kind: str) -> None:
    """Position, velocity and acceleration; the new one ends at rest."""
    move = motions(np.random.default_rng(6))[kind]
    for begun in (stop(move, NOW_S), move_to(move, (0.4, -1.2, 0.8), NOW_S, 0.05)):
        for old, new in zip(move.at([NOW_S]), begun.at([NOW_S]), strict=True):
            np.testing.assert_allclose(new, old, atol=1e-12)
        end_s = begun.start_s + begun.duration_s
        for rate in begun.at([end_s - 1e-9])[1:]:
            np.testing.assert_allclose(rate, 0.0, atol=1e-7)


def test_glide_is_slow_from_the_end_of_its_first_length_on() -> None:
    along, begun = np.array([2.0, -1.0, 2.0]) / 3.0, np.array([0.3, 0.7, -0.4])
    path = glide(begun, along, 1.3, (0.5, 0.05), (0.3, 0.02))
    slow_s = path.start_s + path.ramps_s[0] + path.holds_s[0] + path.ramps_s[1]
    places, speeds, _ = path.at([slow_s, path.start_s + path.duration_s])
    np.testing.assert_allclose(places, begun + np.outer([0.5, 0.8], along), atol=1e-12)
    np.testing.assert_allclose(speeds[0], 0.02 * along, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_turn_of_a_search_follows_attitude_and_rate(seed: int) -> None:
    """A critically damped oscillator of 2 rad/s about the moving attitude."""
    rng = np.random.default_rng(seed)
    body = scenario(chaser={"inertia_kg_m2": list(INERTIA), "torque_max_N_m": 9.0}).chaser
    own, inertia = moving_odometry(rng, 0, 0, 0), np.diag(INERTIA)
    error, rate = rng.uniform(-0.2, 0.2, (2, 3))
    q = rotations.multiply(own.q_wxyz, rotations.exp(error))
    soon = rotations.multiply(q, rotations.exp(0.02 * rate))
    omega = np.array(own.omega_rad_s)
    torque = inertia @ (4.0 * error + 4.0 * (rate - omega)) + np.cross(omega, inertia @ omega)
    np.testing.assert_allclose(turning_wrench(own, body, q, soon)[3:], torque, atol=1e-9)


def test_port_is_seen_as_by_an_observer_on_it() -> None:
    """Rates of gap, side and attitude by differences of poses in TRF."""
    rng, h = np.random.default_rng(7), 1e-4
    chaser, target = (
        BodyState(
            rng.uniform(-1, 1, 3), rng.uniform(-0.1, 0.1, 3), attitude(rng),
            rng.uniform(-0.3, 0.3, 3),
        )
        for _ in range(2)
    )  # fmt: skip
    axis, place, q_off, reach_m = rng.normal(size=3), rng.normal(size=3), attitude(rng), 0.35
    axis /= np.linalg.norm(axis)
    port = Port(chaser=0, position_m=tuple(place.tolist()), axis=tuple(axis.tolist()))

    def seen(t: float) -> tuple[float, Array, Array]:
        poses = []
        for b in (chaser, target):
            size = float(np.linalg.norm(b.omega_rad_s))
            half = size * t / 2
            turn = matrix([math.cos(half), *(math.sin(half) * b.omega_rad_s / size)])
            poses.append((b.position_m + t * b.velocity_m_s, matrix(b.q_wxyz) @ turn))
        (p, r), (p_t, r_t) = poses
        tip = r_t.T @ (p + r @ np.array([reach_m, 0.0, 0.0]) - p_t) - place
        gap = float(tip @ axis)
        return gap, tip - gap * axis, r_t.T @ r

    view = view_of(port, reach_m, q_off, chaser, target)
    (gap_0, side_0, r_0), (gap, side, _), (gap_1, side_1, r_1) = map(seen, (-h, 0.0, h))
    assert view.gap_m == pytest.approx(gap, abs=1e-12)
    assert view.lateral_m == pytest.approx(float(np.linalg.norm(side)), abs=1e-12)
    assert view.closing_m_s == pytest.approx((gap_0 - gap_1) / (2 * h), abs=1e-7)
    speed = float(np.linalg.norm(side_1 - side_0)) / (2 * h)
    assert view.lateral_speed_m_s == pytest.approx(speed, abs=1e-7)
    rate = float(np.linalg.norm(turn_between(r_0, r_1))) / (2 * h)
    assert view.rate_rad_s == pytest.approx(rate, abs=1e-7)
    cosine = (np.trace(matrix(q_off).T @ seen(0.0)[2]) - 1.0) / 2.0
    assert view.angle_rad == pytest.approx(math.acos(cosine), abs=1e-6)


def test_target_is_where_a_moving_reference_says() -> None:
    """An escape keeps its place in WRF relative to the target's origin, whatever that turns."""
    flight = Flight(1)
    c = flight.chasers[KINDS.index("escape")]
    turned: TargetState = replace(flight.start, q_wxyz=attitude(np.random.default_rng(3)))
    one, other = (flight.builder.pose(c, t, NOW_S) for t in (flight.start, turned))
    np.testing.assert_allclose(one[0], other[0], atol=1e-12)
    assert np.linalg.norm(one[2] - other[2]) > 0.1


def test_corridor_to_a_port_is_wide_enough_at_its_end_for_twice_the_lateral_error() -> None:
    """About the axis of a port that does not point away from the target's centre."""
    mission, axis = docking_scenario(), np.array([2.0, -1.0, 2.0]) / 3.0
    port = Port(chaser=0, position_m=(0.23, -0.08, 0.17), axis=(2 / 3, -1 / 3, 2 / 3))
    docking = mission.docking.model_copy(update={"ports": (port,)})
    mission = mission.model_copy(update={"docking": docking})
    cone, dock = cone_of(mission, 0), dock_of(mission, 0)
    assert dock is not None
    end = np.asarray(dock.offset(-mission.docking.overdrive_m))
    along = float(end @ axis)
    outwards = (end - along * axis) / np.linalg.norm(end - along * axis)
    widest = end + 2.0 * mission.docking.corridor.lateral_m * outwards
    assert cone.room_m(widest) == pytest.approx(0.0, abs=1e-9)
