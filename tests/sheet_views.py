# SPDX-License-Identifier: Apache-2.0
"""Photographs of printed marker sheets, drawn by OpenCV alone.

A sheet of `chaserdock target --markers` is rasterized at 300 dpi and seen at a known pose through a
lens: warped by the homography of its plane with supersampling, distorted, blurred, with a light
that falls off, and noise. Shares no code with the renderers of the world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from chaserdock_models.camera import Camera
from chaserdock_models.targets import Marker, TargetModel
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray

from chaserdock.targets.marker_sheets import SHEETS_MM, Sheet, figure_of, lay_out, marker_bits

DPI, _MM_PER_INCH = 300, 25.4
_PX_PER_MM = DPI / _MM_PER_INCH
Grey = NDArray[np.uint8]


@dataclass(frozen=True)
class Lens:
    """A camera in OpenCV's terms: ``distortion`` k1, k2, p1, p2. ``samples`` of a pixel along each
    side.
    """

    width: int = 1280
    height: int = 720
    fx: float = 1108.0
    fy: float = 1108.0
    cx: float = 642.7
    cy: float = 355.2
    distortion: tuple[float, ...] = (-0.12, 0.03, 4e-4, -3e-4)
    samples: int = 6

    def camera(self) -> Camera:
        """Return the same camera for the tracker."""
        return Camera(self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.distortion)

    @property
    def matrix(self) -> NDArray[np.float64]:
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @cached_property
    def fine_map(self) -> tuple[Any, Any]:
        """Place in the supersampled ideal image of each pixel of the supersampled image."""
        s = self.samples
        u, v = (np.arange(n * s, dtype=float) for n in (self.width, self.height))
        px = (np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2) + 0.5) / s - 0.5
        ideal = cv2.undistortPoints(
            px, self.matrix, np.array(self.distortion), P=self.matrix
        ).reshape(self.height * s, self.width * s, 2)
        fine = ((ideal + 0.5) * s - 0.5).astype(np.float32)
        return fine[..., 0], fine[..., 1]


@dataclass(frozen=True, eq=False)
class PrintedSheet:
    """A sheet of paper. ``pixels`` (h, w): reflectance 0 to 255; ``sheet``: its layout, mm from the
    upper left corner. The sheet's axes: x right, y up, z out of the paper, origin in its middle.
    """

    sheet: Sheet
    pixels: Grey

    def to_pixels(self, scale_m: float = 1.0) -> NDArray[np.float64]:
        """Return the map (3, 3) from (x, y, 1) on the sheet, m, to its pixels."""
        width, height = (1e-3 * mm for mm in self.sheet.size_mm)
        per_m = 1e3 * _PX_PER_MM * scale_m
        rows = self.pixels.shape[0]
        # Rasterizers count from the lower edge of the sheet.
        return np.array(
            [[per_m, 0.0, per_m * width / 2 - 0.5], [0.0, -per_m, rows - per_m * height / 2 - 0.5],
             [0.0, 0.0, 1.0]]
        )  # fmt: skip


@lru_cache(maxsize=8)
def printed(model: TargetModel, page: int = 0) -> PrintedSheet:
    """Return a sheet of a target's markers as printed on A4."""
    sheet = lay_out(model, SHEETS_MM["a4"])[page]
    # Lines and texts as matplotlib rasterizes them; it would round squares to whole dots.
    canvas = FigureCanvasAgg(figure_of(replace(sheet, rectangles=[(0.0, 0.0, 1e-6, 1e-6)])))
    canvas.figure.set_dpi(DPI)
    canvas.figure.set_facecolor("white")
    canvas.draw()
    paper = np.asarray(canvas.buffer_rgba())[..., 1].astype(float)
    rows, columns = paper.shape
    up = rows - sheet.size_mm[1] * _PX_PER_MM
    for x, y, w, h in sheet.rectangles:
        across = _covered(columns, x * _PX_PER_MM, (x + w) * _PX_PER_MM)
        down = _covered(rows, up + y * _PX_PER_MM, up + (y + h) * _PX_PER_MM)
        paper[np.ix_(down > 0, across > 0)] -= 255.0 * np.outer(down[down > 0], across[across > 0])
    return PrintedSheet(sheet, np.clip(np.rint(paper), 0, 255).astype(np.uint8))


def cut_marker(dictionary: str, number: int, side_m: float, margin_m: float) -> PrintedSheet:
    """Return a marker that is cut out with a white border; its axes are those of its paper."""
    bits, side, margin = marker_bits(dictionary, number), 1e3 * side_m, 1e3 * margin_m
    wide, cell = side + 2.0 * margin, side / len(bits)
    pixels = math.ceil(wide * _PX_PER_MM)
    paper = np.full((pixels, pixels), 255.0)
    up = pixels - wide * _PX_PER_MM
    for row, column in np.argwhere(bits == 0).tolist():
        x, y = margin + column * cell, margin + row * cell
        across = _covered(pixels, x * _PX_PER_MM, (x + cell) * _PX_PER_MM)
        down = _covered(pixels, up + y * _PX_PER_MM, up + (y + cell) * _PX_PER_MM)
        paper -= 255.0 * np.outer(down, across)
    image = np.clip(np.rint(paper), 0, 255).astype(np.uint8)
    return PrintedSheet(Sheet((wide, wide)), image)


def _covered(pixels: int, begin: float, end: float) -> NDArray[np.float64]:
    """Return the share of each pixel (n,) of a line that lies between two edges."""
    edges = np.arange(pixels + 1, dtype=float)
    return np.diff(np.clip(edges, begin, end))


def sheet_target(model: TargetModel, sheet: PrintedSheet) -> TargetModel:
    """Return a printed sheet as a target, in the sheet's axes."""
    width, height = (1e-3 * mm for mm in sheet.sheet.size_mm)
    markers = tuple(
        Marker(m.id, m.side_m, (1e-3 * x - width / 2, height / 2 - 1e-3 * y, 0.0), (1.0, 0, 0, 0))
        for m, x, y in sheet.sheet.markers
    )
    size = (width, height, 1e-3)
    return TargetModel("sheet", (), markers, model.dictionary, size, model.white_margin_m)


@dataclass(frozen=True)
class Photograph:
    """How a sheet is photographed. Grey levels: of black and white, and of what is behind;
    ``fall``: loss of light from the left to the right border; ``blur_px``; ``noise``: standard
    deviation; ``jpeg``: quality, 0 for none.
    """

    lens: Lens = field(default_factory=Lens)
    black: float = 28.0
    white: float = 205.0
    behind: float = 90.0
    fall: float = 0.25
    blur_px: float = 0.6
    noise: float = 1.5
    jpeg: int = 85

    def of(
        self, sheet: PrintedSheet, position_m: Any, rotation: Any, rng: np.random.Generator
    ) -> Grey:
        """Return the image (h, w) of a sheet: ``position_m`` (3,) of its middle and ``rotation``
        (3, 3) of its axes, in the camera's.
        """
        k, s = self.lens, self.lens.samples
        plane = np.column_stack([rotation[:, 0], rotation[:, 1], position_m])
        finer = np.array([[s, 0.0, (s - 1) / 2], [0.0, s, (s - 1) / 2], [0.0, 0.0, 1.0]])
        homography = finer @ k.matrix @ plane @ np.linalg.inv(sheet.to_pixels())
        # Paper pixels per fine pixel, against aliasing.
        shrink = _PX_PER_MM * 1e3 * position_m[2] / (k.fx * s)
        paper = cv2.GaussianBlur(sheet.pixels, (0, 0), max(0.35 * shrink, 0.1))
        size = (k.width * s, k.height * s)
        behind = 255.0 * (self.behind - self.black) / (self.white - self.black)
        ideal = cv2.warpPerspective(
            paper, homography, size, flags=cv2.INTER_LINEAR, borderValue=(behind,)
        )
        fine = cv2.remap(
            ideal, *k.fine_map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )  # fmt: skip
        image = cv2.resize(
            fine.astype(np.float32), (k.width, k.height), interpolation=cv2.INTER_AREA
        )
        image = cv2.GaussianBlur(image, (0, 0), self.blur_px)
        light = 1.0 - self.fall * np.linspace(0.0, 1.0, k.width)
        levels = (self.black + image / 255.0 * (self.white - self.black)) * light
        levels = levels + rng.normal(0.0, self.noise, levels.shape)
        image = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
        if not self.jpeg:
            return image
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg])[1]
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def rotation_of(vector: Any) -> NDArray[np.float64]:
    """Return the matrix (3, 3) of a rotation vector."""
    return np.asarray(cv2.Rodrigues(np.asarray(vector, dtype=float))[0], dtype=float)


def random_view(
    rng: np.random.Generator, lens: Lens, distance_m: float, tilt_rad: float, reach_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return position (3,) and rotation (3, 3) of a sheet in view: its normal up to ``tilt_rad``
    from the line to the camera, turned at will, ``reach_m`` around its middle in the image.
    """
    half = np.array([lens.width / lens.fx, lens.height / lens.fy]) / 2.0
    free = np.maximum(half * 0.95 - reach_m / distance_m, 0.0)
    x, y = rng.uniform(-free, free) * distance_m
    towards_camera = np.diag([1.0, -1.0, -1.0])
    axis = rng.uniform(0.0, 2.0 * np.pi)
    tilt = rng.uniform(0.0, tilt_rad) * np.array([np.cos(axis), np.sin(axis), 0.0])
    turn = rotation_of([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    return np.array([x, y, distance_m]), rotation_of(tilt) @ towards_camera @ turn
