# SPDX-License-Identifier: Apache-2.0
"""Shipped satellites as meshes, generated from their dimensions.

``tolerance_m`` is the largest distance between a true surface of revolution and its facets: a finer
mesh has a smaller one. MeshPart names are stable: scenarios name parts that the flight software
does not know of.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np

from . import rotations
from .arrays import Array, Vector3
from .meshes import Material, MeshPart, TriangleMesh, mass_properties, moved

FINE_M = 2e-4
"""Tolerance of the meshes that the world draws."""

INSULATION = Material(
    "insulation", diffuse=0.45, specular=0.35, shininess=25.0, texture="insulation"
)
CELLS = Material(
    "cells", diffuse=0.16, specular=0.30, shininess=60.0, texture="cells", relative_density=2.0
)
STRUCTURE = Material("structure", diffuse=0.60, specular=0.10, shininess=12.0)
WHITE_PAINT = Material("white paint", diffuse=0.80)
BARE_METAL = Material("bare metal", diffuse=0.38, specular=0.40, shininess=35.0)
NOZZLE = Material("nozzle", diffuse=0.18, specular=0.25, shininess=18.0)
BLACK_PAINT = Material("black paint", diffuse=0.06)

BOX_TRIANGLES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
)
"""Triangles (12, 3) of a cuboid's corners, in the order of `targets.cuboid_corners`."""


def _rounded(vertices: Array) -> Array:
    # Sines and cosines differ in the last bit between processors; the vertices must not.
    return np.round(vertices, 9) + 0.0


def box(
    name: str,
    material: Material,
    size_m: Vector3,
    centre_m: Vector3,
    turn_rad: Vector3 = (0.0, 0.0, 0.0),
    joint: str = "",
) -> MeshPart:
    """Return a cuboid, turned by the rotation vector ``turn_rad`` about its centre."""
    corners = (
        np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        * size_m
    )
    vertices = rotations.rotate(rotations.exp(np.array(turn_rad)), corners) + np.array(centre_m)
    return MeshPart(name, material, _rounded(vertices), BOX_TRIANGLES, joint)


def lathe(
    name: str,
    material: Material,
    profile_m: Sequence[tuple[float, float]],
    base_m: Vector3,
    axis: Vector3,
    tolerance_m: float,
    joint: str = "",
) -> MeshPart:
    """Return a surface of revolution about ``axis`` through ``base_m``.

    ``profile_m``: radius and height of the corners of a closed polygon, counter-clockwise with the
    radius to the right; radius 0 lies on the axis.
    """
    radius = max(r for r, _ in profile_m)
    n = max(6, math.ceil(math.pi / math.acos(max(0.0, 1.0 - tolerance_m / radius))))
    angles = 2.0 * np.pi * np.arange(n) / n
    vertices: list[Array] = []
    rings: list[list[int]] = []
    for r, h in profile_m:
        first = sum(len(v) for v in vertices)
        if r == 0.0:
            vertices.append(np.array([[0.0, 0.0, h]]))
            rings.append([first] * n)
        else:
            vertices.append(
                np.stack([r * np.cos(angles), r * np.sin(angles), np.full(n, h)], axis=1)
            )
            rings.append(list(range(first, first + n)))
    triangles = []
    for lower, upper in zip(rings, rings[1:] + rings[:1], strict=True):
        for i in range(n):
            k = (i + 1) % n
            triangles += [[lower[i], lower[k], upper[k]], [lower[i], upper[k], upper[i]]]
    closed = [t for t in triangles if len(set(t)) == 3]
    turn = _rotation_from_z(axis)
    at = rotations.rotate(turn, np.concatenate(vertices)) + np.array(base_m)
    return MeshPart(name, material, _rounded(at), np.array(closed), joint)


def _rotation_from_z(axis: Vector3) -> Array:
    unit = np.array(axis) / np.linalg.norm(axis)
    if unit[2] < -1.0 + 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    q = np.array([1.0 + unit[2], -unit[1], unit[0], 0.0])
    return q / np.linalg.norm(q)


def _cylinder(
    name: str,
    material: Material,
    radius_m: float,
    length_m: float,
    base_m: Vector3,
    axis: Vector3,
    tolerance_m: float,
    joint: str = "",
) -> MeshPart:
    profile = ((0.0, 0.0), (radius_m, 0.0), (radius_m, length_m), (0.0, length_m))
    return lathe(name, material, profile, base_m, axis, tolerance_m, joint)


def _tube(
    name: str,
    material: Material,
    radii_m: tuple[float, float],
    length_m: float,
    base_m: Vector3,
    axis: Vector3,
    tolerance_m: float,
) -> MeshPart:
    inner, outer = radii_m
    profile = ((inner, 0.0), (outer, 0.0), (outer, length_m), (inner, length_m))
    return lathe(name, material, profile, base_m, axis, tolerance_m)


def _bell(
    radius_throat_m: float, radius_exit_m: float, length_m: float, wall_m: float
) -> list[tuple[float, float]]:
    """Return the profile of a bell nozzle whose exit is at the height ``length_m``."""
    steps = np.linspace(0.0, 1.0, 7)
    outer = [
        (float(radius_throat_m + (radius_exit_m - radius_throat_m) * s**0.7), float(length_m * s))
        for s in steps
    ]
    inner = [(r - wall_m, h) for r, h in outer[:0:-1]]
    return [(0.0, 0.0), *outer, *inner, (0.0, 0.25 * length_m)]


def _dish(radius_m: float, depth_m: float, wall_m: float) -> list[tuple[float, float]]:
    """Return the profile of a paraboloid that opens upwards, its vertex at height 0."""
    radii = np.linspace(0.0, radius_m, 7)
    below = [(float(r), float(depth_m * (r / radius_m) ** 2)) for r in radii]
    return below + [(r, h + wall_m) for r, h in below[::-1]]


def _wings(
    bus_half_m: float, panel_m: Vector3, boom_m: float, tilt_rad: float, tolerance_m: float
) -> list[MeshPart]:
    """Return two solar panels on booms along +Y ("north") and -Y ("south").

    ``tilt_rad``: rotation of the panels about the boom.
    """
    parts = []
    for label, side in (("north", 1.0), ("south", -1.0)):
        joint = f"panel_{label}"
        middle = side * (bus_half_m + boom_m + panel_m[1] / 2.0)
        parts += [
            _cylinder(
                f"boom_{label}",
                BARE_METAL,
                0.008,
                boom_m + 0.01,
                (0.0, side * bus_half_m, 0.0),
                (0.0, side, 0.0),
                tolerance_m,
                joint,
            ),
            box(joint, CELLS, panel_m, (0.0, middle, 0.0), (0.0, tilt_rad, 0.0), joint),
        ]
    return parts


def _geo_servicer(tolerance_m: float) -> TriangleMesh:
    """Build a small geostationary satellite: insulated bus, two panels, dish, apogee nozzle inside
    the launch-adapter ring (-X).
    """
    up: Vector3 = (0.0, 0.0, 1.0)
    parts = [
        box("bus", INSULATION, (0.40, 0.32, 0.32), (0.0, 0.0, 0.0)),
        box("radiator_north", WHITE_PAINT, (0.30, 0.004, 0.22), (0.02, 0.162, 0.0)),
        box("radiator_south", WHITE_PAINT, (0.30, 0.004, 0.22), (0.02, -0.162, 0.0)),
        *_wings(0.164, (0.010, 0.40, 0.22), 0.075, 0.35, tolerance_m),
        _tube(
            "adapter_ring",
            BARE_METAL,
            (0.118, 0.130),
            0.030,
            (-0.20, 0.0, 0.0),
            (-1.0, 0.0, 0.0),
            tolerance_m,
        ),
        lathe(
            "nozzle",
            NOZZLE,
            _bell(0.018, 0.055, 0.085, 0.003),
            (-0.20, 0.0, 0.0),
            (-1.0, 0.0, 0.0),
            tolerance_m,
        ),
        _cylinder("dish_arm", STRUCTURE, 0.010, 0.075, (0.09, 0.0, 0.16), up, tolerance_m),
        lathe(
            "dish",
            WHITE_PAINT,
            _dish(0.125, 0.040, 0.003),
            (0.09, 0.0, 0.233),
            (0.45, 0.0, 1.0),
            tolerance_m,
        ),
        _cylinder(
            "dish_feed", STRUCTURE, 0.012, 0.085, (0.09, 0.0, 0.233), (0.45, 0.0, 1.0), tolerance_m
        ),
        _tube(
            "star_tracker",
            BLACK_PAINT,
            (0.020, 0.024),
            0.07,
            (0.10, 0.07, -0.16),
            (0.25, 0.3, -1.0),
            tolerance_m,
        ),
        box("sensor", STRUCTURE, (0.05, 0.08, 0.06), (0.225, -0.08, 0.07)),
        _cylinder(
            "antenna_whip",
            STRUCTURE,
            0.003,
            0.22,
            (-0.15, -0.12, 0.16),
            (-0.3, -0.35, 1.0),
            tolerance_m,
        ),
        _cylinder(
            "antenna_stub",
            STRUCTURE,
            0.010,
            0.06,
            (-0.12, 0.11, -0.16),
            (0.0, 0.0, -1.0),
            tolerance_m,
        ),
    ]
    for k, (y, z) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        parts.append(
            lathe(
                f"thruster_{k}",
                NOZZLE,
                _bell(0.006, 0.014, 0.028, 0.0015),
                (-0.20, 0.135 * y, 0.135 * z),
                (-1.0, 0.0, 0.0),
                tolerance_m,
            )
        )
    return TriangleMesh(
        "geo_servicer",
        tuple(parts),
        {"panel_north": (0.0, 0.164, 0.0), "panel_south": (0.0, -0.164, 0.0)},
    )


def _cubesat_12u(tolerance_m: float) -> TriangleMesh:
    """Build a twelve-unit CubeSat: rails, body-mounted cells, two deployed panels, tape antennas,
    camera and nozzle.
    """
    body: Vector3 = (0.340, 0.220, 0.226)
    parts = [box("bus", BLACK_PAINT, (0.330, 0.210, 0.216), (0.0, 0.0, 0.0))]
    for k, (y, z) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        centre = (0.0, y * (body[1] / 2 - 0.004), z * (body[2] / 2 - 0.004))
        parts.append(box(f"rail_{k}", BARE_METAL, (body[0], 0.0085, 0.0085), centre))
    parts += [
        box("cells_top", CELLS, (0.300, 0.180, 0.003), (0.0, 0.0, 0.1095)),
        box("radiator", WHITE_PAINT, (0.200, 0.150, 0.003), (0.04, 0.0, -0.1095)),
        *_wings(0.113, (0.320, 0.200, 0.004), 0.012, 0.0, tolerance_m),
        _tube(
            "camera",
            BLACK_PAINT,
            (0.024, 0.029),
            0.035,
            (0.165, 0.045, 0.03),
            (1.0, 0.0, 0.0),
            tolerance_m,
        ),
        _tube(
            "star_tracker",
            BLACK_PAINT,
            (0.014, 0.017),
            0.030,
            (0.165, -0.05, -0.04),
            (1.0, 0.0, 0.0),
            tolerance_m,
        ),
        _tube(
            "docking_ring",
            BARE_METAL,
            (0.052, 0.060),
            0.015,
            (-0.165, 0.0, 0.0),
            (-1.0, 0.0, 0.0),
            tolerance_m,
        ),
        lathe(
            "nozzle",
            NOZZLE,
            _bell(0.008, 0.022, 0.030, 0.002),
            (-0.165, 0.07, -0.07),
            (-1.0, 0.0, 0.0),
            tolerance_m,
        ),
        box(
            "antenna_0", BARE_METAL, (0.0016, 0.006, 0.170), (-0.155, 0.03, 0.190), (0.0, 0.15, 0.0)
        ),
        box(
            "antenna_1",
            BARE_METAL,
            (0.0016, 0.006, 0.170),
            (-0.155, -0.03, -0.190),
            (0.0, -0.15, 0.0),
        ),
    ]
    return TriangleMesh(
        "cubesat_12u",
        tuple(parts),
        {"panel_north": (0.0, 0.113, 0.0), "panel_south": (0.0, -0.113, 0.0)},
    )


def _chaser_body(tolerance_m: float) -> TriangleMesh:
    """Build the body of a chaser: a deck with rim, tanks, thruster pods and a camera housing, 0.25
    x 0.25 x 0.05 m.
    """
    parts = [
        box("deck", STRUCTURE, (0.226, 0.226, 0.030), (0.0, 0.0, -0.010)),
        box("cells", CELLS, (0.120, 0.200, 0.003), (-0.045, 0.0, 0.0065)),
        _cylinder(
            "tank", BARE_METAL, 0.018, 0.120, (0.050, -0.060, 0.007), (0.0, 1.0, 0.0), tolerance_m
        ),
        box("front", BLACK_PAINT, (0.012, 0.110, 0.040), (0.119, 0.0, -0.005)),
    ]
    for k, (x, y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        parts.append(
            box(f"pod_{k}", BLACK_PAINT, (0.030, 0.030, 0.050), (0.110 * x, 0.110 * y, 0.0))
        )
    return TriangleMesh("chaser_body", tuple(parts), {})


_SATELLITES: dict[str, Callable[[float], TriangleMesh]] = {
    "chaser_body": _chaser_body,
    "cubesat_12u": _cubesat_12u,
    "geo_servicer": _geo_servicer,
}


def satellite_names() -> tuple[str, ...]:
    """Return the names of the shipped satellites."""
    return tuple(sorted(_SATELLITES))


@lru_cache
def satellite(name: str, tolerance_m: float = FINE_M) -> TriangleMesh:
    """Return a shipped satellite.

    The origin is its centre of mass, to 0.1 mm; that of ``chaser_body`` is the centre of the
    cuboid. Raises ValueError for an unknown name, listing the known ones, and for a tolerance that
    is not positive.
    """
    if name not in _SATELLITES:
        raise ValueError(f"unknown satellite {name!r}; known: {', '.join(satellite_names())}")
    if not tolerance_m > 0.0:
        raise ValueError(f"tolerance_m must be positive (got {tolerance_m})")
    return moved(_SATELLITES[name](tolerance_m), -_centre_of_mass(name))


@lru_cache
def _centre_of_mass(name: str) -> Array:
    # Of the fine mesh, so that meshes of all tolerances coincide.
    if name == "chaser_body":
        return np.zeros(3)
    return np.round(mass_properties(_SATELLITES[name](FINE_M), 1.0)[0], 4)
