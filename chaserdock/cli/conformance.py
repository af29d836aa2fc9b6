"""The verb that holds a foreign process against the protocol."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import JsonOpt


def check(
    process: Annotated[str, typer.Argument(help="whose place it takes: controller, or chaser/N")],
    log: Annotated[Path, typer.Argument(help="a mission.mcap, or the folder of a run; flown in lock-step")],
    command: Annotated[
        list[str], typer.Argument(help="after --: how to run it, with {endpoint} and {namespace} in it")
    ],
    ticks: Annotated[int, typer.Option(min=1, help="ticks of the log to play")] = 100,
    start: Annotated[float, typer.Option("--start-s", min=0.1, help="seconds it may take to join up")] = 60.0,
    patience: Annotated[
        float, typer.Option("--patience-s", min=0.1, help="seconds that an answer, or its end, may take")
    ] = 10.0,
    as_json: JsonOpt = False,
) -> None:
    """Run a foreign process against a recorded log; status 0 if it keeps the protocol, 1 if not."""
    import json

    import msgspec

    from chaserdock.conformance.harness import check as run

    found = run(log, process, command, ticks, start, patience)
    if as_json:
        print(json.dumps({"kept": not found.findings, **msgspec.to_builtins(found)}, indent=2))
    else:
        for finding in found.findings:
            print(finding.line())
        verdict = f"{len(found.findings)} findings" if found.findings else "keeps the protocol"
        print(f"{process}: {verdict}; {found.ticks} ticks played, {found.messages} messages heard")
    raise typer.Exit(1 if found.findings else 0)
