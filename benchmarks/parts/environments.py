# SPDX-License-Identifier: Apache-2.0
"""Speed of the training environments (chaserdock.envs), in processor time of one core."""

from __future__ import annotations

import time
from argparse import ArgumentParser
from statistics import median

import numpy as np
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.shipped_scenarios import shipped_scenario
from common import BenchmarkFailed, Figures, Group, Options

from chaserdock.envs.batch import DockingBatch

_TASK = (
    'learning={{task="{task}", action="{action}", episode_s=30.0, observation="{observation}", '
    "start={{{start}}}}}"
)
_START = "position_m=[0.1, 0.2, 0.2], rotation_deg=5.0, velocity_m_s=0.02, rate_deg_s=1.0"
_LEVEL = 0.05
"""Size of random actions, in shares of the limits: with it, most episodes last their 30 s, and the
camera sees the target.
"""
_BAR_PER_S = 1e6
_STEPS, _PLANNED_STEPS = 100_000, 1_000
"""Steps of a round; with the NMPC, which takes about a millisecond for a step, fewer."""


def _scenario(
    actuation: str,
    observation: str,
    sets: list[str],
    task: str = "dock",
    action: str = "actuators",
) -> Scenario:
    start = "target_rate_deg_s=1.0" if task == "detumble" else _START
    overrides = (
        _TASK.format(task=task, action=action, observation=observation, start=start),
        f'chaser.actuation="{actuation}"',
        'truth.preset="mismatch"',
        *sets,
    )
    return load_scenario(shipped_scenario("docking-contact"), overrides)


def _steps_per_s(
    scenario: Scenario, environments: int, rounds: int, steps: int = _STEPS
) -> tuple[float, float]:
    """Return the median number of agent steps in a second of processor time, and the share of steps
    that began an episode.
    """
    batch = DockingBatch(scenario, environments)
    batch.start(1)
    rng, started, rates = np.random.default_rng(2), 0, []
    shape = (16, environments, batch.chasers, batch.task.actuators)
    actions = (_LEVEL * rng.standard_normal(shape)).astype(np.float32)
    ticks = max(4, steps // (environments * batch.chasers))
    for _ in range(rounds):
        begin_s = time.process_time()
        for tick in range(ticks):
            done = batch.step(actions[tick % 16])
            started += int((done.outcomes != 0).sum())
        spent_s = time.process_time() - begin_s
        rates.append(ticks * environments * batch.chasers / spent_s)
    return median(rates), started / (rounds * ticks * environments * batch.chasers)


def environments(options: Options) -> Figures:
    """Agent steps in a second of processor time on one core: docking with six degrees of freedom,
    random actions, observations, rewards and new episodes included (bar with ``ideal``: 1e6); and
    with the other tasks and actions, with ``ideal`` and ``truth``.
    """
    figures, count = Figures(), options.environments
    rounds = 3 if options.quick else 9
    for actuation in ("ideal", "thrusters"):
        for observation in ("truth", "statistical"):
            scenario = _scenario(actuation, observation, options.set)
            rate, started = _steps_per_s(scenario, count, rounds)
            name = f"{actuation}_{observation}"
            print(
                f"{actuation:9} {observation:11} {count} environments  "
                f"{rate / 1e6:5.2f} million steps/s, {started:.2%} of them starts",
                flush=True,
            )
            figures[f"{name}_steps_per_s"] = rate
    others = (("inspect", "actuators"), ("detumble", "actuators"), ("dock", "reference"))
    for task, action in others:
        scenario = _scenario("ideal", "truth", options.set, task, action)
        steps = _STEPS if action == "actuators" else _PLANNED_STEPS
        rate, _ = _steps_per_s(scenario, count, rounds, steps)
        name = task if action == "actuators" else action
        print(f"{name:21} {count} environments  {rate:10.4g} steps/s", flush=True)
        figures[f"{name}_steps_per_s"] = rate
    figures["environments"] = count
    figures["physics_steps_per_step"] = scenario.timing.steps_per_tick
    slow = [k for k, v in figures.items() if k.startswith("ideal") and v < _BAR_PER_S]
    if slow:
        raise BenchmarkFailed(f"{', '.join(slow)}: below {_BAR_PER_S:g}", figures)
    return figures


def _add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--environments", type=int, default=256, metavar="N", help="in a batch (default: 256)"
    )


GROUP = Group({"environments": environments}, ("set",), _add_options)
