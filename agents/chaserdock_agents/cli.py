"""The ``chaserdock`` program. Heavy imports wait until a verb needs them, so that ``--help`` is quick.

Exit status: 0 done and successful, 1 done but not successful or stopped early, 2 bad input or nothing could be done.
"""

from __future__ import annotations

import os
import sys
from datetime import datetime
from enum import StrEnum
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated

import typer
from chaserdock_protocol.errors import ChaserdockError

from chaserdock_agents.scenarios import find_scenario

app = typer.Typer(
    name="chaserdock",
    help="Vision-based docking of several satellites with a tumbling target.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


class Mode(StrEnum):
    """How simulated time runs."""

    lockstep = "lockstep"
    realtime = "realtime"


class Command(StrEnum):
    """What an operator may ask for."""

    approach = "approach"
    hold = "hold"
    retreat = "retreat"
    abort = "abort"
    goto = "goto"


ScenarioArg = Annotated[str, typer.Argument(help="scenario file, or the name of one that is shipped")]
SetOpt = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="change a scenario value")
]
SeedOpt = Annotated[int | None, typer.Option(help="seed of everything random")]
ModeOpt = Annotated[Mode, typer.Option(help="lockstep waits for every answer; realtime for nobody")]
NamespaceOpt = Annotated[str, typer.Option(help="keeps runs apart")]
ConnectOpt = Annotated[
    list[str] | None, typer.Option("--connect", "-e", metavar="ENDPOINT", help="such as tcp/host:7447")
]
ListenOpt = Annotated[list[str] | None, typer.Option("--listen", "-l", metavar="ENDPOINT")]
NetModeOpt = Annotated[str, typer.Option("--net-mode", "-m", help="peer or client")]
ConfigOpt = Annotated[
    Path | None, typer.Option("--config", "-c", envvar="ZENOH_CONFIG", help="Zenoh configuration file")
]
LeaseOpt = Annotated[int, typer.Option("--lease-ms", help="after that long a silent process counts as lost")]
WatchOpt = Annotated[bool, typer.Option("--watch-parent", hidden=True)]
OutOpt = Annotated[Path | None, typer.Option("--out", help="folder for log and summary; runs/… by default")]


def fail(text: str) -> typer.Exit:
    """One line on standard error, status 2."""
    for line in text.splitlines():
        print(f"chaserdock: {line}", file=sys.stderr)
    return typer.Exit(2)


def link_of(
    namespace: str,
    connect: list[str] | None,
    listen: list[str] | None,
    mode: str,
    config: Path | None,
    lease_ms: int,
):
    """The link that the network options describe."""
    from chaserdock_protocol.transport import DEFAULT_ENDPOINT, Link

    if mode not in ("peer", "client", "router"):
        raise fail(f"--net-mode {mode}: must be peer or client")
    if config is not None and not config.is_file():
        raise fail(f"--config {config}: no such file")
    return Link(
        namespace=namespace,
        connect=tuple(connect if connect is not None else [DEFAULT_ENDPOINT]),
        listen=tuple(listen if listen is not None else ["tcp/127.0.0.1:0"]),
        mode="client" if mode == "client" else "peer",
        config=config,
        lease_ms=lease_ms,
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


def _found(scenario: str) -> Path:
    path = find_scenario(scenario)
    if path is None:
        raise fail(f"{scenario}: no such scenario file, and none of that name is shipped")
    return path


@app.command()
def run(
    scenario: ScenarioArg,
    out: OutOpt = None,
    mode: ModeOpt = Mode.lockstep,
    seed: SeedOpt = None,
    overrides: SetOpt = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="no progress")] = False,
) -> None:
    """Fly a scenario on this machine: start every process, record, judge."""
    from chaserdock_agents.launcher import run_mission

    path = _found(scenario)
    folder = out or Path("runs") / f"{path.stem}-{datetime.now():%Y%m%d-%H%M%S}"
    raise typer.Exit(run_mission(path, folder, mode.value, seed, tuple(overrides or ()), quiet))


@app.command()
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
    lease_ms: LeaseOpt = 60_000,
    watch_parent: WatchOpt = False,
) -> None:
    """The simulated world: physics, cameras, time. Listens on tcp/127.0.0.1:7447 unless told otherwise."""
    from chaserdock_protocol.runtime import ProcessOptions
    from chaserdock_protocol.transport import DEFAULT_ENDPOINT

    if listen is None and connect is None and net_mode == "peer":
        listen = [DEFAULT_ENDPOINT]
    options = ProcessOptions(
        link=link_of(namespace, connect or [], listen, net_mode, config, lease_ms),
        scenario=_found(scenario),
        overrides=tuple(overrides or ()),
        seed=seed,
        mode=mode.value,
        recorder_expected=recorder,
        watch_parent=watch_parent,
    )
    start_process("world", options)


@app.command()
def chaser(
    number: Annotated[int, typer.Argument(min=0, max=255, help="which chaser, from 0")],
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    lease_ms: LeaseOpt = 60_000,
    patience: Annotated[
        float | None, typer.Option(help="seconds to wait for a world; for ever by default")
    ] = None,
    watch_parent: WatchOpt = False,
) -> None:
    """One chaser: sees the target, drives its actuators."""
    from chaserdock_protocol.runtime import ProcessOptions

    link = link_of(namespace, connect, listen, net_mode, config, lease_ms)
    start_process(
        "chaser", ProcessOptions(link=link, chaser=number, patience_s=patience, watch_parent=watch_parent)
    )


@app.command()
def controller(
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    lease_ms: LeaseOpt = 60_000,
    patience: Annotated[
        float | None, typer.Option(help="seconds to wait for a world; for ever by default")
    ] = None,
    watch_parent: WatchOpt = False,
) -> None:
    """The central controller: fuses what all chasers see, plans for all of them."""
    from chaserdock_protocol.runtime import ProcessOptions

    link = link_of(namespace, connect, listen, net_mode, config, lease_ms)
    start_process("controller", ProcessOptions(link=link, patience_s=patience, watch_parent=watch_parent))


@app.command()
def record(
    out: OutOpt = None,
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    listen: ListenOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    lease_ms: LeaseOpt = 60_000,
    patience: Annotated[
        float | None, typer.Option(help="seconds to wait for a world; for ever by default")
    ] = None,
    watch_parent: WatchOpt = False,
) -> None:
    """The recorder: every message into OUT/mission.mcap."""
    from chaserdock_protocol.runtime import ProcessOptions

    folder = out or Path("runs") / f"record-{datetime.now():%Y%m%d-%H%M%S}"
    link = link_of(namespace, connect, listen, net_mode, config, lease_ms)
    options = ProcessOptions(link=link, out=folder, patience_s=patience, watch_parent=watch_parent)
    start_process("record", options)


@app.command()
def command(
    what: Annotated[Command, typer.Argument(help="what the chaser is to do")],
    number: Annotated[int, typer.Argument(min=0, max=255, help="which chaser, from 0")],
    offset: Annotated[
        tuple[float, float, float] | None, typer.Option(help="goto: where, in the target's frame, metres")
    ] = None,
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    timeout: Annotated[float, typer.Option(help="seconds to wait for the answer")] = 5.0,
) -> None:
    """Tell a chaser of a running mission what to do; status 1 when refused, 2 when nobody answers."""
    from chaserdock_agents.operator import send_command

    link = link_of(namespace, connect, None, net_mode, config, 60_000)
    reply = send_command(link, what.value, number, offset, timeout)
    print(f"{'accepted' if reply.accepted else 'refused'}: {reply.reason}")
    raise typer.Exit(0 if reply.accepted else 1)


@app.command()
def summary(log: Annotated[Path, typer.Argument(help="a mission.mcap")]) -> None:
    """Judge a recorded flight again and print its summary as JSON; status 0 only if it was a success."""
    import json

    from chaserdock_agents.analysis.summary import summarize

    result = summarize(log)
    print(json.dumps(result, indent=2))
    raise typer.Exit(0 if result["success"] else 1)


@app.command()
def snapshot(
    log: Annotated[Path, typer.Argument(help="a mission.mcap")],
    at: Annotated[float, typer.Option(help="simulated time, seconds")],
    out: Annotated[Path, typer.Option(help="picture to write: .png or .jpg")],
    width: Annotated[int, typer.Option(min=64, max=4096, help="width of one camera's picture, pixels")] = 640,
) -> None:
    """Draw what every camera saw at a moment of a recorded flight, detections included."""
    import cv2

    from chaserdock_agents.analysis.snapshot import snapshot as draw

    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise fail(f"--out {out}: must end in .png or .jpg")
    if not cv2.imwrite(str(out), draw(log, at, width)):
        raise fail(f"--out {out}: cannot be written")


def main() -> None:
    """Entry point; a closed pipe (``| head``) is no error."""
    try:
        app()
    except ChaserdockError as error:
        sys.exit(fail(str(error)).exit_code)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
