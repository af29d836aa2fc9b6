"""Verbs that hold a recorded flight against something: today's code, or another flight."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated

import typer

from .options import JsonOpt

ToleranceOpt = Annotated[
    float, typer.Option(min=0.0, help="numbers at most so far apart count as equal (another kind of CPU)")
]


def replay(
    log: Annotated[Path, typer.Argument(help="a mission.mcap, or the folder of a run")],
    through: Annotated[str, typer.Option(help="perception, fusion or controller")],
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="what if this scenario value had been …"),
    ] = None,
    tolerance: ToleranceOpt = 0.0,
    as_json: JsonOpt = False,
) -> None:
    """Feed recorded inputs to today's code and compare what it says with the log; status 1 when it differs."""
    from chaserdock_protocol.process import SINGLE_THREADED

    os.environ |= SINGLE_THREADED  # as the processes flew; before NumPy is there
    import msgspec

    from chaserdock.replay.difference import difference_lines, first_difference
    from chaserdock.replay.run import replay as run

    result = run(log, through, tuple(overrides or ()), tolerance)
    first = first_difference(result.topics)
    if as_json:
        told = {"equal": result.equal, "first_difference": first, **msgspec.to_builtins(result)}
        print(json.dumps(told, indent=2))
    else:
        for line in (*result.notes, *difference_lines(result.topics, ("recorded", "now"))):
            print(line)
        print("equal to the log" if first is None else f"first difference: {first}")
    raise typer.Exit(0 if result.equal else 1)


def compare(
    first: Annotated[Path, typer.Argument(help="a log, or the folder of a run")],
    second: Annotated[Path, typer.Argument(help="another")],
    tolerance: ToleranceOpt = 0.0,
    as_json: JsonOpt = False,
) -> None:
    """Put two recorded flights side by side; status 1 unless their digests are equal."""
    import msgspec

    from chaserdock.replay.compare import compare as run
    from chaserdock.replay.compare import comparison_lines

    found = run(first, second, tolerance)
    if as_json:
        print(json.dumps({"equal": found.equal, **msgspec.to_builtins(found)}, indent=2))
    else:
        print("\n".join(comparison_lines(found)))
    raise typer.Exit(0 if found.equal else 1)
