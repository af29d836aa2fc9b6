# SPDX-License-Identifier: Apache-2.0
"""Sheets of markers in true scale for printing, as PDF or SVG.

Lengths are millimetres from the upper left corner of the sheet.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from chaserdock_agents.chaser.perception.detect import (
    LEAST_MARGIN_CELLS,
    NEAR_CELL_PX,
    NEAR_MARGIN_CELLS,
    dictionary_of,
)
from chaserdock_models.targets import Marker, TargetModel, clear_margin_m
from chaserdock_protocol.output_files import replaced
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as MplPath
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

SHEETS_MM = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
_EDGE_MM, _GAP_MM, _TEXT_MM, _MARK_MM, _LINE_MM = 12.0, 8.0, 3.0, 3.0, 0.1
"""Lengths, mm: margin, which printers leave blank; gap between markers, for scissors; height of
text; length of cutting marks; width of lines.
"""
_NOTE_MM = 2.2
"""Height of the text that states the white border, mm: it fits below the smallest marker."""
# Footer of a sheet, mm: a ruler to check the scale, and the sheet's name.
_FOOT_MM = 14.0
_MM_PER_INCH = 25.4  # exact
_POINTS_PER_MM = 72.0 / _MM_PER_INCH
_STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "chaserdock", "pdf.fonttype": 42}


@dataclass
class Sheet:
    """Content of one sheet, mm: ``markers`` with their centres (marker, x, y), black ``rectangles``
    (x, y, width, height), ``lines`` (x0, y0, x1, y1), ``texts`` and smaller ``notes`` (x, y of the
    baseline, text).
    """

    size_mm: tuple[float, float]
    markers: list[tuple[Marker, float, float]] = field(default_factory=list)
    rectangles: list[tuple[float, float, float, float]] = field(default_factory=list)
    lines: list[tuple[float, float, float, float]] = field(default_factory=list)
    texts: list[tuple[float, float, str]] = field(default_factory=list)
    notes: list[tuple[float, float, str]] = field(default_factory=list)


def write_sheets(
    model: TargetModel, out: Path, size_mm: tuple[float, float]
) -> tuple[int, list[Path]]:
    """Write one PDF, or one SVG per sheet (numbered if several). Returns the number of sheets, and
    the files.

    Raise ValueError for a target without markers, and for a marker that does not fit on a sheet or
    is not in its dictionary.
    """
    if not model.markers:
        raise ValueError("has no markers to print; it is seen by its shape (perception model)")
    sheets = lay_out(model, size_mm)
    written = []
    with matplotlib.rc_context(_STYLE):
        if out.suffix.lower() == ".pdf":
            with replaced(out) as new, PdfPages(new) as pdf:
                for sheet in sheets:
                    pdf.savefig(figure_of(sheet))
            return len(sheets), [out]
        for number, sheet in enumerate(sheets, 1):
            path = out if len(sheets) == 1 else out.with_stem(f"{out.stem}-{number}")
            with replaced(path) as new:
                figure_of(sheet).savefig(new, format="svg", metadata={"Date": None})
            written.append(path)
    return len(sheets), written


def lay_out(model: TargetModel, size_mm: tuple[float, float]) -> list[Sheet]:
    """Place all markers in rows, large ones first. Each has its white border up to the next marker
    or the edge of its face.

    Raise ValueError as ``write_sheets``.
    """
    width, height = size_mm
    sheets: list[Sheet] = []
    x = y = row = 0.0
    for marker in sorted(model.markers, key=lambda m: (-m.side_m, m.id)):
        margin = 1000.0 * clear_margin_m(model, marker)
        side = 1000.0 * marker.side_m + 2.0 * margin
        tall = side + _TEXT_MM + _NOTE_MM + 2.0
        if side > width - 2 * _EDGE_MM or tall > height - 2 * _EDGE_MM - _FOOT_MM:
            raise ValueError(
                f"marker {marker.id} with its border is {side:g} mm wide, too large for the sheet"
            )
        if sheets and x + side > width - _EDGE_MM:
            x, y, row = _EDGE_MM, y + row + _GAP_MM, 0.0
        if not sheets or y + tall > height - _EDGE_MM - _FOOT_MM:
            sheets.append(Sheet(size_mm))
            x, y, row = _EDGE_MM, _EDGE_MM, 0.0
        _place(sheets[-1], model.dictionary, marker, (x, y), margin)
        x, row = x + side + _GAP_MM, max(row, tall)
    for number, sheet in enumerate(sheets, 1):
        foot = height - _EDGE_MM
        sheet.lines.append((_EDGE_MM, foot, _EDGE_MM + 100.0, foot))
        sheet.lines += [
            (_EDGE_MM + k, foot - 2.0, _EDGE_MM + k, foot)
            for k in np.arange(0.0, 101.0, 10.0).tolist()
        ]
        about = f"100 mm.  {model.name}, {model.dictionary}, sheet {number} of {len(sheets)}"
        sheet.texts.append((_EDGE_MM + 104.0, foot, about))
        rule = (
            f"Cut at the marks. Perception needs a white border of {LEAST_MARGIN_CELLS:g} cells, "
            f"or {NEAR_MARGIN_CELLS:g} where a cell has {NEAR_CELL_PX} pixels; a cell is a square "
            "of the pattern."
        )
        sheet.notes.append((_EDGE_MM, foot + _NOTE_MM + 1.0, rule))
    return sheets


def _place(
    sheet: Sheet, dictionary: str, marker: Marker, at: tuple[float, float], margin: float
) -> None:
    """Add a marker ``at`` (x, y) with a white ``margin``, crop marks at its corners, and below its
    id and, drawn and as text, the width of the margin.
    """
    cells = marker_bits(dictionary, marker.id)
    cell = 1000.0 * marker.side_m / len(cells)
    x, y = at
    side = 1000.0 * marker.side_m + 2.0 * margin
    sheet.markers.append((marker, x + side / 2.0, y + side / 2.0))
    for r, line in enumerate(cells):
        # Adjacent black cells form one rectangle, so that no hairlines appear between them.
        edges = np.flatnonzero(np.diff(np.concatenate([[1], line, [1]])))
        for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            sheet.rectangles.append(
                (x + margin + start * cell, y + margin + r * cell, (end - start) * cell, cell)
            )
    for cx, sx in ((x, -1.0), (x + side, 1.0)):
        for cy, sy in ((y, -1.0), (y + side, 1.0)):
            sheet.lines.append((cx + sx * 0.5, cy, cx + sx * _MARK_MM, cy))
            sheet.lines.append((cx, cy + sy * 0.5, cx, cy + sy * _MARK_MM))
    sheet.texts.append(
        (x + margin + 1.5, y + side + _TEXT_MM, f"{marker.id}   {1000.0 * marker.side_m:g} mm")
    )
    # Between the crop mark and the marker's black edge, on what is cut off.
    edge, middle = x + margin, y + side + 0.5 + _MARK_MM / 2.0
    sheet.lines.append((edge, y + side + 0.5, edge, y + side + _MARK_MM))
    sheet.lines.append((x, middle, edge, middle))
    note = f"white border {margin:.3g} mm, {margin / cell:.2g} cells"
    sheet.notes.append((x + 1.0, y + side + _TEXT_MM + 1.0 + _NOTE_MM, note))


def marker_bits(dictionary: str, marker_id: int) -> NDArray[np.int64]:
    """Return the cells (n, n) of a marker with its black border, row 0 on top: 1 white, 0 black.
    Raise ValueError.
    """
    table = dictionary_of(dictionary)
    if not 0 <= marker_id < len(table.bytesList):
        raise ValueError(f"{dictionary} has no marker {marker_id}")
    image = cv2.aruco.generateImageMarker(table, marker_id, table.markerSize + 2, borderBits=1)
    return (np.asarray(image) > 0).astype(np.int64)


def figure_of(sheet: Sheet) -> Figure:
    """Return the sheet as a matplotlib figure of its size; one unit of the transform is a
    millimetre of paper.
    """
    width, height = (length / _MM_PER_INCH for length in sheet.size_mm)
    figure = Figure(figsize=(width, height), facecolor="none")
    per_inch = 1.0 / _MM_PER_INCH
    on_paper = Affine2D().scale(per_inch, -per_inch).translate(0.0, height) + figure.dpi_scale_trans
    unit = MplPath.unit_rectangle()
    cells = [
        unit.transformed(Affine2D().scale(a, b).translate(x, y)) for x, y, a, b in sheet.rectangles
    ]
    # One path for all cells: within a path, renderers leave no seams between adjacent parts.
    squares = PathPatch(
        MplPath.make_compound_path(*cells), facecolor="black", linewidth=0.0, antialiased=False
    )
    squares.set_transform(on_paper)
    lines = LineCollection(
        [((a, b), (c, d)) for a, b, c, d in sheet.lines],
        colors="black",
        linewidths=_LINE_MM * _POINTS_PER_MM,
        transform=on_paper,
    )
    for artist in (squares, lines):
        figure.add_artist(artist)
    for texts, high_mm in ((sheet.texts, _TEXT_MM), (sheet.notes, _NOTE_MM)):
        for x, y, text in texts:
            place = x / sheet.size_mm[0], 1.0 - y / sheet.size_mm[1]
            figure.text(*place, text, fontsize=high_mm * _POINTS_PER_MM, va="baseline")
    return figure
