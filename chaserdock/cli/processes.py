# SPDX-License-Identifier: Apache-2.0
"""Commands that run one process of a mission, for missions on several hosts or in containers."""

from __future__ import annotations

import sys
from datetime import datetime
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from chaserdock_protocol.stall import DEFAULT_STALL_S

from chaserdock.exit_codes import FAILED, STOPPED

from .options import (
    ChaserArg,
    JoinTimeoutOpt,
    LinkOptions,
    ModeOpt,
    ModeOption,
    OutOpt,
    ScenarioArg,
    SeedOpt,
    SetOpt,
    StallOpt,
    WatchOpt,
    fail,
    with_link_options,
)

if TYPE_CHECKING:
    from chaserdock_protocol.process import ProcessOptions


RecorderOpt = Annotated[bool, typer.Option(help="wait for a recorder before the first tick")]
ConnectTimeoutOpt = Annotated[
    float | None,
    typer.Option(
        min=0.1,
        help="seconds to wait for a router and, before the first tick, for another process "
        "to connect; unlimited by default",
    ),
]


def start_process(name: str, options: ProcessOptions) -> None:
    """Run a process by its entry point (group ``chaserdock.processes``) and exit with its status:
    ``STOPPED`` where it did not end its work because of a signal.
    """
    from chaserdock_protocol.process import stopped_by_signal

    installed = [e for e in entry_points(group="chaserdock.processes") if e.name == name]
    if not installed:
        raise fail(f"no process {name!r} is installed")
    status = installed[0].load()(options)
    sys.exit(STOPPED if status == FAILED and stopped_by_signal() else status)


@with_link_options()
def world(
    scenario: ScenarioArg,
    mode: ModeOpt = ModeOption.lockstep,
    seed: SeedOpt = None,
    overrides: SetOpt = None,
    recorder: RecorderOpt = True,
    *,
    link: LinkOptions,
    timeout: ConnectTimeoutOpt = None,
    rejoin_timeout: Annotated[
        float,
        typer.Option(min=0.0, help="lock-step: seconds to wait after all processes were lost"),
    ] = 0.0,
    stall_s: StallOpt = DEFAULT_STALL_S,
    watch_parent: WatchOpt = False,
) -> None:
    """Simulate the world: physics, cameras, time. Listens on tcp/127.0.0.1:7447 by default."""
    from chaserdock_protocol.process import ProcessOptions
    from chaserdock_protocol.shipped_scenarios import find_scenario

    options = ProcessOptions(
        link=link.link("world", timeout),
        scenario=find_scenario(scenario),
        overrides=tuple(overrides or ()),
        seed=seed,
        mode=mode.value,
        recorder_expected=recorder,
        patience_s=timeout,
        rejoin_s=rejoin_timeout,
        stall_s=stall_s,
        watch_parent=watch_parent,
    )
    start_process("world", options)


@with_link_options()
def gateway(
    scenario: ScenarioArg,
    seed: SeedOpt = None,
    overrides: SetOpt = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="send nothing to robots and latches")
    ] = False,
    check: Annotated[
        float | None,
        typer.Option(
            min=0.5,
            max=600,
            metavar="SECONDS",
            help="look at the devices for so long, print what is found, and move nothing",
        ),
    ] = None,
    recorder: RecorderOpt = True,
    resume: Annotated[
        Path | None,
        typer.Option(
            help="file that keeps which mission has begun: started with the same one after it was "
            "killed, the gateway takes the mission up again, disarmed"
        ),
    ] = None,
    *,
    link: LinkOptions,
    timeout: ConnectTimeoutOpt = None,
    rejoin_timeout: Annotated[
        float, typer.Option(min=0.0, help="seconds to wait after all processes were lost")
    ] = 0.0,
    watch_parent: WatchOpt = False,
) -> None:
    """Connect cameras, robots and motion capture of a laboratory to a mission, in place of the
    world. Nothing moves before `chaserdock command arm`; in the terminal, k or space kills.
    """
    from chaserdock_protocol.process import ProcessOptions
    from chaserdock_protocol.shipped_scenarios import find_scenario

    options = ProcessOptions(
        link=link.link("world", timeout),
        scenario=find_scenario(scenario),
        overrides=tuple(overrides or ()),
        seed=seed,
        mode="realtime",
        recorder_expected=recorder,
        patience_s=timeout,
        rejoin_s=rejoin_timeout,
        watch_parent=watch_parent,
        dry_run=dry_run,
        resume=resume,
    )
    if check is not None:
        _check_devices(options, check)
    start_process("gateway", options)


def _check_devices(options: ProcessOptions, duration_s: float) -> None:
    """Print what is found about each device; exit with status 1 if something is wrong."""
    import time

    from chaserdock_agents.gateway.check import check_laboratory
    from chaserdock_agents.gateway.devices import DeviceHost
    from chaserdock_protocol.mission.host import load_mission_scenario
    from rich.console import Console
    from rich.table import Table

    scenario = load_mission_scenario(options)
    if scenario.lab is None:
        raise fail(f"{options.scenario}: has no [lab], which names the devices")
    host = DeviceHost(time.monotonic_ns)
    findings = check_laboratory(scenario, host, duration_s, time.sleep)
    table = Table("device", "rate", "jitter", "age", "clock offset", "found")
    for f in findings:
        offset = "" if f.offset_s is None else f"{f.offset_s:+.4f} s"
        found = "; ".join([*f.problems, f.sees] if f.sees else f.problems) or "good"
        row = (f"{f.rate_hz:.1f} Hz", f"{f.jitter_s * 1e3:.1f} ms", f"{f.age_s * 1e3:.0f} ms")
        table.add_row(f.device, *row, offset, found, style="red" if f.problems else None)
    Console().print(table)
    raise typer.Exit(FAILED if any(f.problems for f in findings) else 0)


@with_link_options()
def chaser(
    number: ChaserArg,
    camera: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS",
            help="a camera of its own, as in [[lab.camera]] (docs/devices.md): images stay here",
        ),
    ] = "",
    camera_latency: Annotated[
        float,
        typer.Option(
            min=0.0, max=1.0, metavar="SECONDS", help="--camera: from exposure to arrival, at best"
        ),
    ] = 0.0,
    *,
    link: LinkOptions,
    timeout: JoinTimeoutOpt = None,
    stall_s: StallOpt = DEFAULT_STALL_S,
    watch_parent: WatchOpt = False,
) -> None:
    """Run one chaser: measures the target's pose in its images, drives its actuators."""
    from chaserdock_protocol.process import ProcessOptions

    options = ProcessOptions(
        link=link.link(f"chaser/{number}", timeout),
        chaser=number,
        patience_s=timeout,
        stall_s=stall_s,
        watch_parent=watch_parent,
        camera=camera,
        camera_latency_s=camera_latency,
    )
    start_process("chaser-with-camera" if camera else "chaser", options)


@with_link_options()
def controller(
    standby: Annotated[
        bool, typer.Option("--standby", help="run as the hot standby of another controller")
    ] = False,
    *,
    link: LinkOptions,
    timeout: JoinTimeoutOpt = None,
    stall_s: StallOpt = DEFAULT_STALL_S,
    watch_parent: WatchOpt = False,
) -> None:
    """Run the central controller: fuses all chasers' measurements, plans for all chasers."""
    from chaserdock_protocol.process import ProcessOptions

    own = link.link("standby" if standby else "controller", timeout)
    options = ProcessOptions(
        link=own, patience_s=timeout, stall_s=stall_s, watch_parent=watch_parent, standby=standby
    )
    start_process("controller", options)


@with_link_options()
def mapper(
    *,
    link: LinkOptions,
    timeout: JoinTimeoutOpt = None,
    stall_s: StallOpt = DEFAULT_STALL_S,
    watch_parent: WatchOpt = False,
) -> None:
    """Run the mapper: maps a target of unknown shape from the points that all chasers follow."""
    from chaserdock_protocol.process import ProcessOptions

    options = ProcessOptions(
        link=link.link("mapper", timeout),
        patience_s=timeout,
        stall_s=stall_s,
        watch_parent=watch_parent,
    )
    start_process("mapper", options)


@with_link_options()
def record(
    out: OutOpt = None,
    by_run: Annotated[
        bool, typer.Option(help="write into a folder of this run inside OUT")
    ] = False,
    *,
    link: LinkOptions,
    timeout: JoinTimeoutOpt = None,
    stall_s: StallOpt = DEFAULT_STALL_S,
    rotate_size: Annotated[
        float | None,
        typer.Option(
            min=1, max=1e9, help="start a new file (mission-0000.mcap …) after this many megabytes"
        ),
    ] = None,
    rotate_time: Annotated[
        float | None, typer.Option(min=1, help="start a new file after this many simulated seconds")
    ] = None,
    viewer: Annotated[
        bool, typer.Option(help="write the layer that rerun and Foxglove read, too")
    ] = True,
    watch_parent: WatchOpt = False,
) -> None:
    """Record every message into OUT/mission.mcap."""
    from chaserdock_protocol.process import ProcessOptions, Rotation

    folder = (
        (out or Path("runs"))
        if by_run
        else out or Path("runs") / f"record-{datetime.now():%Y%m%d-%H%M%S}"
    )
    options = ProcessOptions(
        link=link.link("recorder", timeout),
        out=folder,
        by_run=by_run,
        rotation=Rotation(None if rotate_size is None else round(rotate_size * 1e6), rotate_time),
        viewer_layer=viewer,
        patience_s=timeout,
        stall_s=stall_s,
        watch_parent=watch_parent,
    )
    start_process("record", options)


@with_link_options()
def ros2(
    *,
    link: LinkOptions,
    ros_connect: Annotated[
        list[str] | None,
        typer.Option(
            help="Zenoh endpoint of ROS 2's router (rmw_zenohd); tcp/127.0.0.1:7447 by default"
        ),
    ] = None,
    ros_listen: Annotated[
        list[str] | None,
        typer.Option(help="be ROS 2's router, in place of rmw_zenohd, at this endpoint"),
    ] = None,
    ros_domain: Annotated[
        int, typer.Option(min=0, max=232, envvar="ROS_DOMAIN_ID", help="domain of ROS 2")
    ] = 0,
    control: Annotated[
        bool,
        typer.Option(
            "--control",
            help="real time: take the controller's place, with wrenches from "
            "/chaser_N/wrench_command, instead of showing the mission",
        ),
    ] = False,
    timeout: JoinTimeoutOpt = None,
    stall_s: StallOpt = DEFAULT_STALL_S,
    watch_parent: WatchOpt = False,
) -> None:
    """Show a mission to ROS 2 (rmw_zenoh_cpp; Jazzy, Kilted) and serve its operator commands. Needs
    chaserdock[ros2], no ROS.
    """
    from chaserdock_protocol.process import ProcessOptions, RosLink

    from .options import check_endpoints

    check_endpoints("--ros-connect", ros_connect or [])
    check_endpoints("--ros-listen", ros_listen or [])
    listen = tuple(ros_listen or ())
    connect = tuple(ros_connect or (() if listen else RosLink().connect))
    options = ProcessOptions(
        link=link.link("controller" if control else "bridge", timeout),
        patience_s=timeout,
        stall_s=stall_s,
        watch_parent=watch_parent,
        ros=RosLink(connect, listen, ros_domain, control),
    )
    start_process("ros2", options)


@with_link_options("connect", "net_mode", lease=10.0)
def router(
    *,
    link: LinkOptions,
    until: Annotated[
        str | None,
        typer.Option(metavar="PROCESS", help="exit when this process has joined and left"),
    ] = None,
    watch_parent: WatchOpt = False,
) -> None:
    """Run the router that a mission's processes connect to; with --keys it enforces each process'
    access rights.
    """
    from chaserdock_protocol.process import ProcessOptions
    from chaserdock_protocol.topics import is_process_name

    if until is not None and not is_process_name(until):
        raise fail(f"--until {until}: must be a process, e.g. operator or chaser/0")
    start_process(
        "router", ProcessOptions(link=link.router_link(), until=until, watch_parent=watch_parent)
    )
