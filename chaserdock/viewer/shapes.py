# SPDX-License-Identifier: Apache-2.0
"""Bodies, corridors and lines of the 3-D scene as arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_models.targets import cuboid_corners
from chaserdock_protocol.scenario import FlightScenario
from numpy.typing import NDArray

from chaserdock.analysis.dressed_bodies import Coat, DressedBody

_EXPOSURE = 0.55
"""Brightness of bodies, chosen: viser's lights together are brighter than white. Larger: paint in
the light fades to white.
"""
_HIGHLIGHT = 0.3
"""Share of the highlight in the colour of a body, chosen: foil is golden. Larger: cells are
grey."""
_NEAREST_EARTH_M = 50.0
"""Distance (m) of the drawn Earth's surface, in its true angular size. Larger: less parallax when
the view is moved; smaller than the scene: chasers would fly through it.
"""
_CAP = (24, 72)
"""Rings and sides of the drawn Earth. Larger: rounder limb, more triangles."""
_SEA_RGB, _CLOUD_RGB = (38.0, 82.0, 150.0), (225.0, 232.0, 240.0)
"""Colours (0 to 255) of the Earth in sunlight, chosen. Brighter sea: bodies stand out less."""
_WAVES, _WAVE_RAD = 24, 5.0
"""Number of waves of clouds, and their phase (rad) from the middle to the horizon. More of it:
smaller clouds.
"""
_NIGHT = 0.06
"""Brightness of the Earth's night side, so that its disc is seen before black space."""
_SIDES = 24
"""Sides of a polygon that stands for a circle; it deviates by 1 - cos(pi / 24) = 0.9 % of the
radius.
"""


@dataclass(frozen=True)
class Mesh:
    """Coloured triangles. ``vertices_m`` (V, 3). ``triangles`` (F, 3): indices of their corners.
    ``colours`` (V, 3): of the vertices, 0 to 255. ``normals`` (V, 3): those of the triangles
    without.
    """

    vertices_m: Array
    triangles: NDArray[np.int32]
    colours: NDArray[np.uint8]
    normals: Array | None = None


def mesh_of(body: DressedBody) -> Mesh:
    """Return a dressed body as a mesh in body axes. Its coats are as in sunlight; corners are not
    shared, so that they have the normals of their triangles.
    """
    surfaces = body.surfaces()
    corners = np.concatenate([soup.corners_m.reshape(-1, 3) for soup in surfaces.values()])
    normals = np.concatenate([soup.normals.reshape(-1, 3) for soup in surfaces.values()])
    colours = np.concatenate(
        [np.tile(_shown(coat), (3 * len(soup.part), 1)) for coat, soup in surfaces.items()]
    )
    triangles = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    return Mesh(corners, triangles, colours.astype(np.uint8), normals)


def _shown(coat: Coat) -> Array:
    """Return the colour (3,), 0 to 255, linear, of a coat with a part of its highlight: what
    mirrors is dark without its surroundings.
    """
    level = np.array(coat.rgb) + _HIGHLIGHT * np.array(coat.specular)
    return 255.0 * _EXPOSURE * np.clip(level, 0.0, 1.0)


def polyline(points: Array) -> NDArray[np.float32]:
    """Return points (K, 3) as segments (K - 1, 2, 3); one of zero length for fewer than two
    points.
    """
    if len(points) < 2:
        points = np.zeros((2, 3)) if len(points) == 0 else np.repeat(points, 2, axis=0)
    return np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)


def box_edges(size_m: tuple[float, float, float]) -> NDArray[np.float32]:
    """Return the twelve edges (12, 2, 3) of a box about the origin."""
    corners = cuboid_corners(size_m)
    pairs = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b).bit_count() == 1]
    return np.array([[corners[a], corners[b]] for a, b in pairs], dtype=np.float32)


def tube(begin_m: Array, end_m: Array, radius_m: float) -> NDArray[np.float32]:
    """Return a cylinder about the line between two points (3,) as segments (K, 2, 3): rings and
    four generatrices.
    """
    axis = (end_m - begin_m) / max(1e-12, float(np.linalg.norm(end_m - begin_m)))
    radial = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    radial /= np.linalg.norm(radial)
    angles = np.linspace(0.0, 2.0 * np.pi, _SIDES + 1)
    circle = radius_m * (
        np.outer(np.cos(angles), radial) + np.outer(np.sin(angles), np.cross(axis, radial))
    )
    rings = [polyline(circle + begin_m + share * (end_m - begin_m)) for share in (0.0, 0.5, 1.0)]
    along = np.stack([circle[:-1:6] + begin_m, circle[:-1:6] + end_m], axis=1).astype(np.float32)
    return np.concatenate([*rings, along])


def sphere(radius_m: float) -> NDArray[np.float32]:
    """Return a sphere about the origin as circles of latitude and longitude (K, 2, 3)."""
    angles = np.linspace(0.0, 2.0 * np.pi, 2 * _SIDES + 1)
    flat = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    circles = []
    for latitude in np.radians([-45.0, 0.0, 45.0]):
        circles.append(flat * np.cos(latitude) + [0.0, 0.0, np.sin(latitude)])
    for longitude in np.radians(np.arange(0.0, 180.0, 45.0)):
        turn = np.array([-np.sin(longitude), np.cos(longitude)])
        circles.append(np.stack([flat[:, 0] * turn[0], flat[:, 0] * turn[1], flat[:, 1]], axis=1))
    return (radius_m * np.concatenate([polyline(c) for c in circles])).astype(np.float32)


def ring(radius_m: float) -> NDArray[np.float32]:
    """Return a circle about the origin in the plane z = 0 as segments (K, 2, 3)."""
    angles = np.linspace(0.0, 2.0 * np.pi, 4 * _SIDES + 1)
    flat = [np.cos(angles), np.sin(angles), np.zeros_like(angles)]
    return polyline(radius_m * np.stack(flat, axis=1))


def scale_of(reach_m: float) -> tuple[float, float]:
    """Return the radii of the two rings that show the scale: the largest of 1, 2, 5 times a power
    of ten up to ``reach_m``, and half of it.
    """
    power = 10.0 ** np.floor(np.log10(reach_m * (1.0 + 1e-9)))
    outer = float(max(n * power for n in (1.0, 2.0, 5.0) if n * power <= reach_m * (1.0 + 1e-9)))
    return 0.5 * outer, outer


def earth(direction: Array, radius_rad: float, to_sun: Array, reach_m: float) -> Mesh:
    """Return the Earth as seen from the origin: the visible cap of a sphere with sea and clouds,
    lit by the sun.

    ``direction``, ``to_sun`` (3,): of any length. ``radius_rad``: angular radius of its disc.
    ``reach_m``: size of the scene, outside which the cap lies.
    """
    axis = np.asarray(direction) / np.linalg.norm(direction)
    east = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    east /= np.linalg.norm(east)
    north = np.cross(axis, east)
    nearest_m = max(_NEAREST_EARTH_M, 2.0 * reach_m)
    distance_m = nearest_m / (1.0 - np.sin(radius_rad))
    rings, sides = _CAP
    # From below the viewer to the horizon, angles at the Earth's centre.
    theta = np.linspace(0.0, 0.5 * np.pi - radius_rad, rings)[:, None, None]
    phi = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)[None, :, None]
    normals = -axis * np.cos(theta) + np.sin(theta) * (east * np.cos(phi) + north * np.sin(phi))
    vertices = axis * distance_m + distance_m * np.sin(radius_rad) * normals

    ring_of, side = np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    beside = (side + 1) % sides
    a, b = ring_of * sides + side, ring_of * sides + beside
    halves = np.stack([np.stack([a, b + sides, a + sides]), np.stack([a, b, b + sides])])
    triangles = halves.transpose(0, 2, 3, 1).reshape(-1, 3)

    # Clouds are waves through space: noise on rings and sides would converge in the middle.
    noise = np.random.default_rng(0)
    waves = noise.standard_normal((_WAVES, 3)) * _WAVE_RAD / float(theta[-1, 0, 0])
    crests = np.sin(normals @ waves.T + noise.uniform(0.0, 2.0 * np.pi, _WAVES))
    share = np.clip(0.35 + 0.35 * crests.sum(axis=-1) / math.sqrt(_WAVES / 2), 0.0, 1.0)[..., None]
    albedo = (1.0 - share) * np.array(_SEA_RGB) + share * np.array(_CLOUD_RGB)
    sun = np.asarray(to_sun) / np.linalg.norm(to_sun)
    colours = albedo * np.maximum(_NIGHT, normals @ sun)[..., None]
    return Mesh(
        vertices.reshape(-1, 3), triangles.astype(np.int32), colours.reshape(-1, 3).astype(np.uint8)
    )


def corridor_of(scenario: FlightScenario, chaser: int) -> NDArray[np.float32] | None:
    """Return a chaser's approach corridor, TRF, as segments (K, 2, 3); None without one.

    With capture: the region allowed for its centre from the corridor's entry to the port, narrower
    in the final approach. Otherwise: the line from its nominal place to the docking distance, with
    the radius of the docking tolerance.
    """
    docking, port = scenario.docking, scenario.docking.port_of(chaser)
    if docking.kind == "capture":
        if port is None:
            return None
        reach_m = scenario.chaser.probe_reach_m
        entry, final, port_m = (
            centre_offset(port, reach_m, g) for g in (docking.entry_m, docking.final_m, 0.0)
        )
        return np.concatenate(
            [
                tube(entry, final, docking.corridor.lateral_m),
                tube(final, port_m, docking.final.lateral_m),
            ]
        )
    begin = np.array(scenario.chasers[chaser].position_m)
    distance_m = float(np.linalg.norm(begin))
    if distance_m <= scenario.approach.dock_distance_m or scenario.chooses_port(chaser):
        return None
    end = begin * scenario.approach.dock_distance_m / distance_m
    return tube(begin, end, scenario.approach.docked_position_m)
