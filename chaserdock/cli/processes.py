"""Verbs that fly: a whole mission, or one process of it."""

from __future__ import annotations

import sys
from datetime import datetime
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated

import typer
from chaserdock_protocol.shipped_scenarios import find_scenario

from .options import (
    ConfigOpt,
    ConnectOpt,
    KeysOpt,
    LeaseOpt,
    LinesOpt,
    ListenOpt,
    Mode,
    ModeOpt,
    NamespaceOpt,
    NetModeOpt,
    OutOpt,
    PatienceOpt,
    QuietOpt,
    ScenarioArg,
    SeedOpt,
    SetOpt,
    WatchOpt,
    errors_as_lines,
    fail,
    link_of,
    show_of,
)


def start_process(name: str, options) -> None:
    """Runs a process by its entry point (group ``chaserdock.processes``) and exits with its status."""
    found = [e for e in entry_points(group="chaserdock.processes") if e.name == name]
    if not found:
        raise fail(f"no process {name!r} is installed")
    try:
        process = found[0].load()
    except ImportError as error:
        if "pybullet" in str(error):
            raise fail(
                f"the world needs PyBullet, whose wheels end at Python 3.11; this is Python {sys.version_info.major}."
                f"{sys.version_info.minor}. With uv: uv run --python 3.11 chaserdock world …"
            ) from None
        raise
    sys.exit(process(options))


def run(
    scenario: ScenarioArg,
    out: OutOpt = None,
    mode: ModeOpt = Mode.lockstep,
    seed: SeedOpt = None,
    overrides: SetOpt = None,
    quiet: QuietOpt = False,
    as_json: LinesOpt = False,
    view: Annotated[bool, typer.Option("--view", help="show it in a web browser, too (see `view`)")] = False,
    keys: Annotated[
        Path | None,
        typer.Option(
            "--keys",
            envvar="CHASERDOCK_KEYS",
            metavar="DIR",
            help="a mission's keys (see `keys init`): through a router, over TLS, each process held to its rights",
        ),
    ] = None,
) -> None:
    """Fly a scenario on this machine: start every process, record, judge; status 0 only if it was a success."""
    from chaserdock.launch.launcher import run_mission

    show = show_of(quiet, as_json)
    with errors_as_lines(as_json):
        path = find_scenario(scenario)
        folder = out or Path("runs") / f"{path.stem}-{datetime.now():%Y%m%d-%H%M%S}"
        changes = tuple(overrides or ())
        raise typer.Exit(run_mission(path, folder, mode.value, seed, changes, show, view, keys))


def world(
    scenario: ScenarioArg,
    mode: ModeOpt = Mode.lockstep,
    seed: SeedOpt = None,
    overrides: SetOpt = None,
    recorder: Annotated[bool, typer.Option(help="wait for a recorder before the first tick")] = True,
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    lease_ms: LeaseOpt = 60_000,
    rejoin: Annotated[
        float, typer.Option("--rejoin-s", help="lock-step: seconds to wait when everybody is lost")
    ] = 0.0,
    watch_parent: WatchOpt = False,
) -> None:
    """The simulated world: physics, cameras, time. Listens on tcp/127.0.0.1:7447 unless told otherwise."""
    from chaserdock_protocol.process import ProcessOptions
    from chaserdock_protocol.transport import DEFAULT_ENDPOINT

    if listen is None and connect is None and net_mode == "peer" and keys is None:
        listen = [DEFAULT_ENDPOINT]
    options = ProcessOptions(
        link=link_of(namespace, connect or [], listen, net_mode, config, lease_ms, keys, "world"),
        scenario=find_scenario(scenario),
        overrides=tuple(overrides or ()),
        seed=seed,
        mode=mode.value,
        recorder_expected=recorder,
        rejoin_s=rejoin,
        watch_parent=watch_parent,
    )
    start_process("world", options)


def chaser(
    number: Annotated[int, typer.Argument(min=0, max=255, help="which chaser, from 0")],
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    lease_ms: LeaseOpt = 60_000,
    patience: PatienceOpt = None,
    watch_parent: WatchOpt = False,
) -> None:
    """One chaser: sees the target, drives its actuators."""
    from chaserdock_protocol.process import ProcessOptions

    link = link_of(namespace, connect, listen, net_mode, config, lease_ms, keys, f"chaser/{number}")
    start_process(
        "chaser", ProcessOptions(link=link, chaser=number, patience_s=patience, watch_parent=watch_parent)
    )


def controller(
    standby: Annotated[
        bool,
        typer.Option("--standby", help="as the second one: follow, and take over when the first is lost"),
    ] = False,
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    lease_ms: LeaseOpt = 60_000,
    patience: PatienceOpt = None,
    watch_parent: WatchOpt = False,
) -> None:
    """The central controller: fuses what all chasers see, plans for all of them."""
    from chaserdock_protocol.process import ProcessOptions

    name = "standby" if standby else "controller"
    link = link_of(namespace, connect, listen, net_mode, config, lease_ms, keys, name)
    options = ProcessOptions(link=link, patience_s=patience, watch_parent=watch_parent, standby=standby)
    start_process("controller", options)


def record(
    out: OutOpt = None,
    by_run: Annotated[bool, typer.Option(help="make a folder for this run in OUT")] = False,
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    lease_ms: LeaseOpt = 60_000,
    patience: PatienceOpt = None,
    rotate_size_mb: Annotated[
        float | None,
        typer.Option(min=1, help="begin a new file (mission-0000.mcap …) after so many megabytes"),
    ] = None,
    rotate_s: Annotated[
        float | None, typer.Option(min=1, help="begin a new file after so many simulated seconds")
    ] = None,
    viewer: Annotated[bool, typer.Option(help="write the layer that rerun and Foxglove show, too")] = True,
    watch_parent: WatchOpt = False,
) -> None:
    """The recorder: every message into OUT/mission.mcap."""
    from chaserdock_protocol.process import ProcessOptions, Rotation

    folder = (
        (out or Path("runs")) if by_run else out or Path("runs") / f"record-{datetime.now():%Y%m%d-%H%M%S}"
    )
    link = link_of(namespace, connect, listen, net_mode, config, lease_ms, keys, "recorder")
    options = ProcessOptions(
        link=link,
        out=folder,
        by_run=by_run,
        rotation=Rotation(None if rotate_size_mb is None else round(rotate_size_mb * 1e6), rotate_s),
        viewer_layer=viewer,
        patience_s=patience,
        watch_parent=watch_parent,
    )
    start_process("record", options)
