# SPDX-License-Identifier: Apache-2.0
"""Check a scenario across its sections. Every check raises ValueError with the path of what is
wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_models.docking_geometry import axis_error_deg, centre_offset, corridors_apart
from chaserdock_models.meshes import mass_properties
from chaserdock_models.port_load import CarriedBody, tumble_load
from chaserdock_models.satellites import satellite_names
from chaserdock_models.shape_distance import (
    box_table,
    distance_between,
    distance_from_cuboids,
    moved,
    swept_distance,
)
from chaserdock_models.wrench_set import wrench_matrix
from numpy.typing import ArrayLike

from .bodies import FlightTarget
from .faults import check_faults
from .mounting import nominal_mounting, plume_free_thrusters
from .oscillators import check_oscillators
from .planar import check_planar, check_planar_flight, up_in_target
from .schema import MARKER_PERCEPTIONS
from .thrusters import check_pulses, thrusts_max

if TYPE_CHECKING:
    from . import FlightScenario, Scenario
    from .docking import Port
    from .schema import TimelineEntry
    from .target import Geometry


def check_flight(scenario: FlightScenario) -> None:
    """Check the part of a scenario that flight software receives."""
    _check_references(scenario)
    _check_shape_distance(scenario)
    _check_named_chasers(scenario)
    check_planar_flight(scenario)
    _check_perception(scenario)
    if scenario.chaser.actuation == "thrusters":
        check_pulses(
            scenario.chaser.thrusters, scenario.chaser.modulation, scenario.time.physics_hz
        )
    if scenario.docking.kind == "capture":
        _check_capture(scenario)
    _check_detumble(scenario)
    _check_hold_points(scenario)
    _check_approach_cone(scenario)
    _check_chosen_ports(scenario)

    if scenario.ranging is not None and scenario.perception.name not in MARKER_PERCEPTIONS:
        raise ValueError(
            f"ranging: needs a perception by markers ({', '.join(MARKER_PERCEPTIONS)}), not "
            f"{scenario.perception.name!r}"
        )
    if scenario.plume is not None and scenario.chaser.actuation != "thrusters":
        raise ValueError(
            'plume: only thrusters have plumes; it needs chaser.actuation = "thrusters"'
        )

    if scenario.assurance is not None:
        _check_assurance(scenario)
    if scenario.limits.passive_safety != "off" and scenario.estimator.name != "joint":
        raise ValueError(
            'limits.passive_safety: needs the covariance of estimator.name = "joint", '
            f"not {scenario.estimator.name!r}"
        )
    if scenario.limits.passive_safety == "enforce" and scenario.controller.solver != "rti":
        raise ValueError(
            'limits.passive_safety: "enforce" needs controller.solver = "rti", '
            f"not {scenario.controller.solver!r}"
        )


def _check_assurance(scenario: FlightScenario) -> None:
    if scenario.estimator.name != "joint":
        raise ValueError(
            'assurance: needs the poses and covariances of estimator.name = "joint", not '
            f"{scenario.estimator.name!r}"
        )
    for key in ("min_distance_target_m", "min_distance_chasers_m"):
        if getattr(scenario.limits, key) == 0.0:
            raise ValueError(
                f"assurance: keeps distances between centres; limits.{key} must be above 0"
            )


def check_consistent(scenario: Scenario) -> None:
    """Run the checks that need the full scenario."""
    _check_start_positions(scenario)
    check_planar(scenario)
    _check_orbit(scenario)
    _check_mesh(scenario)
    _check_success(scenario)
    _check_reached(scenario)
    _check_thruster_failures(scenario)
    _check_latched(scenario)
    _check_load_limits(scenario)
    _check_stopping_time(scenario)
    check_faults(scenario.fault, scenario)
    _check_truth(scenario)
    check_oscillators(scenario)


def _check_start_positions(scenario: Scenario) -> None:
    starts = [scenario.start_pose(i)[0] for i in range(len(scenario.chasers))]
    width = math.hypot(*scenario.chaser.size_m)
    for i, a in enumerate(starts):
        for j in range(i):
            distance = math.dist(a, starts[j])
            if distance < width:
                raise ValueError(
                    f"chasers.{j} and chasers.{i} start {distance:.3f} m apart, inside one "
                    f"another; their bodies need {width:.3f} m"
                )


def _check_orbit(scenario: Scenario) -> None:
    if scenario.orbit is None:
        return
    target, camera = scenario.target, scenario.camera
    for key in ("position_m", "velocity_m_s"):
        if any(getattr(target, key)) and not (key == "velocity_m_s" and target.motion == "static"):
            raise ValueError(
                f"target.{key}: with [orbit], WRF is the target's Hill frame: the target starts "
                "at rest in its origin, so "
                "this must be [0, 0, 0]"
            )
    given = {"sun_direction", "eclipses", "earth"} & camera.model_fields_set
    given -= {
        key for key in given if getattr(camera, key) == type(camera).model_fields[key].default
    }
    if given:
        raise ValueError(f"camera.{min(given)}: follows from [orbit]; leave it out")


def _check_references(scenario: FlightScenario) -> None:
    limits = scenario.limits
    for i, c in enumerate(scenario.chasers):
        distance = math.hypot(*c.position_m)
        for comparison, wrong, name in (
            ("nearer", distance < limits.min_distance_target_m, "min_distance_target_m"),
            ("farther", distance > limits.max_reference_distance_m, "max_reference_distance_m"),
        ):
            if wrong:
                raise ValueError(
                    f"chasers.{i}.position_m: {distance:.3g} m from the target, {comparison} "
                    f"than limits.{name} ({getattr(limits, name):g} m) allows"
                )
        for j, other in enumerate(scenario.chasers[:i]):
            distance = math.dist(c.position_m, other.position_m)
            if distance < limits.min_distance_chasers_m:
                raise ValueError(
                    f"the positions of chasers.{j} and chasers.{i} are {distance:.3g} m apart, "
                    "nearer than limits.min_distance_chasers_m "
                    f"({limits.min_distance_chasers_m:g} m) allows"
                )


def shape_distance_m(scenario: FlightScenario, chaser: int, offset_m: ArrayLike) -> float:
    """Return the distance (m) of a chaser at an offset (3,), TRF, from the cuboids of the
    target.
    """
    pose = _reference_pose(scenario, chaser, offset_m)
    return distance_from_cuboids(
        box_table(scenario.target_model().boxes), box_table(scenario.chaser.boxes()), *pose
    )


def shapes_apart_m(scenario: FlightScenario, *places: tuple[int, ArrayLike]) -> float:
    """Return the distance (m) between the shapes of two chasers.

    ``places``: chaser and offset (3,), TRF, of each.
    """
    one, other = (_reference_pose(scenario, i, offset_m) for i, offset_m in places)
    return distance_between(box_table(scenario.chaser.boxes()), one, other)


def _reference_pose(
    scenario: FlightScenario, chaser: int, offset_m: ArrayLike
) -> tuple[ArrayLike, Array]:
    """Return an offset (3,) and the attitude (4,) of a chaser that holds there, in TRF."""
    c = scenario.chasers[chaser]
    if scenario.approach.face_target:
        up = up_in_target(scenario)
        return offset_m, facing_attitudes(c.position_m, c.q_wxyz, offset_m, up)[0]
    return offset_m, np.array(c.q_wxyz)


def _check_shape_distance(scenario: FlightScenario) -> None:
    least_m = scenario.limits.min_distance_shape_m
    if not least_m:
        return
    if scenario.controller.solver != "rti":
        raise ValueError(
            'limits.min_distance_shape_m: needs controller.solver = "rti", not '
            f"{scenario.controller.solver!r}"
        )

    places = [(f"chasers.{i}.position_m", i, c.position_m) for i, c in enumerate(scenario.chasers)]
    places += [
        (f"timeline.{k}.offset_m", i, e.offset_m)
        for k, e in enumerate(scenario.timeline)
        for i in e.chasers
        if e.offset_m and i < len(scenario.chasers)
    ]

    for name, i, offset_m in places:
        if (distance_m := shape_distance_m(scenario, i, offset_m)) < least_m:
            raise ValueError(
                f"{name}: chaser {i} is {distance_m:.3g} m from the target's shape there, nearer "
                f"than limits.min_distance_shape_m ({least_m:g} m) allows"
            )

    for (i, a), (j, b) in combinations(enumerate(c.position_m for c in scenario.chasers), 2):
        if (distance_m := shapes_apart_m(scenario, (i, a), (j, b))) < least_m:
            raise ValueError(
                f"chasers.{i} and chasers.{j} at their positions: {distance_m:.3g} m between "
                f"their shapes, nearer than limits.min_distance_shape_m ({least_m:g} m) allows"
            )


def _check_hold_points(scenario: FlightScenario) -> None:
    limits = scenario.limits
    for k, entry in enumerate(scenario.timeline):
        if entry.offset_m is None:
            continue
        distance_m = math.hypot(*entry.offset_m)
        if distance_m <= limits.min_distance_target_m:
            raise ValueError(
                f"timeline.{k}.offset_m: {distance_m:.3g} m from the target, inside the keep-out "
                f"of limits.min_distance_target_m ({limits.min_distance_target_m:g} m)"
            )
        if distance_m > limits.max_reference_distance_m:
            raise ValueError(
                f"timeline.{k}.offset_m: {distance_m:.3g} m from the target, farther than "
                f"limits.max_reference_distance_m ({limits.max_reference_distance_m:g} m) allows"
            )
        for i in entry.chasers:
            _check_in_cone(scenario, f"timeline.{k}.offset_m", i, entry.offset_m)


def _check_in_cone(
    scenario: FlightScenario, path: str, chaser: int, offset_m: tuple[float, ...]
) -> None:
    cone_deg = scenario.approach.cone_deg
    if cone_deg is None or chaser >= len(scenario.chasers):
        return
    off_deg = angle_deg(scenario.chasers[chaser].position_m, offset_m)
    if off_deg > cone_deg:
        raise ValueError(
            f"{path}: {off_deg:.3g} degrees off the approach axis of chaser {chaser}, outside "
            f"approach.cone_deg ({cone_deg:g} degrees)"
        )


def angle_deg(a: Sequence[float] | Array, b: Sequence[float] | Array) -> float:
    """Return the angle between two vectors (3,), degrees."""
    one, two = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    cosine = float(one @ two) / (float(np.linalg.norm(one)) * float(np.linalg.norm(two)))
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def _check_approach_cone(scenario: FlightScenario) -> None:
    """Check that a chaser in its reference attitude sees the target from everywhere in its approach
    cone.
    """
    cone_deg, camera = scenario.approach.cone_deg, scenario.camera_model()
    if cone_deg is None or scenario.approach.face_target:
        return
    half_deg = math.degrees(min(camera.angles_to_borders()))
    for i, c in enumerate(scenario.chasers):
        forward = rotations.rotate(c.q_wxyz, np.array([1.0, 0.0, 0.0]))
        off_deg = cone_deg + angle_deg(-np.asarray(c.position_m), forward)
        if off_deg > half_deg:
            raise ValueError(
                f"approach.cone_deg: from the edge of the cone the target is {off_deg:.3g} "
                f"degrees off the view of chaser {i}, whose camera sees {half_deg:.3g} degrees "
                "to the nearest edge; make the cone narrower, or set approach.face_target"
            )


def _check_mesh(scenario: Scenario) -> None:
    geometry = scenario.target.geometry
    if geometry is not None and geometry.mesh:
        _check_mesh_file(scenario, geometry)
    if scenario.chaser.mesh and not scenario.target_model().satellite:
        raise ValueError(
            f"chaser.mesh: drawn only with a target that has a mesh; {scenario.target.model!r} "
            "has none"
        )


def _check_mesh_file(scenario: Scenario, geometry: Geometry) -> None:
    key, target = "target.geometry.mesh", scenario.target
    if geometry.surface is None and geometry.mesh not in satellite_names():
        raise ValueError(
            f"{key}: {geometry.mesh!r} is read in scenario and target files only; "
            f"shipped: {', '.join(satellite_names())}"
        )
    if (
        target.motion == "torque_free"
        and target.inertia_kg_m2 is None
        and (mesh := target.nominal_mesh())
    ):
        low, high = mesh.bounds_m()
        centre = mass_properties(mesh, target.mass_kg)[0]
        if np.linalg.norm(centre - target.centre_of_mass_m) > 0.01 * np.linalg.norm(high - low):
            at = ", ".join(f"{v:.4g}" for v in centre + geometry.mesh_origin_m)
            raise ValueError(
                "target.centre_of_mass_m: that of the mesh is "
                f"({', '.join(f'{v:.4g}' for v in centre)}); state it, or move the origin there "
                f"by target.geometry.mesh_origin_m = [{at}], or state inertia_kg_m2 too"
            )


def _check_perception(scenario: FlightScenario) -> None:
    if scenario.maps_target:
        _check_unknown_target(scenario)
    if scenario.perception.name in MARKER_PERCEPTIONS and not scenario.target_model().markers:
        raise ValueError(
            f"perception.name: {scenario.perception.name!r} needs markers; the target "
            f"{scenario.target.model!r} has none"
        )


def _check_unknown_target(scenario: FlightScenario) -> None:
    """Check that flight software that maps its target is told nothing of its shape, and that the
    mission needs nothing of it.
    """
    is_flight = type(scenario.target) is FlightTarget
    if is_flight and scenario.target != scenario.target.as_unknown():
        raise ValueError(
            "target: flight software that maps a target may know nothing of it but its motion model"
        )
    if scenario.target.motion == "torque_free":
        raise ValueError('target.motion: perception.name = "features" maps constant rates only')
    if scenario.docking.kind == "capture":
        raise ValueError('docking.kind: "capture" needs the shape of the target at its ports')
    if scenario.mapping.latency_s * scenario.time.image_hz < 1.0 - 1e-9:
        raise ValueError("mapping.latency_s: shorter than the interval of the images")
    if scenario.limits.min_distance_shape_m:
        raise ValueError("limits.min_distance_shape_m: the shape of the target is unknown")


def _check_chosen_ports(scenario: FlightScenario) -> None:
    """Check that ports are chosen on unknown targets only, and that every `goto` has a goal."""
    chosen: set[int] = set()
    for k, entry in sorted(enumerate(scenario.timeline), key=lambda row: row[1].at_s):
        path = f"timeline.{k}"
        if (
            entry.command == "goto"
            and entry.offset_m is None
            and not chosen.issuperset(entry.chasers)
        ):
            raise ValueError(
                f"{path}: offset_m goes with the command goto, and goto needs it unless a port "
                "has been chosen for each of its chasers before"
            )
        if entry.port is None:
            continue
        chosen.update(entry.chasers)
        if not scenario.maps_target:
            raise ValueError(
                f'{path}: ports are chosen on unknown targets only (perception.name = "features")'
            )
        distance_m, reach_m = scenario.approach.dock_distance_m, scenario.chaser.probe_reach_m
        if distance_m <= reach_m:
            raise ValueError(
                f"approach.dock_distance_m: counts from the chosen port; {distance_m:g} m is not "
                f"more than chaser.probe_reach_m ({reach_m:g} m)"
            )


def _check_named_chasers(scenario: FlightScenario) -> None:
    named = [(f"timeline.{i}.chasers", entry.chasers) for i, entry in enumerate(scenario.timeline)]
    named += [
        (f"docking.ports.{i}.chaser", (port.chaser,))
        for i, port in enumerate(scenario.docking.ports)
    ]
    _check_chaser_numbers(named, len(scenario.chasers))


def _check_success(scenario: Scenario) -> None:
    named = [
        (f"success.{key}", getattr(scenario.success, key))
        for key in ("docked", "latched", "reached")
    ]
    if scenario.success.arrival is not None:
        named.append(("success.arrival.chasers", scenario.success.arrival.chasers))
    _check_chaser_numbers(named, len(scenario.chasers))


def _check_chaser_numbers(named: Iterable[tuple[str, tuple[int, ...]]], chasers: int) -> None:
    last = chasers - 1
    for path, numbers in named:
        if max(numbers, default=0) > last:
            raise ValueError(
                f"{path}: there is no chaser {max(numbers)}; this mission has 0 to {last}"
            )


def _check_reached(scenario: Scenario) -> None:
    for i in scenario.success.reached:
        if scenario.goal_of(i) is None:
            raise ValueError(f"success.reached: no goto of the timeline names chaser {i}")


def _check_thruster_failures(scenario: Scenario) -> None:
    chasers, thrusters = len(scenario.chasers), len(scenario.chaser.thrusters)
    if scenario.thruster_failure and scenario.chaser.actuation != "thrusters":
        raise ValueError(
            'thruster_failure: thrusters fail only with chaser.actuation = "thrusters"'
        )
    failed: set[tuple[int, int]] = set()
    for k, failure in enumerate(scenario.thruster_failure):
        path = f"thruster_failure.{k}"
        if failure.chaser >= chasers:
            raise ValueError(
                f"{path}.chaser: there is no chaser {failure.chaser}; this mission has 0 to "
                f"{chasers - 1}"
            )
        if failure.thruster >= thrusters:
            raise ValueError(
                f"{path}.thruster: there is no thruster {failure.thruster}; the body has 0 to "
                f"{thrusters - 1}"
            )
        if (failure.chaser, failure.thruster) in failed:
            raise ValueError(
                f"{path}: thruster {failure.thruster} of chaser {failure.chaser} fails twice"
            )
        failed.add((failure.chaser, failure.thruster))


def _check_truth(scenario: Scenario) -> None:
    body, chasers = scenario.chaser, len(scenario.chasers)
    moves_freely = scenario.target.motion == "torque_free"
    given = scenario.truth.target.model_fields_set - {"marker_m"}
    if not moves_freely and (
        key := next((k for k in sorted(given) if getattr(scenario.truth.target, k)), None)
    ):
        raise ValueError(f'truth.target.{key}: needs target.motion = "torque_free"')

    latches = scenario.truth.latch
    key = next((k for k in sorted(latches.model_fields_set) if getattr(latches, k)), None)
    if key and scenario.docking.kind != "capture":
        raise ValueError(f'truth.latch.{key}: latches exist only with docking.kind = "capture"')

    named: set[int | None] = set()
    for k, values in enumerate(scenario.truth.values):
        path, name = (
            f"truth.values.{k}",
            "the target" if values.target else f"chaser {values.chaser}",
        )
        if values.chaser is not None and values.chaser >= chasers:
            raise ValueError(
                f"{path}.chaser: there is no {name}; this mission has 0 to {chasers - 1}"
            )
        if values.target and not moves_freely:
            raise ValueError(f'{path}.target: needs target.motion = "torque_free"')
        if values.chaser in named:
            raise ValueError(f"{path}: {name} has values already")
        named.add(values.chaser)
        count = len(body.thrusters) if body.actuation == "thrusters" else 6
        if values.thrust_share is not None and len(values.thrust_share) != count:
            raise ValueError(
                f"{path}.thrust_share: must have {count} numbers (got {len(values.thrust_share)})"
            )


def _check_latched(scenario: Scenario) -> None:
    for i in scenario.success.latched:
        if scenario.docking.port_of(i) is None:
            raise ValueError(
                f"success.latched: chaser {i} has no port; see docking.kind and [[docking.ports]]"
            )


def _check_load_limits(scenario: Scenario) -> None:
    """Check that the ports carry the load of the tumble at the start, once their chaser is latched.

    With nominal masses.
    """
    if scenario.docking.kind != "capture":
        return
    target, body = scenario.target, scenario.chaser
    alone = CarriedBody(target.mass_kg, target.inertia_tensor, np.array(target.centre_of_mass_m))
    rate_deg_s = math.degrees(math.hypot(*target.omega_rad_s))
    for k, port in enumerate(scenario.docking.ports):
        turn = rotations.to_matrix(scenario.chasers[port.chaser].q_wxyz)
        inertia = turn @ np.diag(body.inertia) @ turn.T
        chaser = CarriedBody(body.mass_kg, inertia, centre_offset(port, body.probe_reach_m, 0.0))
        force, torque = tumble_load(
            alone, chaser, np.array(port.position_m), np.array(target.omega_rad_s)
        )
        for key, limit, load, unit in (
            ("force_limit_N", port.force_limit_N, force, "N"),
            ("torque_limit_N_m", port.torque_limit_N_m, torque, "N m"),
        ):
            if limit is not None and (exerted := float(np.linalg.norm(load))) > limit:
                raise ValueError(
                    f"docking.ports.{k}.{key}: {limit:g} {unit} is less than the {exerted:.3g} "
                    f"{unit} that the tumble of {rate_deg_s:.3g} degrees/s alone exerts on the "
                    f"port of chaser {port.chaser}"
                )


def _detumblings(scenario: FlightScenario) -> list[tuple[int, TimelineEntry]]:
    """Return the commands to detumble with their places in the timeline."""
    return [(k, entry) for k, entry in enumerate(scenario.timeline) if entry.command == "detumble"]


def _check_detumble(scenario: FlightScenario) -> None:
    detumble = scenario.detumble
    if detumble.plan_s is not None and detumble.plan_s >= detumble.timeout_s:
        raise ValueError(
            f"detumble.plan_s: a plan of {detumble.plan_s:g} s does not end before "
            f"detumble.timeout_s, {detumble.timeout_s:g} s, "
            "when the thrusters close"
        )
    for k, entry in enumerate(scenario.timeline):
        if entry.command == "identify" and not detumble.identification.enabled:
            raise ValueError(f"timeline.{k}: identify needs detumble.identification.enabled = true")
    for k, entry in _detumblings(scenario):
        for i in entry.chasers:
            if scenario.docking.port_of(i) is None:
                raise ValueError(
                    f"timeline.{k}: chaser {i} has no port and cannot be latched to the target"
                )
        if scenario.chaser.actuation != "thrusters":
            raise ValueError(f'timeline.{k}: detumble needs chaser.actuation = "thrusters"')
        for i, free in plume_free_thrusters(scenario, set(entry.chasers)).items():
            if not free.any():
                raise ValueError(
                    f"timeline.{k}: none of the {len(free)} thrusters of chaser {i} may fire at "
                    "its port: every plume (half angle detumble.plume_deg, "
                    f"{scenario.detumble.plume_deg:g} degrees) hits the target, a port or a "
                    "chaser"
                )


def _check_stopping_time(scenario: Scenario) -> None:
    """Check that detumbling can end within the allowed time.

    It takes as if all thrusters could always push where they help most.
    """
    for k, entry in _detumblings(scenario):
        linear, angular, force_N, torque_N_m, mass_kg = _momentum_and_thrust(
            scenario, set(entry.chasers)
        )
        least_s = max(linear / force_N, angular / torque_N_m)
        if least_s > scenario.detumble.timeout_s:
            raise ValueError(
                f"timeline.{k}: stopping the stack of {mass_kg:.4g} kg takes at least "
                f"{least_s:.3g} s, with {linear:.3g} N s and {angular:.3g} N m s against at most "
                f"{force_N:.3g} N and {torque_N_m:.3g} N m; detumble.timeout_s is "
                f"{scenario.detumble.timeout_s:g} s"
            )


def _momentum_and_thrust(
    scenario: Scenario, chasers: set[int]
) -> tuple[float, float, float, float, float]:
    """Return what bounds the time to stop the target with these chasers fixed to it.

    Linear (N s) and angular momentum (N m s) at the start; upper bounds of force (N) and torque (N
    m) of the plume-free thrusters in any direction; the mass (kg).
    """
    target, body, mounted = scenario.target, scenario.chaser, {}
    omega = np.array(target.omega_rad_s)
    inertias = [target.inertia_tensor]
    places = [np.array(target.centre_of_mass_m)]
    for i in sorted(chasers):
        mounted[i] = nominal_mounting(scenario, i)
        turn = rotations.to_matrix(mounted[i].q_wxyz)
        inertias.append(turn @ np.diag(body.inertia) @ turn.T)
        places.append(mounted[i].position_m)

    masses = np.array([target.mass_kg] + [body.mass_kg] * len(mounted))
    centre = masses @ np.array(places) / masses.sum()
    velocity = rotations.rotate_inverse(target.q_wxyz, target.velocity_m_s) + np.cross(
        omega, centre
    )
    angular = sum(
        inertia @ omega + mass * np.cross(place - centre, np.cross(omega, place - centre))
        for inertia, mass, place in zip(inertias, masses, places, strict=True)
    )

    free = np.concatenate(list(plume_free_thrusters(scenario, chasers).values()))
    limits = np.where(free, np.tile(thrusts_max(body.thrusters), len(mounted)), 0.0)
    own = wrench_matrix(body.thrusters)
    wrenches = (
        np.concatenate([c.wrench_to_stack(own, centre) for c in mounted.values()], axis=1) * limits
    )
    return (
        float(masses.sum() * np.linalg.norm(velocity)),
        float(np.linalg.norm(angular)),
        _largest_sum(wrenches[:3]),
        _largest_sum(wrenches[3:]),
        float(masses.sum()),
    )


def _largest_sum(vectors: Array) -> float:
    """Return an upper bound of the length of the sum of some of these vectors (3, n).

    It is the largest sum of components along a direction, of a set of which one is within 0.15 rad
    of any direction.
    """
    k = np.arange(400) + 0.5
    z, turn = 1.0 - 2.0 * k / len(k), math.pi * (1.0 + math.sqrt(5.0)) * k
    across = np.sqrt(1.0 - z**2)
    directions = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
    return float(np.maximum(directions @ vectors, 0.0).sum(axis=1).max() / math.cos(0.15))


def _check_pull(scenario: FlightScenario) -> None:
    """Check that the pull test moves a chaser whose latch is open by more than it tolerates."""
    docking, chaser = scenario.docking, scenario.chaser
    moved_m = docking.open_latch_motion_m(chaser.mass_kg)
    needed_m = docking.pull_clearance * docking.verify_position_m
    if moved_m < needed_m:
        raise ValueError(
            f"docking.pull_N: {docking.pull_N:g} N moves a chaser of {chaser.mass_kg:g} kg whose "
            f"latch is open by {moved_m * 1e3:.3g} mm; to tell it from the "
            f"{docking.verify_position_m * 1e3:g} mm that are tolerated takes "
            f"{needed_m * 1e3:g} mm, and {docking.pull_N * needed_m / moved_m:.3g} N"
        )
    if docking.pull_N > chaser.force_max_N:
        raise ValueError(
            f"docking.pull_N: {docking.pull_N:g} N is more than chaser.force_max_N "
            f"({chaser.force_max_N:g} N)"
        )


def _check_capture(scenario: FlightScenario) -> None:
    if scenario.target.motion != "torque_free":
        raise ValueError(
            f"target.motion: docking by capture needs torque_free, which contact forces can move, "
            f"not {scenario.target.motion}"
        )
    _check_pull(scenario)
    nearest_m = scenario.limits.min_distance_target_m
    for k, port in enumerate(scenario.docking.ports):
        entry_m = math.hypot(
            *centre_offset(port, scenario.chaser.probe_reach_m, scenario.docking.entry_m)
        )
        if entry_m <= nearest_m:
            raise ValueError(
                f"docking.ports.{k}: its corridor begins {entry_m:.3g} m from the target's "
                f"centre, inside limits.min_distance_target_m ({nearest_m:g} m); make "
                "docking.entry_m longer"
            )
        off_deg = axis_error_deg(port, np.asarray(scenario.chasers[port.chaser].q_wxyz))
        if off_deg > 0.1:
            raise ValueError(
                f"docking.ports.{k}.axis: the +X axis of chaser {port.chaser} is {off_deg:.3g} "
                "degrees off the "
                "axis into the port; change the attitude of the chaser or the axis"
            )
    for (k, a), (n, b) in combinations(enumerate(scenario.docking.ports), 2):
        if _at_once(scenario, a.chaser, b.chaser):
            _check_ports_apart(scenario, (k, a), (n, b))


_LEAVING = ("retreat", "abort", "goto")
"""Commands by which a chaser leaves its port, and so frees it for others."""
_FARTHEST_PORT_M = 100.0
"""Distance between ports at which the search for the least one ends: no target is that large."""


def _at_once(scenario: FlightScenario, *chasers: int) -> bool:
    """Return whether two chasers may be at their ports at the same time.

    The timeline may let one leave before the other comes. A chaser that it does not command to
    approach may be commanded by an operator at any time.
    """
    stays: list[list[tuple[float, float]]] = []
    for i in chasers:
        own = sorted((e for e in scenario.timeline if i in e.chasers), key=lambda e: e.at_s)
        stays.append(
            [
                (
                    entry.at_s,
                    next((e.at_s for e in own[k:] if e.command in _LEAVING), math.inf),
                )
                for k, entry in enumerate(own)
                if entry.command == "approach"
            ]
            or [(0.0, math.inf)]
        )
    return any(a < other_end and b < end for a, end in stays[0] for b, other_end in stays[1])


def _check_ports_apart(
    scenario: FlightScenario, one: tuple[int, Port], other: tuple[int, Port]
) -> None:
    """Check that the corridors and bodies of two chasers at their ports keep their distances."""
    (k, a), (n, b) = one, other
    if not (fault := _ports_fault(scenario, a, b)):
        return
    apart_m = math.dist(a.position_m, b.position_m)
    least_m = _least_port_distance_m(scenario, a, b) if apart_m > 0.0 else math.inf
    need = "" if math.isinf(least_m) else f", must be at least {least_m:g} m apart"
    raise ValueError(
        f"docking.ports.{k} and docking.ports.{n}, {apart_m:.3g} m apart{need}: {fault}"
    )


def _least_port_distance_m(scenario: FlightScenario, a: Port, b: Port) -> float:
    """Return the least distance (m, rounded up to 1 mm) of a port ``b`` from ``a``, in its
    direction, without a fault; infinite if there is none of at most ``_FARTHEST_PORT_M``.
    """
    start = np.array(a.position_m)
    apart_m = math.dist(a.position_m, b.position_m)
    direction = (np.array(b.position_m) - start) / apart_m

    def fits(distance_m: float) -> bool:
        x, y, z = (start + direction * distance_m).tolist()
        return not _ports_fault(scenario, a, b.model_copy(update={"position_m": (x, y, z)}))

    low, high = apart_m, 2.0 * apart_m
    while not fits(high):
        if high > _FARTHEST_PORT_M:
            return math.inf
        low, high = high, 2.0 * high
    while high - low > 1e-5:
        middle = (low + high) / 2.0
        low, high = (low, middle) if fits(middle) else (middle, high)
    return math.ceil(high * 1e3) / 1e3


def _ports_fault(scenario: FlightScenario, a: Port, b: Port) -> str:
    """Return how two chasers at their ports are too near to one another, or empty."""
    docking, reach_m = scenario.docking, scenario.chaser.probe_reach_m
    body = box_table(scenario.chaser.boxes())
    places = [centre_offset(port, reach_m, 0.0) for port in (a, b)]
    turns = [scenario.chasers[port.chaser].q_wxyz for port in (a, b)]
    first, second = moved(body, places, turns)
    ways = [np.asarray(port.axis) * docking.entry_m for port in (a, b)]
    room_m = docking.corridor.lateral_m
    if docking.at_once > 1:
        gap_m = swept_distance(first, second, ways[0], ways[1])
    else:  # one is latched while the other comes
        gap_m = min(
            swept_distance(first, second, ways[0], np.zeros(3)),
            swept_distance(first, second, np.zeros(3), ways[1]),
        )
    who = f"chasers {a.chaser} and {b.chaser}"
    if gap_m < room_m:
        return (
            f"the bodies of {who} in their corridors "
            + (f"overlap by {-gap_m:.3g} m" if gap_m < 0.0 else f"come within {gap_m:.3g} m")
            + f", and need {room_m:g} m (docking.corridor.lateral_m)"
        )
    centres_m = corridors_apart(a, b, reach_m, docking.entry_m)
    limit_m = scenario.limits.min_distance_chasers_m
    if centres_m < limit_m + docking.corridor_margin_m:
        return (
            f"the centres of {who} in their corridors come within {centres_m:.3g} m, nearer than "
            f"limits.min_distance_chasers_m ({limit_m:g} m) and {docking.corridor_margin_m:g} m "
            "allow; the second would wait as long as the first stays"
        )
    return ""
