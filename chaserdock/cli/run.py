# SPDX-License-Identifier: Apache-2.0
"""Commands that fly whole missions on this machine: ``run`` and ``campaign``."""

from __future__ import annotations

import os
import sys
import threading
import time
import webbrowser
from collections.abc import Callable
from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.stall import DEFAULT_STALL_S

from .options import (
    ClusterOpt,
    JsonLinesOpt,
    KeysOpt,
    ModeOpt,
    ModeOption,
    OutOpt,
    QuietOpt,
    SeedOpt,
    SetOpt,
    StallOpt,
    complete_scenario,
    errors_as_json,
    fail,
    show_of,
)

if TYPE_CHECKING:
    from chaserdock.launch.launcher import Viewer


def run(
    scenario: Annotated[
        str | None,
        typer.Argument(
            help="scenario file, or name of a shipped scenario", autocompletion=complete_scenario
        ),
    ] = None,
    out: OutOpt = None,
    like: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="in place of a scenario: fly the simulation twin of a recorded flight, with its "
            "start and commands, as RUN/twin.toml",
        ),
    ] = None,
    mode: ModeOpt = ModeOption.lockstep,
    seed: SeedOpt = None,
    overrides: SetOpt = None,
    quiet: QuietOpt = False,
    as_json: JsonLinesOpt = False,
    view: Annotated[
        bool,
        typer.Option(
            "--view", help="serve the viewer, too, until its last tab is closed (see `view`)"
        ),
    ] = False,
    keys: KeysOpt = None,
    stall_s: StallOpt = DEFAULT_STALL_S,
    port: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=65535,
            help="port of 127.0.0.1 on which commands reach the mission; a free one by default",
        ),
    ] = None,
    namespace: Annotated[
        str | None, typer.Option(help="Zenoh namespace of the mission; a unique one by default")
    ] = None,
) -> None:
    """Fly a scenario on this machine: start all processes, record, judge. Status 0 only if the
    flight is a success.
    """
    from chaserdock.launch.launcher import Viewer, fly_mission, print_outcome, print_where
    from chaserdock.launch.progress import Show
    from chaserdock.launch.signals import stop_on_signals

    show = show_of(quiet, as_json)
    with errors_as_json(as_json), stop_on_signals() as stop, ExitStack() as stack:
        scenario = _flown(scenario, like)
        viewer = stack.enter_context(Viewer(choose_viewer_port())) if view else None
        outcome = fly_mission(
            scenario,
            out,
            mode.value,
            tuple(overrides or ()),
            seed=seed,
            keys=keys,
            stall_s=stall_s,
            show=show,
            viewer=viewer,
            stop_requested=stop.is_set,
            port=port,
            namespace=namespace,
        )
        print_outcome(outcome, show)
        if outcome.summary is not None and show is not Show.json:
            print_where(outcome)
        if viewer is not None:
            wait_for_viewer(viewer, stop.is_set)
    raise typer.Exit(outcome.status)


def _flown(scenario: str | None, like: Path | None) -> str:
    """Return the scenario to fly: the given one, or the file of a flight's twin."""
    if (scenario is None) == (like is None):
        raise fail("run: needs a scenario, or --like RUN, and not both")
    if like is None:
        assert scenario is not None
        return scenario
    from chaserdock.launch.twin import twin_of

    from .scenario import as_toml

    path = (like if like.is_dir() else like.parent) / "twin.toml"
    write_atomically(path, as_toml(twin_of(like)))
    return str(path)


def choose_viewer_port(open_page: bool = False) -> int:
    """Return a free port for the viewer of a mission that starts now, and announce its page."""
    from chaserdock.viewer.address import (
        DEFAULT_HOST,
        TOKEN_VARIABLE,
        free_port,
        page_token,
        url_of,
    )

    port = free_port(DEFAULT_HOST, None)
    os.environ[TOKEN_VARIABLE] = token = page_token()  # read by the viewer's process
    announce_viewer(port, url_of(DEFAULT_HOST, port, token), open_page)
    return port


def announce_viewer(port: int, url: str, open_page: bool = False) -> threading.Thread:
    """Print the address of the viewer as soon as it answers, and with ``open_page`` open it in a
    browser, on a thread that does not outlive the program.
    """
    from chaserdock.launch.container import is_listening
    from chaserdock.viewer.address import DEFAULT_HOST

    def wait() -> None:
        while not is_listening(DEFAULT_HOST, port):
            time.sleep(0.1)
        print(f"the viewer is at {url}", file=sys.stderr, flush=True)
        if open_page:
            webbrowser.open(url)

    thread = threading.Thread(target=wait, name="viewer address", daemon=True)
    thread.start()
    return thread


def wait_for_viewer(viewer: Viewer, stop_requested: Callable[[], bool]) -> None:
    """Leave the page of a flight that has ended to its reader, until it is closed."""
    if viewer.is_shown() and not stop_requested():
        print("the viewer ends when its last tab is closed, or by Ctrl-C", file=sys.stderr)
        viewer.wait(stop_requested)


class KeepLogs(StrEnum):
    """Runs whose logs are kept."""

    failures = "failures"
    all = "all"
    none = "none"


def campaign(
    file: Annotated[Path, typer.Argument(help="campaign file (TOML)")],
    out: Annotated[
        Path | None, typer.Option(help="folder for table and report; campaigns/NAME by default")
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, help="concurrent runs on this machine; its CPU cores by default"),
    ] = None,
    cluster: ClusterOpt = None,
    keep_logs: Annotated[
        KeepLogs, typer.Option(help="runs whose logs are kept")
    ] = KeepLogs.failures,
    only: Annotated[
        int | None, typer.Option(min=0, help="fly this run only, and print its result")
    ] = None,
) -> None:
    """Fly many runs of a scenario; a stopped campaign resumes. Status 0 when all runs have ended.

    Each run is a whole mission or, with the table [alone] in the file, the controller alone.
    """
    from chaserdock.experiments.campaign import fly_campaign
    from chaserdock.experiments.worker import Workers

    if only is not None and (cluster is not None or jobs is not None):
        raise fail("--only flies one run on this machine; it excludes --cluster and --jobs")
    if jobs is not None and cluster is not None:
        raise fail("--jobs is for this machine; it excludes --cluster")
    workers = Workers(jobs or os.cpu_count() or 1, cluster, keep_logs.value)
    raise typer.Exit(fly_campaign(file, out, workers, only))
