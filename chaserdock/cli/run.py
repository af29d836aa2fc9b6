"""Verbs that look at a recorded flight."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import fail


def summary(log: Annotated[Path, typer.Argument(help="a mission.mcap")]) -> None:
    """Judge a recorded flight again and print its summary as JSON; status 0 only if it was a success."""
    import json

    from chaserdock.analysis.summary import summarize

    result = summarize(log)
    print(json.dumps(result, indent=2))
    raise typer.Exit(0 if result["success"] else 1)


def snapshot(
    log: Annotated[Path, typer.Argument(help="a mission.mcap")],
    at: Annotated[float, typer.Option(help="simulated time, seconds")],
    out: Annotated[Path, typer.Option(help="image to write: .png or .jpg")],
    width: Annotated[int, typer.Option(min=64, max=4096, help="width of one camera's image, pixels")] = 640,
) -> None:
    """Draw what every camera saw at a moment of a recorded flight, detections included."""
    import cv2

    from chaserdock.analysis.snapshot import snapshot as draw

    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise fail(f"--out {out}: must end in .png or .jpg")
    if not cv2.imwrite(str(out), draw(log, at, width)):
        raise fail(f"--out {out}: cannot be written")
