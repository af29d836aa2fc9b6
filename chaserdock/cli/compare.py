# SPDX-License-Identifier: Apache-2.0
"""Commands that reproduce and compare: replays, flights, the paper's results, conformance with the
protocol.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from .options import JsonOpt, LogArg, SetOpt, print_result

ToleranceOpt = Annotated[
    float,
    typer.Option(
        min=0.0, help="largest difference of numbers that count as equal (for another CPU type)"
    ),
]


def replay(
    log: LogArg,
    through: Annotated[
        str,
        typer.Option(
            metavar="STAGE",
            help="part of the software: perception, fusion, controller, or one that a package "
            "provides (entry points of `chaserdock.replays`)",
        ),
    ],
    overrides: SetOpt = None,
    tolerance: ToleranceOpt = 0.0,
    as_json: JsonOpt = False,
) -> None:
    """Feed recorded inputs to the present code and compare its outputs with the log. Status 1 when
    they differ.
    """
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


def reproduce(
    quick: Annotated[
        bool,
        typer.Option("--quick", help="one short flight per row, no missions: minutes, not an hour"),
    ] = False,
    out: Annotated[
        Path, typer.Option(help="folder for results and page; a second call resumes there")
    ] = Path("runs/reproduce"),
    jobs: Annotated[
        int,
        typer.Option(min=1, help="concurrent flights; more than one disturbs the solve times"),
    ] = 1,
    earlier: Annotated[
        Path | None,
        typer.Option(
            metavar="PAGE",
            help="an earlier reproduction.md: its cells stand, with their date and commit, where a "
            "row is not flown",
        ),
    ] = None,
) -> None:
    """Fly the paper's experiments and compare with its figures: writes OUT/reproduction.md and
    .html.

    The paper's chain needs its solver, OpEn: the extra chaserdock[open] and Rust's cargo. Without
    them the page lacks that chain, and the status is 1.
    """
    from chaserdock.experiments.reproduction.reproduce import reproduce as fly_all

    raise typer.Exit(fly_all(quick, out, jobs, earlier))


def check(
    process: Annotated[
        str, typer.Argument(help="process that it replaces: controller, chaser/N, or world")
    ],
    log: LogArg,
    command: Annotated[
        list[str],
        typer.Argument(help="after --: its command line, with {endpoint} and {namespace}"),
    ],
    ticks: Annotated[int, typer.Option(min=1, help="ticks of the log to play")] = 100,
    join_timeout: Annotated[
        float, typer.Option(min=0.1, help="seconds that joining may take")
    ] = 60.0,
    timeout: Annotated[
        float, typer.Option(min=0.1, help="seconds that a reply, or exiting, may take")
    ] = 10.0,
    as_json: JsonOpt = False,
) -> None:
    """Run a process against a lock-step log and check its messages. Status 0 if it conforms to the
    protocol, else 1.

    A world needs no log: `chaserdock check world -- COMMAND ...`.
    """
    import msgspec

    from chaserdock.conformance.harness import check as run
    from chaserdock.conformance.world import check_world

    if process == "world":  # what stands in the log's place is the command's first word
        result = check_world([str(log), *command], ticks, join_timeout, timeout)
    else:
        result = run(log, process, command, ticks, join_timeout, timeout)
    verdict = f"{len(result.findings)} findings" if result.findings else "conforms to the protocol"
    counts = f"{result.ticks} ticks played, {result.messages} messages received"
    lines = [*(finding.line() for finding in result.findings), f"{process}: {verdict}; {counts}"]
    print_result(as_json, {"kept": not result.findings, **msgspec.to_builtins(result)}, lines)
    raise typer.Exit(1 if result.findings else 0)
