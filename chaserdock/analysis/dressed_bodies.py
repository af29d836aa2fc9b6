# SPDX-License-Identifier: Apache-2.0
"""Bodies of a scenario as coloured meshes for films, replay and viewer: target with foil, cells and
markers, chasers as satellites with their numbers.

Shapes claim no more than the scenario states. A chaser without a mesh is a dressed cuboid: rails,
foil, cells and paint within its stated size; its thrusters at their stated places, on thin struts
where these are outside of the cuboid; probe and lens at theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, Vector3
from chaserdock_models.meshes import (
    Material,
    MeshPart,
    Texture,
    TriangleMesh,
    TriangleSoup,
    moved,
    triangle_soup,
)
from chaserdock_models.satellites import box, lathe, satellite
from chaserdock_models.targets import Box, Marker, TargetModel, face_extent, face_rotation
from chaserdock_protocol.scenario import FlightScenario
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from .plots import colour

Rgb = tuple[float, float, float]

_LIFT_M = 4e-4
"""Distance (m) between paint and what it is painted on: the depth buffer tells them apart, an eye
does not."""
_TOLERANCE_M = 1e-3
"""Largest distance (m) of facets from surfaces of revolution: under a pixel in films."""
_NOZZLE_M = (0.004, 0.010, 0.018)
"""Radius of throat and exit, and length (m), of drawn nozzles: those of 1 N cold gas thrusters."""
_STRUT_M = 0.004
"""Radius (m) of the strut to a thruster outside of the cuboid: thin, because nothing states it."""
_RAIL_SHARE, _INSET_SHARE = 0.045, 0.02
"""Width of the rails at a cuboid's edges, and depth of the walls between them, of the shortest
edge."""
_LENS_M = 0.022
"""Radius (m) of the painted lens: that of a small star tracker's."""
_DIGIT_ROWS = 28
"""Rows of the bitmap that a number is painted from: edges finer than a pixel of the film."""
AMBIENT = 0.22
"""Share of ambient light: less than in the cameras' images, so that shadows are dark, but the
shaded side is visible."""
GAMMA = 0.6
"""Exponent of the grey levels for display, as in snapshots."""


@dataclass(frozen=True)
class Coat:
    """How a surface looks: reflectances (red, green, blue), 0 to 1. ``specular``: of its highlight
    with Blinn's ``exponent``. ``metal``: reflects its surroundings in its own colour.
    """

    rgb: Rgb
    specular: Rgb = (0.0, 0.0, 0.0)
    exponent: float = 20.0
    texture: Texture = ""
    metal: bool = False


FOIL = Coat((0.52, 0.33, 0.09), (0.60, 0.42, 0.16), 25.0, "insulation", metal=True)
CELLS = Coat((0.03, 0.06, 0.22), (0.25, 0.27, 0.32), 60.0, "cells")
WHITE = Coat((0.80, 0.80, 0.78))
BLACK = Coat((0.05, 0.05, 0.055))
METAL = Coat((0.36, 0.37, 0.39), (0.40, 0.40, 0.42), 35.0, metal=True)
NOZZLE = Coat((0.16, 0.15, 0.15), (0.25, 0.24, 0.22), 18.0, metal=True)
LENS = Coat((0.02, 0.02, 0.05), (0.5, 0.5, 0.6), 90.0)
PAPER, INK = Coat((0.90, 0.90, 0.90)), Coat((0.04, 0.04, 0.04))
"""Coats of the white and of the black of markers."""

_COATS = {
    "insulation": FOIL,
    "cells": CELLS,
    "structure": Coat((0.60, 0.60, 0.58), (0.1, 0.1, 0.1), 12.0),
    "white paint": WHITE,
    "bare metal": METAL,
    "nozzle": NOZZLE,
    "black paint": BLACK,
}
"""Coats of the shipped satellites' materials, by name."""


def coat_of(material: Material) -> Coat:
    """Return the coat of a material; grey for one that is not of a shipped satellite."""
    return _COATS.get(material.name, grey_coat(material))


def grey_coat(material: Material) -> Coat:
    """Return the coat of a material with the grey reflectances of the cameras' images."""
    d, s = material.diffuse, material.specular
    known = _COATS.get(material.name)
    metal = known is not None and known.metal
    return Coat((d, d, d), (s, s, s), material.shininess, material.texture, metal)


@dataclass
class DressedBody:
    """A body in its own axes: parts of a mesh, each with a coat."""

    parts: list[tuple[MeshPart, Coat]] = field(default_factory=list)

    def add(self, coat: Coat, *parts: MeshPart) -> None:
        self.parts += [(part, coat) for part in parts]

    def add_quads(self, coat: Coat, quads: Iterable[Array], lift_m: float) -> None:
        """Add flat quadrangles (4, 3), counter-clockwise from outside, lifted off their surface."""
        corners = [np.asarray(q) for q in quads]
        if not corners:
            return
        lifted = []
        for quad in corners:
            normal = np.cross(quad[1] - quad[0], quad[2] - quad[0])
            lifted.append(quad + lift_m * normal / max(float(np.linalg.norm(normal)), 1e-12))
        first = 4 * np.arange(len(corners))[:, None]
        triangles = np.concatenate([first + np.array(k) for k in ((0, 1, 2), (0, 2, 3))])
        material = Material("paint", coat.rgb[1])
        self.add(coat, MeshPart("paint", material, np.concatenate(lifted), triangles))

    def mesh(self, channel: int) -> TriangleMesh:
        """Return the body as one colour channel sees it: 0 red, 1 green, 2 blue."""
        parts = []
        for part, coat in self.parts:
            surface = Material(
                "coat", coat.rgb[channel], coat.specular[channel], coat.exponent, coat.texture
            )
            parts.append(replace(part, material=surface))
        return TriangleMesh("channel", tuple(parts), {})

    def surfaces(self) -> dict[Coat, TriangleSoup]:
        """Return the triangles of each coat."""
        coats: dict[Coat, list[MeshPart]] = {}
        for part, coat in self.parts:
            coats.setdefault(coat, []).append(part)
        return {
            coat: triangle_soup(TriangleMesh("coat", tuple(parts), {}))
            for coat, parts in coats.items()
        }

    def white(self) -> TriangleMesh:
        """Return the body all white, which shows what it covers."""
        parts = [replace(part, material=Material("white", 1.0)) for part, _ in self.parts]
        return TriangleMesh("white", tuple(parts), {})


def target_body(scenario: FlightScenario) -> DressedBody:
    """Return the target: its mesh, or its boxes in foil with their markers; and its ports."""
    body, mesh = DressedBody(), scenario.target.nominal_mesh()
    if mesh is not None:
        for part in mesh.parts:
            body.add(coat_of(part.material), part)
        return body
    model = scenario.target_model()
    for shape in model.boxes:
        body.add(FOIL, _cuboid("box", shape))
    add_markers(body, model, PAPER, INK, _LIFT_M)
    for port in scenario.docking.ports:
        radius_m = scenario.docking.tolerances.lateral_m
        rings = ((radius_m, METAL, 4), (0.6 * radius_m, BLACK, 5))
        for radius, coat, layer in rings:
            quads = _disc(np.array(port.position_m), np.array(port.axis), radius)
            body.add_quads(coat, quads, layer * _LIFT_M)
    return body


def tint(chaser: int) -> Array:
    """Return a chaser's colour (3,), BGR, 0 to 255: that of the figures, lightened for the dark
    background.
    """
    rgb = np.array(to_rgb(colour(chaser)))
    return (255.0 * (0.78 * rgb + 0.22))[::-1]


def chaser_body(scenario: FlightScenario, number: int) -> DressedBody:
    """Return a chaser in its colour, its number painted on."""
    own, body = scenario.chaser, DressedBody()
    blue, green, red = (0.85 * (tint(number) / 255.0) ** 1.6).tolist()  # as paint
    coloured = Coat((red, green, blue), (0.08, 0.08, 0.08), 15.0)
    if own.mesh:
        shape = satellite(own.mesh)
        low, high = shape.bounds_m()
        shape = moved(shape, np.zeros(3), np.array(own.size_m) / (high - low))
        for part in shape.parts:
            coat = coat_of(part.material)
            body.add(coloured if part.name.startswith(("deck", "pod")) else coat, part)
    else:
        _dress(body, own.size_m, coloured)
    faces = (5,) if own.mesh else (1, 4, 5)
    share = 0.5 if own.mesh else 0.6
    inset_m = 0.0 if own.mesh else _INSET_SHARE * min(own.size_m)
    for face in faces:
        _paint_number(body, own.size_m, face, str(number), share, inset_m, coloured)

    front_m = own.size_m[0] / 2.0
    if own.probe_reach_m > front_m:
        length_m = own.probe_reach_m - front_m
        forward: Vector3 = (1.0, 0.0, 0.0)
        rod = ((0.0, 0.0), (0.006, 0.0), (0.006, length_m - 0.012), (0.0, length_m))
        body.add(METAL, lathe("probe", _PLAIN, rod, (front_m, 0.0, 0.0), forward, _TOLERANCE_M))
    camera = scenario.camera_model()
    axis = rotations.rotate(camera.q_crf_irf_wxyz, (0.0, 0.0, 1.0))
    at = np.array(camera.position_crf_m)
    if axis[0] > 0.9 and abs(at[1]) < own.size_m[1] / 2.0 and abs(at[2]) < own.size_m[2] / 2.0:
        place = np.array([front_m - inset_m, at[1], at[2]])
        for radius, coat, layer in ((_LENS_M, BLACK, 3), (0.7 * _LENS_M, LENS, 4)):
            body.add_quads(coat, _disc(place, np.array([1.0, 0.0, 0.0]), radius), layer * _LIFT_M)
    if own.actuation == "thrusters":
        _add_thrusters(body, scenario)
    return body


_PLAIN = Material("plain")


def _cuboid(name: str, shape: Box) -> MeshPart:
    part = box(name, _PLAIN, shape.size_m, (0.0, 0.0, 0.0))
    at = rotations.rotate(shape.q_wxyz, part.vertices_m) + shape.position_m
    return replace(part, vertices_m=at)


def _dress(body: DressedBody, size_m: Vector3, coloured: Coat) -> None:
    """Add a cuboid's bus, walls and rails, all within its size."""
    size, rail_m, inset_m = np.array(size_m), _RAIL_SHARE * min(size_m), _INSET_SHARE * min(size_m)
    x, y, z = (size - 2.0 * inset_m).tolist()
    body.add(FOIL, box("bus", _PLAIN, (x, y, z), (0.0, 0.0, 0.0)))
    rails = []
    for axis in range(3):
        a, b = (k for k in range(3) if k != axis)
        for sa in (-1.0, 1.0):
            for sb in (-1.0, 1.0):
                extent, centre = np.full(3, rail_m), np.zeros(3)
                extent[axis] = size[axis]
                centre[a], centre[b] = (0.5 * (size[[a, b]] - rail_m) * (sa, sb)).tolist()
                rails.append(box("rail", _PLAIN, _vector(extent), _vector(centre)))
    body.add(coloured, *rails)
    for face in (2, 3, 4, 5):  # cells on the sides; foil before and behind
        body.add_quads(CELLS, [_face_quad(size_m, face, 0.8, 0.8, inset_m)], _LIFT_M)


def _vector(values: Array) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z


def _face_quad(size_m: Vector3, face: int, width: float, height: float, inset_m: float) -> Array:
    """Return the middle part (4, 3) of a cuboid's face: shares of its width and height."""
    return _on_face(size_m, face, inset_m)(
        np.array([[-width, height], [-width, -height], [width, -height], [width, height]])
    )


def _on_face(size_m: Vector3, face: int, inset_m: float) -> Callable[[Array], Array]:
    """Return a function from shares (N, 2) of half the face, right and up, to points (N, 3)."""
    q = face_rotation(face)
    right, up, out = face_extent(size_m, face)

    def place(shares: Array) -> Array:
        flat = np.column_stack([shares * (right / 2.0, up / 2.0), np.full(len(shares), out)])
        flat[:, 2] -= inset_m
        return rotations.rotate(q, flat)

    return place


def _paint_number(
    body: DressedBody,
    size_m: Vector3,
    face: int,
    text: str,
    share: float,
    inset_m: float,
    coloured: Coat,
) -> None:
    """Add a plate in the chaser's colour with its number in white to the middle of a face."""
    right, up, _ = face_extent(size_m, face)
    side_m = share * min(right, up)
    width, height = side_m * (0.5 + 0.5 * len(text)) / right, side_m / up
    body.add_quads(coloured, [_face_quad(size_m, face, width, height, inset_m)], 2 * _LIFT_M)
    (w, h), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 3)
    bitmap = np.zeros((h + base + 8, w + 8), np.uint8)
    cv2.putText(bitmap, text, (4, h + 2), cv2.FONT_HERSHEY_SIMPLEX, 1.0, 255, 3)
    filled = np.argwhere(bitmap > 127)
    (top, left), (bottom, end) = filled.min(axis=0), filled.max(axis=0) + 1
    digits = bitmap[top:bottom, left:end]
    columns = max(1, round(digits.shape[1] * _DIGIT_ROWS / len(digits)))
    cells = cv2.resize(digits, (columns, _DIGIT_ROWS), interpolation=cv2.INTER_AREA) > 110
    place, tall = _on_face(size_m, face, inset_m), 0.7 * side_m
    pitch_m = min(tall / _DIGIT_ROWS, 0.8 * width * right / columns)
    quads = []
    for row in range(_DIGIT_ROWS):
        y0, y1 = ((_DIGIT_ROWS / 2.0 - k) * pitch_m * 2.0 / up for k in (row, row + 1))
        for first, last in _filled_runs(cells[row]):
            x0, x1 = ((k - columns / 2.0) * pitch_m * 2.0 / right for k in (first, last))
            quads.append(place(np.array([[x0, y0], [x0, y1], [x1, y1], [x1, y0]])))
    body.add_quads(WHITE, quads, 3 * _LIFT_M)


def _filled_runs(row: NDArray[np.bool_]) -> list[list[int]]:
    """Return begin and end of each run of filled cells of a row (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(int)))
    return edges.reshape(-1, 2).tolist()


def _marker_quads(model: TargetModel, marker: Marker) -> tuple[Array, ...]:
    """Return the quadrangles (4, 3), TRF, of a marker: white border, black square, then the white
    cells row by row.
    """
    table = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, model.dictionary))
    n = table.markerSize + 2
    cells = np.asarray(cv2.aruco.generateImageMarker(table, marker.id, n, borderBits=1)) > 0
    top_left, top_right, _, bottom_left = marker.corners_trf_m()
    right, down = top_right - top_left, bottom_left - top_left

    def quad(x0: float, y0: float, x1: float, y1: float) -> Array:
        return np.array(
            [top_left + x * right + y * down for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
        )

    margin = model.white_margin_m / marker.side_m
    out = [quad(-margin, -margin, 1 + margin, 1 + margin), quad(0, 0, 1, 1)]
    for row in range(n):
        for first, last in _filled_runs(cells[row]):
            out.append(quad(first / n, row / n, last / n, (row + 1) / n))
    return tuple(out)


def add_markers(
    body: DressedBody, model: TargetModel, paper: Coat, ink: Coat, lift_m: float
) -> None:
    """Add the markers of a target: white borders, black squares, white cells, each ``lift_m`` above
    the last.
    """
    layers: tuple[list[Array], ...] = ([], [], [])
    for marker in model.markers:
        border, square, *cells = _marker_quads(model, marker)
        for quads, new in zip(layers, ([border], [square], cells), strict=True):
            quads += [_within(model.boxes, quad)[[3, 2, 1, 0]] for quad in new]
    for layer, (quads, coat) in enumerate(zip(layers, (paper, ink, paper), strict=True)):
        body.add_quads(coat, quads, (layer + 1) * lift_m)


def _within(boxes: Sequence[Box], quad: Array) -> Array:
    """Return a quadrangle (4, 3) on a face cut off at the face's edges, to which it is parallel.
    White borders are wider than the faces of some targets.
    """
    for shape in boxes:
        local = rotations.rotate_inverse(shape.q_wxyz, quad - shape.position_m)
        half = np.array(shape.size_m) / 2.0
        flat = np.ptp(local, axis=0) < 1e-6
        if np.any(flat & (np.abs(np.abs(local[0]) - half) < 1e-5)):
            held = np.clip(local, -half, half)
            return rotations.rotate(shape.q_wxyz, held) + shape.position_m
    return quad


def _add_thrusters(body: DressedBody, scenario: FlightScenario) -> None:
    """Add nozzles at the places of the thrusters, each blowing against its force. Outside of the
    cuboid a strut carries them.
    """
    throat, exit_m, length_m = _NOZZLE_M
    half = 0.49 * np.array(scenario.chaser.size_m)
    bell = ((0.0, 0.0), (throat, 0.0), (exit_m, length_m), (0.0, 0.6 * length_m))
    held: set[Vector3] = set()
    for thruster in scenario.chaser.thrusters:
        at, force = thruster.position_m, np.array(thruster.direction)
        body.add(NOZZLE, lathe("nozzle", _PLAIN, bell, at, _vector(-force), _TOLERANCE_M))
        nearest = np.clip(at, -half, half)
        away_m = float(np.linalg.norm(at - nearest))
        if at in held or away_m < exit_m:
            continue
        held.add(at)
        rod = ((0.0, 0.0), (_STRUT_M, 0.0), (_STRUT_M, away_m), (0.0, away_m))
        axis = _vector((at - nearest) / away_m)
        body.add(METAL, lathe("strut", _PLAIN, rod, _vector(nearest), axis, _TOLERANCE_M))
        body.add(METAL, box("hub", _PLAIN, _vector(np.full(3, 2.5 * _STRUT_M)), at))


def _disc(centre: Array, axis: Array, radius_m: float) -> list[Array]:
    """Return quadrangles (4, 3) that fill a circle about an axis."""
    one = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    one /= np.linalg.norm(one)
    two, n = np.cross(axis, one), 12
    angles = 2.0 * np.pi * np.arange(2 * n + 1) / (2 * n)
    rim = centre + radius_m * (np.outer(np.cos(angles), one) + np.outer(np.sin(angles), two))
    return [np.stack([centre, *rim[2 * k : 2 * k + 3]]) for k in range(n)]
