# SPDX-License-Identifier: Apache-2.0
"""The numbers of a scenario that a batch of environments needs, as its kernel takes them.

Bodies and actuators are the world's, drawn from ``[truth]``; goals, limits and corridors are those
of guidance and of the criteria of missions.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from ctypes import c_double, c_int64, c_void_p
from dataclasses import dataclass

import numpy as np
from chaserdock_controller.guidance.approach_cone import cone_of
from chaserdock_controller.guidance.parameters import GUIDANCE
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.native import location
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.thruster_model import ThrusterDynamics, Valves
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.errors import ScenarioError
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.docking import Corridor
from chaserdock_protocol.scenario.learning import LearningSection
from chaserdock_world.actuators.ideal import given_wrench
from chaserdock_world.actuators.thrusters import true_thrusters
from chaserdock_world.physics.target_motion import prescribed_state
from chaserdock_world.plant import Plant, actuation_errors, chaser_plant, target_plant

from ..analysis.criteria import nearest_allowed_m
from .native import LIBRARY
from .observation import goal_of, names_of
from .sensor_errors import BINS, sensor_table
from .stack import (
    closed_thrusters,
    columns_in_stack,
    mounted_chasers,
    stack_plant,
    stated_stack,
)
from .surface import TargetSurface, extent_m, surface_of

PLANTS = 256
"""Bodies that are drawn from ``[truth]``; each episode flies one of them. The mean of a figure over
256 draws is within 6 % of its standard deviation.
"""
MOST_POINTS = 4096
"""Largest number of points of a surface: a look at all of them takes 0.1 ms."""
FASTEST_TURN_RAD = 0.2
"""Largest turn in a physics step: up to it the kernel's series are exact to rounding. A chaser that
turns faster is lost.
"""
TASKS = ("hold", "come", "latch", "inspect", "detumble")
"""Names of the tasks of native/batch.h, in its order."""
OUTCOMES = (
    "flying", "docked", "held", "time out", "collision", "too near", "lost", "after others",
    "inspected", "stopped",
)  # fmt: skip
"""Names of the outcomes of native/batch.h, in its order."""
SUCCESSES = (1, 2, 8, 9)
"""Indices of the outcomes that are successes."""
_BODY_ROWS = 17  # mass to centre of mass


def _doubles(*names: str, **arrays: int) -> list[tuple[str, type]]:
    return [*((name, c_double) for name in names), *((k, c_double * n) for k, n in arrays.items())]


@LIBRARY.structure("ProbeLimits")
class _ProbeLimits(ctypes.Structure):
    """Mirror `ProbeLimits` of native/batch.h."""

    _fields_ = _doubles("lateral_m", "angle_rad", "lateral_speed_m_s", "closing_m_s", "rate_rad_s")

    @classmethod
    def of(cls, limits: Corridor) -> _ProbeLimits:
        rate = math.inf if limits.rate_deg_s is None else math.radians(limits.rate_deg_s)
        angle = math.radians(limits.angle_deg)
        return cls(limits.lateral_m, angle, limits.lateral_speed_m_s, limits.closing_m_s, rate)


@LIBRARY.structure("Place")
class _Place(ctypes.Structure):
    """Mirror `Place` of native/batch.h."""

    _fields_ = [
        *_doubles(goal_m=3, goal_wxyz=4, port_m=3, port_axis=3, cone_axis=3),
        *_doubles("cone_sine", "cone_cosine", "cone_apex_m", "nearest_m"),
        *_doubles(start_m=3, start_wxyz=4, start_velocity_m_s=3),
    ]


@LIBRARY.structure("Weights")
class _Weights(ctypes.Structure):
    """Mirror `Weights` of native/batch.h: the keys of [learning.reward]."""

    _fields_ = _doubles(
        "progress_per_m",
        "turn_per_rad",
        "distance_per_m_s",
        "angle_per_rad_s",
        "impulse_per_N_s",
        "corridor_per_s",
        "within_per_s",
        "time_per_s",
        "seen",
        "spin_per_rad_s",
        "drift_per_m_s",
        "success",
        "failure",
    )


@LIBRARY.structure("Surface")
class _Surface(ctypes.Structure):
    """Mirror `Surface` of native/batch.h."""

    _fields_ = [
        *((name, c_int64) for name in ("faces", "points", "needed", "sunlit")),
        *_doubles("range_m", "least_cosine", "extent_m", to_sun=3),
        *((name, c_void_p) for name in ("planes", "points_m", "totals", "first", "box")),
    ]


@LIBRARY.structure("Stack")
class _Stack(ctypes.Structure):
    """Mirror `Stack` of native/batch.h."""

    _fields_ = [*_doubles("speed_m_s", "rate_rad_s", centre_m=3), ("closed", c_void_p)]


@LIBRARY.structure("Task")
class TaskNumbers(ctypes.Structure):
    """Mirror `Task` of native/batch.h."""

    _fields_ = [
        *(
            (name, c_int64)
            for name in (
                "environments", "chasers", "pitch", "target_pitch", "actuators", "pulsed", "steps",
                "latency_steps", "episode_ticks", "held_ticks", "image_ticks", "plants", "boxes",
                "bins", "task", "statistical", "width",
            )
        ),
        *_doubles("step_s", "tick_s", "reach_m", half_m=3),
        *_doubles(
            "keep_target_m", "keep_chasers_m", "farthest_m", "fastest_rad_s", "held_m", "held_rad",
            "entry_m", "final_m",
        ),
        *((name, _ProbeLimits) for name in ("corridor", "final", "contact")),
        ("weights", _Weights),
        ("surface", _Surface),
        ("stack", _Stack),
        *_doubles(spread_m=3),
        *_doubles("spread_rad", "spread_m_s", "spread_rad_s", "target_spread_rad_s"),
        *_doubles(target_start=13, camera_m=3, camera_wxyz=4, view=4),
        *_doubles("bin_first_m", "bin_m"),
        *(
            (name, c_void_p)
            for name in (
                "places", "chaser_plants", "target_plants", "solids", "rise", "fall", "effort_N_s",
                "sensor", "rise_steps", "fall_steps", "shortest", "longest",
            )
        ),
    ]  # fmt: skip


@dataclass(frozen=True, eq=False)
class TrainingTask:
    """A scenario's training task. ``numbers`` points into ``kept``. ``effort_N_s`` (actuators,):
    impulse of a tick at level 1, 0 for torques.
    """

    scenario: Scenario
    learning: LearningSection
    numbers: TaskNumbers
    effort_N_s: Array
    kept: tuple[object, ...]

    @property
    def actuators(self) -> int:
        """Number of actions of a chaser: six axes of its wrench or reference, or its thrusters."""
        return self.numbers.actuators

    @property
    def pulsed(self) -> bool:
        """Whether actions are levels of thrusters, 0 to 1; otherwise they are -1 to 1."""
        return bool(self.numbers.pulsed)

    @property
    def width(self) -> int:
        """Number of elements of an observation."""
        return self.numbers.width


def task_of(scenario: Scenario, environments: int) -> TrainingTask:
    """Return the task of a number of environments.

    Raises ScenarioError for a scenario without ``[learning]``, or with parts that the environments
    do not have.
    """
    learning = scenario.learning
    if learning is None:
        raise ScenarioError(
            f"{scenario.name}: no table [learning], which an environment needs (docs/learning.md)"
        )
    _check_supported(scenario, learning)
    chasers, timing = len(scenario.chasers), scenario.timing
    count = environments * chasers
    pulsed = scenario.chaser.actuation == "thrusters"
    docks = "latch" if scenario.docking.kind == "capture" else "come"
    kind = docks if learning.task == "dock" else learning.task
    actuators = len(scenario.chaser.thrusters) if pulsed else 6
    step_s, tick_s = 1.0 / timing.physics_hz, 1.0 / timing.rate_hz
    places = (_Place * chasers)(*(_place(scenario, i, kind) for i in range(chasers)))
    bodies = _stack_bodies if kind == "detumble" else _bodies
    chaser_plants, target_plants = _plants(scenario, pulsed, actuators, bodies)
    solids = _solids(scenario)
    valves = _valve_tables(scenario) if pulsed else _NO_VALVES
    effort = _effort_N_s(scenario, pulsed, tick_s)
    start, approach, docking = learning.start, scenario.approach, scenario.docking
    target, camera = prescribed_state(scenario, 0.0), scenario.camera_model()
    left, top, right, bottom = (math.tan(a) for a in camera.angles_to_borders())
    distances_m, sensor = _sensor(scenario, kind)
    surface, points = _surface(scenario, learning, kind)
    stack, closed = _stack(scenario, pulsed, kind)
    steady_s = GUIDANCE.stack_rest_s if kind == "detumble" else approach.docked_time_s
    arrays = (chaser_plants, target_plants, solids, *valves[:2], effort, sensor, *valves[2:])
    pointers = [ctypes.addressof(places), *map(location, arrays)]
    numbers = TaskNumbers(
        environments, chasers, _padded(count), _padded(environments), actuators, pulsed,
        timing.steps_per_tick, timing.latency_steps, round(learning.episode_s * timing.rate_hz),
        max(1, round(steady_s * timing.rate_hz)), timing.ticks_per_image,
        len(target_plants), len(solids), len(sensor), TASKS.index(kind),
        learning.observation == "statistical", len(names_of(chasers, kind)),
        step_s, tick_s, scenario.chaser.probe_reach_m, _c([s / 2 for s in scenario.chaser.size_m]),
        scenario.limits.min_distance_target_m, scenario.limits.min_distance_chasers_m,
        scenario.limits.max_reference_distance_m, FASTEST_TURN_RAD / step_s,
        approach.docked_position_m, math.radians(approach.docked_angle_deg), docking.entry_m,
        docking.final_m,
        _ProbeLimits.of(docking.corridor), _ProbeLimits.of(docking.final),
        _ProbeLimits.of(docking.tolerances),
        _Weights(*(getattr(learning.reward, field[0]) for field in _Weights._fields_)),
        surface, stack,
        _c(start.position_m), math.radians(start.rotation_deg), start.velocity_m_s,
        math.radians(start.rate_deg_s), math.radians(start.target_rate_deg_s),
        _c(_state13(target)), _c(camera.position_crf_m), _c(camera.q_crf_irf_wxyz),
        _c([left, top, right, bottom]), distances_m[0], distances_m[1] - distances_m[0], *pointers,
    )  # fmt: skip
    return TrainingTask(scenario, learning, numbers, effort, (places, *arrays, *points, closed))


def _padded(count: int) -> int:
    """Return a number of bodies up to a multiple of four, which fly together."""
    return -(-count // 4) * 4


def _c(values: object) -> ctypes.Array[c_double]:
    flat = np.asarray(values, dtype=float).ravel().tolist()
    return (c_double * len(flat))(*flat)


def _state13(s: BodyState) -> Array:
    return np.concatenate([s.position_m, s.velocity_m_s, s.q_wxyz, s.omega_rad_s])


def _check_supported(scenario: Scenario, learning: LearningSection) -> None:
    """Raise ScenarioError for what a mission has and the environments have not."""
    chaser, truth, timing = scenario.chaser, scenario.truth, scenario.timing
    mismatch = truth.mismatch("chaser")
    reasons = {
        "orbit": scenario.orbit is not None,
        "plume": scenario.plume is not None,
        "camera.eclipses": learning.task == "inspect" and bool(scenario.camera.eclipses),
        "chaser.degrees_of_freedom: planar": chaser.is_planar,
        "time.latency_s longer than a tick": timing.latency_steps > timing.steps_per_tick,
        "thruster_failure": bool(scenario.thruster_failure),
        "truth.oscillator": bool(truth.oscillator),
        **{
            f"truth.chaser.{key}": bool(getattr(mismatch, key))
            for key in ("pulse_scatter_share", "force_noise_N", "torque_noise_N_m", "delay_s",
                        "delay_jitter_s", "clock_offset_s")
        },
    }  # fmt: skip
    found = [name for name, present in reasons.items() if present]
    if found:
        raise ScenarioError(
            f"{scenario.name}: environments do not simulate {', '.join(found)}; "
            "train in a variant without"
        )
    tick_s, step_s = 1.0 / timing.rate_hz, 1.0 / timing.physics_hz
    for k, thruster in enumerate(chaser.thrusters if chaser.actuation == "thrusters" else ()):
        if max(thruster.min_on_s, thruster.fall_s) + step_s > tick_s * (1.0 + 1e-9):
            raise ScenarioError(
                f"{scenario.name}: chaser.thrusters.{k}: a minimum on-time of "
                f"{thruster.min_on_s:g} s and a fall of {thruster.fall_s:g} s must be shorter than "
                f"a tick of {tick_s:g} s, for which an environment's action is held"
            )


def _place(scenario: Scenario, chaser: int, kind: str) -> _Place:
    stated, limit_m = scenario.chasers[chaser], scenario.limits.min_distance_target_m
    port = scenario.docking.port_of(chaser)
    nominal = np.asarray(stated.position_m)
    axis = nominal / np.linalg.norm(nominal)
    goal = goal_of(scenario, chaser, kind)
    cone = (axis, 0.0, 0.0, 1.0)
    nearest_m = limit_m
    if kind in ("come", "latch"):
        found = cone_of(scenario, chaser)
        angle = found.half_angle_rad
        cone = (found.axis, math.sin(angle), math.cos(angle), found.apex_m)
        nearest_m = nearest_allowed_m(scenario, chaser)
    port_m, port_axis = (goal.position_m, axis) if port is None else (port.position_m, port.axis)
    position, attitude = scenario.start_pose(chaser)
    return _Place(
        _c(goal.position_m), _c(goal.q_wxyz), _c(port_m), _c(port_axis), _c(cone[0]), *cone[1:],
        nearest_m,
        _c(position), _c(attitude), _c(stated.start_velocity_m_s),
    )  # fmt: skip


def _plants(
    scenario: Scenario, pulsed: bool, actuators: int, bodies: _Bodies
) -> tuple[Array, Array]:
    """Return the bodies that ``[truth]`` gives to the seeds from the scenario's on: chasers
    (P, chasers, 17 + 6 actuators) and target (P, 17). Without ``[truth]`` all are the same.
    """
    first = bodies(scenario, pulsed, actuators)
    second = bodies(_with_seed(scenario, 1), pulsed, actuators)
    if all(np.array_equal(a, b) for a, b in zip(first, second, strict=True)):
        return first[0][None], first[1][None]
    drawn = [first, second]
    drawn += [bodies(_with_seed(scenario, k), pulsed, actuators) for k in range(2, PLANTS)]
    return np.stack([d[0] for d in drawn]), np.stack([d[1] for d in drawn])


def _with_seed(scenario: Scenario, further: int) -> Scenario:
    return scenario.model_copy(update={"seed": (scenario.seed + further) % 2**32})


def _bodies(scenario: Scenario, pulsed: bool, actuators: int) -> tuple[Array, Array]:
    chasers = np.empty((len(scenario.chasers), _BODY_ROWS + 6 * actuators))
    for i, row in enumerate(chasers):
        plant = chaser_plant(scenario, i)
        row[:_BODY_ROWS] = _properties(plant)
        columns = [plant.wrench_in_engine(c) for c in _columns(scenario, i, pulsed)]
        row[_BODY_ROWS:] = np.concatenate(columns)
    target = target_plant(scenario)
    properties = _properties(target)
    if scenario.target.motion != "torque_free":
        properties[1:4] = 1.0  # equal moments keep a prescribed rate
    return chasers, properties


def _stack_bodies(scenario: Scenario, pulsed: bool, actuators: int) -> tuple[Array, Array]:
    """Return the chasers as `_bodies`, with wrenches in the frame of the stack, and the stack."""
    mounts = mounted_chasers(scenario)
    plants = [chaser_plant(scenario, i) for i in mounts]
    stack = stack_plant(target_plant(scenario), plants, list(mounts.values()))
    chasers = np.empty((len(mounts), _BODY_ROWS + 6 * actuators))
    for row, plant, (i, mount) in zip(chasers, plants, mounts.items(), strict=True):
        row[:_BODY_ROWS] = _properties(plant)
        columns = columns_in_stack(stack, mount, _columns(scenario, i, pulsed))
        row[_BODY_ROWS:] = columns.ravel()
    return chasers, _properties(stack)


_Bodies = Callable[[Scenario, bool, int], tuple[Array, Array]]


def _stack(scenario: Scenario, pulsed: bool, kind: str) -> tuple[_Stack, Array | IntArray]:
    """Return what ``detumble`` judges, and the thrusters that stay closed."""
    limits = scenario.success.detumbled or scenario.detumble
    rest = limits.speed_m_s, math.radians(limits.rate_deg_s)
    if kind != "detumble":
        return _Stack(*rest, _c(np.zeros(3)), None), np.zeros(1)
    centre = _c(stated_stack(scenario).centre_trf_m)
    closed = closed_thrusters(scenario) if pulsed else np.zeros((1, 1), dtype=np.int64)
    return _Stack(*rest, centre, location(closed) if pulsed else None), closed


def _columns(scenario: Scenario, chaser: int, pulsed: bool) -> Array:
    """Return the wrench (actuators, 6), body axes, of each actuator at level 1."""
    return _thruster_columns(scenario, chaser) if pulsed else _wrench_columns(scenario, chaser)


def _properties(plant: Plant) -> Array:
    q, offset = rotations.IDENTITY, np.zeros(3)
    if plant.frame is not None:
        q, offset = plant.frame.q_wxyz, plant.frame.offset_m
    disturbance = plant.wrench_in_engine(plant.disturbance)
    return np.concatenate([[plant.mass_kg, *plant.moments_kg_m2], disturbance, q, offset])


def _wrench_columns(scenario: Scenario, chaser: int) -> Array:
    """Return the wrench (6, 6), body axes, for the limit of each axis: rows are axes."""
    full, errors = np.diag(scenario.chaser.wrench_max), actuation_errors(scenario, chaser)
    return full if errors.none else np.array([given_wrench(errors, row, 0) for row in full])


def _thruster_columns(scenario: Scenario, chaser: int) -> Array:
    """Return the wrench (n, 6), body axes, of each thruster's full thrust."""
    errors, thrusters = actuation_errors(scenario, chaser), scenario.chaser.thrusters
    given = thrusters if errors.none else true_thrusters(thrusters, errors)
    return wrench_matrix(given).T * np.array([[t.thrust_N] for t in given])


def _effort_N_s(scenario: Scenario, pulsed: bool, tick_s: float) -> Array:
    if pulsed:
        return np.array([t.thrust_N * tick_s for t in scenario.chaser.thrusters])
    return np.concatenate([scenario.chaser.wrench_max[:3], np.zeros(3)]) * tick_s


_NO_VALVES = (*np.zeros((2, 1)), *np.zeros((4, 1), dtype=np.int64))


def _valve_tables(
    scenario: Scenario,
) -> tuple[Array, Array, IntArray, IntArray, IntArray, IntArray]:
    """Return rise and fall (n, steps) and step counts (n,) of the thrusters: see native/batch.h."""
    timing, thrusters = scenario.timing, scenario.chaser.thrusters
    steps, hz = timing.steps_per_tick, timing.physics_hz
    shares = [_ramp_shares(t, steps, hz) for t in thrusters]
    whole = [
        [math.ceil(getattr(t, key) * hz - 1e-9) for t in thrusters]
        for key in ("rise_s", "fall_s", "min_on_s")
    ]
    whole_steps = np.array(whole, dtype=np.int64)
    rise_steps, fall_steps, shortest = whole_steps + np.array([[1], [1], [0]])
    rise, fall = (np.array([pair[k] for pair in shares]) for k in (0, 1))
    return rise, fall, rise_steps, fall_steps, shortest, steps - fall_steps


def _ramp_shares(thruster: ThrusterDynamics, steps: int, hz: int) -> tuple[Array, Array]:
    """Return the share of the thrust that each step after opening gains over the step before, and
    that each one after closing loses.
    """
    edges = np.arange(steps + 1, dtype=float) * (1e9 / hz)
    spans, shares = ((0, 10 * steps), (-10 * steps, 0)), []
    for begin, end in spans:
        valve = Valves([thruster])
        valve.pulse(0, round(begin * 1e9 / hz), round(end * 1e9 / hz))
        shares.append(valve.impulses(edges)[:, 0] * hz / thruster.thrust_N)
    return np.diff(shares[0], prepend=0.0), np.diff(1.0 - shares[1], prepend=0.0)


def _solids(scenario: Scenario) -> Array:
    """Return the cuboids of the target: half edges, centre, rotation to TRF, radius, (n, 16)."""
    rows = []
    for box in scenario.target_model().boxes:
        half = np.array(box.size_m) / 2.0
        turn = rotations.to_matrix(np.array(box.q_wxyz)).ravel()
        rows.append(np.concatenate([half, box.position_m, turn, [np.linalg.norm(half)]]))
    return np.array(rows)


_NO_SURFACE = TargetSurface(np.zeros((1, 4)), np.zeros((1, 3)), *np.zeros((2, 1), dtype=np.int64))
"""Of other tasks, whose kernels do not read it: arrays need an address."""


def _surface(
    scenario: Scenario, learning: LearningSection, kind: str
) -> tuple[_Surface, tuple[Array | IntArray, ...]]:
    """Return the surface that ``inspect`` has to see, and its arrays."""
    settings, boxes = learning.inspect, scenario.target_model().boxes
    found = surface_of(boxes, settings.spacing_m) if kind == "inspect" else _NO_SURFACE
    faces, points = len(found.box), len(found.points_m)
    if points > MOST_POINTS:
        raise ScenarioError(
            f"{scenario.name}: learning.inspect.spacing_m: {settings.spacing_m:g} m gives {points} "
            f"points on the target; at most {MOST_POINTS}"
        )
    first = np.searchsorted(found.face, np.arange(faces + 1)).astype(np.int64)
    totals = np.zeros((faces, 4))
    np.add.at(totals, found.face, np.column_stack([found.points_m, np.ones(points)]))
    sun = np.array(scenario.camera.sun_direction)
    arrays = (found.planes, found.points_m, totals, first, found.box.astype(np.int64))
    numbers = _Surface(
        faces, points, math.ceil(settings.share * points - 1e-9), settings.sunlit,
        settings.range_m, math.cos(math.radians(settings.incidence_deg)), extent_m(boxes),
        _c(sun / np.linalg.norm(sun)), *map(location, arrays),
    )  # fmt: skip
    return numbers, arrays


def _sensor(scenario: Scenario, kind: str) -> tuple[Array, Array]:
    """Return distances of the sensor's table, and the table for the first chaser, as it sees the
    target from the side of its goal, or with ``inspect`` of its reference pose. Both without
    meaning but for the observation ``statistical``.
    """
    learning = scenario.learning
    if learning is None or learning.observation != "statistical":
        return np.arange(2.0), np.zeros((2, 6, 9))
    goal = goal_of(scenario, 0, "hold" if kind == "inspect" else kind)
    start_m = np.linalg.norm(scenario.start_pose(0)[0] - scenario.target.position_m)
    near_m, far_m = 0.8 * float(np.linalg.norm(goal.position_m)), 2.0 * float(start_m)
    distances_m = np.linspace(near_m, max(far_m, 2.0 * near_m), BINS)
    return distances_m, sensor_table(scenario, goal.position_m, goal.q_wxyz, distances_m)
