"""The ``chaserdock`` program.

Exit status: 0 done and successful, 1 done but not successful or stopped early, 2 bad input or nothing could be done.
"""

from __future__ import annotations

import os
import sys

import typer
from chaserdock_protocol.errors import ChaserdockError

from .verbs import logs
from .verbs.campaign import campaign
from .verbs.check import check
from .verbs.flights import snapshot, summary
from .verbs.network import judge, keys, router, status
from .verbs.operate import command
from .verbs.options import fail
from .verbs.processes import chaser, controller, record, run, world
from .verbs.publish import figures, report, video
from .verbs.replays import compare, replay
from .verbs.reproduce import reproduce, study
from .verbs.seeing import calibrate, markers

app = typer.Typer(
    name="chaserdock",
    help="Vision-based docking of several satellites with a tumbling target.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for verb in (
    run,
    world,
    chaser,
    controller,
    record,
    command,
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
):
    app.command()(verb)
app.add_typer(logs.app, name="log")
app.add_typer(keys, name="keys")


def main() -> None:
    """Entry point; a closed pipe (``| head``) is no error."""
    try:
        app()
    except ChaserdockError as error:
        sys.exit(fail(str(error)).exit_code)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
