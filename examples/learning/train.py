# SPDX-License-Identifier: Apache-2.0
# /// script
# dependencies = ["chaserdock[learn]", "jax>=0.6", "onnx>=1.17"]
# ///
"""Train a policy that docks, by proximal policy optimization: ``python train.py [--out FILE]``.

It begins as a copy of the law of proportional.py, and improves by trying. One process; a step of
all environments, the network and its training share one core. With ``--cluster`` the workers of a
Dask cluster fly the environments, an even share each. J. Schulman et al., "Proximal policy
optimization algorithms", 2017, with generalized advantage estimation (2016).
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import proportional
from policy_file import NEAR, network, weights_of

from chaserdock.envs import loaded
from chaserdock.envs.batch import DockingBatch
from chaserdock.envs.policy import facts_of
from chaserdock.envs.task import SUCCESSES

FOLDER = Path(__file__).parent
ENVIRONMENTS, TICKS = 2048, 64  # of a batch: 9 s of each environment
HIDDEN = 64
DISCOUNT = 0.998  # per tick: 33 s, about one docking
TRACE = 0.98  # lambda of the advantages
CLIP = 0.2
AIM = 0.01  # divergence of a batch from the policy that flew it: the rate is adapted to it
EPOCHS, PARTS = 3, 16  # passes over a batch, in this many parts
SPREAD_TICKS = 375  # 25 s, about one episode
RATES = (5e-5, 1e-3)  # of policy and critic at first; both fall, and the policy's follows AIM
IMITATION_RATE = 2e-3
NOISE = 0.06  # standard deviation of actions at first, before they are limited
REWARD_SCALE = 0.1  # returns of some tens become some units
KEPT = 10  # batches after which policy and curve are written
IMITATION_ROUNDS, VALUE_ROUNDS = 12, 60
EPISODE_TICKS = 448  # 30 s: most episodes end within them


def features(z):
    """Return normalized observations beside themselves with the surrounding of zero enlarged."""
    return jnp.concatenate([z, jnp.tanh(NEAR * z)], axis=-1)


def initial(rng, width, outputs):
    """Return weights: two hidden layers, then the last, and one that passes both by."""
    sizes = ((2 * width, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, outputs), (2 * width, outputs))
    gains = (1.0, 1.0, 0.01, 0.01)
    return [
        (jnp.asarray(gain * rng.normal(size=s) / np.sqrt(s[0]), jnp.float32), jnp.zeros(s[1]))
        for s, gain in zip(sizes, gains, strict=True)
    ]


def output(weights, z):
    """Return the outputs (n, k) of a network for normalized observations (n, width)."""
    x = features(z)
    (w1, b1), (w2, b2), (w3, b3), (w4, b4) = weights
    h = jnp.tanh(jnp.tanh(x @ w1 + b1) @ w2 + b2)
    return h @ w3 + b3 + x @ w4 + b4


def likelihood(policy, spread, z, u):
    """Return the logarithm of the density (n,) of u before the limit, which cancels in ratios."""
    error = (u - output(policy, z)) * jnp.exp(-spread)
    return -jnp.sum(0.5 * error**2 + spread, axis=-1)


@jax.jit
def act(policy, spread, z, key):
    """Return drawn outputs before the limit, and the logarithm of their density."""
    mean = output(policy, z)
    u = mean + jnp.exp(spread) * jax.random.normal(key, mean.shape)
    return u, likelihood(policy, spread, z, u)


def adam(weights, slope, moments, number, rate):
    """Return weights and moments after a step of Adam, its slope limited to unit length."""
    size = jnp.sqrt(sum(jnp.sum(g**2) for g in jax.tree.leaves(slope)))
    slope = jax.tree.map(lambda g: g / jnp.maximum(1.0, size), slope)
    first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, moments[0], slope)
    second = jax.tree.map(lambda m, g: 0.999 * m + 0.001 * g**2, moments[1], slope)

    def moved(w, m, v):
        return w - rate * (m / (1.0 - 0.9**number)) / (jnp.sqrt(v / (1.0 - 0.999**number)) + 1e-8)

    return jax.tree.map(moved, weights, first, second), (first, second)


def imitation_loss(policy, z, wanted):
    return jnp.mean((jnp.tanh(output(policy, z)) - wanted) ** 2)


@jax.jit
def imitate(policy, moments, number, rate, z, wanted):
    slope = jax.grad(imitation_loss)(policy, z, wanted)
    return adam(policy, slope, moments, number, rate)


def loss(trained, data):
    """Return the loss of PPO on a part of a batch; ``counts`` is 0 where an episode began."""
    (policy, spread), critic = trained
    z, u, before, advantage, returns, counts = data
    total = jnp.sum(counts)
    of_value = jnp.sum(counts * (output(critic, z)[:, 0] - returns) ** 2) / total
    ratio = jnp.exp(likelihood(policy, spread, z, u) - before)
    gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - CLIP, 1.0 + CLIP) * advantage)
    return 0.5 * of_value - jnp.sum(counts * gain) / total


@jax.jit
def improve(trained, moments, number, rates, order, batch):
    """Train policy and critic, which share nothing, on a batch in PARTS parts."""

    def part(carried, rows):
        trained, moments, number = carried
        slopes = jax.grad(loss)(trained, tuple(x[rows] for x in batch))
        columns = (trained, slopes, moments, rates)
        found = [adam(w, g, m, number, rate) for w, g, m, rate in zip(*columns, strict=True)]
        return (tuple(f[0] for f in found), tuple(f[1] for f in found), number + 1.0), 0.0

    carried, _ = jax.lax.scan(part, (trained, moments, number), order.reshape(PARTS, -1))
    return carried


@jax.jit
def divergence(policy, spread, batch):
    """Return how far the policy is from the one that flew a batch: the mean of r - 1 - log(r) for
    ratios r of their densities.
    """
    z, u, before, _, _, counts = batch
    change = likelihood(policy, spread, z, u) - before
    return jnp.sum(counts * (jnp.expm1(change) - change)) / jnp.sum(counts)


@jax.jit
def advantages(critic, trace, z, rewards, terminated, done, started):
    """Return advantages and returns (T, n) of observations (T + 1, n, width)."""
    values = output(critic, z)[..., 0]
    gains = rewards + DISCOUNT * values[1:] * (1.0 - terminated) - values[:-1]

    def back(after, tick):
        gain, ended, start = tick
        now = (1.0 - start) * (gain + DISCOUNT * trace * (1.0 - ended) * after)
        return now, now

    _, found = jax.lax.scan(back, jnp.zeros(z.shape[1]), (gains, done, started), reverse=True)
    return found, found + values[:-1]


class Flights:
    """Environments with the scale of their observations, and the episodes that ended."""

    def __init__(self, scenario, seed, environments=ENVIRONMENTS):
        self.batch = DockingBatch(scenario, environments)
        self.seen = self.batch.start(seed)
        self.ended = np.zeros(environments, dtype=bool)
        self.middle = np.zeros(self.seen.shape[-1], np.float32)
        self.scale = np.ones(self.seen.shape[-1], np.float32)
        self.ticks, self.sums = np.zeros(environments), np.zeros(environments)
        self.episodes = []

    def normalized(self):
        return (self.seen[:, 0] - self.middle) / self.scale

    def step(self, actions):
        """Fly a tick; return the result and where it was a start instead."""
        started = self.ended
        self.ticks[started] = self.sums[started] = 0.0
        done = self.batch.step(actions[:, None])
        self.ended = (done.terminated | done.truncated)[:, 0]
        self.seen = done.observations
        self.ticks += ~started
        self.sums += done.rewards[:, 0]
        good = np.isin(done.outcomes[:, 0], SUCCESSES)
        columns = good, self.sums, self.ticks * self.batch.task.numbers.tick_s
        self.episodes.append(np.stack([c[self.ended] for c in columns], axis=1))
        return done, started

    def spread_out(self, policy):
        """Fly by a policy, and start some environments anew in each tick, so that batches contain
        all parts of an episode.
        """
        numbers = np.arange(self.batch.environments)
        for tick in range(SPREAD_TICKS):
            self.step(np.array(jnp.tanh(output(policy, self.normalized()))))
            chosen = numbers % SPREAD_TICKS == tick
            self.seen = self.batch.start(chosen=chosen)
            self.ticks[chosen] = self.sums[chosen] = 0.0
            self.ended &= ~chosen

    def collect(self, trained, ticks, trace, key):
        """Fly, and return the columns of ``loss`` by row: of all ticks of all environments."""
        (policy, spread), critic = trained
        rows = []
        for _ in range(ticks):
            z = self.normalized()
            key, draw = jax.random.split(key)
            u, density = act(policy, spread, z, draw)
            done, started = self.step(np.tanh(np.asarray(u)))
            reward = REWARD_SCALE * done.rewards[:, 0].astype(np.float32)
            rows.append((z, u, density, reward, done.terminated[:, 0], self.ended, started))
        z, u, density, *facts = (
            np.stack([np.asarray(x) for x in column]) for column in zip(*rows, strict=True)
        )
        z = np.concatenate([z, self.normalized()[None]])
        reward, terminated, done, started = (x.astype(np.float32) for x in facts)
        found = advantages(critic, trace, z, reward, terminated, done, started)
        advantage, returns = (np.asarray(x) for x in found)
        columns = (z[:-1], u, density, advantage, returns, 1.0 - started)
        return tuple(x.reshape(-1, *x.shape[2:]) for x in columns)

    def episodes_ended(self):
        """Return success, return and duration (s) of the episodes (n, 3) that ended since the last
        call.
        """
        ended, self.episodes = np.concatenate(self.episodes), []
        return ended


def statistics(ended):
    """Return figures of episodes (n, 3)."""
    names = ("success", "return", "duration_s")
    figures = dict(zip(names, ended.mean(axis=0).round(4).tolist(), strict=True))
    return {"episodes": len(ended)} | (figures if len(ended) else {})


def batch_of(columns):
    """Return the columns of ``loss`` with normalized advantages."""
    z, u, density, advantage, returns, counts = columns
    chosen = advantage[counts > 0.0]
    advantage = (advantage - chosen.mean()) / (chosen.std() + 1e-6)
    return tuple(map(jnp.asarray, (z, u, density, advantage, returns, counts)))


def imitated(flights, policy, rng):
    """Return a policy that copies the proportional law where the copy itself flies (S. Ross et
    al., "A reduction of imitation learning to no-regret online learning", 2011).
    """
    moments, number = (jax.tree.map(jnp.zeros_like, policy),) * 2, 0
    seen, wanted = [], []
    for round_ in range(IMITATION_ROUNDS):
        for _ in range(2 * TICKS):
            law = proportional.actions_of(flights.batch, flights.seen)[:, 0]
            law = np.clip(law, -1.0, 1.0).astype(np.float32)
            if len(seen) % 4 == 0 or round_:
                seen.append(flights.seen[:, 0].copy())
                wanted.append(law)
            flown = law
            if round_:
                flown = np.array(jnp.tanh(output(policy, flights.normalized())))
            flights.step(flown + NOISE * rng.normal(size=law.shape).astype(np.float32))
        if round_ == 0:
            every = np.concatenate(seen)
            flights.middle, flights.scale = every.mean(axis=0), every.std(axis=0)
            flights.scale = np.maximum(flights.scale, 1e-6 + 0.02 * flights.scale.max())
        z, aim = np.concatenate(seen[-512:]), np.concatenate(wanted[-512:])
        z = (z - flights.middle) / flights.scale
        for _ in range(300):
            rows = rng.integers(len(z), size=4096)
            number += 1
            rate = IMITATION_RATE * (1.0 - round_ / IMITATION_ROUNDS)
            policy, moments = imitate(policy, moments, number, rate, z[rows], aim[rows])
        print(
            f"imitation {round_ + 1}: error {float(imitation_loss(policy, z, aim)) ** 0.5:.4f}",
            flush=True,
        )
    return policy


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenario", type=Path, default=FOLDER / "docking.toml")
    parser.add_argument("--out", type=Path, default=FOLDER / "docking.onnx")
    parser.add_argument("--curve", type=Path, help="write the training curve, as JSON")
    parser.add_argument("--start", type=Path, help="begin with this policy instead of imitation")
    parser.add_argument("--batches", type=int, default=240)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cluster", metavar="ADDRESS", help="a Dask scheduler: its workers fly")
    options = parser.parse_args()

    if loaded(options.scenario).chaser.actuation != "ideal":
        parser.error(f'{options.scenario}: wrenches are trained: chaser.actuation = "ideal"')
    begin_s, rng = time.process_time(), np.random.default_rng(options.seed)
    flights = Flights(loaded(options.scenario), options.seed)
    width, outputs = flights.seen.shape[-1], flights.batch.task.actuators
    if options.start is None:
        policy = imitated(flights, initial(rng, width, outputs), rng)
    else:
        policy, flights.middle, flights.scale = weights_of(onnx.load(options.start))
    spread = jnp.full(outputs, np.log(NOISE))
    trained = ((policy, spread), initial(rng, width, 1))
    moments = tuple((jax.tree.map(jnp.zeros_like, w),) * 2 for w in trained)
    number, rate = 1.0, RATES[0]
    key, curve = jax.random.key(options.seed), []
    facts, flown = facts_of(flights.batch.task), flights
    if options.cluster is not None:
        from fleet import Fleet

        flown = Fleet(options.cluster, options.scenario, options.seed, flights)
    flown.spread_out(policy)
    part = TICKS * ENVIRONMENTS
    key, draw = jax.random.split(key)
    batch = batch_of(flown.collect(trained, EPISODE_TICKS, 1.0, draw))
    for k in range(VALUE_ROUNDS):  # a critic that knows nothing would lead the policy astray
        order = jnp.asarray(rng.integers(len(batch[0]), size=part))
        rates = (0.0, RATES[1] * (1.0 - k / VALUE_ROUNDS))
        trained, moments, number = improve(trained, moments, number, rates, order, batch)
    flown.episodes_ended()
    for k in range(options.batches):
        key, draw = jax.random.split(key)
        batch = batch_of(flown.collect(trained, TICKS, TRACE, draw))
        left = 1.0 - k / options.batches
        for _ in range(EPOCHS):
            order = jnp.asarray(rng.permutation(part))
            rates = (rate * left, RATES[1] * left)
            trained, moments, number = improve(trained, moments, number, rates, order, batch)
        far = float(divergence(*trained[0], batch))
        rate *= 1.5 if far < 0.5 * AIM else 1.0 / 1.5 if far > 2.0 * AIM else 1.0
        steps = (k + 1) * ENVIRONMENTS * TICKS
        curve.append({"steps": steps, "cpu_s": round(time.process_time() - begin_s, 1)})
        curve[-1] |= statistics(flown.episodes_ended())
        noise = {
            "noise": round(float(np.exp(trained[0][1]).mean()), 4),
            "divergence": round(far, 4),
            "rate": rate,
        }
        print(json.dumps(curve[-1] | noise), flush=True)
        if (k + 1) % KEPT == 0 or k + 1 == options.batches:
            model = network(trained[0][0], flights.middle, flights.scale, facts)
            onnx.save(model, str(options.out))
            if options.curve is not None:
                options.curve.write_text(json.dumps(curve), "utf-8")
    print(f"{options.out}: {options.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
