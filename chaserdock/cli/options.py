# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share, the network link that they describe, and the output of
errors and results.

Heavy imports wait until a command needs them, so that ``--help`` is quick.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.shipped_scenarios import shipped_names
from chaserdock_protocol.stall import SHORTEST_STALL_S

from chaserdock.exit_codes import BAD_INPUT

if TYPE_CHECKING:
    from chaserdock_protocol.transport import Link, Tls

    from chaserdock.launch.progress import Show


class ModeOption(StrEnum):
    """How simulated time advances."""

    lockstep = "lockstep"
    realtime = "realtime"


class RendererOption(StrEnum):
    """What draws bodies."""

    fast = "fast"
    path = "path"


class NetMode(StrEnum):
    """Zenoh session modes of a process."""

    peer = "peer"
    client = "client"


def complete_scenario(incomplete: str) -> list[str]:
    """Return shipped scenarios and TOML files that begin with ``incomplete``, for shell
    completion.
    """
    folder, _, stem = incomplete.rpartition("/")
    files = [
        f"{folder}/{path.name}" if folder else path.name
        for path in sorted(Path(folder or ".").glob(f"{stem}*"))
        if path.suffix == ".toml"
    ]
    return [name for name in shipped_names() if name.startswith(incomplete)] + files


ScenarioArg = Annotated[
    str,
    typer.Argument(
        help="scenario file, or name of a shipped scenario", autocompletion=complete_scenario
    ),
]
SetOpt = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="override a scenario value (TOML); repeatable"),
]
SeedOpt = Annotated[
    int | None, typer.Option(min=0, max=2**32 - 1, help="seed of all random numbers")
]
ModeOpt = Annotated[
    ModeOption,
    typer.Option(
        help="lockstep: simulated time waits for every process (reproducible); realtime: it "
        "follows the wall clock"
    ),
]
KeysOpt = Annotated[
    Path | None,
    typer.Option(
        "--keys",
        envvar="CHASERDOCK_KEYS",
        metavar="DIR",
        help="keys of the mission or of this process (see `deploy`): connect to a router over TLS",
    ),
]
JoinTimeoutOpt = Annotated[
    float | None,
    typer.Option(
        "--timeout",
        min=0.1,
        help="seconds to wait for a router and for a world; unlimited by default",
    ),
]
StallOpt = Annotated[
    float,
    typer.Option(
        "--stall-s",
        min=SHORTEST_STALL_S,
        help="seconds without progress after which a lock-step mission ends, or without the "
        "world after which a process ends",
    ),
]
ClusterOpt = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", help="fly on the workers of a Dask scheduler, e.g. tcp://host:8786"
    ),
]
ReplyTimeoutOpt = Annotated[
    float, typer.Option(min=0.1, max=3600.0, help="seconds to wait for the reply")
]
OperatorOpt = Annotated[str, typer.Option(help="name of the operator, for the log")]
ChaserArg = Annotated[int, typer.Argument(min=0, max=255, help="chaser number, from 0")]
QuietOpt = Annotated[
    bool, typer.Option("--quiet", "-q", help="print the verdict only, no progress")
]
JsonLinesOpt = Annotated[
    bool, typer.Option("--json", help="print JSON lines on standard output (docs/cli.md)")
]
JsonOpt = Annotated[bool, typer.Option("--json", help="print the result as one JSON object")]
WatchOpt = Annotated[bool, typer.Option("--watch-parent", hidden=True)]
OutOpt = Annotated[
    Path | None,
    typer.Option("--out", help="folder for log and summary; a new folder in runs/ by default"),
]
LogArg = Annotated[Path, typer.Argument(help="folder of a run, or its mission.mcap")]
LogFilesArg = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG", help="folder of a run, its mission.mcap, or the files of a rotated log"
    ),
]
FromOpt = Annotated[float, typer.Option("--from", min=0.0, help="first simulated time, seconds")]
ToOpt = Annotated[
    float | None,
    typer.Option("--to", min=0.0, help="last simulated time, seconds; the end by default"),
]


def fail(text: str) -> typer.Exit:
    """Print ``text`` on standard error, one line per fault. Returns the exit with status 2, to be
    raised.
    """
    for line in text.splitlines():
        print(f"chaserdock: {line}", file=sys.stderr)
    return typer.Exit(BAD_INPUT)


def refuse_options(context: typer.Context, names: Iterable[str], reason: str) -> None:
    """Exit with status 2 if one of these parameters was given on the command line."""
    refused = set(names)
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in refused and source is not None and source.name == "COMMANDLINE":
            raise fail(f"{parameter.opts[0]}: {reason}")


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
    """Also print an error as the last JSON line, for a command that prints JSON lines."""
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
    """Exit with status 2 for a malformed endpoint and, with ``tls``, for one that is not
    encrypted.
    """
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


@dataclass(frozen=True)
class LinkOptions:
    """Network options of a command. ``with_link_options`` adds these annotated fields to it."""

    namespace: Annotated[
        str, typer.Option(help="Zenoh namespace; isolates missions on one network")
    ] = "chaserdock"
    connect: Annotated[
        list[str] | None,
        typer.Option(
            "--connect", "-e", metavar="ENDPOINT", help="connect to, e.g. tcp/host:7447; repeatable"
        ),
    ] = None
    listen: Annotated[
        list[str] | None,
        typer.Option(
            "--listen",
            "-l",
            metavar="ENDPOINT",
            help="listen on, e.g. tcp/0.0.0.0:7447; repeatable",
        ),
    ] = None
    net_mode: Annotated[NetMode, typer.Option("--net-mode", "-m", help="Zenoh session mode")] = (
        NetMode.peer
    )
    config: Annotated[
        Path | None,
        typer.Option("--config", "-c", envvar="ZENOH_CONFIG", help="Zenoh configuration file"),
    ] = None
    keys: KeysOpt = None
    run: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="folder of a mission that `chaserdock run` flies: connect to that mission",
        ),
    ] = None
    lease: Annotated[
        float,
        typer.Option(
            min=0.1, max=86_400.0, help="seconds after which a silent peer counts as lost"
        ),
    ] = 60.0

    def link(self, process: str = "operator", timeout_s: float | None = None) -> Link:
        """Return the link of ``process``: with ``keys`` to a router over TLS. The world listens on
        the default endpoint.

        ``timeout_s``: wall time after which a client that no router accepts gives up; unlimited by
        default.
        """
        from chaserdock_protocol.transport import DEFAULT_ENDPOINT, Link

        if self.run is not None:
            return self._of_run(self.run).link(process, timeout_s)
        connect, listen = self.connect, self.listen
        if process == "world" and not connect:
            connect = []
            if (
                listen is None
                and self.connect is None
                and self.net_mode is NetMode.peer
                and self.keys is None
            ):
                listen = [DEFAULT_ENDPOINT]
        check_config(self.config)
        check_endpoints("--connect", connect or [], tls=self.keys is not None)
        check_endpoints("--listen", listen or [])
        lease_ms = round(self.lease * 1000)
        if self.keys is not None:
            endpoints = tuple(connect or [DEFAULT_ENDPOINT.replace("tcp/", "tls/")])
            tls = tls_of(self.keys, process)
            return Link(
                self.namespace,
                endpoints,
                (),
                "client",
                self.config,
                lease_ms,
                tls,
                connect_timeout_s=timeout_s,
            )
        return Link(
            namespace=self.namespace,
            connect=tuple(connect if connect is not None else [DEFAULT_ENDPOINT]),
            listen=tuple(listen if listen is not None else ["tcp/127.0.0.1:0"]),
            mode=self.net_mode.value,
            config=self.config,
            lease_ms=lease_ms,
            connect_timeout_s=timeout_s,
        )

    def _of_run(self, folder: Path) -> LinkOptions:
        """Return these options with the address of the mission that writes to ``folder``."""
        from chaserdock.launch.mission_address import read_address

        if self.connect is not None or self.namespace != LinkOptions.namespace:
            raise fail(
                "--run excludes --connect and --namespace; it takes both from the mission's folder"
            )
        address = read_address(folder)
        keys = self.keys if self.keys is not None or address.keys is None else Path(address.keys)
        return replace(
            self, run=None, namespace=address.namespace, connect=[address.endpoint], keys=keys
        )

    def router_link(self) -> Link:
        """Return the link of the router."""
        from chaserdock_protocol.transport import DEFAULT_ENDPOINT, Link

        check_config(self.config)
        check_endpoints("--listen", self.listen or [], tls=self.keys is not None)
        tls = tls_of(self.keys, "router") if self.keys is not None else None
        endpoints = tuple(
            self.listen or [DEFAULT_ENDPOINT.replace("tcp/", "tcp/" if tls is None else "tls/")]
        )
        return Link(
            self.namespace, (), endpoints, "router", self.config, round(self.lease * 1000), tls
        )


def with_link_options(
    *without: str, joins_run: bool = False, **defaults: Any
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a command: its parameter ``link`` becomes the fields of LinkOptions, except those in
    ``without``, with other ``defaults``.

    ``joins_run``: also add the option ``--run``.
    """
    without = without if joins_run else (*without, "run")

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(LinkOptions, include_extras=True)
        options = [
            Parameter(
                f.name,
                Parameter.KEYWORD_ONLY,
                default=defaults.get(f.name, f.default),
                annotation=hints[f.name],
            )
            for f in fields(LinkOptions)
            if f.name not in without
        ]
        own = [
            p.replace(kind=Parameter.KEYWORD_ONLY)
            for p in signature(command, eval_str=True).parameters.values()
        ]
        place = next(i for i, p in enumerate(own) if p.name == "link")

        @wraps(command)
        def wrapper(**values: Any) -> None:
            command(link=LinkOptions(**{p.name: values.pop(p.name) for p in options}), **values)

        shown = Signature([*own[:place], *options, *own[place + 1 :]])
        wrapper.__signature__ = shown  # type: ignore[attr-defined]
        return wrapper

    return decorate


_JUDGED_BY_RIGHTS = ("operator", "viewer")
"""Commands of these may have the keys of any process with the rights (``launch.reach``)."""


def tls_of(keys: Path, process: str) -> Tls:
    """Return the TLS files of a process, in the mission's folder ``keys`` or in the folder of the
    process.
    """
    from chaserdock_protocol.transport import Tls
    from chaserdock_protocol.transport.access_control import common_name

    name = common_name(process)
    folder = keys / name if (keys / name).is_dir() else keys
    tls = Tls.in_folder(folder)
    for file in (tls.ca, tls.certificate, tls.key):
        if not os.access(file, os.R_OK):
            raise fail(
                f"--keys {keys}: {file} does not exist or is not readable; "
                f"make a mission's keys with `chaserdock deploy --keys {keys}`, and give {name} "
                "its folder"
            )
    if folder == keys and process not in _JUDGED_BY_RIGHTS:
        from chaserdock.launch.reach import check_holder

        check_holder(tls.certificate, process, [name])
    return tls
