# SPDX-License-Identifier: Apache-2.0
"""The command that tests a process for conformance with the protocol."""

from __future__ import annotations

from typing import Annotated

import typer

from .options import JsonOpt, LogArg, print_result


def check(
    process: Annotated[str, typer.Argument(help="process that it replaces: controller, or chaser/N")],
    log: LogArg,
    command: Annotated[
        list[str], typer.Argument(help="after --: its command line, with {endpoint} and {namespace}")
    ],
    ticks: Annotated[int, typer.Option(min=1, help="ticks of the log to play")] = 100,
    join_timeout: Annotated[float, typer.Option(min=0.1, help="seconds that joining may take")] = 60.0,
    timeout: Annotated[
        float, typer.Option(min=0.1, help="seconds that a reply, or exiting, may take")
    ] = 10.0,
    as_json: JsonOpt = False,
) -> None:
    """Run a process against a lock-step log and check its messages. Status 0 if it conforms to the protocol, else 1."""
    import msgspec

    from chaserdock.conformance.harness import check as run

    result = run(log, process, command, ticks, join_timeout, timeout)
    verdict = f"{len(result.findings)} findings" if result.findings else "conforms to the protocol"
    counts = f"{result.ticks} ticks played, {result.messages} messages received"
    lines = [*(finding.line() for finding in result.findings), f"{process}: {verdict}; {counts}"]
    print_result(as_json, {"kept": not result.findings, **msgspec.to_builtins(result)}, lines)
    raise typer.Exit(1 if result.findings else 0)
