# SPDX-License-Identifier: Apache-2.0
"""Commands that prepare a mission: marker sheets, camera calibration, and keys (``chaserdock keys
…``).
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from .help import add_command, command_group
from .options import fail


class Paper(StrEnum):
    """Sheet sizes."""

    a4 = "a4"
    letter = "letter"


def markers(
    target: Annotated[
        str, typer.Argument(help="target file (.toml), or a shipped target: paper, servicer")
    ],
    out: Annotated[
        Path, typer.Option(help="file to write: .pdf, or .svg (one file per page, numbered)")
    ],
    paper: Annotated[Paper, typer.Option(help="sheet size")] = Paper.a4,
) -> None:
    """Write a target's markers as sheets to print at true scale, with cutting marks and ids."""
    from chaserdock_protocol.scenario.files import find_target

    from chaserdock.calibration.marker_sheets import SHEETS_MM, write_sheets

    if out.suffix.lower() not in (".pdf", ".svg"):
        raise fail(f"--out {out}: must end in .pdf or .svg")
    model = find_target(target)
    try:
        count, written = write_sheets(model, out, SHEETS_MM[paper.value])
    except ValueError as error:
        raise fail(f"{target}: {error}") from None
    except OSError as error:
        raise fail(f"--out {out}: cannot be written: {error.strerror or error}") from None
    print(f"{len(model.markers)} markers on {count} sheet(s): {', '.join(map(str, written))}")
    print("print without scaling, and check the 100 mm ruler on the sheet")


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


def compose(
    chasers: Annotated[int, typer.Option(min=1, max=16, help="number of chaser services")] = 4,
    standby: Annotated[bool, typer.Option("--standby", help="with a standby controller")] = False,
    view: Annotated[
        bool,
        typer.Option(
            "--view", help="with the viewer, which `docker compose --profile view up` starts"
        ),
    ] = False,
) -> None:
    """Print the Docker Compose file of a mission: a service per process, with access control."""
    from chaserdock.launch.compose_file import compose_file

    print(compose_file(chasers, standby=standby, view=view), end="")


keys = command_group("keys", "Make the keys and certificates of a mission.")


@keys.callback()
def group() -> None:
    """Make the keys and certificates of a mission."""


def init(
    folder: Annotated[
        Path, typer.Argument(help="folder to write to, one folder per process inside")
    ],
    host: Annotated[
        list[str] | None, typer.Option(help="name or address of the router's host; repeatable")
    ] = None,
    chasers: Annotated[int, typer.Option(min=1, max=256, help="number of chasers")] = 16,
    days: Annotated[int, typer.Option(min=1, max=3650, help="validity, days")] = 90,
    shared: Annotated[
        bool,
        typer.Option(help="make keys readable by every user (for volumes that one process mounts)"),
    ] = False,
    renew: Annotated[
        bool, typer.Option(help="keep valid keys, replace missing or expired ones")
    ] = False,
) -> None:
    """Make a mission's keys: FOLDER/NAME holds all that process NAME needs. Existing keys are not
    overwritten.
    """
    from datetime import UTC, datetime

    from chaserdock.launch.keys import init_keys, names, remove_keys, why_not_usable

    now = datetime.now(UTC)
    if renew:
        if why_not_usable(folder, chasers, now) is None:
            print(f"{folder}: all keys are valid")
            return
        remove_keys(folder, chasers)
    hosts = ("localhost", "127.0.0.1", *(host or ()))
    init_keys(folder, chasers, hosts, days, now, shared=shared)
    print(
        f"{folder}: keys of {', '.join(names(chasers))}; router at {', '.join(hosts)}; {days} days"
    )


add_command(keys, init)
