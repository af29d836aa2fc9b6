# SPDX-License-Identifier: Apache-2.0
"""Distance of a chaser's shape from cuboids: our kernel and the library coal, which the product
does not need (``pip install coal``).

Random poses of a chaser (body and probe) about random cuboids. Time per pair of a chaser and a
cuboid: of the planner's kernel (gap along one direction, with its gradient) in a plan's check, and
of ``coal.distance`` between boxes, and between convex hulls of 8 and of 42 points, called from
Python as a planner in Python would.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np
from chaserdock_controller.nmpc import NmpcInput, NmpcParameters
from chaserdock_controller.nmpc.kernels import plan_violation
from chaserdock_controller.nmpc.problem import check_input, native_problem
from chaserdock_controller.parameters import nmpc_parameters
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.shape_distance import box_table, chaser_boxes, distance_from_cuboids, moved
from chaserdock_models.targets import Box
from common import Figures, Group, Options
from flights import load_shipped

CUBOIDS = 8
"""Number of cuboids about the chaser."""


def random_cuboids(rng: np.random.Generator) -> Array:
    """Return a table (CUBOIDS, 15) of cuboids within about 1.5 m of the origin."""
    boxes = [
        Box(
            tuple(rng.uniform(0.02, 1.0, 3).tolist()),
            tuple(rng.uniform(-1.0, 1.0, 3).tolist()),
            tuple(rotations.normalize(rng.normal(size=4)).tolist()),
        )
        for _ in range(CUBOIDS)
    ]
    return box_table(boxes)


def random_states(rng: np.random.Generator, number: int) -> Array:
    """Return states (number, 13) of a chaser 1 to 3 m from the origin."""
    states = np.zeros((number, 13))
    along = rng.normal(size=(number, 3))
    states[:, :3] = (
        along / np.linalg.norm(along, axis=1, keepdims=True) * rng.uniform(1.0, 3.0, (number, 1))
    )
    states[:, 6:10] = rotations.normalize(rng.normal(size=(number, 4)))
    return states


def kernel_s(params: NmpcParameters, table: Array, states: Array, repeats: int) -> float:
    """Return the processor time (s) per pair of our kernel: that of checking plans with the
    cuboids, less that without.
    """
    d = params.stages
    problem = NmpcInput(
        states=states[:1],
        references=np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (1, d + 1, 1)),
        u_ref=np.zeros((1, d, 6)),
        target_positions=np.zeros((d + 1, 3)),
        min_distance_target_m=np.zeros(1),
        min_distance_chasers_m=0.0,
        input_max=np.tile(params.input_limits(), (1, 1)),
        chaser_shape=box_table(chaser_boxes()),
    )
    boxes, clearance = np.repeat(table[None], d + 1, axis=0), np.array([0.02])
    both = [problem, replace(problem, boxes=boxes, box_clearance_m=clearance)]
    took = []
    for one in both:
        checked, plan = check_input(one, params, 1), states[None, : d + 1].copy()
        call = partial(plan_violation, native_problem(checked, params), plan)
        took.append(best_of(call, repeats))
    return (took[1] - took[0]) / (CUBOIDS * (d + 1))


def best_of(call: Callable[[], Any], repeats: int) -> float:
    """Return the least processor time (s) of a call."""
    best = np.inf
    for _ in range(repeats):
        begin = time.process_time_ns()
        call()
        best = min(best, (time.process_time_ns() - begin) * 1e-9)
    return best


def placed(coal: Any, row: Array) -> Any:
    """Return the pose of a cuboid of a table."""
    return coal.Transform3s(row[3:12].reshape(3, 3), row[:3])


def hull(coal: Any, row: Array, points: int) -> Any:
    """Return the convex hull of a cuboid's corners and of further points on the ellipsoid about it,
    so that all are its vertices.
    """
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * row[12:]
    spread = np.random.default_rng(points).normal(size=(points - 8, 3))
    spread /= np.linalg.norm(spread, axis=1, keepdims=True)
    vertices = coal.StdVec_Vec3s()
    for vertex in np.vstack([corners, spread * row[12:] * np.sqrt(3.0)]):
        vertices.append(vertex)
    return coal.Convex.convexHull(vertices, True, "Qt")


def all_distances(
    coal: Any, parts: list[Any], poses: list[Any], cuboids: list[Any], places: list[Any]
) -> None:
    """Compute the distances of all parts of a chaser in all poses from all cuboids."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    for pose in poses:
        for cuboid, place in zip(cuboids, places, strict=True):
            for part, at in zip(parts, pose, strict=True):
                result.clear()
                coal.distance(part, at, cuboid, place, request, result)


def coal_figures(coal: Any, table: Array, states: Array, repeats: int) -> Figures:
    """Return times per pair of chaser and cuboid, and by how much our gap is below the distance."""
    body = box_table(chaser_boxes())
    places = [placed(coal, row) for row in table]
    poses = [[placed(coal, r) for r in moved(body, s[None, :3], s[None, 6:10])[0]] for s in states]
    kinds: dict[str, Callable[[Array], Any]] = {
        "box": lambda row: coal.Box(*(2.0 * row[12:])),
        "hull_8": lambda row: hull(coal, row, 8),
        "hull_42": lambda row: hull(coal, row, 42),
    }
    figures: Figures = {}
    for name, shape in kinds.items():
        parts, cuboids = [shape(row) for row in body], [shape(row) for row in table]
        took_s = best_of(partial(all_distances, coal, parts, poses, cuboids, places), repeats)
        figures[f"coal_{name}_s"] = took_s / (len(poses) * len(places))
    parts, cuboids = [kinds["box"](row) for row in body], [kinds["box"](row) for row in table]
    below = np.array(
        [
            min(
                distance_of(coal, part, at, cuboid, place)
                for part, at in zip(parts, pose, strict=True)
            )
            - distance_from_cuboids(row[None], body, state[:3], state[6:10])
            for state, pose in zip(states, poses, strict=True)
            for row, cuboid, place in zip(table, cuboids, places, strict=True)
        ]
    )
    return figures | {
        "gap_below_distance_median_m": float(np.median(below)),
        "gap_below_distance_max_m": float(below.max()),
        "gap_above_distance_max_m": float(-below.min()),
    }


def distance_of(coal: Any, one: Any, at: Any, other: Any, there: Any) -> float:
    """Return the distance (m) of two shapes in their poses."""
    result = coal.DistanceResult()
    return float(coal.distance(one, at, other, there, coal.DistanceRequest(), result))


def shapes(options: Options) -> Figures:
    """Time our distance of shapes and coal's, and print how much less than the distance ours is."""
    rng, scenario = np.random.default_rng(24), load_shipped("single")
    params = nmpc_parameters(scenario)
    repeats = 5 if options.quick else 50
    table, states = random_cuboids(rng), random_states(rng, params.stages + 1)
    figures: Figures = {
        "pairs": len(table) * len(states),
        "kernel_s": kernel_s(params, table, states, 20 * repeats),
    }
    try:
        coal = import_module("coal")
    except ImportError:
        print("coal is not installed: only our kernel is measured")
    else:
        figures |= coal_figures(coal, table, states, repeats)
    return figures


GROUP = Group({"shapes": shapes})
