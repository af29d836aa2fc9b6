# SPDX-License-Identifier: Apache-2.0
"""The action ``reference``: offsets of the reference that the NMPC follows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_protocol.errors import ScenarioError
from chaserdock_protocol.scenario import Scenario, parse_scenario
from env_cases import ALONG_PORT, SEVERAL, docking, learning

from chaserdock.envs.batch import BatchStep, DockingBatch
from chaserdock.envs.observation import goal_of
from chaserdock.envs.policy import facts_of
from chaserdock.envs.task import OUTCOMES

REACH = {"position_m": 0.4, "rotation_deg": 30.0}


def holding(task: str = "hold", **changes: Any) -> Scenario:
    """A chaser before a target that turns, with the action ``reference``."""
    keys = learning(task, action="reference", reference=REACH, episode_s=30.0)
    target = ALONG_PORT["target"] | {"omega_rad_s": [0.02, 0.03, 0.04]}
    values = {"docking": {}, "target": target, "learning": keys}
    return parse_scenario(ALONG_PORT | values | changes, "test")


def flown(batch: DockingBatch, action: list[float], ticks: int) -> BatchStep:
    """Start the environments, and fly all chasers by one action."""
    batch.start(2)
    actions = np.broadcast_to(np.array(action), (batch.environments, batch.chasers, 6))
    done = batch.step(actions)
    for _ in range(ticks - 1):
        done = batch.step(actions)
    assert not done.outcomes.any()
    return done


@pytest.mark.parametrize("observation", ["truth", "statistical"])
def test_the_chaser_follows_its_reference(observation: str) -> None:
    """To a moved place with a turned attitude, beside a target that turns."""
    camera = {"width_px": 960, "height_px": 540}
    keys = learning("hold", action="reference", reference=REACH, observation=observation)
    scenario = holding(learning=keys, camera=camera)
    action = [-0.5, 0.25, 1.0, 0.0, 0.5, 1.0]
    batch = DockingBatch(scenario, 1)
    flown(batch, action, 200)
    own, target = batch.state(0, 0), batch.state(0, None)
    place = rotations.rotate_inverse(target.q_wxyz, own.position_m - target.position_m)
    wanted = goal_of(scenario, 0, "hold").position_m + 0.4 * np.array(action[:3])
    np.testing.assert_allclose(place, wanted, atol=0.02)
    turned = rotations.exp(np.radians(30.0) * np.array(action[3:]))
    q = rotations.multiply(target.q_wxyz, rotations.multiply([1.0, 0.0, 0.0, 0.0], turned))
    assert float(rotations.angle_between(own.q_wxyz, q)) < np.radians(2.0)


def test_actions_are_bounded() -> None:
    ours, theirs = DockingBatch(holding(), 1), DockingBatch(holding(), 1)
    a = flown(ours, [9.0, 0.0, 0.0, 0.0, 0.0, -5.0], 5)
    b = flown(theirs, [1.0, 0.0, 0.0, 0.0, 0.0, -1.0], 5)
    np.testing.assert_array_equal(a.observations, b.observations)


def test_an_inspecting_chaser_faces_the_target_from_every_reference() -> None:
    batch = DockingBatch(holding("inspect"), 1)
    done = flown(batch, [0.2, 1.0, 0.5, 0.0, 0.0, 0.0], 200)
    place, q = done.observations[0, 0, :3], done.observations[0, 0, 6:10]
    ahead = rotations.rotate(q.astype(float), np.array([1.0, 0.0, 0.0]))
    assert float(ahead @ -place) / float(np.linalg.norm(place)) > np.cos(0.05)
    assert place[1] > 0.3


def test_the_reference_ends_outside_of_the_keep_out() -> None:
    """A reference in the target: the chaser waits at the distance, and the episode goes on."""
    chasers = [ALONG_PORT["chasers"][0] | {"position_m": [-0.8, 0.0, 0.0]}]
    limits = {"min_distance_target_m": 0.7}
    batch = DockingBatch(holding(chasers=chasers, limits=limits), 1)
    flown(batch, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0], 200)
    away_m = np.linalg.norm(batch.state(0, 0).position_m - batch.state(0, None).position_m)
    assert 0.7 < away_m < 0.76


def test_a_reference_that_comes_slowly_docks() -> None:
    """Along the port's axis; a reference that jumps to the port hits it too fast."""
    keys = {"action": "reference", "reference": {"position_m": 0.5}, "episode_s": 60.0}
    scenario = docking(
        'chaser.actuation="ideal"',
        "time.physics_hz=240",
        "chasers.0.start_offset_m=[0.0, 0.0, 0.0]",
        "chasers.0.start_rotation_rad=[0.0, 0.0, 0.0]",
        **keys,
    )
    axis = np.array(scenario.docking.ports[0].axis)
    words = []
    for speed_m_s in (0.02, 10.0):
        batch = DockingBatch(scenario, 1)
        batch.start(0)
        for tick in range(900):
            # The last of the reference lies behind the port: the NMPC would stop before it.
            gap_m = max(0.45 - speed_m_s * tick / 15.0, -0.05)
            action = np.zeros((1, 1, 6))
            action[0, 0, :3] = gap_m / 0.5 * axis
            outcome = int(batch.step(action).outcomes[0, 0])
            if outcome:
                words.append(OUTCOMES[outcome])
                break
    assert words == ["docked", "collision"]


def test_several_chasers_are_planned_together() -> None:
    """Their references are in one place; they keep their distance."""
    keys = learning("hold", action="reference", reference={"position_m": 2.0}, episode_s=60.0)
    values = SEVERAL | {"docking": {}, "learning": keys, "limits": {"min_distance_target_m": 0.5}}
    chasers = [c | {"start_offset_m": [0.0, 0.0, 0.0]} for c in SEVERAL["chasers"][:2]]
    for chaser in chasers:
        chaser.pop("start_velocity_m_s", None)
    chasers[1] = {"position_m": [-1.0, 1.2, 0.0], "look_at": "target"}
    scenario = parse_scenario(values | {"chasers": chasers}, "test")
    batch = DockingBatch(scenario, 1)
    batch.start(0)
    actions = np.zeros((1, 2, 6))
    actions[0, 1, 1] = -0.6
    for _ in range(200):
        assert not batch.step(actions).outcomes.any()
    apart_m = np.linalg.norm(batch.state(0, 0).position_m - batch.state(0, 1).position_m)
    limit_m = scenario.limits.min_distance_chasers_m
    assert limit_m < apart_m < limit_m + 0.3


def test_seeds_repeat_and_episodes_forget_the_last_plan() -> None:
    scenario = holding(learning=learning("hold", action="reference", episode_s=1.0))
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1.0, 1.0, (20, 3, 1, 6))
    batch, fresh = DockingBatch(scenario, 3), DockingBatch(scenario, 1)

    def rewards(one: DockingBatch) -> np.ndarray:
        one.start(7)
        n = one.environments
        return np.array([one.step(action[:n]).rewards[0, 0] for action in actions])

    first = rewards(batch)
    np.testing.assert_array_equal(first, rewards(batch))
    np.testing.assert_array_equal(first, rewards(fresh))
    assert first[15] == 0.0  # the next episode began


def test_actions_that_are_not_finite_are_rejected() -> None:
    batch = DockingBatch(holding(), 2)
    batch.start(1)
    actions = np.zeros((2, 1, 6))
    actions[1, 0, 3] = np.nan
    done = batch.step(actions)
    assert done.rejected.tolist() == [0, 1]
    assert np.isfinite(done.observations).all()


def test_the_facts_of_a_policy_name_its_action() -> None:
    assert facts_of(DockingBatch(holding(), 1).task)["action"] == "reference"


@pytest.mark.parametrize(
    ("override", "keys", "text"),
    [
        ('chaser.actuation="thrusters"', {}, 'needs chaser.actuation = "ideal"'),
        ('chaser.actuation="ideal"', {"task": "detumble"}, "is for free chasers"),
        ('chaser.actuation="ideal"', {"reference": {"position_m": 0.0}}, "reference.position_m"),
    ],
)
def test_what_the_nmpc_cannot_fly_is_one_line(
    override: str, keys: dict[str, Any], text: str
) -> None:
    with pytest.raises(ScenarioError, match=text) as raised:
        docking(override, action="reference", **keys)
    assert len(str(raised.value).splitlines()) == 1
