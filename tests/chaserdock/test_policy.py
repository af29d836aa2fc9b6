# SPDX-License-Identifier: Apache-2.0
"""Policies: the observation of the environments from states, files and their errors, the solver of
the example, and flights of the policy that ships.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.interfaces import HorizonReference
from chaserdock_controller.nmpc import NmpcParameters
from chaserdock_controller.parameters import nmpc_parameters
from chaserdock_models import rotations
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol import plugins
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.plugins import PluginError
from chaserdock_protocol.scenario import Scenario, flight_scenario, load_scenario, parse_scenario
from env_cases import ALONG_PORT, SEVERAL, START, docking, learning
from harness import ROOT, install_example
from numpy.typing import NDArray

from chaserdock.envs.batch import DockingBatch
from chaserdock.envs.observation import goal_of, names_of, observation_of
from chaserdock.envs.policy import Policy, PolicyError, facts_of
from chaserdock.envs.task import TASKS

EXAMPLE = ROOT / "examples" / "learning"


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    for name in ("docking_policy", "policy_file"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return SimpleNamespace(
        solver=importlib.import_module("docking_policy"),
        files=importlib.import_module("policy_file"),
    )


Weights = list[tuple[NDArray[np.float64], NDArray[np.float64]]]


def weights_of(rng: np.random.Generator, width: int, outputs: int) -> Weights:
    sizes = ((2 * width, 5), (5, 7), (7, outputs), (2 * width, outputs))
    return [(0.3 * rng.normal(size=s), 0.1 * rng.normal(size=s[1])) for s in sizes]


def written(
    example: Any, path: Path, scenario: Scenario, seed: int = 1, **facts: str
) -> tuple[Weights, Any, Any]:
    """Write a policy with random weights for a scenario; return them, and the scale of its
    observations.
    """
    rng, task = np.random.default_rng(seed), DockingBatch(scenario, 1).task
    weights = weights_of(rng, task.width, task.actuators)
    middle, scale = rng.normal(size=task.width), rng.uniform(0.5, 2.0, task.width)
    onnx.save(example.files.network(weights, middle, scale, facts_of(task) | facts), str(path))
    return weights, middle, scale


def held(task: str) -> Scenario:
    """A task without a port, with a target that tumbles and a chaser that turns and drifts."""
    target = ALONG_PORT["target"] | {"omega_rad_s": [0.02, -0.03, 0.05]}
    keys = learning(task, start=START)
    return parse_scenario(ALONG_PORT | {"docking": {}, "target": target, "learning": keys}, "test")


# -- observation -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["one", "several", "come", "hold"])
def test_observation_from_states_is_that_of_the_environment(kind: str) -> None:
    scenario = {
        "one": lambda: docking('truth.preset="mismatch"', 'chaser.actuation="ideal"'),
        "several": lambda: parse_scenario(SEVERAL, "test"),
        "come": lambda: held("dock"),
        "hold": lambda: held("hold"),
    }[kind]()
    batch, rng = DockingBatch(scenario, 3), np.random.default_rng(1)
    seen = batch.start(5)
    for _ in range(12):
        levels = rng.uniform(-1.0, 1.0, (3, batch.chasers, batch.task.actuators))
        seen = batch.step(levels).observations
    task = TASKS[batch.task.numbers.task]
    assert seen.shape[-1] == len(names_of(batch.chasers, task))
    for e in range(3):
        states = [batch.state(e, i) for i in range(batch.chasers)]
        target = batch.state(e, None)
        for i, own in enumerate(states):
            others = [s.position_m for k, s in enumerate(states) if k != i]
            found = observation_of(goal_of(scenario, i, task), own, target, others)
            np.testing.assert_allclose(seen[e, i], found, rtol=2e-7, atol=1e-7)
            assert np.abs(found[[1, 4, 7, 11, 14]]).min() > 1e-4 or kind == "several"


def test_scalar_part_of_the_attitude_is_not_negative() -> None:
    rng = np.random.default_rng(3)
    goal = goal_of(docking(), 0, "latch")
    for turn in (2.0, 2.9, 3.6, 5.0):
        q = rotations.exp(turn * np.array([0.6, -0.48, 0.64]))
        own = BodyState(rng.normal(size=3), rng.normal(size=3), q, rng.normal(size=3))
        target = BodyState(np.zeros(3), np.zeros(3), rotations.IDENTITY, np.zeros(3))
        found = observation_of(goal, own, target)[6:10]
        assert found[0] >= 0.0
        assert float(rotations.angle_between(found, q)) == pytest.approx(0.0, abs=1e-6)


# -- files -----------------------------------------------------------------------------------------


def test_a_file_gives_the_actions_of_its_weights(example: Any, tmp_path: Path) -> None:
    scenario = docking('chaser.actuation="ideal"')
    weights, middle, scale = written(example, tmp_path / "p.onnx", scenario)
    seen = np.random.default_rng(2).normal(size=(4, 16)).astype(np.float32)
    z = (seen - middle) / scale
    x = np.concatenate([z, np.tanh(example.files.NEAR * z)], axis=1)
    (w1, b1), (w2, b2), (w3, b3), (w4, b4) = weights
    h = np.tanh(np.tanh(x @ w1 + b1) @ w2 + b2)
    policy = Policy(tmp_path / "p.onnx")
    np.testing.assert_allclose(policy.actions(seen), np.tanh(h @ w3 + b3 + x @ w4 + b4), atol=2e-6)
    policy.check(scenario)


def test_a_policy_for_another_scenario_is_refused_in_one_line(example: Any, tmp_path: Path) -> None:
    path = tmp_path / "p.onnx"
    scenario = docking('chaser.actuation="ideal"')
    written(example, path, parse_scenario(SEVERAL, "test"))
    with pytest.raises(PolicyError) as error:
        Policy(path).check(scenario)
    assert str(error.value) == (
        f"{path}: observes 22 elements, docking-contact has 16; from element 16 on: other_1_x_m, "
        "other_1_y_m, other_1_z_m, not nothing"
    )
    names = list(names_of(1, "latch"))
    names[4], names[5] = names[5], names[4]
    written(example, path, scenario, observation=json.dumps(names))
    with pytest.raises(PolicyError, match=r"from element 4 on: velocity_z_m_s, velocity_y_m_s, "):
        Policy(path).check(scenario)
    written(example, path, scenario)
    for change, text in (
        ('chaser.actuation="thrusters"', "has 'thrusters' at 15 Hz"),
        ("time.rate_hz=30", "has 'ideal' at 30 Hz"),
    ):
        with pytest.raises(PolicyError, match=text):
            Policy(path).check(load_scenario(ROOT / "scenarios/docking-contact.toml",
                                             ['chaser.actuation="ideal"', change]))  # fmt: skip


def test_a_file_that_is_no_policy_is_named_in_one_line(example: Any, tmp_path: Path) -> None:
    path = tmp_path / "p.onnx"
    with pytest.raises(PolicyError, match=f"^{re.escape(str(path))}: no such policy$"):
        Policy(path)
    path.write_bytes(b"no network")
    with pytest.raises(PolicyError, match=f"^{re.escape(str(path))}: no policy with the metadata"):
        Policy(path)
    scenario = docking('chaser.actuation="ideal"')
    written(example, path, scenario, observation=json.dumps(names_of(1, "latch")[:-1]))
    with pytest.raises(PolicyError, match="its metadata name 15 elements, its network takes 16"):
        Policy(path)


# -- solver ----------------------------------------------------------------------------------------


def solver_for(example: Any, path: Path, scenario: Scenario, monkeypatch: Any) -> tuple[Any, Any]:
    monkeypatch.setenv("CHASERDOCK_POLICY", str(path))
    flight = flight_scenario(scenario)
    params = nmpc_parameters(flight)
    solver = example.solver.PolicySolver(params, len(scenario.chasers))
    solver.prepare(flight)
    return solver, params


def problem_of(scenario: Scenario, params: NmpcParameters, rows: tuple[int, ...]) -> Any:
    """The problem of a tick with a target that tumbles, from the planning stage."""
    rng, flight = np.random.default_rng(7), flight_scenario(scenario)
    n, d = len(scenario.chasers), params.stages
    target = BodyState(
        rng.normal(size=3), 0.05 * rng.normal(size=3), rotations.exp(rng.normal(size=3)),
        0.05 * rng.normal(size=3),
    )  # fmt: skip
    states, references = np.zeros((n, 13)), np.zeros((n, d + 1, 7))
    for i, chaser in enumerate(scenario.chasers):
        at = target.position_m + rotations.rotate(target.q_wxyz, chaser.position_m)
        q = rotations.multiply(target.q_wxyz, chaser.q_wxyz)
        references[i] = np.concatenate([at, q])
        turned = rotations.multiply(q, rotations.exp(0.05 * rng.normal(size=3)))
        states[i] = np.concatenate(
            [at + 0.05 * rng.normal(size=3), 0.03 * rng.normal(size=3), turned,
             0.02 * rng.normal(size=3)]
        )  # fmt: skip
    horizon = HorizonReference(
        tuple(range(n)), references, np.zeros((n, d, 6)), np.tile(target.position_m, (d + 1, 1)),
        np.full(n, 0.3), None, frozenset(), docking=rows,
    )  # fmt: skip
    stage = ControllerCore(flight, lambda: 0.0).planning
    limits = np.tile(0.6 * params.input_limits(), (n, 1))
    return replace(stage.problem(horizon, states, limits), target=target)


def test_the_solver_flies_rows_that_dock_by_the_policy_and_others_by_the_nmpc(
    example: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario, path = parse_scenario(SEVERAL, "test"), tmp_path / "p.onnx"
    written(example, path, scenario)
    solver, params = solver_for(example, path, scenario, monkeypatch)
    problem = problem_of(scenario, params, (1,))
    plan = solver.solve(problem, 0.0, (0, 1, 2))
    own = [BodyState(s[:3], s[3:6], s[6:10], s[10:]) for s in problem.states]
    others = [own[k].position_m for k in (0, 2)]
    seen = observation_of(goal_of(scenario, 1, "latch"), own[1], problem.target, others)
    wrench = Policy(path).actions(seen[None])[0] * params.input_limits()
    most = problem.input_max[1]
    np.testing.assert_allclose(plan.inputs[1, 0], np.clip(wrench, -most, most), rtol=1e-6)
    assert (np.abs(wrench) > most).any()
    assert (np.abs(wrench) < most).any()
    nmpc = example.solver.make_solver("rti", params, 3).solve(problem, 0.0, (0, 1, 2))
    for row in (0, 2):
        np.testing.assert_array_equal(plan.inputs[row], nmpc.inputs[row])
    # The plan is what the model makes of its inputs.
    after = plan.states[1, 1, :3] - problem.states[1, :3]
    force = rotations.rotate(problem.states[1, 6:10], plan.inputs[1, 0, :3])
    step_s = params.dt_s
    moved = step_s * (problem.states[1, 3:6] + step_s * force / params.mass_kg)
    np.testing.assert_allclose(after, moved, atol=1e-12)
    alone = solver.solve(problem_of(scenario, params, (0, 1, 2)), 0.0, (0, 1, 2))
    np.testing.assert_array_equal(alone.inputs[1], plan.inputs[1])
    assert alone.status == ("solved",) * 3


def test_a_policy_of_thrusters_of_another_task_or_of_references_is_no_solver(
    example: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(example, tmp_path / "p.onnx", docking())
    with pytest.raises(PolicyError, match=r"commands 'thrusters'; a solver plans wrenches"):
        solver_for(example, tmp_path / "p.onnx", docking(), monkeypatch)
    inspecting = docking('chaser.actuation="ideal"', task="inspect")
    written(example, tmp_path / "p.onnx", inspecting)
    with pytest.raises(PolicyError, match=r"task 'inspect'; this solver flies hold, come, latch"):
        solver_for(example, tmp_path / "p.onnx", inspecting, monkeypatch)
    ideal = docking('chaser.actuation="ideal"', action="reference")
    written(example, tmp_path / "p.onnx", ideal)
    with pytest.raises(PolicyError, match=r"its actions are of 'reference'; this solver takes"):
        solver_for(example, tmp_path / "p.onnx", ideal, monkeypatch)


def test_a_solver_is_prepared_before_the_flight_and_its_errors_are_named() -> None:
    given: list[object] = []
    plugins.prepare("solver", "own", SimpleNamespace(prepare=given.append), "mission")
    plugins.prepare("solver", "own", object(), "mission")
    assert given == ["mission"]

    def fails(_: object) -> None:
        raise KeyError("goal")

    def refuses(_: object) -> None:
        raise ChaserdockError("not for it")

    with pytest.raises(PluginError, match=r"^solver 'own' does not start: KeyError: 'goal'$"):
        plugins.prepare("solver", "own", SimpleNamespace(prepare=fails), "mission")
    with pytest.raises(ChaserdockError, match=r"^not for it$"):
        plugins.prepare("solver", "own", SimpleNamespace(prepare=refuses), "mission")


# -- the policy that ships -------------------------------------------------------------------------


def test_the_policy_that_ships_is_for_its_scenarios_and_small() -> None:
    path = EXAMPLE / "docking.onnx"
    policy = Policy(path)
    for name in ("docking", "flight"):
        policy.check(load_scenario(EXAMPLE / f"{name}.toml", ['controller.solver="rti"']))
    assert path.stat().st_size < 100_000


@pytest.mark.slow
def test_the_policy_that_ships_docks_in_the_environment() -> None:
    done = subprocess.run(
        [sys.executable, str(EXAMPLE / "evaluate.py"), "--episodes", "500", "--seed", "7"],
        capture_output=True,
        text=True,
        check=True,
    )
    laws = {
        line.split()[0]: [float(x) for x in re.findall(r"(\d+\.\d+)(?:%| N? ?s \()", line)]
        for line in done.stdout.splitlines()
    }
    assert laws["policy"][0] >= 99.1
    assert laws["proportional"][0] >= 98.0
    assert laws["policy"][1] < laws["proportional"][1]


@pytest.mark.slow
def test_the_policy_that_ships_flies_the_whole_mission(tmp_path: Path) -> None:
    parts = tmp_path / "parts"
    parts.mkdir()
    env = os.environ | install_example(EXAMPLE, parts)
    done = subprocess.run(
        [sys.executable, str(EXAMPLE / "fly.py"), "--flights", "1", "--first", "3"],
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    policy, nmpc = (json.loads(line) for line in done.stdout.splitlines()[:2])
    assert (policy["solver"], nmpc["solver"]) == ("policy", "rti")
    for flight in (policy, nmpc):
        assert flight["success"], flight["failures"]
        assert 10.0 < flight["latched_after_s"] < 40.0
    assert policy["latched_after_s"] != nmpc["latched_after_s"]
    assert done.stdout.splitlines()[-2].startswith("| policy | 1 of 1 | 1 |")


@pytest.mark.slow
def test_a_policy_of_another_scenario_ends_the_flight_in_one_line(
    example: Any, tmp_path: Path
) -> None:
    parts, path = tmp_path / "parts", tmp_path / "p.onnx"
    parts.mkdir()
    written(example, path, parse_scenario(SEVERAL, "test"))
    env = os.environ | install_example(EXAMPLE, parts) | {"CHASERDOCK_POLICY": str(path)}
    done = subprocess.run(
        [sys.executable, "-m", "chaserdock", "run", str(EXAMPLE / "flight.toml"), "--out",
         str(tmp_path / "run")],
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode != 0
    text = done.stdout + done.stderr
    assert text.count("observes 22 elements, docking-flight has 16") == 1, text
    assert "Traceback" not in text
