"""What several verbs share: options, the network link they describe, and how they fail.

Heavy imports wait until a verb needs them, so that ``--help`` is quick.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.shipped_scenarios import shipped_names

from chaserdock.exit_codes import BAD_INPUT

if TYPE_CHECKING:
    from chaserdock.launch.progress import Show


class Mode(StrEnum):
    """How simulated time runs."""

    lockstep = "lockstep"
    realtime = "realtime"


def complete_scenario(incomplete: str) -> list[str]:
    """Shipped scenarios and TOML files here that begin so, for the shell."""
    folder, _, begun = incomplete.rpartition("/")
    files = [
        f"{folder}/{path.name}" if folder else path.name
        for path in sorted(Path(folder or ".").glob(f"{begun}*"))
        if path.suffix == ".toml"
    ]
    return [name for name in shipped_names() if name.startswith(incomplete)] + files


ScenarioArg = Annotated[
    str,
    typer.Argument(
        help="scenario file, or the name of one that is shipped", autocompletion=complete_scenario
    ),
]
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
KeysOpt = Annotated[
    Path | None,
    typer.Option(
        "--keys",
        envvar="CHASERDOCK_KEYS",
        metavar="DIR",
        help="keys of the mission or of this process (see `keys init`): TLS to a router, as its client",
    ),
]
LeaseOpt = Annotated[int, typer.Option("--lease-ms", help="after that long a silent process counts as lost")]
PatienceOpt = Annotated[float | None, typer.Option(help="seconds to wait for a world; for ever by default")]
QuietOpt = Annotated[bool, typer.Option("--quiet", "-q", help="no progress, only the verdict")]
LinesOpt = Annotated[
    bool, typer.Option("--json", help="for scripts: JSON lines on standard output, see docs/cli.md")
]
JsonOpt = Annotated[bool, typer.Option("--json", help="print JSON")]
WatchOpt = Annotated[bool, typer.Option("--watch-parent", hidden=True)]
OutOpt = Annotated[Path | None, typer.Option("--out", help="folder for log and summary; runs/… by default")]


def fail(text: str) -> typer.Exit:
    """One line on standard error, status 2."""
    for line in text.splitlines():
        print(f"chaserdock: {line}", file=sys.stderr)
    return typer.Exit(BAD_INPUT)


def show_of(quiet: bool, as_json: bool) -> Show:
    """To whom a flight is shown."""
    from chaserdock.launch.progress import Show

    if quiet and as_json:
        raise fail("--quiet and --json: one or the other; --json shows people nothing anyway")
    return Show.scripts if as_json else Show.nobody if quiet else Show.people


@contextmanager
def errors_as_lines(as_json: bool) -> Iterator[None]:
    """Tells an error to scripts as well, as the last JSON line of a verb that flies."""
    try:
        yield
    except ChaserdockError as error:
        if as_json:
            from chaserdock.launch.json_events import Failed, line_of

            print(line_of(Failed(status=BAD_INPUT, text=str(error))), flush=True)
        raise


def link_of(
    namespace: str,
    connect: list[str] | None,
    listen: list[str] | None,
    mode: str,
    config: Path | None,
    lease_ms: int,
    keys: Path | None = None,
    process: str = "operator",
):
    """The link that the network options describe; with ``keys``, that of ``process`` to a router over TLS."""
    from chaserdock_protocol.transport import DEFAULT_ENDPOINT, Link

    if mode not in ("peer", "client", "router"):
        raise fail(f"--net-mode {mode}: must be peer or client")
    if config is not None and not config.is_file():
        raise fail(f"--config {config}: no such file")
    if keys is not None:
        endpoints = tuple(connect or [DEFAULT_ENDPOINT.replace("tcp/", "tls/")])
        if plain := [e for e in endpoints if not e.startswith("tls/")]:
            raise fail(
                f"--connect {plain[0]}: with --keys it must be tls/HOST:PORT, that of the mission's router"
            )
        tls = tls_of(keys, process)
        return Link(namespace, endpoints, (), "client", config, lease_ms, tls)
    return Link(
        namespace=namespace,
        connect=tuple(connect if connect is not None else [DEFAULT_ENDPOINT]),
        listen=tuple(listen if listen is not None else ["tcp/127.0.0.1:0"]),
        mode="client" if mode == "client" else "peer",
        config=config,
        lease_ms=lease_ms,
    )


def tls_of(keys: Path, process: str):
    """The TLS files of a process, in the mission's folder ``keys`` or in the process' own."""
    from chaserdock_protocol.transport import Tls
    from chaserdock_protocol.transport.access_control import common_name

    name = common_name(process)
    folder = keys / name if (keys / name).is_dir() else keys
    tls = Tls.in_folder(folder)
    for file in (tls.ca, tls.certificate, tls.key):
        if not os.access(file, os.R_OK):
            raise fail(
                f"--keys {keys}: {file} is not there or may not be read; "
                f"make a mission's keys with `chaserdock keys init {keys}`, and give {name} its folder"
            )
    return tls
