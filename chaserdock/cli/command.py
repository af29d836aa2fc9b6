"""Verbs of an operator: commands to a running mission."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from .options import ConfigOpt, ConnectOpt, JsonOpt, KeysOpt, NamespaceOpt, NetModeOpt, link_of


class Command(StrEnum):
    """What an operator may ask for."""

    approach = "approach"
    hold = "hold"
    retreat = "retreat"
    abort = "abort"
    goto = "goto"
    calibrate = "calibrate"
    isolate = "isolate"
    restore = "restore"


def command(
    what: Annotated[Command, typer.Argument(help="what the chaser is to do")],
    number: Annotated[int, typer.Argument(min=0, max=255, help="which chaser, from 0")],
    offset: Annotated[
        tuple[float, float, float] | None, typer.Option(help="goto: where, in the target's frame, metres")
    ] = None,
    thruster: Annotated[
        int | None, typer.Option(min=0, max=254, help="isolate, restore: which thruster, from 0")
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
    as_json: JsonOpt = False,
) -> None:
    """Tell a chaser of a running mission what to do; status 1 when refused, 2 when nobody answers."""
    import json

    from chaserdock.launch.operator import send_command

    link = link_of(namespace, connect, None, net_mode, config, 60_000, keys)
    reply = send_command(link, what.value, number, offset, timeout, thruster, operator, before)
    if as_json:
        answer = {"accepted": reply.accepted, "reason": reply.reason, "sim_time_s": reply.sim_time_ns / 1e9}
        print(json.dumps(answer, indent=2))
    else:
        print(f"{'accepted' if reply.accepted else 'refused'}: {reply.reason}")
    raise typer.Exit(0 if reply.accepted else 1)


class Kind(StrEnum):
    """How a thruster fails, or that it works again."""

    stuck_on = "stuck_on"
    stuck_off = "stuck_off"
    weak = "weak"
    healthy = "healthy"


def thruster_fault(
    number: Annotated[int, typer.Argument(min=0, max=255, help="which chaser, from 0")],
    thruster: Annotated[int, typer.Argument(min=0, max=254, help="which thruster, from 0")],
    kind: Annotated[Kind, typer.Argument(help="how it fails; healthy mends it")],
    factor: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="weak: what is left of its thrust")
    ] = None,
    operator: Annotated[str, typer.Option(help="who asks, for the log")] = "",
    namespace: NamespaceOpt = "chaserdock",
    connect: ConnectOpt = None,
    net_mode: NetModeOpt = "peer",
    config: ConfigOpt = None,
    keys: KeysOpt = None,
    timeout: Annotated[float, typer.Option(help="seconds to wait for the answer")] = 5.0,
) -> None:
    """Make a thruster of a running mission fail, for a test; status 1 when refused, 2 when nobody answers.

    Only where the scenario allows it: chaser.thruster_faults_by_command. The chaser is not told.
    """
    from chaserdock.launch.operator import send_thruster_fault

    link = link_of(namespace, connect, None, net_mode, config, 60_000, keys)
    reply = send_thruster_fault(link, number, thruster, kind.value, factor, timeout, operator)
    print(f"{'accepted' if reply.accepted else 'refused'}: {reply.reason}")
    raise typer.Exit(0 if reply.accepted else 1)
