# SPDX-License-Identifier: Apache-2.0
"""The training environments' kernel against the world: flight, actuators, contact, and what is
drawn.
"""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.guidance.approach_cone import cone_of
from chaserdock_models import rotations
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.errors import ScenarioError
from chaserdock_protocol.scenario import Scenario, parse_scenario
from chaserdock_world.actuators.ideal import fly_to
from chaserdock_world.actuators.thrusters import make_actuators
from chaserdock_world.physics.simulation import TARGET, Physics
from env_cases import (
    ALONG_PORT,
    REWARD,
    SEVERAL,
    START,
    actuator_command,
    along_port,
    docking,
    learning,
    start_of,
)
from numpy.typing import NDArray

from chaserdock.analysis.criteria import nearest_allowed_m
from chaserdock.envs import batch as batch_module
from chaserdock.envs import native
from chaserdock.envs.batch import DockingBatch
from chaserdock.envs.sensor_errors import _filters
from chaserdock.envs.task import OUTCOMES, SUCCESSES

HERE = (0.0, 0.0, 0.0)
GENERAL = (
    "seed=5",
    "time.physics_hz=1000",  # whole nanoseconds, to which messages round times
    "time.rate_hz=10",
    "time.image_hz=10",
    'truth.preset="mismatch"',
    "limits.max_reference_distance_m=1000.0",
    "chasers.0.start_offset_m=[-20.0, 1.0, 2.0]",
    "chasers.0.start_velocity_m_s=[-0.2, 0.1, 0.05]",
    "chaser.inertia_kg_m2=[0.3, 0.4, 0.5]",
    "target.inertia_kg_m2=[0.6, 0.7, 0.9]",
    "target.inertia_products_kg_m2=[0.05, 0.02, -0.03]",
)


def worst_difference(scenario: Scenario, ticks: int) -> float:
    """The largest difference of a position, m, between the second of three environments and the
    world, in free flight for a third of the time and then under random actions.
    """
    batch = DockingBatch(scenario, 3)
    batch.start(1)
    drawn = scenario.model_copy(update={"seed": scenario.seed + int(batch.plants[1])})
    physics, actuators = Physics(drawn), {"chaser/0": make_actuators(drawn, 0)}
    timing, rng, worst = scenario.timing, np.random.default_rng(2), 0.0
    for tick in range(ticks):
        actions = rng.uniform(-0.3, 1.2, (3, 1, batch.task.actuators))
        if tick < ticks // 3:
            actions[:] = 0.0
        actions = actions.astype(np.float32)
        step = timing.step_of_tick(tick)
        sent = actuator_command(scenario, tick, actions[1, 0].astype(float))
        actuators["chaser/0"].command(sent, step + timing.latency_steps, step)
        fly_to(timing.step_of_tick(tick + 1), physics, actuators, 1.0 / timing.physics_hz)
        actuators["chaser/0"].take_output(timing.step_of_tick(tick + 1))
        assert batch.step(actions).outcomes[1, 0] == 0
        for name, number in (("chaser/0", 0), (TARGET, None)):
            ours, worlds = batch.state(1, number), physics.state(name)
            worst = max(worst, float(np.abs(ours.position_m - worlds.position_m).max()))
            turned = rotations.angle_between(ours.q_wxyz, worlds.q_wxyz)
            assert float(turned) < 1e-7  # the resolution of an angle from a product
            np.testing.assert_allclose(ours.omega_rad_s, worlds.omega_rad_s, rtol=0.0, atol=1e-9)
    physics.close()
    travelled = np.linalg.norm(batch.state(1, 0).velocity_m_s - [-0.2, 0.1, 0.05])
    assert travelled > 0.05  # the actions did something
    return worst


@pytest.mark.slow
@pytest.mark.parametrize("latency_s", [0.0, 0.033, 0.1])
@pytest.mark.parametrize("actuation", ["ideal", "thrusters"])
def test_sixty_seconds_are_those_of_the_world(actuation: str, latency_s: float) -> None:
    scenario = docking(
        *GENERAL,
        f'chaser.actuation="{actuation}"',
        f"time.latency_s={latency_s}",
        episode_s=90.0,
    )
    assert worst_difference(scenario, 600) < 1e-9


def test_a_prescribed_target_is_that_of_the_world() -> None:
    scenario = docking(
        *GENERAL[:5],
        *GENERAL[5:-2],
        'target.motion="constant_rates"',
        'docking.kind="held"',
        "success.latched=[]",
        'chaser.actuation="ideal"',
    )
    assert worst_difference(scenario, 60) < 1e-9


# -- contact ---------------------------------------------------------------------------------------

ONWARD = (0.018, 0.0, 0.0)
APPROACHES = {
    "straight": ((0.4, 0.0, 0.0), ONWARD, (0.0, 0.0, 0.0), True),
    "rolled": ((0.4, 0.004, -0.003), ONWARD, (0.04, 0.0, 0.0), True),
    "fast": ((0.4, 0.0, 0.0), (0.024, 0.0, 0.0), (0.0, 0.0, 0.0), False),
    "drifting": ((0.4, -0.02, 0.0), (0.018, 0.012, 0.0), (0.0, 0.0, 0.0), False),
    "tilted": ((0.4, 0.0, -0.02), ONWARD, (0.0, 0.06, 0.0), False),
    "beside": ((0.4, 0.012, 0.0), ONWARD, (0.0, 0.0, 0.0), False),
}


@pytest.mark.parametrize("name", APPROACHES)
def test_a_drift_to_the_port_ends_as_in_the_world(name: str) -> None:
    """Within the tolerances it is latched there and docked here; else refused, and a collision."""
    offset, velocity, rotation, docks = APPROACHES[name]
    scenario = along_port(offset, velocity, rotation)
    batch, physics = DockingBatch(scenario, 1), Physics(scenario)
    batch.start(0)
    physics.command_latch(0, "arm", 0)
    steps, latch = scenario.timing.steps_per_tick, physics.latches["chaser/0"]
    outcome, ended_tick, touched_tick = 0, 0, None
    for tick in range(1, 200):
        if not outcome:
            outcome = int(batch.step(np.zeros((1, 1, 6))).outcomes[0, 0])
            ended_tick = tick
        if touched_tick is None:
            physics.advance(steps, {})
            touched_tick = tick if latch.touches else None
    physics.close()
    assert touched_tick is not None
    assert latch.touches[0].latched == docks
    assert OUTCOMES[outcome] == ("docked" if docks else "collision")
    assert abs(ended_tick - touched_tick) <= 2


def outcome_of(scenario: Scenario, ticks: int = 400) -> tuple[str, float]:
    """How a drift ends, and its last reward."""
    batch = DockingBatch(scenario, 1)
    batch.start(0)
    for _ in range(ticks):
        done = batch.step(np.zeros((1, 1, batch.task.actuators)))
        if done.outcomes[0, 0]:
            ended = done.terminated[0, 0], done.truncated[0, 0]
            word = OUTCOMES[int(done.outcomes[0, 0])]
            assert ended == ((False, True) if word in ("held", "time out") else (True, False))
            return word, float(done.rewards[0, 0])
    raise AssertionError("no end")


@pytest.mark.parametrize(
    ("offset", "velocity", "word"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "time out"),
        ((0.0, 0.9, 0.05), (0.1, -0.09, 0.0), "too near"),
        ((0.0, 0.0, 0.0), (-2.0, 0.0, 0.0), "lost"),
        ((0.0, 0.0, 0.5), (0.3, 0.0, -0.02), "too near"),
    ],
)
def test_other_ends(
    offset: tuple[float, float, float], velocity: tuple[float, float, float], word: str
) -> None:
    found, reward = outcome_of(along_port(offset, velocity))
    assert found == word
    assert (reward < -25.0) == (word != "time out")


def test_a_panel_beside_the_way_is_hit() -> None:
    """The probe passes the port's face at 0.3 m and meets a cuboid there."""
    scenario = along_port((0.0, 0.0, 0.0), (0.05, 0.0, 0.0), limits={"min_distance_target_m": 0.0})
    batch = DockingBatch(scenario, 1)
    batch.start(0)
    turned = dataclasses.replace(batch.state(0, 0), q_wxyz=np.array([0.6, 0.0, 0.0, 0.8]))
    solids: Any = batch.task.kept[3]
    solids[0, 3:6] = [-1.0, 0.35, -0.05]  # where the turned probe points
    place(batch, turned)
    done = batch.step(np.zeros((1, 1, 6)))
    assert OUTCOMES[int(done.outcomes[0, 0])] == "collision"


def test_the_keep_out_is_that_of_criteria_and_corridor() -> None:
    """At random places around the target, without contact: nearer than missions allow, or outside
    of the guidance's cone within the keep-out distance.
    """
    scenario = along_port(HERE, HERE, limits={"min_distance_target_m": 0.8})
    cone, nearest_m = cone_of(scenario, 0), nearest_allowed_m(scenario, 0)
    rng, found = np.random.default_rng(4), []
    for _ in range(300):
        batch = DockingBatch(scenario, 1)
        batch.start(0)
        state = batch.state(0, 0)
        offset = rng.normal(size=3) + np.array([-1.0, 0.0, 0.0])
        offset *= rng.uniform(0.45, 0.9) / np.linalg.norm(offset)
        outward = rotations.multiply([0.0, 0.0, 0.0, 1.0], state.q_wxyz)  # the probe points away
        place(batch, dataclasses.replace(state, position_m=offset, q_wxyz=outward))
        word = OUTCOMES[int(batch.step(np.zeros((1, 1, 6))).outcomes[0, 0])]
        if word == "collision":
            continue
        away_m = float(np.linalg.norm(offset))
        near = away_m < nearest_m or (away_m < 0.8 and cone.room_m(offset) < 0.0)
        assert (word == "too near") == near
        found.append((near, away_m < 0.8))
    assert {(False, False), (False, True), (True, True)} == set(found)


def test_leaving_the_corridor_before_the_port_costs_its_weight() -> None:
    weights = {"corridor_per_s": 3.0}
    scenario = along_port((0.2, 0.0, 0.0), HERE, learning=learning(reward=weights))
    for lateral_m, gap_m, outside in (
        (0.029, 0.2, False),
        (0.031, 0.2, True),  # docking.corridor
        (0.031, 0.4, False),  # before its entry
        (0.009, 0.05, True),  # docking.final
        (0.007, 0.05, False),
    ):
        batch = DockingBatch(scenario, 1)
        batch.start(0)
        off = [-0.55 - gap_m, 0.6 * lateral_m, -0.05 + 0.8 * lateral_m]
        place(batch, dataclasses.replace(batch.state(0, 0), position_m=np.array(off)))
        done = batch.step(np.zeros((1, 1, 6)))
        assert done.outcomes[0, 0] == 0
        assert done.rewards[0, 0] == pytest.approx(-3.0 / 15.0 if outside else 0.0)


def place(batch: DockingBatch, state: BodyState) -> None:
    """Set the motion of the only chaser, whose frame is its principal one."""
    rows = batch._arrays["bodies"]
    parts = [state.position_m, state.velocity_m_s, state.q_wxyz, state.omega_rad_s]
    rows[:13, 0] = np.concatenate(parts)


# -- reward and observation ------------------------------------------------------------------------


def test_reward_and_observation_follow_from_the_motion() -> None:
    scenario = docking('chaser.actuation="ideal"', *GENERAL[4:5])
    batch = DockingBatch(scenario, 4)
    before = batch.start(3)
    rng, tick_s = np.random.default_rng(1), 1.0 / scenario.time.rate_hz
    port, reach_m = scenario.docking.ports[0], scenario.chaser.probe_reach_m
    goal = np.array(port.position_m) + np.array(port.axis) * reach_m
    limits = np.where(np.arange(6) < 3, scenario.chaser.wrench_max, 0.0)
    for _ in range(20):
        actions = rng.uniform(-1.5, 1.5, (4, 1, 6)).astype(np.float32)
        done = batch.step(actions)
        for e in range(4):
            chaser, target = batch.state(e, 0), batch.state(e, None)
            position = rotations.rotate_inverse(
                target.q_wxyz, chaser.position_m - target.position_m
            )
            velocity = rotations.rotate_inverse(
                target.q_wxyz, chaser.velocity_m_s - target.velocity_m_s
            ) - rotations.cross(target.omega_rad_s, position)
            q = rotations.multiply(rotations.conjugate(target.q_wxyz), chaser.q_wxyz)
            rate = chaser.omega_rad_s - rotations.rotate_inverse(q, target.omega_rad_s)
            seen = done.observations[e, 0]
            expected = [*(position - goal), *velocity, *(q * np.sign(q[0])), *rate]
            np.testing.assert_allclose(seen, [*expected, *target.omega_rad_s], rtol=0, atol=1e-6)
            away, turned = zip(
                *(
                    (np.linalg.norm(o[:3]), 2.0 * np.arcsin(np.linalg.norm(o[7:10])))
                    for o in (before[e, 0].astype(float), seen.astype(float))
                ),
                strict=True,
            )
            impulse = float(np.abs(np.clip(actions[e, 0], -1.0, 1.0)) @ limits) * tick_s
            reward = (
                REWARD["progress_per_m"] * (away[0] - away[1])
                + REWARD["turn_per_rad"] * (turned[0] - turned[1])
                - REWARD["impulse_per_N_s"] * impulse
                - tick_s
                * (
                    REWARD["distance_per_m_s"] * away[1]
                    + REWARD["angle_per_rad_s"] * turned[1]
                    + REWARD["time_per_s"]
                )
            )
            assert done.rewards[e, 0] == pytest.approx(reward, abs=2e-5)
        before = done.observations


def test_holding_at_the_reference_pose_succeeds() -> None:
    keys = learning("hold", episode_s=8.0, reward={"within_per_s": 2.0, "success": 50.0})
    values = ALONG_PORT | {"learning": keys, "docking": {}}
    scenario = parse_scenario(values, "test")
    assert outcome_of(scenario) == ("held", pytest.approx(50.0 + 2.0 / scenario.time.rate_hz))
    drifting = along_port((0.3, 0.0, 0.0), (0.0, 0.0, 0.0), docking={}, learning=keys)
    assert outcome_of(drifting) == ("time out", 0.0)


def test_a_chaser_that_comes_to_its_docking_distance_is_docked_after_the_stated_time() -> None:
    at_goal = along_port((0.4, 0.0, 0.05), (0.0, 0.0, 0.0), docking={})
    scenario = at_goal.model_copy(
        update={"approach": at_goal.approach.model_copy(update={"dock_distance_m": 0.602})}
    )
    nominal = np.array(scenario.chasers[0].position_m)
    goal = nominal / np.linalg.norm(nominal) * 0.602
    batch = DockingBatch(scenario, 1)
    batch.start(0)
    place(batch, dataclasses.replace(batch.state(0, 0), position_m=goal))
    ticks = round(scenario.approach.docked_time_s * scenario.time.rate_hz)
    for tick in range(ticks):
        outcome = int(batch.step(np.zeros((1, 1, 6))).outcomes[0, 0])
        assert (outcome in SUCCESSES) == (tick == ticks - 1)


def test_statistical_observations_have_the_errors_of_the_filter() -> None:
    """Of the drawn start and after 10 s of updates, in one place: no mean, and the deviations of
    the table.
    """
    keys = {"observation": "statistical", "episode_s": 60.0}
    camera = {"width_px": 960, "height_px": 540}
    scenario = along_port(HERE, HERE, learning=learning(**keys), camera=camera)
    exact = along_port(HERE, HERE, learning=learning(episode_s=60.0), camera=camera)
    noisy, true = DockingBatch(scenario, 2000), DockingBatch(exact, 1)
    first, truth = noisy.start(4), true.start(4)
    table: Any = noisy.task.kept[7]
    numbers = noisy.task.numbers
    at = (np.linalg.norm([-1.0, 0.0, -0.05]) - numbers.bin_first_m) / numbers.bin_m
    row = table[round(float(at))]
    later = first
    for _ in range(150):
        later = noisy.step(np.zeros((2000, 1, 6))).observations
    for seen in (first, later):
        off = (seen - truth)[:, 0].astype(float)
        # The attitude error of the target is half of it in the quaternion, and moves the chaser
        # about it at 1 m: mostly along y and z.
        assert (np.abs(off.mean(axis=0)) < 5.0 * off.std(axis=0) / np.sqrt(2000) + 1e-9).all()
        np.testing.assert_allclose(2.0 * off[:, 7:10].std(axis=0), row[3:, 6], rtol=0.1)
        sigma_x = np.hypot(row[0, 6], 0.05 * row[4, 6])
        assert off[:, 0].std() == pytest.approx(sigma_x, rel=0.1)
        rate = np.hypot(row[3:, 7], row[3:, 8])
        np.testing.assert_allclose(off[:, 13:16].std(axis=0), rate, rtol=0.1)
    moved = (later - first)[:, 0, :3]
    assert (moved.std(axis=0) > 0.0).all()


@pytest.mark.parametrize("sigma", [1e-5, 3e-4, 1e-2])
def test_the_filter_is_the_kalman_filter(sigma: float) -> None:
    """Gains and covariance by thousands of steps of its recursion."""
    t, density = 0.2, 2e-5
    gain, rate_gain, *_, error, rate_error, alone = _filters(
        np.array([[sigma]]), density, t
    ).ravel()
    move = np.array([[1.0, t], [0.0, 1.0]])
    noise = density**2 * np.array([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]])
    p, k = np.diag([sigma**2, 1e-2]), np.zeros((2, 1))
    for _ in range(6000):
        ahead = move @ p @ move.T + noise
        k = ahead[:, :1] / (ahead[0, 0] + sigma**2)
        p = ahead - k @ ahead[:1]
    np.testing.assert_allclose([gain, rate_gain], k[:, 0], rtol=1e-9)
    found = np.array([[error, 0.0], [rate_error, alone]])
    np.testing.assert_allclose(found @ found.T, p, rtol=1e-9)


def test_a_target_out_of_view_is_not_measured() -> None:
    keys = learning(observation="statistical", episode_s=60.0)
    scenario = along_port(HERE, HERE, learning=keys)
    batch = DockingBatch(scenario, 2)
    batch.start(0)
    away = dataclasses.replace(batch.state(0, 0), q_wxyz=np.array([0.0, 0.0, 0.0, 1.0]))
    place(batch, away)
    errors = batch._arrays["errors"].copy()
    batch.step(np.zeros((2, 1, 6)))
    after = batch._arrays["errors"]
    np.testing.assert_allclose(after[6:, 0], errors[6:, 0], rtol=0, atol=0)
    np.testing.assert_allclose(after[:6, 0], errors[:6, 0] + errors[6:, 0] / 15.0, rtol=1e-12)
    assert (after[6:, 1] != errors[6:, 1]).all()


# -- seeds, rejections, several chasers ------------------------------------------------------------


def flown(batch: DockingBatch, seed: int, ticks: int = 120) -> list[NDArray[Any]]:
    """Observations and rewards of the first two environments, with restarts."""
    rng, out = np.random.default_rng(7), list[NDArray[Any]]()
    out.append(batch.start(seed)[:2])
    for _ in range(ticks):
        actions = np.zeros((batch.environments, batch.chasers, batch.task.actuators))
        actions[:2] = rng.uniform(-1.0, 1.0, actions[:2].shape)
        done = batch.step(actions)
        out += [done.observations[:2], done.rewards[:2], done.outcomes[:2]]
    return out


@pytest.mark.parametrize(
    ("task", "observation"),
    [("dock", "truth"), ("dock", "statistical"), ("inspect", "statistical"), ("detumble", "truth")],
)
def test_equal_seeds_repeat_to_the_bit_whatever_the_number_of_environments(
    task: str, observation: str
) -> None:
    scenario = docking(
        'truth.preset="mismatch"',
        task=task,
        observation=observation,
        start=start_of(task),
        episode_s=3.0,
    )
    small, large = flown(DockingBatch(scenario, 2), 11), flown(DockingBatch(scenario, 9), 11)
    assert all(np.array_equal(a, b) for a, b in zip(small, large, strict=True))
    again = DockingBatch(scenario, 2)
    flown(again, 5, 17)
    assert all(np.array_equal(a, b) for a, b in zip(small, flown(again, 11), strict=True))
    other = flown(DockingBatch(scenario, 2), 12)
    assert not np.array_equal(small[0], other[0])
    outcomes = np.array(small[3::3])
    assert (outcomes != 0).any()  # episodes ended, and new ones began
    assert ((outcomes[:-1] != 0) <= (outcomes[1:] == 0)).all()


@pytest.mark.parametrize("level", [2, 3])
@pytest.mark.parametrize(
    ("task", "actuation"),
    [("dock", "ideal"), ("dock", "thrusters"), ("inspect", "ideal"), ("detumble", "thrusters")],
)
def test_every_instruction_set_flies_the_same_bits(
    level: int, task: str, actuation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if native.LIBRARY.level < level:
        pytest.skip(f"this processor has no copy {level}")
    scenario = docking(
        'truth.preset="mismatch"',
        f'chaser.actuation="{actuation}"',
        task=task,
        observation="truth" if task == "detumble" else "statistical",
        start=start_of(task),
        episode_s=3.0,
    )
    expected, own = flown(DockingBatch(scenario, 2), 1), native.function
    monkeypatch.setattr(
        batch_module, "function", lambda name, result=None: own(name, result, level)
    )
    found = flown(DockingBatch(scenario, 2), 1)
    assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))


def test_starts_fill_their_spread() -> None:
    scenario = docking(start=START)
    batch = DockingBatch(scenario, 3000)
    batch.start(2)
    position, attitude = scenario.start_pose(0)
    states = [batch.state(e, 0) for e in range(3000)]
    off = np.array([s.position_m for s in states]) - position
    np.testing.assert_allclose(np.abs(off).max(axis=0), START["position_m"], rtol=0.01)
    np.testing.assert_allclose(off.std(axis=0), np.array(START["position_m"]) / 3**0.5, rtol=0.05)
    turned = [rotations.angle_between(s.q_wxyz, attitude) for s in states]
    assert np.radians(8.0) < max(turned) <= np.radians(8.0) * 3**0.5
    speed = np.array([s.velocity_m_s for s in states])
    np.testing.assert_allclose(np.abs(speed).max(axis=0), 0.02, rtol=0.01)
    rates = np.array([batch.state(e, None).omega_rad_s for e in range(3000)])
    spread = np.abs(rates - np.array(scenario.target.omega_rad_s)).max(axis=0)
    np.testing.assert_allclose(spread, np.radians(1.0), rtol=0.01)


def test_bodies_are_drawn_from_the_truth() -> None:
    drawn = DockingBatch(docking('truth.preset="mismatch"'), 500)
    drawn.start(1)
    masses = drawn._arrays["bodies"][13, :500]
    assert masses.std() == pytest.approx(1.78, rel=0.2)  # 10 % of 17.8 kg
    assert len(set(masses.tolist())) > 150
    same = DockingBatch(docking(), 500)
    same.start(1)
    assert set(same._arrays["bodies"][13, :500].tolist()) == {17.8}


def test_actions_that_are_not_finite_are_counted_and_flown_as_zero() -> None:
    scenario = docking('chaser.actuation="ideal"', episode_s=2.0)
    bad, still = DockingBatch(scenario, 3), DockingBatch(scenario, 3)
    bad.start(1)
    still.start(1)
    actions = np.zeros((3, 1, 6))
    actions[0] = 0.5
    refused = actions.copy()
    refused[1, 0, 2], refused[2, 0, 0] = np.nan, np.inf
    for tick in range(10):
        ours, theirs = bad.step(refused), still.step(actions)
        np.testing.assert_array_equal(ours.observations, theirs.observations)
        assert ours.rejected.tolist() == [0, tick + 1, tick + 1]
        assert theirs.rejected.tolist() == [0, 0, 0]
    for _ in range(20):
        bad.step(refused)
    ours = bad.step(refused)
    assert ours.outcomes[:, 0].tolist() == [0, 0, 0]  # started anew, with the count
    assert ours.rejected.tolist() == [0, 0, 0]
    with pytest.raises(ValueError, match=r"^actions: the shape is \(3, 6\), not \(3, 1, 6\)$"):
        bad.step(actions[:, 0])
    with pytest.raises(ValueError, match="environments: at least 1"):
        DockingBatch(scenario, 0)


def test_a_docked_chaser_moves_with_the_target_and_a_failure_ends_the_episode_of_all() -> None:
    scenario = parse_scenario(SEVERAL, "test")
    batch = DockingBatch(scenario, 1)
    batch.start(0)
    zeros = np.zeros((1, 3, 6))
    done = batch.step(zeros)
    while not done.terminated.any():
        done = batch.step(zeros)
    assert done.terminated[0].tolist() == [True, False, False]
    places = []
    for _ in range(20):
        done = batch.step(zeros)
        chaser, target = batch.state(0, 0), batch.state(0, None)
        off = chaser.position_m - target.position_m
        places.append(
            np.concatenate(
                [
                    rotations.rotate_inverse(target.q_wxyz, off),
                    rotations.multiply(rotations.conjugate(target.q_wxyz), chaser.q_wxyz),
                ]
            )
        )
        np.testing.assert_allclose(
            chaser.velocity_m_s - target.velocity_m_s,
            rotations.rotate(target.q_wxyz, rotations.cross(target.omega_rad_s,
                             rotations.rotate_inverse(target.q_wxyz, off))),
            atol=1e-12,
        )  # fmt: skip
        assert not done.terminated.any()
        assert done.rewards[0, 0] == 0.0
    assert all(np.allclose(a, b, rtol=0, atol=1e-12) for a, b in pairwise(places))
    # Others are seen relative to oneself, in TRF.
    positions = [batch.state(0, i).position_m for i in range(3)]
    q = batch.state(0, None).q_wxyz
    seen = rotations.rotate_inverse(q, np.array([positions[0], positions[2]]) - positions[1])
    np.testing.assert_allclose(done.observations[0, 1, 16:], seen.ravel(), atol=1e-6)
    rows = batch._arrays["bodies"]
    rows[:3, 1] = rows[:3, 2] + 0.1
    done = batch.step(zeros)
    assert [OUTCOMES[k] for k in done.outcomes[0]] == ["docked", "too near", "too near"]
    assert (done.rewards[0] < [1.0, -29.0, -29.0]).all()
    assert done.rewards[0, 0] == 0.0
    batch.step(zeros)
    rows[:3, 1] = [0.05, 0.1, 0.03]
    done = batch.step(zeros)
    assert [OUTCOMES[k] for k in done.outcomes[0]] == ["after others", "collision", "after others"]
    assert done.terminated.all()


# -- invalid scenarios -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        (["orbit={semi_major_axis_m=7e6}", "target.velocity_m_s=[0.0, 0.0, 0.0]",
          "target.omega_rad_s=[0.0, 0.0, 0.0]"], "do not simulate orbit"),
        (["time.latency_s=0.5"], "time.latency_s longer than a tick"),
        (["truth.chaser.delay_s=0.01"], "truth.chaser.delay_s"),
        (["truth.oscillator=[{mass_share=0.1, position_m=[0.0, 0.0, 0.0], frequency_hz=1.0}]"],
         "truth.oscillator"),
        (["time.rate_hz=96", "time.image_hz=96", "chaser.modulation.carrier_hz=10",
          "time.latency_s=0.0"],
         "chaser.thrusters.0: a minimum on-time of 0.01 s and a fall"),
        (['learning.observation="statistical"', 'target.model="cubesat_12u"',
          'perception.name="model"'], "needs markers"),
    ],
)  # fmt: skip
def test_what_environments_do_not_have_is_one_line(overrides: list[str], text: str) -> None:
    with pytest.raises(ScenarioError, match=text) as raised:
        DockingBatch(docking(*overrides), 1)
    assert len(str(raised.value).splitlines()) == 1


def test_a_scenario_without_the_table_is_one_line() -> None:
    scenario = parse_scenario(ALONG_PORT, "test")
    with pytest.raises(ScenarioError, match=r"^along-port: no table \[learning\], which an env"):
        DockingBatch(scenario, 1)


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ({"task": "juggle"}, "learning.task: must be one of hold, dock, inspect, detumble"),
        ({"episode_s": 0.01}, "learning.episode_s: 0.01 s is shorter than a tick"),
        ({"start": {"position_m": [0.6, 0.0, 0.0]}},
         "learning.start.position_m: chaser 0 could start 0.401 m from the target"),
        ({"start": {"position_m": [30.0, 0.0, 0.0]}}, "could start"),
        ({"start": {"rotation_deg": -1.0}}, "learning.start.rotation_deg"),
        ({"reward": {"style": 1.0}}, "learning.reward.style"),
        ({"reward": {"success": float("nan")}}, "learning.reward.success"),
    ],
)  # fmt: skip
def test_an_invalid_table_is_one_line(table: dict[str, Any], text: str) -> None:
    with pytest.raises(ScenarioError, match=text) as raised:
        parse_scenario(ALONG_PORT | {"learning": learning() | table}, "test")
    assert len(str(raised.value).splitlines()) == 1


def test_a_chaser_without_port_cannot_dock_by_capture() -> None:
    values = SEVERAL | {"docking": ALONG_PORT["docking"]}
    with pytest.raises(
        ScenarioError, match=r"learning\.task: chasers 1, 2 have no port to dock at"
    ):
        parse_scenario(values, "test")


def test_what_is_done_starts_anew_also_if_another_one_is_started_before() -> None:
    scenario = docking(episode_s=0.4)
    batches = [DockingBatch(scenario, 2) for _ in range(2)]
    levels = np.full((2, 1, batches[0].task.actuators), 0.3)
    for batch in batches:
        batch.start(3)
        while not batch.step(levels).truncated[0, 0]:
            pass
    batches[1].start(chosen=np.array([False, True]))
    one, other = (batch.step(levels) for batch in batches)
    assert other.outcomes[0, 0] == 0
    np.testing.assert_array_equal(other.observations[0], one.observations[0])
    assert not np.array_equal(other.observations[1], one.observations[1])
