# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share, the network link they describe, and how commands report errors and results.

Heavy imports wait until a command needs them, so that ``--help`` is quick.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.shipped_scenarios import shipped_names

from chaserdock.exit_codes import BAD_INPUT

if TYPE_CHECKING:
    from chaserdock_protocol.transport import Link, Tls

    from chaserdock.launch.progress import Show

DEFAULT_LEASE_S = 60.0


class Mode(StrEnum):
    """How simulated time advances."""

    lockstep = "lockstep"
    realtime = "realtime"


class NetMode(StrEnum):
    """Zenoh session modes of a process."""

    peer = "peer"
    client = "client"


def complete_scenario(incomplete: str) -> list[str]:
    """Return shipped scenarios and TOML files that begin with ``incomplete``, for shell completion."""
    folder, _, stem = incomplete.rpartition("/")
    files = [
        f"{folder}/{path.name}" if folder else path.name
        for path in sorted(Path(folder or ".").glob(f"{stem}*"))
        if path.suffix == ".toml"
    ]
    return [name for name in shipped_names() if name.startswith(incomplete)] + files


ScenarioArg = Annotated[
    str,
    typer.Argument(help="scenario file, or name of a shipped scenario", autocompletion=complete_scenario),
]
SetOpt = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="override a scenario value (TOML); repeatable"),
]
SeedOpt = Annotated[int | None, typer.Option(min=0, max=2**32 - 1, help="seed of all random numbers")]
ModeOpt = Annotated[
    Mode,
    typer.Option(
        help="lockstep: simulated time waits for every process (reproducible); realtime: it follows the wall clock"
    ),
]
NamespaceOpt = Annotated[str, typer.Option(help="Zenoh namespace; isolates missions on one network")]
ConnectOpt = Annotated[
    list[str] | None,
    typer.Option("--connect", "-e", metavar="ENDPOINT", help="connect to, e.g. tcp/host:7447; repeatable"),
]
ListenOpt = Annotated[
    list[str] | None,
    typer.Option("--listen", "-l", metavar="ENDPOINT", help="listen on, e.g. tcp/0.0.0.0:7447; repeatable"),
]
NetModeOpt = Annotated[NetMode, typer.Option("--net-mode", "-m", help="Zenoh session mode")]
ConfigOpt = Annotated[
    Path | None, typer.Option("--config", "-c", envvar="ZENOH_CONFIG", help="Zenoh configuration file")
]
KeysOpt = Annotated[
    Path | None,
    typer.Option(
        "--keys",
        envvar="CHASERDOCK_KEYS",
        metavar="DIR",
        help="keys of the mission or of this process (see `keys init`): connect to a router over TLS",
    ),
]
LeaseOpt = Annotated[
    float, typer.Option(min=0.1, max=86_400.0, help="seconds after which a silent peer counts as lost")
]
JoinTimeoutOpt = Annotated[
    float | None,
    typer.Option("--timeout", min=0.1, help="seconds to wait for a world; unlimited by default"),
]
ReplyTimeoutOpt = Annotated[float, typer.Option(min=0.1, max=3600.0, help="seconds to wait for the reply")]
OperatorOpt = Annotated[str, typer.Option(help="name of the operator, for the log")]
ChaserArg = Annotated[int, typer.Argument(min=0, max=255, help="chaser number, from 0")]
QuietOpt = Annotated[bool, typer.Option("--quiet", "-q", help="print the verdict only, no progress")]
JsonLinesOpt = Annotated[
    bool, typer.Option("--json", help="print JSON lines on standard output (docs/cli.md)")
]
JsonOpt = Annotated[bool, typer.Option("--json", help="print the result as one JSON object")]
WatchOpt = Annotated[bool, typer.Option("--watch-parent", hidden=True)]
OutOpt = Annotated[
    Path | None, typer.Option("--out", help="folder for log and summary; a new folder in runs/ by default")
]
LogArg = Annotated[Path, typer.Argument(help="folder of a run, or its mission.mcap")]


def fail(text: str) -> typer.Exit:
    """Print ``text`` on standard error, one line per fault, and return the exit with status 2."""
    for line in text.splitlines():
        print(f"chaserdock: {line}", file=sys.stderr)
    return typer.Exit(BAD_INPUT)


def print_result(as_json: bool, value: dict[str, Any], lines: Iterable[str]) -> None:
    """Print a result on standard output: ``value`` as one JSON object, or ``lines`` of text."""
    print(json.dumps(value, indent=2) if as_json else "\n".join(lines))


def show_of(quiet: bool, as_json: bool) -> Show:
    """Return how progress is shown."""
    from chaserdock.launch.progress import Show

    if quiet and as_json:
        raise fail("--quiet and --json exclude each other; --json prints no text anyway")
    return Show.json if as_json else Show.none if quiet else Show.text


@contextmanager
def errors_as_json(as_json: bool) -> Generator[None]:
    """Print an error as the last JSON line, too, for a command that prints JSON lines."""
    try:
        yield
    except ChaserdockError as error:
        if as_json:
            from chaserdock.launch.json_events import Failed, encode_line

            print(encode_line(Failed(status=BAD_INPUT, text=str(error))), flush=True)
        raise


_ADDRESS_PORT = re.compile(
    r"(?:tcp|udp|tls|quic|ws)/(?:\[[\da-fA-F:.%\w]+\]|[^\s:/\[\]]+):(\d{1,5})(?:[?#].*)?"
)
_OTHER_ENDPOINT = re.compile(r"(?:unixsock-stream|unixpipe|serial|vsock)/\S+")


def check_endpoints(option: str, endpoints: Iterable[str], tls: bool = False) -> None:
    """Exit with status 2 for a malformed endpoint and, with ``tls``, for one that is not encrypted."""
    for endpoint in endpoints:
        found = _ADDRESS_PORT.fullmatch(endpoint)
        if not (_OTHER_ENDPOINT.fullmatch(endpoint) or (found and int(found[1]) <= 65_535)):
            raise fail(f"{option} {endpoint}: must be PROTOCOL/HOST:PORT, e.g. tcp/127.0.0.1:7447")
        if tls and not endpoint.startswith("tls/"):
            raise fail(f"{option} {endpoint}: must be tls/HOST:PORT with --keys")


def check_config(config: Path | None) -> None:
    """Exit with status 2 when the Zenoh configuration file does not exist."""
    if config is not None and not config.is_file():
        raise fail(f"--config {config}: no such file")


def link_of(
    namespace: str,
    connect: list[str] | None,
    listen: list[str] | None,
    mode: NetMode,
    config: Path | None,
    lease_s: float = DEFAULT_LEASE_S,
    keys: Path | None = None,
    process: str = "operator",
) -> Link:
    """Return the link that the network options describe; with ``keys``, that of ``process`` to a router over TLS."""
    from chaserdock_protocol.transport import DEFAULT_ENDPOINT, Link

    check_config(config)
    check_endpoints("--connect", connect or [], tls=keys is not None)
    check_endpoints("--listen", listen or [])
    lease_ms = round(lease_s * 1000)
    if keys is not None:
        endpoints = tuple(connect or [DEFAULT_ENDPOINT.replace("tcp/", "tls/")])
        return Link(namespace, endpoints, (), "client", config, lease_ms, tls_of(keys, process))
    return Link(
        namespace=namespace,
        connect=tuple(connect if connect is not None else [DEFAULT_ENDPOINT]),
        listen=tuple(listen if listen is not None else ["tcp/127.0.0.1:0"]),
        mode=mode.value,
        config=config,
        lease_ms=lease_ms,
    )


def server_link(
    namespace: str,
    connect: list[str] | None,
    listen: list[str] | None,
    mode: NetMode,
    config: Path | None,
    lease_s: float = DEFAULT_LEASE_S,
    keys: Path | None = None,
) -> Link:
    """Return the link of the world, or of what replaces it: listens on the default endpoint unless configured."""
    from chaserdock_protocol.transport import DEFAULT_ENDPOINT

    if listen is None and connect is None and mode is NetMode.peer and keys is None:
        listen = [DEFAULT_ENDPOINT]
    return link_of(namespace, connect or [], listen, mode, config, lease_s, keys, "world")


def tls_of(keys: Path, process: str) -> Tls:
    """Return the TLS files of a process, in the mission's folder ``keys`` or in the folder of the process."""
    from chaserdock_protocol.transport import Tls
    from chaserdock_protocol.transport.access_control import common_name

    name = common_name(process)
    folder = keys / name if (keys / name).is_dir() else keys
    tls = Tls.in_folder(folder)
    for file in (tls.ca, tls.certificate, tls.key):
        if not os.access(file, os.R_OK):
            raise fail(
                f"--keys {keys}: {file} does not exist or is not readable; "
                f"make a mission's keys with `chaserdock keys init {keys}`, and give {name} its folder"
            )
    return tls
