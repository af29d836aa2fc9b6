# SPDX-License-Identifier: Apache-2.0
"""``chaserdock calibrate``: a camera's intrinsics from images of a board."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import fail


def calibrate(
    folder: Annotated[Path, typer.Argument(help="folder of images (.png, .jpg) of one board")],
    out: Annotated[Path, typer.Option(help="calibration file to write: .yaml, .json or .xml")],
    board: Annotated[
        str,
        typer.Option(help="chessboard COLUMNSxROWS inner corners, or charuco COLUMNSxROWS squares"),
    ] = "charuco 8x6",
    square: Annotated[
        float, typer.Option(min=0.0001, max=100.0, help="edge of a square, metres")
    ] = 0.03,
    marker: Annotated[
        float, typer.Option(min=0.0001, max=100.0, help="charuco: edge of a marker, metres")
    ] = 0.022,
    dictionary: Annotated[str, typer.Option(help="charuco: ArUco dictionary")] = "DICT_4X4_50",
) -> None:
    """Calibrate a camera from images of a board. Status 1 when too few images are usable."""
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
        print(f"{name}: not used: {reason}")
    values = (result.matrix[0, 0], result.matrix[1, 1], result.matrix[0, 2], result.matrix[1, 2])
    intrinsics = ", ".join(
        f"{name} {value:.2f} +- {sigma:.2f}"
        for name, value, sigma in zip(("fx", "fy", "cx", "cy"), values, result.sigma, strict=False)
    )
    print(f"{len(result.rms_px)} images, RMS {result.total_rms_px:.3f} px; {intrinsics} px")
    try:
        write_calibration(result, out)
    except OSError as error:
        raise fail(f"--out {out}: cannot be written: {error}") from None
    print(out)
