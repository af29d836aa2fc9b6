# SPDX-License-Identifier: Apache-2.0
"""Marker sheets have true scale as SVG and as PDF."""

import re
import zlib
from pathlib import Path

import numpy as np
import pytest
from chaserdock_agents.chaser.perception.detect import detect, dictionary_of
from chaserdock_models.targets import clear_margin_m, target_model, target_names
from typer.testing import CliRunner

from chaserdock.cli.main import app
from chaserdock.targets.marker_sheets import SHEETS_MM, lay_out, marker_bits, write_sheets

POINTS_PER_MM = 72.0 / 25.4


def corners_mm(path: str, height_mm: float, downwards: bool) -> np.ndarray:
    """Return the corners (n, 4, 2) of the rectangles of an SVG or PDF path, mm from the upper left
    corner.
    """
    numbers = re.findall(r"-?\d+(?:\.\d+)?", path)
    corners = np.array(numbers, dtype=float).reshape(-1, 4, 2) / POINTS_PER_MM
    if not downwards:
        corners[..., 1] = height_mm - corners[..., 1]
    return corners


def svg_rectangles(file: Path, height_mm: float) -> np.ndarray:
    (squares,) = re.findall(r'<path d="([^"]+)"/>', file.read_text())  # the lines have a style
    return corners_mm(squares, height_mm, True)


def pdf_rectangles(data: bytes, height_mm: float) -> list[np.ndarray]:
    """Return the rectangles of each page."""
    pages = []
    for stream in re.findall(rb"stream\r?\n(.*?)\r?\nendstream", data, re.DOTALL):
        try:
            text = zlib.decompress(stream).decode("latin-1")
        except zlib.error:
            continue
        number = r"-?\d+(?:\.\d+)?"
        rectangle = rf"{number} {number} m\n(?:{number} {number} l\n){{3}}h\n"
        if found := re.findall(rectangle, text):
            pages.append(corners_mm("".join(found), height_mm, False))
    return pages


def rectangles_of(corners: np.ndarray) -> np.ndarray:
    """Return x, y, width and height (n, 4), sorted."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    boxes = np.hstack([low, high - low])
    return boxes[np.lexsort(boxes.round(2).T)]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "servicer"])
def test_svg_shows_every_marker_in_true_size(name: str, tmp_path: Path) -> None:
    """Paint the rectangles of the SVG file, detect the markers in the painting, measure them."""
    model = target_model(name)
    count, files = write_sheets(model, tmp_path / "m.svg", SHEETS_MM["a4"])
    assert count == len(files)
    sides_mm: dict[int, float] = {}
    px_per_mm = 8.0
    for file in files:
        ((width, height),) = re.findall(
            r'<svg [^>]*width="([\d.]+)pt" height="([\d.]+)pt"', file.read_text()
        )
        assert (float(width) / POINTS_PER_MM, float(height) / POINTS_PER_MM) == pytest.approx(
            (210.0, 297.0)
        )
        page = np.full((round(297 * px_per_mm), round(210 * px_per_mm)), 255, np.uint8)
        for x, y, w, h in rectangles_of(svg_rectangles(file, 297.0)) * px_per_mm:
            page[round(y) : round(y + h), round(x) : round(x + w)] = 0
        seen = detect(page, dictionary_of(model.dictionary), None)
        for i, corners in zip(seen.ids.tolist(), seen.corners_px, strict=True):
            sides_mm[i] = float(np.linalg.norm(corners[1] - corners[0])) / px_per_mm
    assert sides_mm.keys() == {m.id for m in model.markers}
    for marker in model.markers:
        assert sides_mm[marker.id] == pytest.approx(1000 * marker.side_m, abs=0.5)


@pytest.mark.slow
def test_pdf_and_svg_contain_the_rectangles_of_the_layout(tmp_path: Path) -> None:
    model = target_model("servicer")
    width, height = SHEETS_MM["letter"]
    sheets = lay_out(model, (width, height))
    count, (file,) = write_sheets(model, tmp_path / "m.pdf", (width, height))
    data = file.read_bytes()
    assert data.startswith(b"%PDF-")
    assert data.count(b"/MediaBox [ 0 0 612 792 ]") == count == len(sheets) > 1
    _, svgs = write_sheets(model, tmp_path / "m.svg", (width, height))
    pages = pdf_rectangles(data, height)
    for sheet, page, svg in zip(sheets, pages, svgs, strict=True):
        expected = np.array(sheet.rectangles)
        expected = expected[np.lexsort(expected.round(2).T)]
        np.testing.assert_allclose(rectangles_of(page), expected, atol=1e-4)
        np.testing.assert_allclose(rectangles_of(svg_rectangles(svg, height)), expected, atol=1e-4)


def test_markers_lie_within_the_printable_area() -> None:
    for sheet in lay_out(target_model("servicer"), SHEETS_MM["a4"]):
        for x, y, w, h in sheet.rectangles:
            assert 0 < x < x + w < 210
            assert 0 < y < y + h < 297 - 26


@pytest.mark.parametrize("name", ["paper", "servicer"])
def test_sheets_state_the_white_border_and_draw_its_width(name: str) -> None:
    model = target_model(name)
    for sheet in lay_out(model, SHEETS_MM["a4"]):
        assert "needs a white border of 0.5 cells, or 0.4 where" in sheet.notes[-1][2]
        assert len(sheet.notes) == len(sheet.markers) + 1
        for (marker, x, y), (_, _, note) in zip(sheet.markers, sheet.notes, strict=False):
            margin = 1e3 * clear_margin_m(model, marker)
            cells = margin / (1e3 * marker.side_m / len(marker_bits(model.dictionary, marker.id)))
            assert note == f"white border {margin:.3g} mm, {cells:.2g} cells"
            edge = x - 5e2 * marker.side_m
            drawn = [
                line
                for line in sheet.lines
                if line[0] == pytest.approx(edge - margin) and line[2] == pytest.approx(edge)
            ]
            below = y + 5e2 * marker.side_m + margin  # not on the white
            assert any(line[1] == line[3] > below for line in drawn)


def test_marker_larger_than_the_sheet_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="too large"):
        write_sheets(target_model("servicer"), tmp_path / "m.pdf", (100.0, 150.0))


@pytest.mark.parametrize("name", ["geo_servicer", "cubesat_12u"])
def test_target_without_markers_has_no_sheets(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has no markers to print"):
        write_sheets(target_model(name), tmp_path / "m.pdf", SHEETS_MM["a4"])
    said = CliRunner().invoke(app, ["target", name, "--markers", str(tmp_path / "m.pdf")])
    assert said.exit_code == 2
    assert f"{name}: has no markers to print" in said.stderr
    assert list(tmp_path.iterdir()) == []


def test_command_names_every_shipped_target() -> None:
    said = CliRunner().invoke(app, ["target", "--help"]).output
    assert [name for name in target_names() if name not in said] == []
