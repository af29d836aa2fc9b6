# SPDX-License-Identifier: Apache-2.0
"""Published rendezvous and docking tasks with their own dynamics and criteria, for many samples at
once.

ARCH-COMP: N. Chan and S. Mitra, Verifying Safety of an Autonomous Spacecraft Rendezvous Mission,
ARCH17; a benchmark of the category of affine dynamics since ARCH-COMP18. Its controller is part of
the benchmark.

AFRL: the docking task of the packages safe-autonomy-sims and K. Dunlap et al., Run Time Assured
Reinforcement Learning for Safe Satellite Docking, Journal of Aerospace Information Systems 20(1),
2023, with three deputies. It is flown here by the guidance law in ``afrl_force``, which is ours.

``afrl_starts`` and ``arch_start`` draw the starts of the shipped scenarios of both tasks, which the
flight software flies.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.relative_motion import cw_matrix, cw_transition
from chaserdock_protocol.shipped_scenarios import shipped_scenario
from numpy.typing import NDArray

from chaserdock.analysis.summary import summarize
from chaserdock.simulation.mission import simulate

from . import load_shipped

# -- ARCH-COMP: metres and minutes, in the orbit's plane -------------------------------------------

ARCH_CENTRE, ARCH_HALF = np.array([-900.0, -400.0, 0.0, 0.0]), np.array([25.0, 25.0, 0.0, 0.0])
"""Initial set: a box of positions (m), at rest."""
ARCH_CONE_DEG, ARCH_SPEED_M_S, ARCH_BOX_M = 30.0, 0.055, 0.2
"""Half angle of the approach cone, largest speed, half edge of the target's box: the task's."""
ARCH_END_MIN = 300.0
"""Duration of a sample, of the task."""
_ARCH_BATCH = 4000
"""Samples that are flown together: their states fit the processor's cache."""
_ARCH_APPROACH = np.array(
    [
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        [-0.057599765881773, 0.000200959896519766, -2.89995083970656, 0.00877200894463775],
        [-0.000174031357370456, -0.0665123984901026, -0.00875351105536225, -2.90300269286856],
    ]
)
"""Closed loop of the task's controller beyond 100 m: d(x, y, vx, vy)/dt, minutes."""
_ARCH_ATTEMPT = np.array(
    [
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        [-0.575999943070835, 0.000262486079431672, -19.2299795908647, 0.00876275931760007],
        [-0.000262486080737868, -0.575999940191886, -0.00876276068239993, -19.2299765959399],
    ]
)
"""The same within 100 m."""
_ARCH_ABORT = np.array(
    [
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        [0.0000575894721132, 0.0, 0.0, 0.00876276],
        [0.0, 0.0, -0.00876276, 0.0],
    ]
)
"""The coast after an abort."""


@dataclass(frozen=True)
class ArchOutcome:
    """Of the samples: ``attempts``, how many came within 100 m; numbers of samples that violate
    each property. ``cone_margin_m``, ``speed_margin_m_s``, ``clearance_m``: smallest margins; the
    clearance is from the target's box after the abort."""

    samples: int
    attempts: int
    outside_cone: int
    too_fast: int
    hit: int
    cone_margin_m: float
    speed_margin_m_s: float
    clearance_m: float

    @property
    def violations(self) -> int:
        return self.outside_cone + self.too_fast + self.hit


def arch_comp(
    samples: int, seed: int, abort_min: tuple[float, float], step_min: float = 0.05
) -> ArchOutcome:
    """Fly random samples of the initial set for 300 minutes; each aborts at a random time in
    ``abort_min``, minutes.

    An attempt is the part within the octagon of 100 m about the target. The states are exact at the
    steps of ``step_min``.
    """
    rng = np.random.default_rng([seed, 0xA7C4])
    x = ARCH_CENTRE + rng.uniform(-1.0, 1.0, (samples, 4)) * ARCH_HALF
    aborts = rng.uniform(*abort_min, samples)
    transitions = [_expm(a * step_min).T for a in (_ARCH_APPROACH, _ARCH_ATTEMPT, _ARCH_ABORT)]
    parts = [
        _arch_margins(x[k : k + _ARCH_BATCH], aborts[k : k + _ARCH_BATCH], transitions, step_min)
        for k in range(0, samples, _ARCH_BATCH)
    ]
    cone, speed, box = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return ArchOutcome(
        samples,
        int(np.isfinite(cone).sum()),
        *(int((worst < 0.0).sum()) for worst in (cone, speed, box)),
        *(float(worst.min()) for worst in (cone, speed, box)),
    )


def _arch_margins(
    x: Array, aborts: Array, transitions: list[Array], step_min: float
) -> tuple[Array, Array, Array]:
    """Return the smallest margins (S,) of cone, speed and box of flights from states (S, 4);
    infinity where a property is not asked for. An attempt lasts until the abort, and the box counts
    from then on."""
    cone, speed, box = (np.full(len(x), math.inf) for _ in range(3))
    slope, cosine = math.tan(math.radians(ARCH_CONE_DEG)), math.cos(math.radians(ARCH_CONE_DEG))
    mode = np.zeros(len(x), dtype=np.intp)
    for k in range(round(ARCH_END_MIN / step_min)):
        away = np.abs(x[:, :2])
        near = (away.max(axis=1) <= 100.0) & (away.sum(axis=1) <= 141.1)
        mode[(mode == 0) & near] = 1
        mode[k * step_min >= aborts] = 2
        rows = [np.flatnonzero(mode == m) for m in range(3)]
        if len(rows[1]):
            # Distance from the cone's faces y = +-x tan(30 degrees), positive inside.
            at = x[rows[1]]
            inside = (-slope * at[:, 0] - np.abs(at[:, 1])) * cosine
            cone[rows[1]] = np.minimum(cone[rows[1]], inside)
            spare = ARCH_SPEED_M_S - np.hypot(at[:, 2], at[:, 3]) / 60.0
            speed[rows[1]] = np.minimum(speed[rows[1]], spare)
        if len(rows[2]):
            box[rows[2]] = np.minimum(box[rows[2]], away[rows[2]].max(axis=1) - ARCH_BOX_M)
        for some, transition in zip(rows, transitions, strict=True):
            if len(some):
                x[some] = x[some] @ transition
    return cone, speed, box


def _expm(matrix: Array) -> Array:
    """Return the exponential of a matrix (4, 4): a Taylor series of the scaled matrix, then
    squared.
    """
    scaled, squarings = matrix / 2.0**12, 12
    term, total = np.eye(len(matrix)), np.eye(len(matrix))
    for k in range(1, 9):
        term = term @ scaled / k
        total = total + term
    for _ in range(squarings):
        total = total @ total
    return total


# -- AFRL: three deputies, metres and seconds ------------------------------------------------------

AFRL_RATE_RAD_S, AFRL_MASS_KG, AFRL_FORCE_N = 0.001027, 12.0, 1.0
"""Mean motion, mass and largest force per axis, of the task."""
AFRL_DOCKED_M, AFRL_DOCKED_M_S, AFRL_SLOPE = 0.5, 0.2, 2.0
"""Radius of docking, speed limit there, and its slope in mean motions, of the task."""
AFRL_START_M, AFRL_TIMEOUT_S, AFRL_STEP_S = (100.0, 150.0), 2000.0, 1.0
"""Distances of the start, longest episode and control step, of the task."""
AFRL_DEPUTIES, AFRL_APART_M = 3, 1.0
"""Number of deputies, and the distance that they keep from one another while they fly; the task
states none.
"""
_START_SHARE = 0.8
"""Largest speed at the start as a share of the limit; the package draws up to 0.8 m/s, beyond its
own limit of 0.4 m/s at 100 m.
"""
_STAGGER_S = 260.0
"""Deputies come in one after the other: the later ones wait at their start for this long each."""


@dataclass(frozen=True)
class AfrlOutcome:
    """Of the episodes: ``docked``, all three deputies within the radius below the speed limit and
    no limit violated before. ``speed_margin_m_s``: smallest distance from the limit; ``apart_m``:
    smallest distance of two deputies before they docked."""

    episodes: int
    docked: int
    too_fast: int
    too_near: int
    late: int
    speed_margin_m_s: float
    apart_m: float
    time_s: float
    delta_v_m_s: float


def afrl_speed_limit(distance_m: Array) -> Array:
    """Return the speed limit, m/s: 0.2 + 2 n (d - 0.5)."""
    return AFRL_DOCKED_M_S + AFRL_SLOPE * AFRL_RATE_RAD_S * (distance_m - AFRL_DOCKED_M)


def afrl_force(x: Array, waits: NDArray[np.bool_]) -> Array:
    """Return forces (..., 3), N, at states (..., 6): follow a velocity towards the target at a
    share of the speed limit.

    Those that wait hold their place. The force cancels the relative motion of Clohessy and
    Wiltshire.
    """
    position, velocity = x[..., :3], x[..., 3:]
    distance = np.linalg.norm(position, axis=-1, keepdims=True)
    speed = 0.8 * afrl_speed_limit(distance)
    wanted = np.where(waits[..., None], 0.0, -position / np.maximum(distance, 1e-9) * speed)
    # The speed limit falls on the way in: v v' = (0.8)^2 2 n v.
    slowing = np.where(waits[..., None], 0.0, -wanted * 0.8 * AFRL_SLOPE * AFRL_RATE_RAD_S)
    natural = x @ cw_matrix(AFRL_RATE_RAD_S)[3:].T
    force = AFRL_MASS_KG * (0.25 * (wanted - velocity) + slowing - natural)
    return np.clip(force, -AFRL_FORCE_N, AFRL_FORCE_N)


def _afrl_starts(episodes: int, rng: np.random.Generator) -> Array:
    """Return states (episodes, 3, 6)."""
    along = rng.normal(size=(2, episodes, AFRL_DEPUTIES, 3))
    along /= np.linalg.norm(along, axis=3, keepdims=True)
    distance = rng.uniform(*AFRL_START_M, (episodes, AFRL_DEPUTIES, 1))
    speed = rng.uniform(0.0, _START_SHARE, distance.shape) * afrl_speed_limit(distance)
    return np.concatenate([along[0] * distance, along[1] * speed], axis=2)


def _smallest_gap(x: Array, docked: NDArray[np.bool_]) -> Array:
    """Return the smallest distance (episodes,) of two deputies that both still fly."""
    gaps = [np.full(len(x), math.inf)]
    for i in range(AFRL_DEPUTIES):
        for j in range(i):
            both = ~(docked[:, i] | docked[:, j])
            gaps.append(np.where(both, np.linalg.norm(x[:, i, :3] - x[:, j, :3], axis=1), math.inf))
    return np.min(gaps, axis=0)


def afrl_docking(episodes: int, seed: int) -> AfrlOutcome:
    """Fly episodes with a control step of 1 s and the force held.

    Each starts at a random place, with a speed of at most `_START_SHARE` of the limit there, in a
    random direction.
    """
    x = _afrl_starts(episodes, np.random.default_rng([seed, 0xAF71]))
    step = cw_transition(AFRL_RATE_RAD_S, AFRL_STEP_S)
    fine = np.linspace(0.0, AFRL_STEP_S, 21)
    held = np.trapezoid(cw_transition(AFRL_RATE_RAD_S, fine)[:, :, 3:], fine, axis=0) / AFRL_MASS_KG
    docked = np.zeros((episodes, AFRL_DEPUTIES), dtype=bool)
    fast, near, spent = np.zeros_like(docked), np.zeros(episodes, dtype=bool), np.zeros(episodes)
    margin, apart, last_s = math.inf, math.inf, 0.0
    order = np.arange(AFRL_DEPUTIES) * _STAGGER_S
    for k in range(round(AFRL_TIMEOUT_S / AFRL_STEP_S)):
        waits = np.broadcast_to(k * AFRL_STEP_S < order, docked.shape)
        force = np.where(docked[..., None], 0.0, afrl_force(x, waits))
        spent += np.abs(force).sum(axis=(1, 2)) / AFRL_MASS_KG * AFRL_STEP_S
        moved = x @ step.T + force @ held.T
        x = np.where(docked[..., None], x, moved)
        distance, speed = np.linalg.norm(x[..., :3], axis=2), np.linalg.norm(x[..., 3:], axis=2)
        spare = np.where(docked, math.inf, afrl_speed_limit(distance) - speed)
        fast |= spare < 0.0
        margin = min(margin, float(spare.min()))
        gap = _smallest_gap(x, docked)
        near |= gap < AFRL_APART_M
        apart = min(apart, float(gap.min()))
        arrived = ~docked & (distance <= AFRL_DOCKED_M)
        docked |= arrived
        if arrived.any():
            last_s = (k + 1) * AFRL_STEP_S
        if docked.all():
            break
    all_docked = docked.all(axis=1)
    good = all_docked & ~fast.any(axis=1) & ~near
    return AfrlOutcome(
        episodes,
        int(good.sum()),
        int(fast.any(axis=1).sum()),
        int(near.sum()),
        int((~all_docked).sum()),
        margin,
        apart,
        last_s,
        float(spent.mean() / AFRL_DEPUTIES),
    )


# -- The scenarios ---------------------------------------------------------------------------------

_APART_DEG = 60.0
"""Least angle between the directions from which deputies start, as they dock where they come from;
the task states none.
"""
_HOLD_M = 2.5
"""Distance of the hold point before the docking."""
_ARCH_HOLD_M = 116.0
"""Distance within which the hold point before the attempt is."""


def _directions(rng: np.random.Generator) -> Array:
    """Return random unit vectors (3, 3) at least `_APART_DEG` from one another."""
    while True:
        along = rng.normal(size=(AFRL_DEPUTIES, 3))
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        cosines = (along @ along.T)[np.triu_indices(AFRL_DEPUTIES, 1)]
        if cosines.max() <= math.cos(math.radians(_APART_DEG)):
            return along


def afrl_starts(seed: int) -> tuple[str, ...]:
    """Return overrides of ``afrl-docking``: starts with distances and speeds as in
    ``afrl_docking``, and directions apart.
    """
    rng = np.random.default_rng([seed, 0xAF72])
    along, heading = _directions(rng), rng.normal(size=(AFRL_DEPUTIES, 3))
    heading /= np.linalg.norm(heading, axis=1, keepdims=True)
    distance = rng.uniform(*AFRL_START_M, (AFRL_DEPUTIES, 1))
    speed = rng.uniform(0.0, _START_SHARE, distance.shape) * afrl_speed_limit(distance)
    overrides = [f"seed={seed}"]
    for i in range(AFRL_DEPUTIES):
        overrides += [
            f"chasers.{i}.position_m={_toml(along[i] * distance[i])}",
            f"chasers.{i}.start_velocity_m_s={_toml(heading[i] * speed[i])}",
            f"timeline.{i}.offset_m={_toml(along[i] * _HOLD_M)}",
        ]
    return tuple(overrides)


def arch_start(seed: int) -> tuple[str, ...]:
    """Return overrides of ``arch-comp-rendezvous``: a start in the task's initial set and, with an
    odd seed, an abort at a random moment after the hold point, before which the chaser need not
    come nearer than that."""
    rng = np.random.default_rng([seed, 0xA7C5])
    start = (ARCH_CENTRE + rng.uniform(-1.0, 1.0, 4) * ARCH_HALF)[:2]
    overrides = (f"seed={seed}", f"chasers.0.position_m={_toml([*start, 0.0])}")
    if seed % 2 == 0:
        return overrides
    _, attempt, abort = load_shipped("arch-comp-rendezvous").timeline
    at_s, hold_m = rng.uniform(attempt.at_s, abort.at_s), _ARCH_HOLD_M
    return (*overrides, f"timeline.2.at_s={at_s:.1f}", f"success.arrival.distance_m={hold_m}")


def fly_scenario(name: str, overrides: tuple[str, ...]) -> dict[str, Any]:
    """Fly a shipped scenario as ``chaserdock simulate`` does; return its summary."""
    with tempfile.TemporaryDirectory() as folder:
        simulate(shipped_scenario(name), Path(folder), overrides)
        return summarize(Path(folder))


def _toml(values: Iterable[float]) -> str:
    return f"[{', '.join(repr(float(v)) for v in values)}]"
