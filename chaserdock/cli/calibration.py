"""Verbs about cameras and what they look at: marker sheets and calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import fail


def markers(
    target: Annotated[str, typer.Argument(help="a target file ….toml, or paper, servicer")],
    out: Annotated[
        Path, typer.Option(help="file to write: .pdf, or .svg (one page after another, numbered)")
    ],
    paper: Annotated[str, typer.Option(help="sheet: a4 or letter")] = "a4",
) -> None:
    """Write a target's markers as sheets to print in true scale, with cutting marks and ids."""
    from chaserdock_protocol.scenario.files import find_target

    from chaserdock.calibration.marker_sheets import SHEETS_MM, write_sheets

    if paper not in SHEETS_MM:
        raise fail(f"--paper {paper}: must be one of {', '.join(SHEETS_MM)}")
    if out.suffix.lower() not in (".pdf", ".svg"):
        raise fail(f"--out {out}: must end in .pdf or .svg")
    model = find_target(target)
    try:
        count, written = write_sheets(model, out, SHEETS_MM[paper])
    except ValueError as error:
        raise fail(f"{target}: {error}") from None
    except OSError as error:
        raise fail(f"--out {out}: cannot be written: {error.strerror or error}") from None
    print(f"{len(model.markers)} markers on {count} sheet(s): {', '.join(map(str, written))}")
    print("print without scaling, and measure the 100 mm rule on the sheet")


def calibrate(
    folder: Annotated[Path, typer.Argument(help="folder of images (.png, .jpg) of one board")],
    out: Annotated[Path, typer.Option(help="calibration file to write: .yaml, .json or .xml")],
    board: Annotated[
        str, typer.Option(help="chessboard COLUMNSxROWS inner corners, or charuco COLUMNSxROWS squares")
    ] = "charuco 8x6",
    square: Annotated[float, typer.Option(help="edge of a square, metres")] = 0.03,
    marker: Annotated[float, typer.Option(help="charuco: edge of a marker, metres")] = 0.022,
    dictionary: Annotated[str, typer.Option(help="charuco: ArUco dictionary")] = "DICT_4X4_50",
) -> None:
    """Calibrate a camera from images of a board; status 1 when too few of them are usable."""
    from chaserdock.calibration.intrinsics import (
        BadBoard,
        TooFew,
        board_of,
        calibrate_folder,
        write_calibration,
    )

    if out.suffix.lower() not in (".yaml", ".yml", ".json", ".xml"):
        raise fail(f"--out {out}: must end in .yaml, .json or .xml")
    try:
        result = calibrate_folder(folder, board_of(board, square, marker, dictionary))
    except BadBoard as error:
        raise fail(str(error)) from None
    except TooFew as error:
        print(error)
        raise typer.Exit(1) from None
    for name, rms in result.rms_px.items():
        print(f"{name}: {rms:.3f} px")
    for name, reason in result.excluded.items():
        print(f"{name}: left out: {reason}")
    print(
        f"{len(result.rms_px)} images, RMS {result.total_rms_px:.3f} px; "
        f"fx {result.matrix[0, 0]:.2f} +- {result.sigma[0]:.2f}, fy {result.matrix[1, 1]:.2f} +- {result.sigma[1]:.2f}, "
        f"cx {result.matrix[0, 2]:.2f} +- {result.sigma[2]:.2f}, cy {result.matrix[1, 2]:.2f} +- {result.sigma[3]:.2f} px"
    )
    try:
        write_calibration(result, out)
    except OSError as error:
        raise fail(f"--out {out}: cannot be written: {error}") from None
    print(out)
