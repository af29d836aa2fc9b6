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
_BAR_PER_S, _IMAGES_BAR_PER_S = 1e6, 2e3
_IMAGE_ENVIRONMENTS = 32
_IMAGES = ("camera.width_px=64", "camera.height_px=64")
_STEPS, _PLANNED_STEPS = 100_000, 1_000
"""Steps of a round; with the NMPC, which takes about a millisecond for a step, fewer."""


def task_scenario(
    actuation: str,
    observation: str,
    sets: list[str],
    task: str = "dock",
    action: str = "actuators",
) -> Scenario:
    """Return `docking-contact` with a training task and plant mismatch."""
    start = "target_rate_deg_s=1.0" if task == "detumble" else _START
    overrides = (
        _TASK.format(task=task, action=action, observation=observation, start=start),
        f'chaser.actuation="{actuation}"',
        'truth.preset="mismatch"',
        *sets,
    )
    return load_scenario(shipped_scenario("docking-contact"), overrides)


def steps_per_s(
    scenario: Scenario, environments: int, rounds: int, steps: int = _STEPS
) -> tuple[float, float]:
    """Return the median number of agent steps in a second of processor time, and the share of steps
    that began an episode; a round has about ``steps``.
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
    random actions, observations, rewards and new episodes included (bar with ``ideal``: 1e6), with
    the other tasks and actions, and with images of 64 x 64 pixels (bar: 2,000).
    """
    figures, count = Figures(), options.environments
    rounds = 3 if options.quick else 9
    for actuation in ("ideal", "thrusters"):
        for observation in ("truth", "statistical"):
            scenario = task_scenario(actuation, observation, options.set)
            rate, started = steps_per_s(scenario, count, rounds)
            name = f"{actuation}_{observation}"
            print(
                f"{actuation:9} {observation:11} {count} environments  "
                f"{rate / 1e6:5.2f} million steps/s, {started:.2%} of them starts",
                flush=True,
            )
            figures[f"{name}_steps_per_s"] = rate
    others = (("inspect", "actuators"), ("detumble", "actuators"), ("dock", "reference"))
    for task, action in others:
        scenario = task_scenario("ideal", "truth", options.set, task, action)
        steps = _STEPS if action == "actuators" else _PLANNED_STEPS
        rate, _ = steps_per_s(scenario, count, rounds, steps)
        name = task if action == "actuators" else action
        print(f"{name:21} {count} environments  {rate:10.4g} steps/s", flush=True)
        figures[f"{name}_steps_per_s"] = rate
    images = task_scenario("ideal", "images", [*_IMAGES, *options.set])
    rate, _ = steps_per_s(images, _IMAGE_ENVIRONMENTS, rounds, steps=0)
    print(f"ideal     images      {_IMAGE_ENVIRONMENTS} environments  {rate:5.0f} steps/s")
    figures["images_steps_per_s"] = rate
    figures["environments"] = count
    figures["physics_steps_per_step"] = scenario.timing.steps_per_tick
    slow = [k for k, v in figures.items() if k.startswith("ideal") and v < _BAR_PER_S]
    slow += ["images_steps_per_s"] if rate < _IMAGES_BAR_PER_S else []
    if slow:
        raise BenchmarkFailed(f"below the bar: {', '.join(slow)}", figures)
    return figures


def _add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--environments", type=int, default=256, metavar="N", help="in a batch (default: 256)"
    )


GROUP = Group({"environments": environments}, ("set",), _add_options)
