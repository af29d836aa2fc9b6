# SPDX-License-Identifier: Apache-2.0
"""``chaserdock calibrate``: a camera's intrinsics from images of a board, or a robot's mass
properties and thrusts from a run.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import JsonOpt, fail, print_result, refuse_options

_CAMERA = ("out", "board", "square", "marker", "dictionary")
"""Options of a camera's calibration."""


def calibrate(
    context: typer.Context,
    folder: Annotated[
        Path,
        typer.Argument(
            help="folder of images (.png, .jpg) of one board; --robot: folder of a run, or its "
            "mission.mcap"
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="calibration file to write: .yaml, .json or .xml")
    ] = None,
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
    robot: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=255,
            metavar="CHASER",
            help="identify this chaser's robot from a run instead: mass, inertia, centre of mass, "
            "thrusts, delay (docs/laboratory.md)",
        ),
    ] = None,
    mass: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            max=1e6,
            help="--robot: mass as weighed, kg; without: thrusts are taken as stated on average",
        ),
    ] = None,
    as_json: JsonOpt = False,
) -> None:
    """Calibrate a camera from images of a board, or identify a robot from a run. Status 1 when too
    few images are usable, or when the run tells nothing about the robot.
    """
    if robot is not None:
        refuse_options(context, _CAMERA, "not with --robot")
        _identify(folder, robot, mass, as_json)
        return
    refuse_options(context, ("mass", "as_json"), "only with --robot")
    if out is None:
        raise fail("--out: needed for a camera's calibration")
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


def _identify(run: Path, chaser: int, mass_kg: float | None, as_json: bool) -> None:
    import os

    from chaserdock_protocol.process import SINGLE_THREADED

    os.environ |= SINGLE_THREADED  # many small matrices; must precede the import of NumPy
    from chaserdock.identification.fit import identify
    from chaserdock.identification.report import identification_lines, identification_values

    found = identify(run, chaser, mass_kg)
    print_result(as_json, identification_values(found), identification_lines(found))
    raise typer.Exit(0 if any(q.known for q in found.quantities) else 1)
