# SPDX-License-Identifier: Apache-2.0
"""Choose where chasers are to dock on a mapped target, and keep these places on it while the map
improves. No I/O; TRF of the map, SI units.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property

import msgspec
import numpy as np
from chaserdock_models.arrays import Array, IntArray
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import ChosenPort, PortPlace
from chaserdock_protocol.scenario import FlightScenario

from .docking_site import (
    DockingSite,
    SiteLimits,
    judged_site,
    landmarks_near,
    plane_near,
    ring_site,
    site_on_ray,
)
from .rings import CircleSights, Ring, RingTuning, find_rings
from .surface import MappedSurface, SightLines, surface_of

_CELL_M = 0.06
"""Edge of the cells of which each offers one place to a search, m: half the radius of a place."""
_ANCHORS = 3
"""Landmarks near a port that two maps must share, so that it follows them."""
_MOST_CLEARANCE_M = 10.0
"""Clearance that is stated of a place in front of which there is nothing, m."""
_FULL_LANDMARKS = 20
"""Landmarks of a place beyond which more do not make it better: its normal is then known to a
fifth of that of one landmark."""
_FULL_IMAGES = 12
"""Images that show a ring beyond which more do not make it better: half a turn of two chasers."""
_AROUND_M = 0.06
"""Landmarks up to so far outside a ring carry its port along, m: its edge has none itself."""
_PROPOSALS = 3
"""Places that the answer to a search names."""


@dataclass(frozen=True, eq=False)
class MappedPoints:
    """Landmarks of a map: ``keys`` (n,), ascending, places (n, 3) with covariances (n, 3, 3), and
    lines of sight to them; the ellipses that cameras saw. Surface and rings are made when they are
    asked for.
    """

    keys: IntArray
    landmarks_m: Array
    covariances_m2: Array
    sights: SightLines
    circles: CircleSights = field(default_factory=CircleSights.none)

    @cached_property
    def surface(self) -> MappedSurface | None:
        """The surface; None of too few landmarks."""
        return surface_of(self.landmarks_m, self.covariances_m2, self.sights)

    @cached_property
    def rings(self) -> tuple[Ring, ...]:
        """The circles that several images confirm."""
        return find_rings(self.circles)


@dataclass(frozen=True)
class PortDecision:
    """Whether a place became a port, and the answer to who asked: its figures, or why not."""

    accepted: bool
    answer: str


@dataclass(frozen=True, eq=False)
class _Held:
    """A port with the keys (k,) and places (k, 3) of the landmarks near it, in the last map."""

    port: ChosenPort
    keys: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    landmarks_m: Array = field(default_factory=lambda: np.zeros((0, 3)))


class PortChooser:
    """Holds at most one port for each chaser. All methods may be called on any thread."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario = scenario
        self._limits = site_limits(scenario)
        self._held: dict[int, _Held] = {}
        self._points: MappedPoints | None = None
        self._chosen = 0
        self._lock = threading.Lock()

    def follow(self, points: MappedPoints) -> None:
        """Take a new map; the ports move with the landmarks near them."""
        with self._lock:
            self._points = points
            self._held = {i: _moved(held, points) for i, held in self._held.items()}

    def ports(self) -> tuple[ChosenPort, ...]:
        """Return the ports by the last map."""
        with self._lock:
            return tuple(held.port for _, held in sorted(self._held.items()))

    def decide(
        self, chaser: int, where: PortPlace, ray: tuple[Array, Array] | None
    ) -> PortDecision:
        """Judge a place by the last map; make it the chaser's port if nothing is against it.

        ``ray``: origin and direction (3,) of a line of sight, for a request by a pixel.
        """
        with self._lock:
            if reason := self._why_impossible(chaser):
                return PortDecision(False, reason)
            points = self._points
            surface = None if points is None else points.surface
            if points is None or surface is None:
                return PortDecision(False, "there is no surface: the map has too few landmarks")
            if where.find == "flat":
                judged = self._judged(_candidates(surface), points, surface)
                return self._best(chaser, judged, points)
            if where.find == "ring":
                return self._ring(chaser, where.radii_m, points, surface)
            if ray is not None:
                site = self._on_ray(ray, points, surface)
            else:
                assert where.point_m is not None
                site = self._nearest(np.array(where.point_m), points, surface)
            if site is None:
                return PortDecision(False, "the line of sight does not meet the target")
            return self._decided(chaser, site, points)

    def _why_impossible(self, chaser: int) -> str:
        """Return why this chaser cannot have a port at all; empty if it can."""
        scenario, count = self._scenario, len(self._scenario.chasers)
        if chaser >= count:
            return f"there is no chaser {chaser}; this mission has 0 to {count - 1}"
        distance_m, reach_m = scenario.approach.dock_distance_m, scenario.chaser.probe_reach_m
        if distance_m <= reach_m:
            return (
                f"approach.dock_distance_m ({distance_m:g} m) counts from the port; it must be "
                f"more than chaser.probe_reach_m ({reach_m:g} m)"
            )
        return ""

    def _on_ray(
        self, ray: tuple[Array, Array], points: MappedPoints, surface: MappedSurface
    ) -> DockingSite | None:
        return site_on_ray(*ray, surface, points.landmarks_m, points.covariances_m2, self._limits)

    def _nearest(self, at_m: Array, points: MappedPoints, surface: MappedSurface) -> DockingSite:
        """Judge the place of the surface that is nearest to a point, by the middles of faces."""
        face = int(np.argmin(np.linalg.norm(_middles(surface) - at_m, axis=1)))
        return self._judged([face], points, surface)[0]

    def _judged(
        self, faces: Iterable[int], points: MappedPoints, surface: MappedSurface
    ) -> list[DockingSite]:
        """Judge the middles of faces."""
        middles, normals = _middles(surface), surface.normals()
        known = surface, points.landmarks_m, points.covariances_m2, self._limits
        return [judged_site(middles[k], normals[k], *known, bool(surface.seen[k])) for k in faces]

    def _ring(
        self,
        chaser: int,
        radii_m: tuple[float, float] | None,
        points: MappedPoints,
        surface: MappedSurface,
    ) -> PortDecision:
        """Return the decision for the middle of the best ring, or why there is none."""
        sights, tuning = points.circles, RingTuning()
        if not points.rings:
            return PortDecision(
                False,
                f"no ring: {len(sights.image)} ellipses in {sights.images} images, none of them "
                f"the same circle in at least {tuning.least_images}; see it from nearer, or for "
                "longer",
            )
        low, high = radii_m or tuning.radii_m
        chosen = [r for r in points.rings if low <= r.radius_m <= high]
        if not chosen:
            known = ", ".join(f"{r.radius_m:.3f}" for r in points.rings)
            return PortDecision(
                False, f"no ring of {low:g} to {high:g} m; radii of those found: {known} m"
            )
        judged = [ring_site(r, surface, self._limits) for r in chosen]
        return self._best(chaser, judged, points)

    def _best(self, chaser: int, judged: list[DockingSite], points: MappedPoints) -> PortDecision:
        """Return the decision for the best place of a search; of rings, why none will do."""
        good = [s for s in judged if not self._why_not(chaser, s)]
        if not good:
            reasons = "".join(
                f"; {_figures(s)}: {', '.join(self._why_not(chaser, s))}"
                for s in judged[:_PROPOSALS]
                if s.ring is not None
            )
            return PortDecision(False, f"none of {len(judged)} places will do{reasons}")
        best = sorted(good, key=lambda s: -score(s, self._limits))[:_PROPOSALS]
        decision = self._decided(chaser, best[0], points)
        others = "; ".join(
            f"{_text(s.position_m)} m{_radius(s)}, score {score(s, self._limits):.2f}"
            for s in best[1:]
        )
        of = f"; {len(good)} of {len(judged)} places will do"
        return replace(decision, answer=decision.answer + of + (f", next: {others}" * bool(others)))

    def _decided(self, chaser: int, site: DockingSite, points: MappedPoints) -> PortDecision:
        figures = _figures(site)
        if why := self._why_not(chaser, site):
            return PortDecision(False, f"{'; '.join(why)}: {figures}")
        self._chosen += 1
        port = ChosenPort(
            chaser=chaser,
            number=self._chosen,
            position_m=vector(site.position_m),
            axis=vector(site.normal),
            axis_sigma_rad=site.normal_sigma_rad,
            flatness_m=site.flatness_m,
            clearance_m=_room_m(site),
            radius_m=None if site.ring is None else site.ring.radius_m,
        )
        self._held[chaser] = _anchored(port, points)
        return PortDecision(True, f"{figures}, score {score(site, self._limits):.2f}")

    def _why_not(self, chaser: int, site: DockingSite) -> tuple[str, ...]:
        """Return the reasons against a place for a chaser, those of reach included."""
        why, at, axis = list(site.why_not), site.position_m, site.normal
        if float(at @ axis) <= 0.0:
            why.append("it faces the middle of the target")
        least_m = self._scenario.limits.min_distance_chasers_m
        place = self._docked_m(at, axis)
        for other, held in self._held.items():
            there = self._docked_m(np.array(held.port.position_m), np.array(held.port.axis))
            apart_m = float(np.linalg.norm(place - there))
            if other != chaser and apart_m < least_m:
                why.append(
                    f"docked there, the chaser is {apart_m:.2f} m from chaser {other} at its port; "
                    f"at least {least_m:g} m"
                )
        return tuple(why)

    def _docked_m(self, at_m: Array, axis: Array) -> Array:
        return at_m + self._scenario.approach.dock_distance_m * axis


def site_limits(scenario: FlightScenario) -> SiteLimits:
    """Return what a place must offer to the chasers of a scenario.

    The corridor reaches from the docked chaser's front to where chasers keep their distance.
    """
    body = scenario.chaser.boxes()[0]
    length_m, width_m, height_m = body.size_m
    docked_m = scenario.approach.dock_distance_m
    return SiteLimits(
        corridor_m=max(docked_m, scenario.limits.min_distance_target_m),
        corridor_half_angle_rad=math.radians(scenario.docking.corridor_angle_deg),
        radius_m=math.hypot(width_m, height_m) / 2.0,
        reach_m=max(docked_m - length_m / 2.0, 0.0),
    )


def score(site: DockingSite, limits: SiteLimits) -> float:
    """Return how good a place is, 0 to 1: the product of what is left of the limits of flatness and
    normal, of the room beside the corridor and of the number of landmarks, as shares, and of the
    cosine between its normal and the direction away from the middle of the target. Of a ring it is
    the share of its edge that is seen, what is left of the limit of its residual, and the number of
    images instead of flatness and landmarks.
    """
    at = site.position_m
    outward = float(at @ site.normal) / max(float(np.linalg.norm(at)), 1e-9)
    ring = site.ring
    shares = (
        1.0 - site.normal_sigma_rad / limits.normal_rad,
        min(1.0, site.clearance_m / limits.radius_m),
        outward,
    )
    if ring is None:
        shares += (
            1.0 - site.flatness_m / limits.flatness_m,
            min(1.0, site.landmarks / _FULL_LANDMARKS),
        )
    else:
        shares += (
            1.0 - ring.residual_px / RingTuning().support_px,
            ring.coverage,
            min(1.0, ring.images / _FULL_IMAGES),
        )
    return float(np.prod([max(0.0, s) for s in shares]))


def _figures(site: DockingSite) -> str:
    """Return what an operator is told of a place."""
    figures = (
        f"({_text(site.position_m)}) m, normal ({_text(site.normal)}) within "
        f"{math.degrees(min(site.normal_sigma_rad, math.pi)):.2g} degrees, "
    )
    if site.ring is None:
        figures += f"{site.landmarks} landmarks"
        if math.isfinite(site.flatness_m):
            figures += f" {site.flatness_m * 1e3:.1f} mm (RMS) from their plane"
    else:
        figures = (
            f"ring{_radius(site)} about {figures}{site.ring.images} images, "
            f"{site.ring.residual_px:.1f} px (RMS), {100.0 * site.ring.coverage:.0f} % of its edge"
        )
    return f"{figures}, {_room_m(site):.2f} m of room beside the corridor"


def _room_m(site: DockingSite) -> float:
    return min(site.clearance_m, _MOST_CLEARANCE_M)


def _radius(site: DockingSite) -> str:
    return "" if site.ring is None else f" of radius {site.ring.radius_m:.3f} m"


def _middles(surface: MappedSurface) -> Array:
    return surface.vertices_m[surface.triangles].mean(axis=1)


def _candidates(surface: MappedSurface) -> list[int]:
    """Return faces that were seen, one whose middle is in each cell."""
    seen = np.flatnonzero(surface.seen)
    cells = np.floor(_middles(surface)[seen] / _CELL_M)
    return np.sort(seen[np.unique(cells, axis=0, return_index=True)[1]]).tolist()


def _anchored(port: ChosenPort, points: MappedPoints) -> _Held:
    around_m = {} if port.radius_m is None else {"radius_m": port.radius_m + _AROUND_M}
    near = landmarks_near(np.array(port.position_m), points.landmarks_m, **around_m)
    return _Held(port, points.keys[near], points.landmarks_m[near])


def _moved(held: _Held, points: MappedPoints) -> _Held:
    """Return a port in a new map: moved by the median of the landmarks near it, then into the plane
    of those that are near it now if that is as well known as the plane before. Once a chaser is
    near, it sees few of them, of which a plane turns by degrees. A ring keeps its normal.
    """
    port = held.port
    _, before, now = np.intersect1d(held.keys, points.keys, assume_unique=True, return_indices=True)
    at, axis = np.array(port.position_m), np.array(port.axis)
    if len(now) >= _ANCHORS:
        at = at + np.median(points.landmarks_m[now] - held.landmarks_m[before], axis=0)
    found = None
    if port.radius_m is None:
        found = plane_near(at, axis, points.landmarks_m, points.covariances_m2)
    if found is not None and found[0].normal_sigma_rad <= port.axis_sigma_rad:
        plane, near, _ = found
        at = at - float(plane.distances(at[None])[0]) * plane.normal
        changes = {
            "axis": vector(plane.normal),
            "axis_sigma_rad": plane.normal_sigma_rad,
            "flatness_m": float(np.sqrt(np.mean(plane.distances(near) ** 2))),
        }
    else:
        changes = {}
    return _anchored(msgspec.structs.replace(port, position_m=vector(at), **changes), points)


def _text(values: Array) -> str:
    return ", ".join(f"{v:.3f}" for v in values)
