# SPDX-License-Identifier: Apache-2.0
"""Commands that run one process of a mission, for missions on several hosts or in containers."""

from __future__ import annotations

import sys
from datetime import datetime
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .options import (
    DEFAULT_LEASE_S,
    ChaserArg,
    ConfigOpt,
    ConnectOpt,
    JoinTimeoutOpt,
    KeysOpt,
    LeaseOpt,
    ListenOpt,
    Mode,
    ModeOpt,
    NamespaceOpt,
    NetMode,
    NetModeOpt,
    OutOpt,
    ScenarioArg,
    SeedOpt,
    SetOpt,
    WatchOpt,
    check_config,
    check_endpoints,
    fail,
    link_of,
    server_link,
    tls_of,
)

if TYPE_CHECKING:
    from chaserdock_protocol.process import ProcessOptions


def start_process(name: str, options: ProcessOptions) -> None:
    """Run a process by its entry point (group ``chaserdock.processes``) and exit with its status."""
    installed = [e for e in entry_points(group="chaserdock.processes") if e.name == name]
    if not installed:
        raise fail(f"no process {name!r} is installed")
    try:
        process = installed[0].load()
    except ImportError as error:
        if "pybullet" in str(error):
            python = f"{sys.version_info.major}.{sys.version_info.minor}"
            raise fail(
                f"the world needs PyBullet, which has no wheels for Python {python}; use Python 3.11, "
                "e.g. uv run --python 3.11 chaserdock world …"
            ) from None
        raise
    sys.exit(process(options))


def world(
    scenario: ScenarioArg,
    mode: ModeOpt = Mode.lockstep,
    seed: SeedOpt = None,
    overrides: SetOpt = None,
    recorder: Annotated[bool, typer.Option(help="wait for a recorder before the first tick")] = True,
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = NetMode.peer,
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    lease: LeaseOpt = DEFAULT_LEASE_S,
    rejoin_timeout: Annotated[
        float, typer.Option(min=0.0, help="lock-step: seconds to wait after all processes were lost")
    ] = 0.0,
    watch_parent: WatchOpt = False,
) -> None:
    """Simulate the world: physics, cameras, time. Listens on tcp/127.0.0.1:7447 by default."""
    from chaserdock_protocol.process import ProcessOptions
    from chaserdock_protocol.shipped_scenarios import find_scenario

    options = ProcessOptions(
        link=server_link(namespace, connect, listen, net_mode, config, lease, keys),
        scenario=find_scenario(scenario),
        overrides=tuple(overrides or ()),
        seed=seed,
        mode=mode.value,
        recorder_expected=recorder,
        rejoin_s=rejoin_timeout,
        watch_parent=watch_parent,
    )
    start_process("world", options)


def chaser(
    number: ChaserArg,
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = NetMode.peer,
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    lease: LeaseOpt = DEFAULT_LEASE_S,
    timeout: JoinTimeoutOpt = None,
    watch_parent: WatchOpt = False,
) -> None:
    """Run one chaser: measures the target's pose in its images, drives its actuators."""
    from chaserdock_protocol.process import ProcessOptions

    link = link_of(namespace, connect, listen, net_mode, config, lease, keys, f"chaser/{number}")
    start_process(
        "chaser", ProcessOptions(link=link, chaser=number, patience_s=timeout, watch_parent=watch_parent)
    )


def controller(
    standby: Annotated[
        bool, typer.Option("--standby", help="run as the hot standby of another controller")
    ] = False,
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = NetMode.peer,
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    lease: LeaseOpt = DEFAULT_LEASE_S,
    timeout: JoinTimeoutOpt = None,
    watch_parent: WatchOpt = False,
) -> None:
    """Run the central controller: fuses all chasers' measurements, plans for all chasers."""
    from chaserdock_protocol.process import ProcessOptions

    name = "standby" if standby else "controller"
    link = link_of(namespace, connect, listen, net_mode, config, lease, keys, name)
    options = ProcessOptions(link=link, patience_s=timeout, watch_parent=watch_parent, standby=standby)
    start_process("controller", options)


def record(
    out: OutOpt = None,
    by_run: Annotated[bool, typer.Option(help="write into a folder of this run inside OUT")] = False,
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = NetMode.peer,
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    lease: LeaseOpt = DEFAULT_LEASE_S,
    timeout: JoinTimeoutOpt = None,
    rotate_size: Annotated[
        float | None,
        typer.Option(min=1, max=1e9, help="start a new file (mission-0000.mcap …) after this many megabytes"),
    ] = None,
    rotate_time: Annotated[
        float | None, typer.Option(min=1, help="start a new file after this many simulated seconds")
    ] = None,
    viewer: Annotated[bool, typer.Option(help="write the layer that rerun and Foxglove read, too")] = True,
    watch_parent: WatchOpt = False,
) -> None:
    """Record every message into OUT/mission.mcap."""
    from chaserdock_protocol.process import ProcessOptions, Rotation

    folder = (
        (out or Path("runs")) if by_run else out or Path("runs") / f"record-{datetime.now():%Y%m%d-%H%M%S}"
    )
    link = link_of(namespace, connect, listen, net_mode, config, lease, keys, "recorder")
    options = ProcessOptions(
        link=link,
        out=folder,
        by_run=by_run,
        rotation=Rotation(None if rotate_size is None else round(rotate_size * 1e6), rotate_time),
        viewer_layer=viewer,
        patience_s=timeout,
        watch_parent=watch_parent,
    )
    start_process("record", options)


def router(
    listen: ListenOpt = None,
    keys: KeysOpt = None,
    namespace: NamespaceOpt = "chaserdock",
    config: ConfigOpt = None,
    lease: LeaseOpt = 10.0,
    until: Annotated[
        str | None, typer.Option(metavar="PROCESS", help="exit when this process has joined and left")
    ] = None,
    watch_parent: WatchOpt = False,
) -> None:
    """Run the router that a mission's processes connect to; with --keys it enforces each process' access rights."""
    from chaserdock_protocol.process import ProcessOptions
    from chaserdock_protocol.topics import is_process_name
    from chaserdock_protocol.transport import DEFAULT_ENDPOINT, Link

    if until is not None and not is_process_name(until):
        raise fail(f"--until {until}: must be a process, e.g. operator or chaser/0")
    check_config(config)
    check_endpoints("--listen", listen or [], tls=keys is not None)
    scheme = "tls/" if keys is not None else "tcp/"
    endpoints = tuple(listen or [DEFAULT_ENDPOINT.replace("tcp/", scheme)])
    tls = tls_of(keys, "router") if keys is not None else None
    link = Link(namespace, (), endpoints, "router", config, round(lease * 1000), tls)
    start_process("router", ProcessOptions(link=link, until=until, watch_parent=watch_parent))
