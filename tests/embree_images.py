# SPDX-License-Identifier: Apache-2.0
"""Images of a mesh by Embree, an independent ray tracer, and the comparison of the world's
renderers with them.

Light as of the renderer: Lambert, Blinn's highlight, hard shadows of the sun. Textures are left
out. Each pixel has ``samples`` squared rays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.camera import Camera
from chaserdock_models.meshes import Material, TriangleMesh, triangle_soup
from chaserdock_world.rendering.background import SPACE_LEVEL, WHITE_LEVEL, Light
from chaserdock_world.rendering.mesh_renderer import MeshRenderer
from embreex.mesh_construction import TriangleMesh as EmbreeMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

BLOCK_PX = 12
_LEAST_EDGE_PX = 6.0


@dataclass(frozen=True)
class RayTraced:
    """By pixel (h, w): grey ``level``, ``covered`` share, ``sunlit`` share of the covered part,
    levels ``lit`` and ``dark`` with and without sun, and whether all rays of the pixel and of its
    neighbours hit one smooth part (``inside``)."""

    level: Array
    covered: Array
    sunlit: Array
    lit: Array
    dark: Array
    inside: Mask


def plain(mesh: TriangleMesh, material: Material | None = None) -> TriangleMesh:
    """Return a mesh without textures, or of one material."""
    return replace(
        mesh,
        parts=tuple(
            replace(p, material=material or replace(p.material, texture="")) for p in mesh.parts
        ),
    )


def trace(
    mesh: TriangleMesh, camera: Camera, position: Array, q: Array, light: Light, samples: int
) -> RayTraced:
    """Return the image of a mesh at a pose in the camera's frame."""
    soup = triangle_soup(mesh)
    corners = rotations.rotate(q, soup.corners_m) + position
    normals = rotations.rotate(q, soup.normals)
    scene = EmbreeScene()
    EmbreeMesh(scene, corners.astype(np.float32))
    h, w = camera.height_px, camera.width_px
    sums = np.zeros((6, h, w))
    first, same = np.zeros((h, w), dtype=np.int64), np.ones((h, w), dtype=bool)
    # No ray outside of this cone hits.
    radius_m, distance_m = np.linalg.norm(soup.corners_m, axis=-1).max(), np.linalg.norm(position)
    widest = np.arcsin(min(radius_m / distance_m, 1.0)) + 2.0 / camera.fx_px
    y, x = (axis.ravel() for axis in np.mgrid[0:h, 0:w].astype(float))
    centres = np.stack(
        [(x - camera.cx_px) / camera.fx_px, (y - camera.cy_px) / camera.fy_px, np.ones_like(x)],
        axis=-1,
    )
    cosines = centres @ position / distance_m / np.linalg.norm(centres, axis=1)
    near = np.flatnonzero(cosines > np.cos(widest))
    x, y = x[near], y[near]
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    surfaces = np.array(
        [(p.material.diffuse, p.material.specular, p.material.shininess) for p in mesh.parts]
    )
    for number, (j, i) in enumerate((j, i) for j in steps for i in steps):
        rays = np.stack(
            [
                (x + i - camera.cx_px) / camera.fx_px,
                (y + j - camera.cy_px) / camera.fy_px,
                np.ones_like(x),
            ],
            axis=-1,
        )
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        hit = scene.run(np.zeros_like(rays, dtype=np.float32), rays.astype(np.float32), output=1)
        hits = np.flatnonzero(hit["primID"] >= 0)
        lit, dark, sunlit = _shade(
            scene, hit, hits, rays[hits], corners, normals, soup.part, surfaces, light
        )
        seen = near[hits]
        part = np.full(h * w, -1)
        part[seen] = soup.part[hit["primID"][hits]]
        level = np.full(h * w, float(SPACE_LEVEL))
        level[seen] = np.where(sunlit, lit, dark)
        for k, values in enumerate((level[seen], np.ones(len(seen)), sunlit, lit, dark)):
            sums[k].reshape(-1)[seen] += values
        sums[5] += level.reshape(h, w)
        part = part.reshape(h, w)
        first = part if number == 0 else first
        same &= part == first
    n, covered = samples**2, np.maximum(sums[1], 1)
    return RayTraced(
        sums[5] / n,
        sums[1] / n,
        sums[2] / covered,
        sums[3] / covered,
        sums[4] / covered,
        _inside(first, same),
    )


def _inside(part: IntArray, same: Mask) -> Mask:
    """Return the pixels that one part covers alone, as it does their neighbours."""
    inside = same & (part >= 0)
    for axis in (0, 1):
        for step in (-1, 1):
            inside &= (np.roll(part, step, axis) == part) & np.roll(same, step, axis)
    return inside


def _shade(
    scene: EmbreeScene, hit: dict[str, Any], seen: IntArray, rays: Array, corners: Array,
    normals: Array, parts: IntArray,
    surfaces: Array, light: Light,
) -> tuple[Array, Array, Mask]:  # fmt: skip
    """Return the levels with and without sun, and whether the sun shines, of rays that hit."""
    triangle = hit["primID"][seen]
    u, v = hit["u"][seen, None].astype(float), hit["v"][seen, None].astype(float)
    mix = np.stack([1 - u - v, u, v], axis=1)
    normal = (normals[triangle] * mix).sum(axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    points = (corners[triangle] * mix).sum(axis=1)
    flat = np.cross(
        corners[triangle, 1] - corners[triangle, 0], corners[triangle, 2] - corners[triangle, 0]
    )
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    sun = light.direction_w
    cosine = normal @ sun
    faces = (cosine > 0.0) & (flat @ sun > 0.0)
    towards = np.broadcast_to(sun, points.shape).astype(np.float32)
    blocked = scene.run((points + 5e-5 * flat).astype(np.float32), towards, output=1)["primID"] >= 0
    diffuse, specular, shininess = surfaces[parts[triangle]].T
    half = sun - rays
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    gloss = np.maximum((normal * half).sum(axis=1), 0.0) ** np.floor(shininess)
    dark = WHITE_LEVEL * light.ambient * diffuse
    lit = dark + np.where(
        faces, WHITE_LEVEL * light.sun * (diffuse * cosine + specular * gloss), 0.0
    )
    return np.minimum(lit, 255.0), dark, faces & ~blocked


def draw(mesh: TriangleMesh, camera: Camera, position: Array, q: Array, light: Light) -> Array:
    """Return the image by the world's renderer of meshes, in floating point."""
    return (
        MeshRenderer(camera, mesh)
        .render(np.zeros(3), rotations.IDENTITY, position, q, (), light)
        .astype(float)
    )


def compare(
    mesh: TriangleMesh,
    camera: Camera,
    position: Array,
    q: Array,
    light: Light,
    samples: int,
    draw: Callable[[TriangleMesh, Camera, Array, Array, Light], Array] = draw,
) -> tuple[float, Array, Array]:
    """Return the mean grey-level error inside surfaces, and the displacements, px, of silhouettes
    and shadow edges by block.
    """
    mesh = plain(mesh)
    traced = trace(mesh, camera, position, q, light, samples)
    image = draw(mesh, camera, position, q, light)
    grey = float(np.abs(image - traced.level)[traced.inside].mean())
    white = plain(mesh, Material("white", 1.0))
    flat = draw(white, camera, position, q, Light((0.0, 0.0, -1.0), 0.0, 1.0))
    body = dilated(traced.covered > 0.0)
    covered = np.where(body, (flat - SPACE_LEVEL) / (WHITE_LEVEL - SPACE_LEVEL), 0.0)
    silhouette = displacements(covered, traced.covered, np.ones_like(body))
    contrast = traced.lit - traced.dark
    usable = traced.inside & (contrast > 15.0)
    share = np.where(usable, (image - traced.dark) / np.where(usable, contrast, 1.0), 0.0)
    return grey, silhouette, displacements(share, np.where(usable, traced.sunlit, 0.0), usable)


def dilated(mask: Mask) -> Mask:
    """Return a mask grown by two pixels, which leaves out the stars."""
    grown = mask.copy()
    for _ in range(2):
        grown = (
            grown
            | np.roll(grown, 1, 0)
            | np.roll(grown, -1, 0)
            | np.roll(grown, 1, 1)
            | np.roll(grown, -1, 1)
        )
    return grown


def displacements(drawn: Array, traced: Array, valid: Mask) -> Array:
    """Return the mean displacement, px, of the edges in each block: excess area over length of
    edge.

    ``drawn`` and ``traced`` (h, w): shares, 0 to 1; pixels that are not ``valid``, and blocks with
    little edge, do not count.
    """
    dy, dx = np.zeros_like(traced), np.zeros_like(traced)
    dx[:, 1:-1], dy[1:-1] = (traced[:, 2:] - traced[:, :-2]) / 2, (traced[2:] - traced[:-2]) / 2
    wide = (
        valid
        & np.roll(valid, 1, 0)
        & np.roll(valid, -1, 0)
        & np.roll(valid, 1, 1)
        & np.roll(valid, -1, 1)
    )
    length = np.where(wide, np.hypot(dx, dy), 0.0)
    excess = np.where(wide, drawn - traced, 0.0)
    rows, columns = (n // BLOCK_PX * BLOCK_PX for n in traced.shape)

    def by_block(values: Array) -> Array:
        return (
            values[:rows, :columns]
            .reshape(rows // BLOCK_PX, BLOCK_PX, columns // BLOCK_PX, BLOCK_PX)
            .sum(axis=(1, 3))
            .ravel()
        )

    lengths, areas = by_block(length), by_block(excess)
    return areas[lengths > _LEAST_EDGE_PX] / lengths[lengths > _LEAST_EDGE_PX]
