# SPDX-License-Identifier: Apache-2.0
"""Commands that compare a recorded flight with the present code, or with another flight."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from .options import JsonOpt, LogArg, SetOpt, print_result

ToleranceOpt = Annotated[
    float,
    typer.Option(min=0.0, help="largest difference of numbers that count as equal (for another CPU type)"),
]


def replay(
    log: LogArg,
    through: Annotated[
        str,
        typer.Option(
            metavar="STAGE",
            help="part of the software: perception, fusion, controller, or one that a package provides "
            "(entry points of `chaserdock.replays`)",
        ),
    ],
    overrides: SetOpt = None,
    tolerance: ToleranceOpt = 0.0,
    as_json: JsonOpt = False,
) -> None:
    """Feed recorded inputs to the present code and compare its outputs with the log. Status 1 when they differ."""
    from chaserdock_protocol.process import SINGLE_THREADED

    os.environ |= SINGLE_THREADED  # as in flight; must precede the import of NumPy
    import msgspec

    from chaserdock.replay.difference import difference_lines, first_difference
    from chaserdock.replay.run import replay as run

    result = run(log, through, tuple(overrides or ()), tolerance)
    first = first_difference(result.topics)
    lines = [*result.notes, *difference_lines(result.topics, ("recorded", "now"))]
    lines.append("equal to the log" if first is None else f"first difference: {first}")
    value = {"equal": result.equal, "first_difference": first, **msgspec.to_builtins(result)}
    print_result(as_json, value, lines)
    raise typer.Exit(0 if result.equal else 1)


def compare(
    first: LogArg,
    second: LogArg,
    tolerance: ToleranceOpt = 0.0,
    as_json: JsonOpt = False,
) -> None:
    """Compare two recorded flights. Status 1 unless their digests are equal."""
    import msgspec

    from chaserdock.replay.compare import compare as run
    from chaserdock.replay.compare import comparison_lines

    result = run(first, second, tolerance)
    value = {"equal": result.equal, **msgspec.to_builtins(result)}
    print_result(as_json, value, comparison_lines(result))
    raise typer.Exit(0 if result.equal else 1)
