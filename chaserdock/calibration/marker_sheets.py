"""Sheets of markers to be printed in true scale and cut out: SVG, and PDF with the same rectangles.

Both formats hold nothing but black rectangles, lines and text, so they are written here, without a library.
All lengths are millimetres, from the sheet's upper left corner, unless they say otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import escape

import cv2
import numpy as np
from chaserdock_agents.chaser.perception.detect import dictionary_of
from chaserdock_models.targets import Marker, TargetModel, clear_margin_m
from numpy.typing import NDArray

SHEETS_MM = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
_EDGE_MM, _GAP_MM, _TEXT_MM, _MARK_MM = 12.0, 8.0, 3.0, 3.0
# The foot of a sheet: a rule to measure, and what the sheet is.
_FOOT_MM = 14.0
_POINTS_PER_MM = 72.0 / 25.4


@dataclass
class Sheet:
    """``rectangles`` (x, y, width, height), black; ``lines`` (x0, y0, x1, y1); ``texts`` (x, y of its start, text)."""

    size_mm: tuple[float, float]
    rectangles: list[tuple[float, float, float, float]] = field(default_factory=list)
    lines: list[tuple[float, float, float, float]] = field(default_factory=list)
    texts: list[tuple[float, float, str]] = field(default_factory=list)


def write_sheets(model: TargetModel, out: Path, size_mm: tuple[float, float]) -> tuple[int, list[Path]]:
    """Writes the sheets and returns their number and files: one PDF, or an SVG for each sheet (numbered when several).

    Raises ValueError for a marker that does not fit on a sheet, or that its dictionary does not have.
    """
    sheets = lay_out(model, size_mm)
    if out.suffix.lower() == ".pdf":
        out.write_bytes(_pdf(sheets))
        return len(sheets), [out]
    written = []
    for number, sheet in enumerate(sheets, 1):
        path = out if len(sheets) == 1 else out.with_stem(f"{out.stem}-{number}")
        path.write_text(_svg(sheet), encoding="utf-8")
        written.append(path)
    return len(sheets), written


def lay_out(model: TargetModel, size_mm: tuple[float, float]) -> list[Sheet]:
    """Sheets with all markers, large ones first, in rows; each with its white border up to the next marker or the end
    of its face. Raises ValueError as `write_sheets` does."""
    width, height = size_mm
    sheets: list[Sheet] = []
    x = y = row = 0.0
    for marker in sorted(model.markers, key=lambda m: (-m.side_m, m.id)):
        margin = 1000.0 * clear_margin_m(model, marker)
        side = 1000.0 * marker.side_m + 2.0 * margin
        tall = side + _TEXT_MM + 1.0
        if side > width - 2 * _EDGE_MM or tall > height - 2 * _EDGE_MM - _FOOT_MM:
            raise ValueError(
                f"marker {marker.id} with its border is {side:g} mm wide: too large for the sheet"
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
            (_EDGE_MM + k, foot - 2.0, _EDGE_MM + k, foot) for k in np.arange(0.0, 101.0, 10.0).tolist()
        ]
        about = f"100 mm.  {model.name}, {model.dictionary}, sheet {number} of {len(sheets)}"
        sheet.texts.append((_EDGE_MM + 104.0, foot, about))
    return sheets


def _place(sheet: Sheet, dictionary: str, marker: Marker, at: tuple[float, float], margin: float) -> None:
    """A marker with a white ``margin`` ``at`` (x, y), marks at the corners to cut along, and its id below."""
    cells = marker_bits(dictionary, marker.id)
    cell = 1000.0 * marker.side_m / len(cells)
    x, y = at
    side = 1000.0 * marker.side_m + 2.0 * margin
    for r, line in enumerate(cells):
        # Black cells in a row are one rectangle: no hair lines between them.
        edges = np.flatnonzero(np.diff(np.concatenate([[1], line, [1]])))
        for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            sheet.rectangles.append(
                (x + margin + start * cell, y + margin + r * cell, (end - start) * cell, cell)
            )
    for cx, sx in ((x, -1.0), (x + side, 1.0)):
        for cy, sy in ((y, -1.0), (y + side, 1.0)):
            sheet.lines.append((cx + sx * 0.5, cy, cx + sx * _MARK_MM, cy))
            sheet.lines.append((cx, cy + sy * 0.5, cx, cy + sy * _MARK_MM))
    sheet.texts.append((x + 1.0, y + side + _TEXT_MM, f"{marker.id}   {1000.0 * marker.side_m:g} mm"))


def marker_bits(dictionary: str, marker_id: int) -> NDArray[np.int64]:
    """Cells (n, n) of a marker with its black border, row 0 on top: 1 white, 0 black. Raises ValueError."""
    table = dictionary_of(dictionary)
    if not 0 <= marker_id < len(table.bytesList):
        raise ValueError(f"{dictionary} has no marker {marker_id}")
    image = cv2.aruco.generateImageMarker(table, marker_id, table.markerSize + 2, borderBits=1)
    return (np.asarray(image) > 0).astype(np.int64)


def _svg(sheet: Sheet) -> str:
    w, h = sheet.size_mm
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{w:g}mm" height="{h:g}mm" viewBox="0 0 {w:g} {h:g}">',
        '<g fill="black" shape-rendering="crispEdges">',
        *(
            f'<rect x="{x:.4f}" y="{y:.4f}" width="{a:.4f}" height="{b:.4f}"/>'
            for x, y, a, b in sheet.rectangles
        ),
        '</g><g stroke="black" stroke-width="0.1">',
        *(f'<line x1="{a:.4f}" y1="{b:.4f}" x2="{c:.4f}" y2="{d:.4f}"/>' for a, b, c, d in sheet.lines),
        f'</g><g font-family="sans-serif" font-size="{_TEXT_MM:g}">',
        *(f'<text x="{x:.4f}" y="{y:.4f}">{escape(text)}</text>' for x, y, text in sheet.texts),
        "</g></svg>",
    ]
    return "\n".join(lines) + "\n"


def _pdf(sheets: list[Sheet]) -> bytes:
    """A PDF 1.4 file (ISO 32000-1, 7.5): catalogue, pages, a font, and a page and its contents for each sheet."""
    pages = [4 + 2 * k for k in range(len(sheets))]
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        f"<< /Type /Pages /Kids [{' '.join(f'{n} 0 R' for n in pages)}] /Count {len(pages)} >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    for number, sheet in zip(pages, sheets, strict=True):
        w, h = (s * _POINTS_PER_MM for s in sheet.size_mm)
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {w:.4f} {h:.4f}] "
            f"/Resources << /Font << /F 3 0 R >> >> /Contents {number + 1} 0 R >>".encode()
        )
        stream = _pdf_contents(sheet)
        objects.append(b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream))
    out = bytearray(b"%PDF-1.4\n")
    places = []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    start = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    out += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, start)
    return bytes(out)


def _pdf_contents(sheet: Sheet) -> bytes:
    # From here on units are millimetres; y points up.
    h = sheet.size_mm[1]
    parts = [f"{_POINTS_PER_MM:.8f} 0 0 {_POINTS_PER_MM:.8f} 0 0 cm 0.1 w"]
    parts += [f"{x:.4f} {h - y - b:.4f} {a:.4f} {b:.4f} re f" for x, y, a, b in sheet.rectangles]
    parts += [f"{a:.4f} {h - b:.4f} m {c:.4f} {h - d:.4f} l S" for a, b, c, d in sheet.lines]
    for x, y, text in sheet.texts:
        safe = text.encode("latin-1", "replace").decode("latin-1")
        safe = safe.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
        parts.append(f"BT /F {_TEXT_MM:g} Tf {x:.4f} {h - y:.4f} Td ({safe}) Tj ET")
    return "\n".join(parts).encode("latin-1")
