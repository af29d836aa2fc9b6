# SPDX-License-Identifier: Apache-2.0
"""The training environments through the interfaces of Gymnasium and PettingZoo."""

from __future__ import annotations

import importlib
import itertools
import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from chaserdock_protocol.errors import ChaserdockError, ScenarioError
from chaserdock_protocol.scenario import Scenario, parse_scenario
from chaserdock_world.rendering.cameras import Cameras
from env_cases import ALONG_PORT, SEVERAL, START, along_port, docking, learning, start_of
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode
from harness import ROOT
from pettingzoo.test import parallel_api_test, parallel_seed_test

from chaserdock import envs
from chaserdock.envs.batch import DockingBatch
from chaserdock.envs.policy import facts_of
from chaserdock.envs.task import OUTCOMES, task_of

IDEAL = 'chaser.actuation="ideal"'


def several(**changes: Any) -> Scenario:
    """Three chasers, each with a port."""
    values = SEVERAL | changes
    return parse_scenario(values, "test")


@pytest.mark.parametrize("task", ["dock", "inspect", "detumble"])
@pytest.mark.parametrize(
    ("actuation", "action"),
    [("ideal", "actuators"), ("thrusters", "actuators"), ("ideal", "reference")],
)
def test_gymnasium_accepts_an_environment(actuation: str, action: str, task: str) -> None:
    if (task, action) == ("detumble", "reference"):
        pytest.skip("the NMPC flies free chasers")
    scenario = docking(
        f'chaser.actuation="{actuation}"', task=task, action=action, start=start_of(task)
    )
    environment = envs.make(scenario, render_mode="rgb_array")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(environment)
    # Observations have no limits; and an environment made without the registry has no others.
    expected = ("probably too low", "probably too high", "Not able to test alternative render")
    assert [w for w in said if not any(text in str(w.message) for text in expected)] == []


def test_gymnasium_makes_registered_environments(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text(
        'extends = "docking-contact"\n[learning]\ntask = "dock"\nepisode_s = 2.0\n', "utf-8"
    )
    envs.register()
    envs.register()
    one = gymnasium.make(envs.ID, scenario=file)
    observation, info = one.reset(seed=1)
    assert observation in one.observation_space
    assert info == {"outcome": "flying", "is_success": False}
    many = gymnasium.make_vec(
        envs.ID, num_envs=3, vectorization_mode="vector_entry_point", scenario=file
    )
    first, _ = many.reset(seed=1)
    np.testing.assert_array_equal(first[0], observation)
    assert many.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP


def test_a_vector_environment_is_as_many_single_ones() -> None:
    """Spaces, types, ends, and the start that follows; a vector of one gives the single's bits."""
    scenario = docking(IDEAL, start=START, episode_s=1.0)
    single, vector = envs.make(scenario), envs.make_vec(scenario, 4)
    assert vector.single_observation_space == single.observation_space
    assert vector.single_action_space == single.action_space
    seen, _ = single.reset(seed=9)
    all_seen, info = vector.reset(seed=9)
    np.testing.assert_array_equal(all_seen[0], seen)
    vector.action_space.seed(3)
    told = {}
    for tick in range(1, 16):
        actions = vector.action_space.sample()
        seen, reward, terminated, truncated, told = single.step(actions[0])
        all_seen, rewards, ended, cut, info = vector.step(actions)
        assert all_seen in vector.observation_space
        assert (rewards.shape, ended.dtype, cut.dtype) == ((4,), bool, bool)
        np.testing.assert_array_equal(all_seen[0], seen)
        assert (rewards[0], ended[0], cut[0]) == (reward, terminated, truncated)
        assert OUTCOMES[info["outcome"][0]] == told["outcome"]
        assert cut.tolist() == [tick == 15] * 4
    assert told == {"outcome": "time out", "is_success": False}
    all_seen, rewards, ended, cut, info = vector.step(vector.action_space.sample())
    assert rewards.tolist() == [0.0] * 4
    assert not np.concatenate([ended, cut, info["outcome"]]).any()
    after, _ = single.reset()
    np.testing.assert_array_equal(all_seen[0], after)


def test_seeds_repeat_and_starts_without_one_differ() -> None:
    scenario = docking(start=START)
    a, b = envs.make_vec(scenario, 3), envs.make_vec(scenario, 3)
    assert data_equivalence(a.reset(seed=5), b.reset(seed=5), exact=True)
    assert data_equivalence(a.reset(), b.reset(), exact=True)
    c, d = envs.make(scenario), envs.make(scenario)
    assert not np.array_equal(c.reset()[0], d.reset()[0])
    e, f = envs.parallel_env(several()), envs.parallel_env(several())
    assert data_equivalence(e.reset(seed=2)[0], f.reset(seed=2)[0], exact=True)


def test_pettingzoo_accepts_environments_of_one_to_sixteen_chasers() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scenario in (
            docking(start=START, episode_s=3.0),
            several(),
            several(learning=learning("inspect", episode_s=3.0)),
            several(learning=learning("detumble", episode_s=3.0)),
            several(learning=learning(action="reference", episode_s=3.0)),
            sixteen(),
        ):
            parallel_api_test(envs.parallel_env(scenario), num_cycles=100)
            parallel_seed_test(lambda s=scenario: envs.parallel_env(s), num_cycles=20)


def sixteen() -> Scenario:
    """Sixteen chasers that hold their places on a circle."""
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    chasers = [
        {"position_m": [3.0 * float(np.cos(a)), 3.0 * float(np.sin(a)), 0.1], "look_at": "target"}
        for a in angles
    ]
    learning = {"task": "hold", "episode_s": 5.0}
    return parse_scenario(
        ALONG_PORT | {"docking": {}, "chasers": chasers, "learning": learning}, "test"
    )


def test_a_docked_agent_leaves_and_the_episode_goes_on() -> None:
    environment = envs.parallel_env(several())
    environment.reset(seed=0)
    zeros = {a: np.zeros(6, np.float32) for a in environment.possible_agents}
    _, rewards, terminated, _, infos = environment.step(zeros)
    while not any(terminated.values()):
        _, rewards, terminated, _, infos = environment.step(zeros)
    assert terminated == {"chaser_0": True, "chaser_1": False, "chaser_2": False}
    assert infos["chaser_0"] == {"outcome": "docked", "is_success": True}
    assert rewards["chaser_0"] > 40.0
    assert environment.agents == ["chaser_1", "chaser_2"]
    del zeros["chaser_0"]
    seen, *_ = environment.step(zeros)
    assert set(seen) == {"chaser_1", "chaser_2"}


def test_a_team_ends_together_and_then_needs_a_reset() -> None:
    environment = envs.parallel_env(several(learning={"task": "dock", "episode_s": 0.2}))
    environment.reset(seed=0)
    zeros = {a: np.zeros(6, np.float32) for a in environment.agents}
    for _ in range(2):
        environment.step(zeros)
    truncated = environment.step(zeros)[3]
    assert truncated == dict.fromkeys(environment.possible_agents, True)
    assert environment.agents == []
    assert environment.step({}) == ({}, {}, {}, {}, {})
    with pytest.raises(ValueError, match="the episode is over"):
        environment.step(zeros)


SMALL = ("camera.width_px=80", "camera.height_px=64", 'chaser.actuation="ideal"')
NO_NOISE = ("camera.effects.read_noise=0.0", "camera.effects.shot_noise=0.0")


def test_images_are_those_of_the_cameras_of_the_world() -> None:
    scenario = docking(*SMALL, *NO_NOISE, observation="images", start=START)
    batch = DockingBatch(scenario, 3)
    images = batch.start(4)
    for _ in range(3):
        images = batch.step(np.full((3, 1, 6), 0.3)).observations
    for e in range(3):
        bodies = {"target": batch.state(e, None), "chaser/0": batch.state(e, 0)}
        seen = Cameras(scenario).render(0, 0, 3 * 10**9 // scenario.time.rate_hz, bodies)
        np.testing.assert_array_equal(images[e, 0, :, :, 0], seen)
    assert (images[0] != images[1]).mean() > 0.01  # they start elsewhere


def test_images_come_at_their_rate_and_repeat_with_the_seed() -> None:
    scenario = docking(*SMALL, "time.rate_hz=15", "time.image_hz=5", observation="images")
    environments = envs.make_vec(scenario, 2)
    actions = np.zeros((2, 6), np.float32)

    def episode() -> Any:
        return [environments.reset(seed=5)[0], *(environments.step(actions)[0] for _ in range(6))]

    first, again = episode(), episode()
    np.testing.assert_array_equal(first, again)
    changed = [bool((a != b).any()) for a, b in itertools.pairwise(first)]
    assert changed == [False, False, True, False, False, True]
    assert (first[0][0] != first[0][1]).any()  # noise of its own
    alone = envs.make_vec(scenario, 1)
    np.testing.assert_array_equal(alone.reset(seed=5)[0], first[0][:1])


def test_checkers_accept_images() -> None:
    scenario = docking(*SMALL, observation="images", start=START)
    environment = envs.make(scenario)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(environment, skip_render_check=True)
    assert [str(w.message) for w in said] == []
    assert environment.observation_space.shape == (64, 80, 1)
    team = several(
        learning=learning(observation="images"), camera={"width_px": 80, "height_px": 64}
    )
    parallel_api_test(envs.parallel_env(team), num_cycles=5)


def test_a_policy_of_images_does_not_fly() -> None:
    with pytest.raises(ChaserdockError, match="takes estimates"):
        facts_of(task_of(docking(*SMALL, observation="images"), 1))


def test_invalid_actions_are_one_line() -> None:
    scenario = docking(IDEAL)
    single, vector = envs.make(scenario), envs.make_vec(scenario, 2)
    several_chasers = envs.parallel_env(several())
    single.reset()
    vector.reset()
    several_chasers.reset()
    bad = np.zeros(6, np.float32)
    bad[2] = np.nan
    with pytest.raises(ValueError, match=r"^action: must be finite numbers$"):
        single.step(bad)
    with pytest.raises(ValueError, match=r"^action: the shape is \(5,\), not \(6,\)$"):
        single.step(bad[:2].repeat(3)[:5])
    with pytest.raises(ValueError, match=r"^actions: the shape is \(6,\), not \(2, 6\)$"):
        vector.step(np.zeros(6, np.float32))
    info = vector.step(np.stack([bad, np.zeros(6, np.float32)]))[4]
    assert info["rejected"].tolist() == [1, 0]
    zeros = {a: np.zeros(6, np.float32) for a in several_chasers.agents}
    with pytest.raises(ValueError, match=r"^actions: chaser_1: must be finite numbers$"):
        several_chasers.step(zeros | {"chaser_1": bad})
    with pytest.raises(ValueError, match=r"^actions: chaser_2: the shape is \(3,\), not \(6,\)$"):
        several_chasers.step(zeros | {"chaser_2": np.zeros(3, np.float32)})
    with pytest.raises(ValueError, match=r"^actions: of chaser_1, not of chaser_0, chaser_1, c"):
        several_chasers.step({"chaser_1": bad})


def test_scenarios_that_do_not_fit_are_one_line() -> None:
    with pytest.raises(ScenarioError, match=r"one chaser \(got 3\); use chaserdock.envs.parallel"):
        envs.make_vec(several(), 2)
    with pytest.raises(ScenarioError, match=r"one chaser \(got 3\)"):
        envs.make(several())
    with pytest.raises(ScenarioError, match=r"single: no table \[learning\]"):
        envs.make_vec("single", 2)
    with pytest.raises(ScenarioError, match="no-such-scenario"):
        envs.parallel_env("no-such-scenario")
    with pytest.raises(ValueError, match=r"^render_mode: one of human, rgb_array \(got 'ansi'\)$"):
        envs.make(docking(), render_mode="ansi")


@pytest.mark.slow
def test_pictures_show_the_bodies_where_they_are() -> None:
    """A chaser that starts elsewhere is drawn elsewhere, in all environments alike."""
    near, far = along_port((0, 0, 0), (0, 0, 0)), along_port((-1.0, 0.6, 0), (0, 0, 0))
    pictures = []
    for scenario in (near, far):
        environment = envs.make(scenario, render_mode="rgb_array")
        environment.reset(seed=0)
        picture = environment.render()
        assert isinstance(picture, np.ndarray)
        assert (picture.shape, picture.dtype) == ((480, 640, 3), np.uint8)
        pictures.append(picture)
    bright = [(p.max(axis=2) > 60).sum() for p in pictures]
    assert bright[0] > 1.3 * bright[1] > 1000  # from nearer
    vector = envs.make_vec(near, 2, render_mode="rgb_array")
    vector.reset(seed=0)
    drawn = vector.render()
    assert drawn is not None
    np.testing.assert_array_equal(drawn[0], pictures[0])
    team = envs.parallel_env(near, render_mode="rgb_array")
    team.reset(seed=0)
    np.testing.assert_array_equal(team.render(), pictures[0])
    assert envs.make(near).render() is None


def test_a_window_needs_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    environment = envs.make(docking(), render_mode="human")
    environment.reset(seed=0)
    with pytest.raises(ChaserdockError, match="needs a display; matplotlib has 'agg' here"):
        environment.render()
    environment.close()
    environment.close()


PROGRAM = """
import sys
sys.modules[sys.argv[1]] = None
import chaserdock
import chaserdock.envs
assert not {"gymnasium", "pettingzoo", "matplotlib"} & {
    name for name, module in sys.modules.items() if module is not None}
from chaserdock.envs.batch import DockingBatch
try:
    getattr(chaserdock.envs, sys.argv[2])("single", *map(int, sys.argv[3:]))
except chaserdock.ChaserdockError as error:
    print(error)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "call"),
    [
        ("gymnasium", ("make",)),
        ("gymnasium", ("make_vec", "2")),
        ("gymnasium", ("parallel_env",)),
        ("pettingzoo", ("parallel_env",)),
    ],
)
def test_without_the_extra_its_name_is_said(package: str, call: tuple[str, ...]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, package, *call], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    (line,) = done.stdout.splitlines()
    assert f"{package}, of the extra chaserdock[learn], is not installed" in line
    assert "pip install -e '.[learn]'" in line


# -- examples --------------------------------------------------------------------------------------

EXAMPLES = ROOT / "examples" / "learning"


@pytest.mark.slow
def test_the_proportional_law_of_the_example_docks() -> None:
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / "proportional.py"), "200"],
        capture_output=True,
        text=True,
        check=True,
    )
    counts = {word: int(n) for word, n in re.findall(r"^(\w[\w ]*?) +(\d+)$", done.stdout, re.M)}
    assert sum(counts.values()) == 200
    assert counts["docked"] >= 196


@pytest.mark.slow
def test_the_team_of_the_example_docks_without_coming_near_each_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The ways of two chasers cross: without evasion they come too near."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    for name in ("team", "proportional"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    team = importlib.import_module("team")
    environment = envs.parallel_env(team.SCENARIO)
    limit_m = envs.loaded(team.SCENARIO).limits.min_distance_chasers_m
    episode = team.fly(environment, 3)
    assert set(episode.outcomes.values()) == {"docked"}
    assert episode.nearest_m > limit_m
    monkeypatch.setattr(team, "AWAY_PER_S", 0.0)
    episode = team.fly(environment, 3)
    assert "too near" in episode.outcomes.values()


@pytest.mark.parametrize("name", ["docking", "holding", "inspecting", "team"])
def test_tasks_of_the_examples_have_rewards(name: str) -> None:
    environment = envs.parallel_env(EXAMPLES / f"{name}.toml")
    environment.reset(seed=1)
    for agent in environment.agents:
        environment.action_space(agent).seed(1)
    rewards = set[float]()
    for _ in range(3):
        actions = {a: environment.action_space(a).sample() for a in environment.agents}
        rewards |= set(environment.step(actions)[1].values())
    assert len({*rewards, 0.0}) >= 4
