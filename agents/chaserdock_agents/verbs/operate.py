"""Verbs of an operator: commands to a running mission."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from .options import ConfigOpt, ConnectOpt, KeysOpt, NamespaceOpt, NetModeOpt, link_of


class Command(StrEnum):
    """What an operator may ask for."""

    approach = "approach"
    hold = "hold"
    retreat = "retreat"
    abort = "abort"
    goto = "goto"
    isolate = "isolate"
    restore = "restore"


def command(
    what: Annotated[Command, typer.Argument(help="what the chaser is to do")],
    number: Annotated[int, typer.Argument(min=0, max=255, help="which chaser, from 0")],
    offset: Annotated[
        tuple[float, float, float] | None, typer.Option(help="goto: where, in the target's frame, metres")
    ] = None,
    jet: Annotated[
        int | None, typer.Option(min=0, max=254, help="isolate, restore: which jet, from 0")
    ] = None,
    operator: Annotated[str, typer.Option(help="who asks, for the log")] = "",
    before: Annotated[
        float | None, typer.Option(min=0, help="simulated seconds of the mission after which it is too late")
    ] = None,
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    timeout: Annotated[float, typer.Option(help="seconds to wait for the answer")] = 5.0,
) -> None:
    """Tell a chaser of a running mission what to do; status 1 when refused, 2 when nobody answers."""
    from chaserdock_agents.operator import send_command

    link = link_of(namespace, connect, None, net_mode, config, 60_000, keys)
    reply = send_command(link, what.value, number, offset, timeout, jet, operator, before)
    print(f"{'accepted' if reply.accepted else 'refused'}: {reply.reason}")
    raise typer.Exit(0 if reply.accepted else 1)
