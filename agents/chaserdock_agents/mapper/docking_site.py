# SPDX-License-Identifier: Apache-2.0
"""Judge a place on a mapped target as a place to dock: position, normal, and why not.

Pure functions; TRF, SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array
from numpy.typing import NDArray

from .rings import Ring
from .surface import MappedSurface, met_triangles

_RADIUS_M = 0.12
"""Landmarks so far from a place make its plane, m: the radius of an adapter ring of a small
satellite, and the diameter of a probe's head with its lateral error."""
_LEAST_LANDMARKS = 6
"""Landmarks that a plane needs: twice its unknowns."""
_OUTLIER_SIGMAS = 3.0
"""Landmarks farther from the plane than this, in standard deviations of their own, are left out
once: points beside the place on something else."""
_PLANE_SHARE = 0.8
"""Share of the landmarks near a place that must lie in its plane."""


@dataclass(frozen=True)
class SiteLimits:
    """What a place must offer.

    ``flatness_m``: greatest RMS distance of its landmarks from their plane. ``normal_rad``:
    greatest standard deviation of its normal. ``corridor_m``, ``corridor_half_angle_rad``: length
    and half angle of the cone in front of it that must be free. ``radius_m``: of the chaser's body
    about its axis, at ``reach_m`` before the place.
    """

    flatness_m: float = 0.01
    normal_rad: float = math.radians(2.0)
    corridor_m: float = 0.8
    corridor_half_angle_rad: float = math.radians(15.0)
    radius_m: float = 0.2
    reach_m: float = 0.3


@dataclass(frozen=True, eq=False)
class DockingSite:
    """A place to dock: its centre (3,), outward unit normal (3,), standard deviations along and of
    the normal, RMS distance of ``landmarks`` landmarks from their plane, and the least distance of
    the surface from the axis of approach beyond what the chaser needs. Of the middle of a ``ring``
    the plane is that of its edge, and ``landmarks`` is 0.

    ``why_not``: reasons against it; empty for a place that will do.
    """

    position_m: Array
    normal: Array
    sigma_m: float
    normal_sigma_rad: float
    flatness_m: float
    landmarks: int
    clearance_m: float
    why_not: tuple[str, ...]
    ring: Ring | None = None


def site_on_ray(
    origin_m: Array,
    direction: Array,
    surface: MappedSurface,
    landmarks_m: Array,
    covariances_m2: Array,
    limits: SiteLimits,
) -> DockingSite | None:
    """Return the place where a line of sight from ``origin_m`` (3,) along ``direction`` (3,) meets
    the surface, judged; None if it does not meet it.

    ``landmarks_m`` (n, 3) with ``covariances_m2`` (n, 3, 3): of the map.
    """
    faces, far = met_triangles(origin_m, direction, surface.vertices_m[surface.triangles])
    if not len(faces):
        return None
    nearest = int(np.argmin(far))
    at = origin_m + far[nearest] * direction
    face_normal = surface.normals()[faces[nearest]]
    towards = -direction / np.linalg.norm(direction)
    return judged_site(
        at,
        face_normal if float(face_normal @ towards) > 0.0 else towards,
        surface,
        landmarks_m,
        covariances_m2,
        limits,
        bool(surface.seen[faces[nearest]]),
    )


def judged_site(
    at_m: Array,
    outward: Array,
    surface: MappedSurface,
    landmarks_m: Array,
    covariances_m2: Array,
    limits: SiteLimits,
    seen: bool = True,
) -> DockingSite:
    """Judge a place (3,) of which ``outward`` (3,) says roughly where outside is."""
    why: list[str] = [] if seen else ["no camera has seen it from outside"]
    found = plane_near(at_m, outward, landmarks_m, covariances_m2)
    if found is None:
        count = int(landmarks_near(at_m, landmarks_m).sum())
        why.append(
            f"{count} landmarks within {_RADIUS_M * 1e2:.0f} cm, at least {_LEAST_LANDMARKS}"
        )
        normal = outward / np.linalg.norm(outward)
        clear_m = _clearance(at_m, normal, surface, limits)
        return DockingSite(at_m, normal, math.inf, math.inf, math.inf, count, clear_m, tuple(why))
    plane, points, off_plane = found
    if off_plane > (1.0 - _PLANE_SHARE) * len(points):
        within = f"{len(points) - off_plane} of {len(points)}"
        why.append(f"not flat: {within} landmarks lie in one plane")
    off = plane.distances(points)
    flatness_m = float(np.sqrt(np.mean(off**2)))
    position = at_m - float(plane.distances(at_m[None])[0]) * plane.normal
    clear_m = _clearance(position, plane.normal, surface, limits)
    if flatness_m > limits.flatness_m:
        why.append(
            f"not flat: its landmarks are {flatness_m * 1e3:.0f} mm (RMS) from their plane, "
            f"at most {limits.flatness_m * 1e3:.0f} mm"
        )
    why += _why_unreached(plane.normal_sigma_rad, clear_m, limits)
    return DockingSite(
        position,
        plane.normal,
        plane.sigma_m,
        plane.normal_sigma_rad,
        flatness_m,
        len(points),
        clear_m,
        tuple(why),
    )


def ring_site(ring: Ring, surface: MappedSurface, limits: SiteLimits) -> DockingSite:
    """Judge the middle of a ring as a place to dock."""
    clear_m = _clearance(ring.centre_m, ring.normal, surface, limits)
    return DockingSite(
        ring.centre_m,
        ring.normal,
        ring.sigma_m,
        ring.normal_sigma_rad,
        ring.residual_m,
        0,
        clear_m,
        tuple(_why_unreached(ring.normal_sigma_rad, clear_m, limits)),
        ring,
    )


def _why_unreached(normal_sigma_rad: float, clear_m: float, limits: SiteLimits) -> list[str]:
    """Return the reasons of the normal and of the room in front of a place against it."""
    why = []
    if normal_sigma_rad > limits.normal_rad:
        why.append(
            f"normal known to {math.degrees(normal_sigma_rad):.1f} degrees, "
            f"at most {math.degrees(limits.normal_rad):.1f}: see it from nearer or from aside"
        )
    if clear_m < 0.0:
        why.append(f"the surface is {-clear_m * 1e3:.0f} mm within the corridor of approach")
    return why


def landmarks_near(
    at_m: Array, landmarks_m: Array, radius_m: float = _RADIUS_M
) -> NDArray[np.bool_]:
    """Return which landmarks (n, 3) are near a place (3,), (n,): those that make its plane."""
    return np.linalg.norm(landmarks_m - at_m, axis=1) <= radius_m


def plane_near(
    at_m: Array, outward: Array, landmarks_m: Array, covariances_m2: Array
) -> tuple[SitePlane, Array, int] | None:
    """Return the plane of the landmarks near a place (3,), the landmarks (k, 3) that make it, and
    how many of these are not in it; None if too few are near.
    """
    near = landmarks_near(at_m, landmarks_m)
    points, covariances = landmarks_m[near], covariances_m2[near]
    if len(points) < _LEAST_LANDMARKS:
        return None
    plane = SitePlane.through(points, covariances, outward)
    off = np.abs(plane.distances(points))
    kept = off <= np.maximum(_OUTLIER_SIGMAS * plane.sigmas(covariances), 1e-3)
    if _PLANE_SHARE * len(points) <= kept.sum() < len(points):
        plane = SitePlane.through(points[kept], covariances[kept], outward)
        return plane, points[kept], 0
    return plane, points, int((~kept).sum())


@dataclass(frozen=True, eq=False)
class SitePlane:
    """A plane through a centre (3,) with a unit normal (3,), and the accuracy of both."""

    centre_m: Array
    normal: Array
    sigma_m: float
    normal_sigma_rad: float

    @classmethod
    def through(cls, points: Array, covariances: Array, outward: Array) -> SitePlane:
        """Return the plane nearest to points (n, 3), weighted by their covariances (n, 3, 3).

        The normal is that of the least spread; its standard deviation is the larger of the two
        about the axes in the plane, from the points' own or, if larger, from how they scatter.
        """
        weights = 1.0 / np.trace(covariances, axis1=1, axis2=2)
        weights /= weights.sum()
        centre = weights @ points
        off = points - centre
        _, axes = np.linalg.eigh(np.einsum("i,ij,ik->jk", weights, off, off))
        normal = axes[:, 0] if float(axes[:, 0] @ outward) > 0.0 else -axes[:, 0]
        own = np.einsum("j,ijk,k->i", normal, covariances, normal)
        scatter = np.sum((off @ normal) ** 2) / max(1, len(points) - 3)
        variance = max(float(np.mean(own)), float(scatter))
        across = float(np.sum((off @ axes[:, 1]) ** 2))  # the narrower direction in the plane
        return cls(
            centre,
            normal,
            math.sqrt(variance / len(points)),
            math.sqrt(variance / across) if across > 0.0 else math.inf,
        )

    def distances(self, points: Array) -> Array:
        """Return the signed distances of points (n, 3) from the plane, positive outside."""
        return (points - self.centre_m) @ self.normal

    def sigmas(self, covariances: Array) -> Array:
        """Return the standard deviations of points along the normal, (n,)."""
        return np.sqrt(np.einsum("j,ijk,k->i", self.normal, covariances, self.normal))


def _clearance(at_m: Array, normal: Array, surface: MappedSurface, limits: SiteLimits) -> float:
    """Return the least distance (m) of the surface from the space that an approach needs.

    That is a cylinder of the chaser's radius from ``reach_m`` before the place on, which widens by
    the corridor's half angle, over the corridor's length. Points of the surface within the reach
    are beside the probe and do not count.
    """
    off = surface.dense_m - at_m
    ahead = off @ normal
    aside = np.linalg.norm(off - ahead[:, None] * normal, axis=1)
    inside = (ahead > limits.reach_m) & (ahead < limits.reach_m + limits.corridor_m)
    if not inside.any():
        return math.inf
    needed = limits.radius_m + (ahead - limits.reach_m) * math.tan(limits.corridor_half_angle_rad)
    return float((aside - needed)[inside].min())
