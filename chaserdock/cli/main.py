"""The ``chaserdock`` program.

Exit statuses: ``statuses``.
"""

from __future__ import annotations

import os
import sys
from importlib import metadata
from typing import Annotated

import typer
from chaserdock_protocol.errors import ChaserdockError

from chaserdock.exit_codes import FAILED

from . import logs
from .calibration import calibrate, markers
from .campaign import campaign
from .command import command, thruster_fault
from .conformance import check
from .network import judge, keys, router, status
from .options import fail
from .plain import PlainGroup
from .processes import chaser, controller, record, run, world
from .publish import figures, report, video
from .replay import compare, replay
from .reproduce import reproduce, study
from .run import snapshot, summary
from .view import view


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"chaserdock {metadata.version('chaserdock')}")
        raise typer.Exit


app = typer.Typer(
    name="chaserdock",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    cls=PlainGroup,
    rich_markup_mode=None,  # rich takes longer to load than help to read
)
for verb in (
    run,
    world,
    chaser,
    controller,
    record,
    command,
    thruster_fault,
    summary,
    snapshot,
    campaign,
    figures,
    report,
    video,
    replay,
    compare,
    router,
    status,
    judge,
    reproduce,
    study,
    markers,
    calibrate,
    check,
    view,
):
    app.command()(verb)


@app.callback()
def program(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_version, help="Say the version and leave.")
    ] = False,
) -> None:
    """Vision-based docking of several satellites with a tumbling target."""


app.add_typer(logs.app, name="log")
app.add_typer(keys, name="keys")


def main() -> None:
    """Entry point; a closed pipe (``| head``) is no error."""
    try:
        app()
    except ChaserdockError as error:
        sys.exit(fail(str(error)).exit_code)
    except BrokenPipeError:
        sys.exit(FAILED)
    finally:
        _let_go()


def _let_go() -> None:
    """Writes what is still to be written; where nobody reads any more it goes nowhere, or Python would complain."""
    assert sys.__stdout__ is not None  # sys.stdout may be click's wrapper by now
    try:
        sys.__stdout__.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.__stdout__.fileno())
