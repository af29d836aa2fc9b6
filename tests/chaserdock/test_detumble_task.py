# SPDX-License-Identifier: Apache-2.0
"""The training task ``detumble``: the stack against the world, thrusters that may fire, rewards,
and the end of an episode.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.guidance.detumble.allocation import feedback
from chaserdock_controller.guidance.detumble.stack import thruster_wrenches
from chaserdock_controller.guidance.parameters import GUIDANCE
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.errors import ScenarioError
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.scenario.mounting import plume_free_thrusters
from chaserdock_protocol.shipped_scenarios import shipped_scenario
from chaserdock_world.actuators.ideal import fly_to
from chaserdock_world.actuators.thrusters import make_actuators
from chaserdock_world.physics.simulation import TARGET, Physics
from env_cases import actuator_command, docking, learning

from chaserdock.envs.batch import DockingBatch
from chaserdock.envs.observation import goal_of, names_of, observation_of, stack_elements
from chaserdock.envs.stack import mounted_chasers, stated_stack
from chaserdock.envs.task import OUTCOMES
from chaserdock.toml_text import toml_value

MISMATCH = 'truth.preset="mismatch"'
RATE = {"target_rate_deg_s": 1.0}


def pair(*overrides: str, **keys: Any) -> Scenario:
    """Two chasers at opposite ports of a client of 150 kg that tumbles at 7 degrees/s."""
    table = f"learning={toml_value(learning('detumble', **keys))}"
    return load_scenario(shipped_scenario("detumble-pair"), [table, *overrides])


def alone(*overrides: str, **keys: Any) -> Scenario:
    """One chaser with an ideal wrench at the servicer's port."""
    return docking('chaser.actuation="ideal"', *overrides, task="detumble", **keys)


def at_rest(batch: DockingBatch, omega_rad_s: float = 0.0, speed_m_s: float = 0.0) -> None:
    """Set the motion of all stacks."""
    rows = batch._arrays["targets"]
    rows[3:6], rows[10:13] = [[speed_m_s], [0.0], [0.0]], [[0.0], [omega_rad_s], [0.0]]


# -- dynamics --------------------------------------------------------------------------------------


@pytest.mark.parametrize("actuation", ["ideal", "thrusters"])
def test_the_stack_moves_as_latched_bodies_of_the_world(actuation: str) -> None:
    """10 s under random actions. The world's joint gives way by some micrometres."""
    exact = ("time.physics_hz=1000", "time.rate_hz=10", "time.image_hz=10", "timeline=[]")
    scenario = pair(*exact, MISMATCH, f'chaser.actuation="{actuation}"')
    batch = DockingBatch(scenario, 2)
    batch.start(1)
    drawn = scenario.model_copy(update={"seed": scenario.seed + int(batch.plants[1])})
    physics = Physics(drawn)
    for name, number in ((TARGET, None), ("chaser/0", 0), ("chaser/1", 1)):
        physics.place(name, batch.state(1, number))
    for i in range(2):
        physics.close_latch(i)
    actuators = {f"chaser/{i}": make_actuators(drawn, i) for i in range(2)}
    timing, rng = scenario.timing, np.random.default_rng(2)
    before = batch.state(1, None).omega_rad_s
    for tick in range(100):
        actions = rng.uniform(-0.3, 1.0, (2, 2, batch.task.actuators)).astype(np.float32)
        if actuation == "thrusters":  # of those whose plume is free
            free = plume_free_thrusters(scenario, {0, 1})
            actions *= [free[0], free[1]]
        step = timing.step_of_tick(tick)
        for i in range(2):
            sent = actuator_command(scenario, tick, actions[1, i].astype(float), i)
            actuators[f"chaser/{i}"].command(sent, step + timing.latency_steps, step)
        fly_to(timing.step_of_tick(tick + 1), physics, actuators, 1.0 / timing.physics_hz)
        for part in actuators.values():
            part.take_output(timing.step_of_tick(tick + 1))
        batch.step(actions)
    for name, number in ((TARGET, None), ("chaser/0", 0), ("chaser/1", 1)):
        ours, worlds = batch.state(1, number), physics.state(name)
        np.testing.assert_allclose(ours.position_m, worlds.position_m, rtol=0.0, atol=5e-5)
        np.testing.assert_allclose(ours.omega_rad_s, worlds.omega_rad_s, rtol=0.0, atol=1e-5)
        assert float(rotations.angle_between(ours.q_wxyz, worlds.q_wxyz)) < 1e-4
    physics.close()
    assert np.abs(batch.state(1, None).omega_rad_s - before).max() > 0.01


def test_thrusters_whose_plume_hits_something_stay_closed() -> None:
    scenario = pair(reward={"impulse_per_N_s": 1.0})
    free = plume_free_thrusters(scenario, {0, 1})
    closed = ~np.array([free[0], free[1]])
    assert 0 < closed.sum() < closed.size
    idle, firing = DockingBatch(scenario, 1), DockingBatch(scenario, 1)
    idle.start(3)
    firing.start(3)
    for _ in range(5):
        still, done = idle.step(np.zeros((1, 2, 12))), firing.step(closed[None].astype(float))
        np.testing.assert_array_equal(done.observations, still.observations)
        assert done.rewards.tolist() == [[0.0, 0.0]]
    done = firing.step((~closed)[None].astype(float))
    assert (done.rewards < 0.0).all()


# -- observation and reward ------------------------------------------------------------------------


def test_observation_is_that_of_the_stated_stack() -> None:
    scenario = pair(MISMATCH, start=RATE)
    batch = DockingBatch(scenario, 3)
    seen = batch.start(4)
    rng = np.random.default_rng(1)
    for _ in range(8):
        seen = batch.step(rng.uniform(0.0, 0.5, (3, 2, 12))).observations
    centre = stated_stack(scenario).centre_trf_m
    assert batch.task.width == len(names_of(2, "detumble"))
    for e in range(3):
        states, target = [batch.state(e, i) for i in range(2)], batch.state(e, None)
        for i, own in enumerate(states):
            others, added = [states[1 - i].position_m], stack_elements(centre, target)
            goal = goal_of(scenario, i, "detumble")
            found = observation_of(goal, own, target, others, added)
            np.testing.assert_allclose(seen[e, i], found, rtol=2e-7, atol=1e-6)
            np.testing.assert_allclose(found[:6], 0.0, atol=1e-9)  # it is where it is latched
            assert np.abs(found[13:19]).min() > 1e-4


def test_reward_follows_the_rates_of_the_stack() -> None:
    weights = {"spin_per_rad_s": 5.0, "drift_per_m_s": 30.0, "time_per_s": 0.1}
    scenario = alone(reward=weights)
    batch = DockingBatch(scenario, 1)
    batch.start(0)
    stack = stated_stack(scenario)

    def rates() -> tuple[float, float]:
        target = batch.state(0, None)
        velocity = stack_elements(stack.centre_trf_m, target)
        return float(np.linalg.norm(velocity)), float(np.linalg.norm(target.omega_rad_s))

    before = rates()
    rng = np.random.default_rng(2)
    for _ in range(10):
        done = batch.step(rng.uniform(-1.0, 1.0, (1, 1, 6)))
        now = rates()
        expected = 30.0 * (before[0] - now[0]) + 5.0 * (before[1] - now[1]) - 0.1 / 15.0
        assert done.rewards[0, 0] == pytest.approx(expected, abs=1e-9)
        assert now != before
        before = now


# -- end -------------------------------------------------------------------------------------------


def test_a_stack_at_rest_for_the_stated_time_is_stopped() -> None:
    scenario = alone(reward={"success": 9.0, "within_per_s": 3.0})
    limits = scenario.detumble
    batch = DockingBatch(scenario, 1)
    batch.start(0)
    at_rest(batch, 0.9 * math.radians(limits.rate_deg_s), 0.9 * limits.speed_m_s)
    ticks = round(GUIDANCE.stack_rest_s * scenario.time.rate_hz)
    for tick in range(ticks):
        done = batch.step(np.zeros((1, 1, 6)))
        assert OUTCOMES[done.outcomes[0, 0]] == ("stopped" if tick == ticks - 1 else "flying")
        assert done.rewards[0, 0] == pytest.approx(0.2 + 9.0 * (tick == ticks - 1), abs=1e-6)
        assert (done.terminated[0, 0], done.truncated[0, 0]) == (tick == ticks - 1, False)
    assert batch.step(np.zeros((1, 1, 6))).outcomes[0, 0] == 0


@pytest.mark.parametrize(("share", "drift"), [(1.1, 0.0), (0.0, 1.1)])
def test_a_stack_that_moves_faster_is_not_stopped(share: float, drift: float) -> None:
    scenario = alone(episode_s=2.0)
    limits, batch = scenario.detumble, DockingBatch(scenario, 1)
    batch.start(0)
    at_rest(batch, share * math.radians(limits.rate_deg_s), drift * limits.speed_m_s)
    words = [OUTCOMES[batch.step(np.zeros((1, 1, 6))).outcomes[0, 0]] for _ in range(30)]
    assert set(words) == {"flying", "time out"}
    assert words[-1] == "time out"


def test_a_stack_that_turns_too_fast_is_lost() -> None:
    batch = DockingBatch(pair(reward={"failure": 4.0}), 1)
    batch.start(0)
    at_rest(batch, 1.1 * batch.task.numbers.fastest_rad_s)
    done = batch.step(np.zeros((1, 2, 12)))
    assert [OUTCOMES[k] for k in done.outcomes[0]] == ["lost", "lost"]
    assert done.rewards[0].tolist() == [-4.0, -4.0]


def test_limits_are_those_by_which_missions_are_judged() -> None:
    numbers = DockingBatch(pair("success.detumbled.speed_m_s=0.007"), 1).task.numbers
    assert numbers.stack.speed_m_s == 0.007
    other = DockingBatch(alone("detumble.speed_m_s=0.005"), 1).task.numbers
    assert other.stack.speed_m_s == 0.005


@pytest.mark.parametrize("truth", [(), (MISMATCH,)])
def test_the_feedback_of_the_product_stops_stacks(truth: tuple[str, ...]) -> None:
    """By its allocation, with pulses saved up to the minimum on-time."""
    scenario = pair(*truth, start=RATE, episode_s=30.0)
    batch = DockingBatch(scenario, 4)
    seen = batch.start(1)
    saved, ended = np.zeros((4, 24)), np.zeros(4, dtype=int)
    while not ended.all():
        done = batch.step(law(scenario, seen.astype(float), saved))
        seen = done.observations
        ended = np.where(ended == 0, done.outcomes[:, 0], ended)
    assert [OUTCOMES[k] for k in ended] == ["stopped"] * 4


def law(scenario: Scenario, seen: Array, saved: Array) -> Array:
    """Return actions (n, 2, 12), and update the thrust in shares of a tick that is ``saved``
    (n, 24).
    """
    body, mounts = stated_stack(scenario), mounted_chasers(scenario)
    thrusters = scenario.chaser.thrusters
    wrenches = thruster_wrenches(body, mounts, thrusters)
    free = np.concatenate(list(plume_free_thrusters(scenario, set(mounts)).values()))
    limits_N = np.where(free, np.tile([t.thrust_N for t in thrusters], len(mounts)), 0.0)
    shortest = thrusters[0].min_on_s * scenario.time.rate_hz
    for row, observed in zip(saved, seen[:, 0], strict=True):
        rate, velocity = observed[13:16], observed[16:19]
        momentum = np.concatenate([body.mass_kg * velocity, body.inertia_kg_m2 @ rate])
        thrusts_N = feedback(wrenches, momentum, limits_N, 0.5).thrusts_N
        row += np.divide(thrusts_N, limits_N, out=np.zeros(24), where=limits_N > 0.0)
    pulses = np.where(saved >= shortest, np.minimum(saved, 1.0), 0.0)
    saved -= pulses
    saved *= 0.9  # forget what is too old to matter
    return pulses.reshape(len(seen), 2, 12)


# -- scenarios -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "keys", "text"),
    [
        ((), {"start": {"position_m": [0.1, 0.0, 0.0]}}, "learning.start.position_m: must be 0"),
        ((), {"start": {"rate_deg_s": 1.0}}, "learning.start.rate_deg_s: must be 0"),
        ((), {"observation": "statistical"}, 'learning.observation: "detumble" has "truth" only'),
        (("docking.ports=[]", "docking.kind='held'", "success.latched=[]"), {}, "have no port"),
    ],
)
def test_what_a_latched_chaser_has_not_is_one_line(
    overrides: tuple[str, ...], keys: dict[str, Any], text: str
) -> None:
    with pytest.raises(ScenarioError, match=text) as raised:
        alone(*overrides, **keys)
    assert len(str(raised.value).splitlines()) == 1


def test_thrusters_of_one_chaser_cannot_stop_a_stack() -> None:
    values = pair()
    ports = tuple(p for p in values.docking.ports if p.chaser == 0)
    docking_ = values.docking.model_copy(update={"ports": ports})
    one = values.model_copy(update={"chasers": values.chasers[:1], "docking": docking_})
    with pytest.raises(ScenarioError, match=r"is free \(6 of 12 of chaser 0\) cannot push and"):
        DockingBatch(one, 1)


def test_chasers_start_at_their_ports() -> None:
    batch = DockingBatch(pair(start=RATE), 5)
    batch.start(2)
    mounts = mounted_chasers(batch.task.scenario)
    for e in range(5):
        target: BodyState = batch.state(e, None)
        for i, mount in mounts.items():
            own = batch.state(e, i)
            off = rotations.rotate_inverse(target.q_wxyz, own.position_m - target.position_m)
            np.testing.assert_allclose(off, mount.position_m, atol=1e-12)
            turned = rotations.multiply(target.q_wxyz, mount.q_wxyz)
            assert float(rotations.angle_between(own.q_wxyz, turned)) < 1e-7
    rates = [np.degrees(batch.state(e, None).omega_rad_s) for e in range(5)]
    assert np.ptp(rates, axis=0).min() > 0.1
