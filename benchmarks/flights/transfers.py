# SPDX-License-Identifier: Apache-2.0
"""Seeded transfers around the target, ``collision-avoidance`` and ``swap``: variations, and figures
of a flight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_models.shape_distance import box_table, distance_between
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.rendering.cameras import States
from numpy.typing import ArrayLike

from chaserdock.experiments.in_process import InProcessMission
from chaserdock.experiments.perception import PerceptionModel

from . import load_shipped
from .shape_gaps import shape_gap_m

SYMMETRIC_EVERY = 4
"""Every fourth variation of ``collision-avoidance`` is exactly symmetric."""
SMALL = {"width_px": 640, "height_px": 360}
"""A quarter of the scenario's pixels, to save time."""
CLUTTER_S = 100.0
"""Longest flight in clutter."""
CLUTTER_TIMING = ("time.rate_hz=10", "time.image_hz=10", "time.physics_hz=120")
"""Coarser than the scenario, to save time."""
_DIAGONAL = 9.0
"""m: stands for a chaser's distance to itself, larger than any between two."""


def avoidance(seed: int, full_images: bool = False) -> Scenario:
    """Return ``collision-avoidance`` rotated and scattered by the seed; every fourth seed is
    exactly symmetric.

    Symmetric: chaser 0 at rest on an axis of TRF (another one each time), its goal exactly
    opposite, chaser 1 at right angles to both; seeds above 11 with the whole scene rotated at
    random in WRF. Otherwise starts, goal and chaser 1's place are scattered by up to 10 cm (the
    goal up to 5 cm), attitudes by 0.1 rad.
    """
    rng = np.random.default_rng([seed, 0xA701])
    scenario = load_shipped("collision-avoidance", f"seed={seed}")
    symmetric = seed % SYMMETRIC_EVERY == 0
    rotated = seed > 11 or not symmetric
    attitude = (
        rotations.normalize(rng.normal(size=4)) if rotated else np.array([1.0, 0.0, 0.0, 0.0])
    )
    way = np.roll([1.0, 0.0, 0.0], seed // SYMMETRIC_EVERY if symmetric else 0)
    aside = np.roll([0.0, 1.0, 0.0], seed // SYMMETRIC_EVERY if symmetric else 0)
    places, scatter = [-way, -aside], np.zeros((2, 3))
    if not symmetric:
        scatter = rng.uniform(-0.1, 0.1, (2, 3))
        places[1] = places[1] + rng.uniform(-0.1, 0.1, 3)
    nominal = scenario.chasers[0]
    chasers = tuple(
        nominal.model_copy(
            update={
                "position_m": tuple(place.tolist()),
                "q_wxyz": tuple(
                    facing_attitudes(nominal.position_m, nominal.q_wxyz, place)[0].tolist()
                ),
                "start_offset_m": tuple(offset.tolist()),
                "start_rotation_rad": tuple(
                    [0.0] * 3 if symmetric else rng.uniform(-0.1, 0.1, 3).tolist()
                ),
            }
        )
        for place, offset in zip(places, scatter, strict=True)
    )
    goal = way if symmetric else way + rng.uniform(-0.05, 0.05, 3)
    (entry,) = scenario.timeline
    return scenario.model_copy(
        update={
            "camera": scenario.camera if full_images else scenario.camera.model_copy(update=SMALL),
            "target": scenario.target.model_copy(update={"q_wxyz": tuple(attitude.tolist())}),
            "chasers": chasers,
            "timeline": (entry.model_copy(update={"offset_m": tuple(goal.tolist())}),),
        }
    )


def swap(seed: int) -> Scenario:
    """Return ``swap``; except for seed 0, starts are scattered by 5 cm (one sigma, each axis), the
    tumble axis is random.
    """
    rng, scenario = np.random.default_rng([seed, 0x5A]), load_shipped("swap", f"seed={seed}")
    if seed == 0:
        return scenario
    omega = rotations.rotate(
        rotations.normalize(rng.normal(size=4)), np.array(scenario.target.omega_rad_s)
    )
    chasers = tuple(
        c.model_copy(update={"start_offset_m": tuple(rng.normal(0.0, 0.05, 3).tolist())})
        for c in scenario.chasers
    )
    target = scenario.target.model_copy(update={"omega_rad_s": tuple(omega.tolist())})
    return scenario.model_copy(update={"chasers": chasers, "target": target})


CLUTTER_SHAPES_M = 0.02
"""Distance of the shapes of chasers from each other and from the target in clutter, m."""
CLUTTER, DENSE_CLUTTER = (0.8, 1.4, 0.5), (0.7, 1.15, 0.42)
"""Smallest and largest distance of places from the target, and least distance from each other, m,
in `clutter`.
"""


def clutter(
    seed: int,
    chasers: int = 16,
    places_m: tuple[float, float, float] = CLUTTER,
    duration_s: float = CLUTTER_S,
) -> Scenario:
    """Return a scenario in which chasers at random places around the tumbling target fly to random
    places, all at once.
    """
    rng = np.random.default_rng([seed, 0xC107])
    base = load_shipped(
        "swap",
        f"seed={seed}",
        "navigation.grade='exact'",
        f"limits.min_distance_shape_m={CLUTTER_SHAPES_M}",
        f"duration_s={duration_s}",
        *CLUTTER_TIMING,
    )
    nominal, entry, shape = base.chasers[0], base.timeline[0], box_table(base.chaser.boxes())
    starts, attitudes = _places(
        rng, places_m, shape, [(nominal.position_m, nominal.q_wxyz)] * chasers
    )
    goals, _ = _places(rng, places_m, shape, list(zip(starts, attitudes, strict=True)))
    made = [
        nominal.model_copy(
            update={"position_m": tuple(place.tolist()), "q_wxyz": tuple(q.tolist())}
        )
        for place, q in zip(starts, attitudes, strict=True)
    ]
    timeline = [
        entry.model_copy(update={"at_s": 1.0, "chasers": (i,), "offset_m": tuple(goal.tolist())})
        for i, goal in enumerate(goals)
    ]
    return base.model_copy(update={"chasers": tuple(made), "timeline": tuple(timeline)})


def _places(
    rng: np.random.Generator,
    places_m: tuple[float, float, float],
    shape: Array,
    nominal: Sequence[tuple[ArrayLike, ArrayLike]],
) -> tuple[Array, Array]:
    """Return random places (N, 3) and the attitudes (N, 4) in which chasers with ``nominal`` poses
    face the target there; ``places_m`` as in `clutter`. The chasers' shapes (S, 15) do not come
    near each other."""
    nearest_m, farthest_m, apart_m = places_m
    places, attitudes = np.zeros((0, 3)), np.zeros((0, 4))
    while len(places) < len(nominal):
        way = rng.normal(size=3)
        place = way / np.linalg.norm(way) * rng.uniform(nearest_m, farthest_m)
        if np.any(np.linalg.norm(places - place, axis=1) < apart_m):
            continue
        q = facing_attitudes(*nominal[len(places)], place)[0]
        others = zip(places, attitudes, strict=True)
        if all(
            distance_between(shape, (place, q), other) > 2.0 * CLUTTER_SHAPES_M for other in others
        ):
            places, attitudes = np.vstack([places, place]), np.vstack([attitudes, q])
    return places, attitudes


@dataclass
class TransferOutcome:
    """How near bodies came in one flight, and whether chasers reached their goals.

    ``to_target_m``, ``between_m``: least true distances of centres, chaser to target and chaser to
    chaser. ``shapes_m``: least gap between the shapes of two bodies, probes included, if the
    scenario limits it. ``reached_s``: from its command on until the last chaser stayed at its goal
    (NaN: never). ``end_m``: largest distance from a goal at the end. ``missed``: number of chasers
    not at their goal then. ``failed``, ``relaxed``: solves of single chasers.
    """

    seed: int
    to_target_m: float = math.inf
    between_m: float = math.inf
    shapes_m: float = math.inf
    reached_s: float = math.nan
    end_m: float = math.inf
    missed: int = 0
    failed: int = 0
    relaxed: int = 0
    contacts: int = 0

    def line(self) -> str:
        """Return one line for people."""
        return (
            f"{self.seed:3d}  to target {self.to_target_m:.4f} m  "
            f"between chasers {self.between_m:.4f} m  between shapes {self.shapes_m:.4f} m  "
            f"reached after {self.reached_s:.1f} s, {self.end_m * 1e3:.1f} mm  "
            f"missed {self.missed}  failed {self.failed}  relaxed {self.relaxed}  "
            f"contacts {self.contacts}"
        )


def fly_transfer(
    seed: int, scenario: Scenario, perception: PerceptionModel | None, stay_s: float = math.inf
) -> TransferOutcome:
    """Fly to the end, or until all chasers with a goal are there for ``stay_s``; distances and
    goals are checked on ground truth at every tick. Without ``perception`` the target is known
    exactly."""
    out = TransferOutcome(seed)
    goals = {i: g for i in range(len(scenario.chasers)) if (g := scenario.goal_of(i)) is not None}
    last_away_s: dict[int, float] = {}
    distances: dict[int, float] = {}

    def measure(time_s: float, states: States) -> None:
        nonlocal distances
        _note_distances(out, scenario, states)
        if scenario.limits.min_distance_shape_m:
            out.shapes_m = min(out.shapes_m, shape_gap_m(scenario, states))
        distances = {i: _goal_distance_m(i, offset, states) for i, (_, offset) in goals.items()}
        for i, (sent_s, _) in goals.items():
            if distances[i] > scenario.success.reached_position_m or time_s < sent_s:
                last_away_s[i] = time_s - sent_s

    def there_for_s(time_s: float) -> float:
        return min(time_s - sent_s - last_away_s[i] for i, (sent_s, _) in goals.items())

    with InProcessMission(scenario, perception) as flight:
        for record in flight.ticks():
            measure(record.time_s, record.states)
            solver = record.outputs.solver if record.outputs is not None else None
            if solver is not None:
                out.failed += solver.status.count("failed")
                out.relaxed += solver.status.count("infeasible_relaxed")
            if there_for_s(record.time_s) >= stay_s:
                break
        measure(flight.time_s, flight.states())
        out.contacts = len(flight.contacts)
    step_s = 1.0 / scenario.time.rate_hz
    out.end_m = max(distances.values())
    out.missed = sum(d > scenario.success.reached_position_m for d in distances.values())
    if all(
        last_away_s[i] < scenario.duration_s - sent_s - step_s for i, (sent_s, _) in goals.items()
    ):
        out.reached_s = max(last_away_s.values()) + step_s
    return out


def _note_distances(out: TransferOutcome, scenario: Scenario, states: States) -> None:
    n = len(scenario.chasers)
    positions = np.array([states[f"chaser/{i}"].position_m for i in range(n)])
    to_target = np.linalg.norm(positions - states[TARGET].position_m, axis=1)
    between = np.linalg.norm(positions[:, None] - positions[None], axis=-1) + _DIAGONAL * np.eye(n)
    out.to_target_m = min(out.to_target_m, float(to_target.min()))
    out.between_m = min(out.between_m, float(between.min()))


def _goal_distance_m(chaser: int, offset_m: tuple[float, float, float], states: States) -> float:
    target = states[TARGET]
    goal = target.position_m + rotations.rotate(target.q_wxyz, np.array(offset_m))
    return float(np.linalg.norm(states[f"chaser/{chaser}"].position_m - goal))
