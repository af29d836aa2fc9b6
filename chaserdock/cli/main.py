# SPDX-License-Identifier: Apache-2.0
"""The ``chaserdock`` program: all commands. Exit statuses: ``chaserdock.exit_codes``."""

from __future__ import annotations

import errno
import gc
import os
import sys
from collections.abc import Callable
from importlib import metadata
from typing import Annotated, Any

import typer
from chaserdock_protocol.errors import ChaserdockError
from typer.exceptions import TyperException

from chaserdock.exit_codes import FAILED, STOPPED
from chaserdock.launch.signals import interrupts

from .analysis import judge, report, video
from .calibrate import calibrate
from .compare import check, compare, replay, reproduce
from .datasets import dataset
from .demo import demo
from .deploy import deploy
from .help import HELP_OPTIONS, ProgramHelp, add_command
from .logs import log, play
from .operate import command, status, view
from .options import fail
from .processes import chaser, controller, gateway, mapper, record, ros2, router, world
from .renamed import renamed
from .run import campaign, run
from .scenario import scenario
from .simulate import simulate
from .target import target
from .track import track

_GC_THRESHOLD = 100_000
"""Objects allocated between two garbage collections. Imports create several 100,000 objects that
stay. With Python's default, 700, collecting among them takes an eighth of a process' start.
"""

GROUPS: dict[str, tuple[Callable[..., None], ...]] = {
    "Fly": (demo, run, simulate, campaign, reproduce),
    "Processes": (world, gateway, chaser, controller, mapper, record, play, router, ros2),
    "Operate": (command, status, view),
    "Look at a flight": (judge, report, video, log),
    "Compare": (replay, compare, check),
    "Laboratory": (track,),
    "Prepare": (scenario, target, calibrate, dataset, deploy),
}
"""Commands by the section of the help that lists them."""


def _print_version(requested: bool) -> None:
    if requested:
        typer.echo(f"chaserdock {metadata.version('chaserdock')}")
        raise typer.Exit


app = typer.Typer(
    name="chaserdock",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    cls=ProgramHelp,
    context_settings=HELP_OPTIONS,
    rich_markup_mode=None,  # importing rich takes longer than all of the help
)
for panel, members in GROUPS.items():
    for member in members:
        add_command(app, member, rich_help_panel=panel)


@app.callback()
def program(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Vision-based docking of several satellites with a tumbling target."""


def main() -> None:
    """Run the program; report an error and a stop as one line, a closed pipe (``| head``) not at
    all.
    """
    gc.set_threshold(_GC_THRESHOLD)
    try:
        with interrupts():
            _run()
    except KeyboardInterrupt:
        print("chaserdock: stopped", file=sys.stderr)
        sys.exit(STOPPED)
    finally:
        _flush_output()
        # Otherwise Python searches all modules for garbage once more before it exits, which takes a
        # fifth of a short command's time.
        gc.freeze()


def _run() -> None:
    try:
        if notice := renamed(sys.argv[1:]):
            raise ChaserdockError(notice)
        sys.exit(app(prog_name="chaserdock", standalone_mode=False) or 0)
    except ChaserdockError as error:
        sys.exit(fail(str(error)).exit_code)
    except TyperException as error:
        sys.exit(_report_usage_error(error))
    except typer.Abort:  # what click makes of KeyboardInterrupt
        raise KeyboardInterrupt from None
    except BrokenPipeError:
        sys.exit(FAILED)
    except OSError as error:
        if error.errno not in _NO_ROOM:
            raise
        sys.exit(fail(f"{error.filename or 'standard output'}: {error.strerror}").exit_code)


_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
"""Errors of a disk on which nothing can be written."""
_PLAIN_TEXTS = {
    "Value error, ": "",
    "Input should be a valid integer, unable to parse string as an integer": "must be a whole "
    "number",
    "Input should be a valid integer, got a number with a fractional part": "must be a whole "
    "number",
    "Input should be a valid number, unable to parse string as a number": "must be a number",
    "Input should be": "must be",
}


def _report_usage_error(error: Any) -> int:
    """Print typer's error as one line, or the help if that is the error. Returns the exit
    status.
    """
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()
        return error.exit_code
    path = error.ctx.command_path if error.ctx is not None else "chaserdock"
    name = path.removeprefix("chaserdock").strip()
    text = " ".join(error.format_message().split())
    for pydantic_text, plain_text in _PLAIN_TEXTS.items():
        text = text.replace(pydantic_text, plain_text)
    return fail(
        f"{name}: {text.rstrip('.')}; see `chaserdock {name} --help`" if name else text
    ).exit_code


def _flush_output() -> None:
    """Flush standard output; discard it when the reader has closed the pipe, or the disk is full.

    The latter ends the program with status 2.
    """
    assert sys.__stdout__ is not None  # sys.stdout may be click's wrapper by now
    try:
        sys.__stdout__.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.__stdout__.fileno())
        if not isinstance(error, BrokenPipeError):
            sys.exit(fail(f"standard output: {error.strerror}").exit_code)
