# SPDX-License-Identifier: Apache-2.0
"""Map and motion of a target of unknown shape by the points that chasers track, as it would fly.

Two chasers hold 2 m beside the target for two turns (`unknown_scene`). Points of each image are
tracked, the mapper is updated every second before its first map and every ``UPDATE_S`` after it,
and what it knows goes back to the trackers. Nothing else reaches them: no truth, no mesh.

``first``: time to the first map, which is false if its rate is 10 % wrong. ``half``, ``turn``:
after half a turn and one. ``size``, ``direction``: of the rate's error; ``mounting``: direction by
which the cameras' unknown mounting alone turns it. ``closed``: when the mapper says that a side has
returned, and poses from then on. ``next``: poses over the next turn (with ``--quick``: over 8 s),
each by the latest map before it, against the frame of the map; landmarks against the surface in the
frame of the last map, and rings by it (`unknown_rings`). NEES is of velocity and rate (6). Times
are CPU times of this process.
"""

from __future__ import annotations

import math
import time
from argparse import ArgumentParser
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from chaserdock_agents.chaser.perception.features import (
    BYTES_PER_POINT,
    FeatureTracker,
    KnownTarget,
    describe,
)
from chaserdock_agents.chaser.perception.features.description import DESCRIPTION_BYTES
from chaserdock_agents.chaser.perception.refine import PoseInCamera
from chaserdock_agents.mapper.mapper import MAP_STATUS, Mapper, TargetMap
from chaserdock_agents.mapper.types import CameraUncertainty, ConstantRates, ImageTracks
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.satellites import satellite, satellite_names
from chaserdock_world.sensors.errors import camera_errors
from common import BenchmarkFailed, Figures, Group, KeptResults, Options, seeds_of

from .unknown_rings import RingSearch
from .unknown_scene import SUNS, TUMBLES, SceneCase, UnknownImages

UPDATE_S = 6.0
"""Between updates of a map: 0.3 to 0.6 of a core (docs/evidence/unknown.md)."""
DESCRIBED_IMAGES = 26
"""Every 26th image is described: once in 5.2 s."""
FALSE_SHARE = 0.1
"""Error of the rate, as a share, from which a first map is false."""


@dataclass(frozen=True)
class MapOutcome:
    """Figures of one sequence; not a number where there is no map."""

    image_mean_s: float
    image_p95_s: float
    mapper_share: float
    bytes_per_s: float
    first_s: float = math.nan
    first_rate_share: float = math.nan
    half_rate_share: float = math.nan
    half_nees: float = math.nan
    turn_rate_share: float = math.nan
    turn_size_share: float = math.nan
    turn_direction_rad: float = math.nan
    mounting_direction_rad: float = math.nan
    closed_turns: float = math.nan
    closed_rate_share: float = math.nan
    closed_direction_rad: float = math.nan
    closed_nees: float = math.nan
    closed_position_m: float = math.nan
    closed_angle_rad: float = math.nan
    turn_nees: float = math.nan
    turn_scale_share: float = math.nan
    next_offset_m: float = math.nan
    next_offset_rad: float = math.nan
    next_position_m: float = math.nan
    next_angle_rad: float = math.nan
    next_rate_share: float = math.nan
    landmarks: float = math.nan
    landmark_median_m: float = math.nan
    landmark_p90_m: float = math.nan
    merges: float = math.nan
    ellipses_mean_s: float = math.nan
    rings_s: float = math.nan
    rings: float = math.nan
    rings_false: float = math.nan
    ring_offset_m: float = math.nan
    ring_angle_rad: float = math.nan
    ring_radius_m: float = math.nan
    ring_nees: float = math.nan


def uncertainty(images: UnknownImages) -> CameraUncertainty:
    """Return what the flight software is told of the cameras' errors."""
    errors = images.scenario.navigation.errors()
    return CameraUncertainty(
        errors.camera_turn_rad,
        errors.camera_shift_m,
        errors.camera_focal_share,
        errors.attitude_noise_rad,
        errors.position_noise_m,
    )


def fly(case: SceneCase, folder: Path) -> MapOutcome:
    """Return the figures of a sequence of two turns."""
    images = UnknownImages(case, folder)
    camera, chasers = images.camera, len(case.places_m)
    trackers = [FeatureTracker(camera) for _ in range(chasers)]
    mapper = Mapper([uncertainty(images)] * chasers, camera.fx_px)
    known: list[KnownTarget | None] = [None] * chasers
    first: TargetMap | None = None
    after_half: TargetMap | None = None
    after_turn: TargetMap | None = None
    closed: TargetMap | None = None
    last: TargetMap | None = None
    next_s, image_s, mapper_s, points = 1.0, [], 0.0, 0.0
    search = RingSearch(camera)
    times, motions = [], []
    for exposure in images.exposures():
        i, at_s, own = exposure.chaser, exposure.time_s, exposure.odometry
        lens, q = camera.irf_pose_in_world(own.position_m, own.q_wxyz)
        if i == 0 and last is not None and last.motion is not None and at_s > case.turn_s:
            times.append(at_s)
            motions.append(last.motion)
        begin_s = time.process_time()
        seen = trackers[i].track(exposure.image, at_s, lens, q, known[i])
        image_s.append(time.process_time() - begin_s)
        points += len(seen.ids)
        rays = camera.normalized(seen.px)
        mapper.add(ImageTracks(i, at_s, lens, rotations.to_matrix(q), seen.ids, rays, seen.ages_s))
        last_motion = mapper.motion
        search.look(exposure, lens, q, seen.px, last_motion)
        if last_motion is not None and round(at_s * 5) % DESCRIBED_IMAGES == 0:
            begin_s = time.process_time()
            p, r = last_motion.at([at_s])
            axes = rotations.to_matrix(q)
            pose = PoseInCamera(axes.T @ (p[0] - lens), axes.T @ r[0])
            described = describe(exposure.image, camera, seen.ids, seen.px, pose)
            image_s[-1] += time.process_time() - begin_s
            mapper.describe(i, at_s, described.ids, described.values)
            points += len(described.ids) * DESCRIPTION_BYTES / BYTES_PER_POINT
        if i < chasers - 1 or at_s < next_s:
            continue
        begin_s = time.process_time()
        found = mapper.update(at_s)
        mapper_s += time.process_time() - begin_s
        mapped = found.status in MAP_STATUS
        next_s = at_s + (UPDATE_S if mapped else 1.0)
        if not mapped or found.motion is None:
            continue
        last = found
        if closed is None and found.closed:
            closed = found
        first = first or found
        known = [KnownTarget(found.motion, *mapper.known_points(k)) for k in range(chasers)]
        if after_half is None and at_s >= 0.5 * case.turn_s:
            after_half = found
        if after_turn is None and at_s >= case.turn_s:
            after_turn = found
    outcome = MapOutcome(
        float(np.mean(image_s)),
        float(np.percentile(image_s, 95)),
        mapper_s / case.duration_s,
        BYTES_PER_POINT * points / case.duration_s / chasers,
    )
    if first is None or last is None or after_half is None or after_turn is None or not times:
        return outcome
    if closed is not None:
        outcome = replace(
            outcome,
            closed_turns=closed.time_s / case.turn_s,
            closed_rate_share=rate_share(case, closed),
            closed_direction_rad=size_and_direction(case, closed)[1],
            closed_nees=rate_nees(case, closed),
        )
        later = int(np.searchsorted(times, closed.time_s))
        if times[-1] > closed.time_s + 0.5 * case.turn_s:
            since = pose_errors(images, np.array(times[later:]), motions[later:])
            outcome = replace(
                outcome, closed_position_m=since.position_m, closed_angle_rad=since.angle_rad
            )
    errors = pose_errors(images, np.array(times), motions)
    distance = surface_distances(case.mesh, (last.landmarks_m - errors.origin_m) @ errors.turn)
    assert last.motion is not None
    outcome = replace(
        outcome,
        **search.figures(case.mesh, last.motion, errors.turn, errors.origin_m),
    )
    return replace(
        outcome,
        first_s=first.time_s,
        first_rate_share=rate_share(case, first),
        half_rate_share=rate_share(case, after_half),
        half_nees=rate_nees(case, after_half),
        turn_rate_share=rate_share(case, after_turn),
        turn_size_share=size_and_direction(case, after_turn)[0],
        turn_direction_rad=size_and_direction(case, after_turn)[1],
        mounting_direction_rad=mounting_direction(images),
        turn_nees=rate_nees(case, after_turn),
        turn_scale_share=scale_error(images, after_turn),
        next_offset_m=errors.offset_m,
        next_offset_rad=errors.offset_rad,
        next_position_m=errors.position_m,
        next_angle_rad=errors.angle_rad,
        next_rate_share=rate_share(case, last),
        landmarks=float(len(distance)),
        landmark_median_m=float(np.median(distance)),
        landmark_p90_m=float(np.percentile(distance, 90)),
        merges=float(last.merges),
    )


def rate_share(case: SceneCase, found: TargetMap) -> float:
    """Return the error of the rate vector as a share of its length. Its direction in WRF is that in
    TRF, as the rates are constant and the target starts with the axes of WRF.
    """
    assert found.motion is not None
    true = np.array(case.omega_rad_s)
    return float(np.linalg.norm(found.motion.omega_rad_s - true) / np.linalg.norm(true))


def size_and_direction(case: SceneCase, found: TargetMap) -> tuple[float, float]:
    """Return the error of the size of the rate, as a share, and that of its direction, rad."""
    assert found.motion is not None
    true, mine = np.array(case.omega_rad_s), found.motion.omega_rad_s
    size, length = float(np.linalg.norm(true)), float(np.linalg.norm(mine))
    across = float(np.linalg.norm(np.cross(true, mine))) / (size * length)
    return length / size - 1.0, math.asin(min(across, 1.0))


def mounting_direction(images: UnknownImages) -> float:
    """Return the angle, rad, by which the mean of the cameras' true mounting errors turns the
    direction of the rate: no image tells it.
    """
    turns = []
    for i, chaser in enumerate(images.scenario.chasers):
        turns.append(rotations.rotate(chaser.q_wxyz, camera_errors(images.scenario, i).turn_rad))
    true = np.array(images.case.omega_rad_s)
    return float(np.linalg.norm(np.cross(np.mean(turns, axis=0), true)) / np.linalg.norm(true))


def rate_nees(case: SceneCase, found: TargetMap) -> float:
    """Return the squared error of velocity and rate (6) by their covariance."""
    assert found.motion is not None
    error = found.motion.vector()[3:] - np.array([*case.velocity_m_s, *case.omega_rad_s])
    return float(error @ np.linalg.solve(found.covariance[3:, 3:], error))


@dataclass(frozen=True, eq=False)
class MapPoseErrors:
    """Errors of poses in the frame of the map.

    ``offset_m``, ``offset_rad``: constant error in WRF, which the cameras' unknown mounting makes,
    and which a chaser that looks at the target by the same camera does not feel. ``position_m``,
    ``angle_rad``: RMS of what varies. ``turn`` (3, 3): true TRF to that of the map; ``origin_m``
    (3,): the true origin in the map.
    """

    offset_m: float
    offset_rad: float
    position_m: float
    angle_rad: float
    turn: Array
    origin_m: Array


def pose_errors(
    images: UnknownImages, times_s: Array, motions: list[ConstantRates]
) -> MapPoseErrors:
    """Return the errors of the poses by ``motions`` at times (n,)."""
    found = [motion.at([at_s]) for motion, at_s in zip(motions, times_s, strict=True)]
    p, r = np.array([f[0][0] for f in found]), np.array([f[1][0] for f in found])
    true = [images.target_pose(at_s) for at_s in times_s.tolist()]
    true_p = np.array([t[0] for t in true])
    true_r = rotations.to_matrix(np.array([t[1] for t in true]))
    tilt, turn = np.eye(3), np.eye(3)
    for _ in range(_ALIGNMENTS):  # r = tilt true_r turn'
        turn = nearest_rotation((r.transpose(0, 2, 1) @ tilt @ true_r).mean(axis=0))
        tilt = nearest_rotation((r @ turn @ true_r.transpose(0, 2, 1)).mean(axis=0))
    # p + r origin = true_p + offset, for constant origin and offset.
    rows = np.concatenate([r, -np.repeat(np.eye(3)[None], len(r), axis=0)], axis=2)
    # Along the axis of rotation the two are one: it counts as the place of the origin.
    rows = np.concatenate([rows.reshape(-1, 6), np.eye(6)[3:]])
    seen = np.append((true_p - p).ravel(), np.zeros(3))
    solved: Array = np.asarray(np.linalg.lstsq(rows, seen, rcond=None)[0], dtype=np.float64)
    origin, offset = solved[:3], solved[3:]
    varies = p + r @ origin - true_p - offset
    left = r @ turn @ (tilt @ true_r).transpose(0, 2, 1)
    return MapPoseErrors(
        float(np.linalg.norm(offset)),
        _angle(tilt),
        float(np.sqrt((varies**2).sum(axis=1).mean())),
        float(np.sqrt(np.mean([_angle(m) ** 2 for m in left]))),
        turn,
        origin,
    )


_ALIGNMENTS = 20
"""Repetitions until two rotations agree."""


def nearest_rotation(m: Array) -> Array:
    """Return the rotation nearest to a matrix (3, 3)."""
    u, _, v = np.linalg.svd(m)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v


def _angle(m: Array) -> float:
    return float(np.linalg.norm(rotations.log(rotations.from_matrix(m))))


def scale_error(images: UnknownImages, found: TargetMap) -> float:
    """Return the error of distances in the map, as a share: by the path of the first camera around
    the target, relative to the target, against the true one.
    """
    assert found.motion is not None
    times_s = np.linspace(0.0, found.time_s, 60)
    p, r = found.motion.at(times_s)
    true = [images.target_pose(at_s) for at_s in times_s.tolist()]
    lens = np.array([images.state("chaser/0", at_s).position_m for at_s in times_s.tolist()])
    mine = np.einsum("nji,nj->ni", r, lens - p)
    theirs = np.array(
        [rotations.rotate_inverse(q, at - o) for (o, q), at in zip(true, lens, strict=True)]
    )
    mine, theirs = mine - mine.mean(axis=0), theirs - theirs.mean(axis=0)
    return float(np.sqrt((mine**2).sum() / (theirs**2).sum()) - 1.0)


def surface_distances(mesh: str, points_m: Array) -> Array:
    """Return the distances (n,) of points (n, 3), TRF, from the surface of a shipped satellite."""
    parts = satellite(mesh).parts
    first = np.cumsum([0, *(len(p.vertices_m) for p in parts)])
    surface = trimesh.Trimesh(
        np.concatenate([p.vertices_m for p in parts]),
        np.concatenate([p.triangles + f for p, f in zip(parts, first, strict=False)]),
        process=False,
    )
    out = [np.zeros(0)]
    for k in range(0, len(points_m), _CHUNK):
        out.append(trimesh.proximity.closest_point_naive(surface, points_m[k : k + _CHUNK])[1])
    return np.concatenate(out)


_CHUNK = 50
"""Points whose distances from all triangles are computed at once: 20 MB."""


def case_of(options: Options, seed: int) -> SceneCase:
    """Return the sequence of a seed. Suns and rates take turns, so that as many seeds as there are
    pairs fly each pair once.
    """
    suns, rates = options.suns, options.rates_deg_s
    number = seed % (len(suns) * len(rates))
    turn = number + number // math.lcm(len(suns), len(rates))
    omega = np.array(TUMBLES[seed % len(TUMBLES)])
    omega *= np.deg2rad(rates[turn % len(rates)]) / np.linalg.norm(omega)
    x, y, z = omega.tolist()
    sun = SUNS[suns[number % len(suns)]]
    case = SceneCase(mesh=options.mesh, to_sun=sun, omega_rad_s=(x, y, z), seed=seed)
    turns = 1.0 if options.quick else 2.0
    return replace(case, duration_s=float(np.ceil(turns * case.turn_s)) + _AFTER_S)


_AFTER_S = 8.0
"""Time after the last whole turn, s: more than an update takes."""


def measure(options: Options) -> Figures:
    """Measure map and motion of each seed."""
    outcomes = []
    for seed in seeds_of(options, 20, 1):
        case = case_of(options, seed)
        key = {"mesh": case.mesh, "sun": list(case.to_sun),
               "omega": [round(v, 6) for v in case.omega_rad_s],
               "duration_s": case.duration_s}  # fmt: skip
        outcomes += KeptResults(options.results, key, MapOutcome).of(
            [seed], partial(_flown, case, options.images), _line
        )
    rows = {name: np.array([getattr(o, name) for o in outcomes]) for name in _FIELDS}
    mapped = np.isfinite(rows["first_s"])
    figures: Figures = {
        "sequences": len(outcomes),
        "mapped": float(mapped.sum()),
        "false_first_maps": float((rows["first_rate_share"][mapped] > FALSE_SHARE).sum()),
    }
    for name in _FIELDS:
        known = rows[name][np.isfinite(rows[name])]
        if len(known):
            figures[f"{name}_median"] = float(np.median(np.abs(known)))
            figures[f"{name}_max"] = float(np.abs(known).max())
    for name in ("half_nees", "turn_nees", "closed_nees"):
        known = rows[name][np.isfinite(rows[name])]
        if len(known):
            figures[f"{name}_mean"] = float(known.mean())
    return figures


REFUSED_S = 30.0
"""Duration of a sequence that must give no map: six times that of a usual start."""


@dataclass(frozen=True)
class RefusalOutcome:
    """States of the mapper while it must not give a map with distances: the last one, whether any
    was `mapped`, and the standard deviation of the scale, as a share, where a map has none.
    """

    status: str
    mapped: bool
    scale_share: float = math.nan


def refused(case: SceneCase, folder: Path) -> RefusalOutcome:
    """Return what the mapper says in a sequence."""
    images = UnknownImages(case, folder)
    camera, chasers = images.camera, len(case.places_m)
    trackers = [FeatureTracker(camera) for _ in range(chasers)]
    mapper = Mapper([uncertainty(images)] * chasers, camera.fx_px)
    next_s, found, mapped = 1.0, TargetMap(0.0, "gathering"), False
    for exposure in images.exposures():
        i, at_s, own = exposure.chaser, exposure.time_s, exposure.odometry
        lens, q = camera.irf_pose_in_world(own.position_m, own.q_wxyz)
        seen = trackers[i].track(exposure.image, at_s, lens, q)
        rays = camera.normalized(seen.px)
        mapper.add(ImageTracks(i, at_s, lens, rotations.to_matrix(q), seen.ids, rays, seen.ages_s))
        if i == chasers - 1 and at_s >= next_s:
            found = mapper.update(at_s)
            mapped |= found.status == "mapped"
            next_s = at_s + (UPDATE_S if found.motion is not None else 1.0)
    return RefusalOutcome(found.status, mapped, found.scale_share)


def measure_refused(options: Options) -> Figures:
    """Measure what gives no map: one chaser, whose scale is unknown, and a target that stands
    still. Raises BenchmarkFailed if anything is `mapped`.
    """
    figures: Figures = {}
    for name, expected in _REFUSALS.items():
        outcomes = []
        for seed in seeds_of(options, 20, 1):
            case = replace(case_of(options, seed), duration_s=REFUSED_S)
            if name == "single":
                case = replace(case, places_m=case.places_m[:1])
            else:
                case = replace(case, omega_rad_s=(0.0, 0.0, 0.0))
            key = {"refused": name, "mesh": case.mesh, "sun": list(case.to_sun),
                   "omega": [round(v, 6) for v in case.omega_rad_s]}  # fmt: skip
            outcomes += KeptResults(options.results, key, RefusalOutcome).of(
                [seed],
                lambda seed, case=case: refused(replace(case, seed=seed), options.images),
                lambda o, name=name: f"{name}: {o.status}",
            )
        figures[f"{name}_sequences"] = len(outcomes)
        figures[f"{name}_named"] = float(sum(o.status in expected for o in outcomes))
        figures[f"{name}_mapped"] = float(sum(o.mapped for o in outcomes))
    if any(v for k, v in figures.items() if k.endswith("_mapped")):
        raise BenchmarkFailed("a map where there must be none", figures)
    return figures


_REFUSALS = {
    "single": ("scale unknown", "ambiguous"),
    "still": ("does not turn", "no texture"),
}
"""What the mapper may say at the end, by sequence. A tracker shows no point that does not move."""

_FIELDS = tuple(MapOutcome.__dataclass_fields__)


def _flown(case: SceneCase, folder: Path, seed: int) -> MapOutcome:
    return fly(replace(case, seed=seed), folder)


def _line(o: MapOutcome) -> str:
    return (
        f"first {o.first_s:.0f} s, rate {1e2 * o.turn_rate_share:.3f} %, NEES {o.turn_nees:.1f}, "
        f"closed {o.closed_turns:.2f}: {1e2 * o.closed_rate_share:.3f} %, {o.closed_nees:.1f}, "
        f"{1e3 * o.closed_position_m:.2f} mm {np.rad2deg(o.closed_angle_rad):.3f} deg; "
        f"next turn {1e3 * o.next_position_m:.2f} mm {np.rad2deg(o.next_angle_rad):.3f} deg"
    )


def _add_options(parser: ArgumentParser) -> None:
    parser.add_argument("--mesh", choices=satellite_names(), default="geo_servicer")
    parser.add_argument(
        "--suns", nargs="+", choices=tuple(SUNS), default=list(SUNS), metavar="NAME",
        help=f"where the sun is, by turns (default: {' '.join(SUNS)})",
    )  # fmt: skip
    parser.add_argument(
        "--rates-deg-s", nargs="+", type=float, default=[3.2, 5.0], metavar="RATE",
        help="how fast the target turns, by turns (default: 3.2 5)",
    )  # fmt: skip
    parser.add_argument(
        "--images", type=Path, metavar="FOLDER", default=Path("/tmp/chaserdock-unknown"),
        help="keeps rendered images, 0.2 GB a sequence (default: /tmp/chaserdock-unknown)",
    )  # fmt: skip


GROUP = Group(
    {"map": measure, "refused": measure_refused},
    on_request=("refused",),
    uses=("flights", "first", "results"),
    add_options=_add_options,
)
