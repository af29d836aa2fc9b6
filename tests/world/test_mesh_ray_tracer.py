# SPDX-License-Identifier: Apache-2.0
"""The mesh renderer against an independent ray tracer: brute force over all triangles, shadow rays,
no code in common but the mesh.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.camera import Camera
from chaserdock_models.meshes import TriangleMesh, TriangleSoup, triangle_soup
from chaserdock_models.satellites import satellite
from chaserdock_world.rendering.background import SPACE_LEVEL, WHITE_LEVEL, Light
from chaserdock_world.rendering.mesh_renderer import MeshRenderer

CAMERA = Camera(80, 60, 76.0, 76.0, 39.5, 29.5)
LIGHT = Light((-0.6, -0.5, 0.6), 0.8, 0.2)
SAMPLES = 4
CHUNK = 2000


def first_hits(origins: Array, directions: Array, corners: Array) -> tuple[IntArray, Array, Array]:
    """Return the nearest triangle hit by each ray (n,), -1 for none, its distance (n,), and
    barycentric coordinates (n, 2).

    T. Moeller, B. Trumbore, 1997.
    """
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    number, distance = np.full(len(origins), -1), np.full(len(origins), np.inf)
    where = np.zeros((len(origins), 2))
    for start in range(0, len(origins), CHUNK):
        o, d = origins[start : start + CHUNK, None], directions[start : start + CHUNK, None]
        p = np.cross(d, ac)
        det = np.einsum("ijk,jk->ij", p, ab)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = o - corners[:, 0]
            u = np.einsum("ijk,ijk->ij", s, p) / det
            q = np.cross(s, ab)
            v = np.einsum("ijk,ijk->ij", np.broadcast_to(d, q.shape), q) / det
            t = np.einsum("ijk,jk->ij", q, ac) / det
        hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 1e-7)
        t = np.where(hit, t, np.inf)
        best = np.argmin(t, axis=1)
        rows = np.arange(len(t))
        some = np.isfinite(t[rows, best])
        out = slice(start, start + CHUNK)
        number[out] = np.where(some, best, -1)
        distance[out] = t[rows, best]
        where[out] = np.stack([u[rows, best], v[rows, best]], axis=1)
    return number, distance, where


def ray_traced(mesh: TriangleMesh, position: Array, q_w_irf: Array) -> tuple[Array, Array]:
    """Return grey levels (h, w) and the number of different triangles (h, w) in each pixel, with
    SAMPLES squared rays a pixel.
    """
    soup = triangle_soup(mesh)
    at = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    y, x, j, i = np.meshgrid(
        np.arange(CAMERA.height_px), np.arange(CAMERA.width_px), at, at, indexing="ij"
    )
    rays = np.stack(
        [
            (x + i - CAMERA.cx_px) / CAMERA.fx_px,
            (y + j - CAMERA.cy_px) / CAMERA.fy_px,
            np.ones_like(x),
        ],
        axis=-1,
    ).reshape(-1, 3)
    rays = rotations.rotate(q_w_irf, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    low, high = mesh.bounds_m()
    centre, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    near = np.flatnonzero(np.linalg.norm(np.cross(rays, centre - position), axis=1) < radius)
    number = np.full(len(rays), -1)
    levels = np.full(len(rays), float(SPACE_LEVEL))
    hit, distance, where = first_hits(
        np.broadcast_to(position, (len(near), 3)), rays[near], soup.corners_m
    )
    number[near] = hit
    seen = hit >= 0
    points = position + distance[seen, None] * rays[near[seen]]
    levels[near[seen]] = _shaded(mesh, soup, hit[seen], where[seen], points)
    shape = (CAMERA.height_px, CAMERA.width_px, SAMPLES**2)
    number = np.sort(number.reshape(shape), axis=2)
    return levels.reshape(shape).mean(axis=2), 1 + (np.diff(number, axis=2) != 0).sum(axis=2)


def _shaded(
    mesh: TriangleMesh, soup: TriangleSoup, hit: IntArray, where: Array, points: Array
) -> Array:
    u, v = where[:, :1], where[:, 1:]
    corners, normals = soup.corners_m[hit], soup.normals[hit]
    normal = (1 - u - v) * normals[:, 0] + u * normals[:, 1] + v * normals[:, 2]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosine = normal @ LIGHT.direction_w
    lit = (cosine > 0.0) & (flat @ LIGHT.direction_w > 0.0)
    lifted = points[lit] + 1e-6 * flat[lit] / np.linalg.norm(flat[lit], axis=1, keepdims=True)
    blocked, _, _ = first_hits(
        lifted, np.broadcast_to(LIGHT.direction_w, lifted.shape), soup.corners_m
    )
    lit[lit] = blocked < 0
    diffuse = np.array([p.material.diffuse for p in mesh.parts])[soup.part[hit]]
    return WHITE_LEVEL * diffuse * (LIGHT.ambient + LIGHT.sun * np.where(lit, cosine, 0.0))


def looking_at_origin(position: Array) -> Array:
    z = -position / np.linalg.norm(position)
    x = np.cross(z, (0.0, 0.0, 1.0))
    x /= np.linalg.norm(x)
    return rotations.from_matrix(np.stack([x, np.cross(z, x), z], axis=1))


@pytest.mark.slow
def test_images_equal_those_of_a_ray_tracer() -> None:
    """Grey levels inside surfaces, and the whole image with its silhouettes and shadow edges."""
    mesh = satellite("cubesat_12u", 2e-2)
    matt = tuple(
        replace(p, material=replace(p.material, specular=0.0, texture="")) for p in mesh.parts
    )  # its highlights and textures have tests of their own
    mesh = replace(mesh, parts=matt)
    position = np.array([-0.55, -0.4, 0.3])
    q = looking_at_origin(position)
    expected, surfaces = ray_traced(mesh, position, q)
    image = (
        MeshRenderer(CAMERA, mesh)
        .render(position, q, np.zeros(3), (1.0, 0.0, 0.0, 0.0), light=LIGHT)
        .astype(float)
    )
    inside = (surfaces == 1) & (expected > SPACE_LEVEL + 0.5)
    assert inside.sum() > 500
    difference = np.abs(image - expected)
    print(
        f"inside {difference[inside].mean():.2f}, all of the body "
        f"{difference[expected > SPACE_LEVEL + 0.5].mean():.2f} grey levels"
    )
    assert difference[inside].mean() < 1.5
    body = expected > SPACE_LEVEL + 0.5
    assert difference[body].mean() < 3.0
    assert (difference[body] > 40.0).mean() < 0.01
    # Shadows matter: the same surface is lit at one place and not at another.
    ambient = (
        np.abs(
            expected[inside, None]
            - WHITE_LEVEL * LIGHT.ambient * np.unique([p.material.diffuse for p in matt])
        )
        < 0.1
    )
    assert 30 < ambient.any(axis=1).sum() < inside.sum() - 30
