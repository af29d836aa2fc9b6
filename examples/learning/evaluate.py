# SPDX-License-Identifier: Apache-2.0
"""Compare a policy with the proportional law in the training environment: ``python evaluate.py
[--policy FILE] [--episodes N]``.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import numpy as np
import proportional

from chaserdock.envs import loaded
from chaserdock.envs.batch import DockingBatch
from chaserdock.envs.policy import Policy
from chaserdock.envs.task import OUTCOMES, SUCCESSES

FOLDER = Path(__file__).parent


def flown(scenario, law, episodes, seed):
    """Fly episodes by a law that maps batch and observations to actions; return outcome (n,) of the
    first chaser, duration (n,), s, and impulse (n,) of all, N s.
    """
    batch = DockingBatch(scenario, episodes)
    seen = batch.start(seed)
    outcome, ticks, impulse_N_s = (
        np.zeros(episodes, dtype=int),
        np.zeros(episodes),
        np.zeros(episodes),
    )
    while not outcome.all():
        flying = outcome == 0
        actions = np.clip(law(batch, seen), -1.0, 1.0)
        done = batch.step(actions)
        seen = done.observations
        ticks += flying
        impulse_N_s += flying * (np.abs(actions).sum(axis=1) @ batch.task.effort_N_s)
        outcome = np.where(flying, done.outcomes[:, 0], outcome)
    return outcome, ticks * batch.task.numbers.tick_s, impulse_N_s


def line_of(name, outcome, duration_s, impulse_N_s):
    """Return what is printed of a law's episodes."""
    good = np.isin(outcome, SUCCESSES)
    counts = Counter(OUTCOMES[k] for k in outcome.tolist())
    columns = [
        f"{np.median(x[good]):.1f} {unit} (95 %: {np.quantile(x[good], 0.95):.1f})"
        for x, unit in ((duration_s, "s"), (impulse_N_s, "N s"))
        if good.any()
    ]
    ended = ", ".join(f"{n} {word}" for word, n in counts.most_common())
    return f"{name:13} success {good.mean():.2%}; {'; '.join(columns)}; {ended}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenario", type=Path, default=FOLDER / "docking.toml")
    parser.add_argument("--policy", type=Path, default=FOLDER / "docking.onnx")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    scenario, policy = loaded(options.scenario), Policy(options.policy)
    policy.check(scenario)
    laws = {
        "proportional": proportional.actions_of,
        "policy": lambda _, seen: policy.actions(seen[:, 0])[:, None],
    }
    for name, law in laws.items():
        print(line_of(name, *flown(scenario, law, options.episodes, options.seed)))


if __name__ == "__main__":
    main()
