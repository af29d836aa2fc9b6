# SPDX-License-Identifier: Apache-2.0
"""Commands to a running mission, its status, and the web viewer."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .options import (
    JsonOpt,
    LinkOptions,
    OperatorOpt,
    ReplyTimeoutOpt,
    WatchOpt,
    fail,
    print_result,
    refuse_options,
    with_link_options,
)

if TYPE_CHECKING:
    from chaserdock_protocol.messages import CommandReply


class CommandName(StrEnum):
    """Operator commands to a chaser, one to the mapper, one to simulated hardware, and three to all
    robots of a gateway.
    """

    approach = "approach"
    hold = "hold"
    retreat = "retreat"
    abort = "abort"
    goto = "goto"
    calibrate = "calibrate"
    inspect = "inspect"
    identify = "identify"
    detumble = "detumble"
    isolate = "isolate"
    restore = "restore"
    port = "port"
    thruster_fault = "thruster-fault"
    arm = "arm"
    disarm = "disarm"
    kill = "kill"


class PortSearch(StrEnum):
    """What a port can be found by."""

    flat = "flat"
    ring = "ring"


class ThrusterFaultKind(StrEnum):
    """Thruster failures, and the end of one."""

    stuck_on = "stuck_on"
    stuck_off = "stuck_off"
    weak = "weak"
    healthy = "healthy"


@with_link_options("listen", "lease", joins_run=True)
def command(
    context: typer.Context,
    what: Annotated[CommandName, typer.Argument(help="command")],
    number: Annotated[
        int | None,
        typer.Argument(min=0, max=255, help="chaser number, from 0; not with arm, disarm, kill"),
    ] = None,
    offset: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z",
            help="goto: position in the target's frame, metres; default: before the chosen port",
        ),
    ] = None,
    thruster: Annotated[
        int | None,
        typer.Option(
            min=0, max=254, help="isolate, restore, thruster-fault: thruster number, from 0"
        ),
    ] = None,
    fault: Annotated[
        ThrusterFaultKind | None,
        typer.Option(help="thruster-fault: failure; healthy ends it"),
    ] = None,
    factor: Annotated[
        float | None,
        typer.Option(min=0.0, max=1.0, help="thruster-fault, weak: fraction of the nominal thrust"),
    ] = None,
    image: Annotated[
        str | None,
        typer.Option(
            metavar="chaser/N",
            help="port: chaser in whose newest image --pixel is",
            show_default=False,
        ),
    ] = None,
    pixel: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="X Y", help="port: place in the image, pixels"),
    ] = None,
    point: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="port: place in the map's frame, metres"),
    ] = None,
    find: Annotated[
        PortSearch | None, typer.Option(help="port: choose the best place of this kind")
    ] = None,
    radii: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="MIN MAX", help="port --find ring: least and greatest radius, metres"),
    ] = None,
    operator: OperatorOpt = "",
    before: Annotated[
        float | None,
        typer.Option(
            min=0, max=7_776_000, help="simulated time, seconds, after which the command is refused"
        ),
    ] = None,
    *,
    link: LinkOptions,
    timeout: ReplyTimeoutOpt = 5.0,
    as_json: JsonOpt = False,
) -> None:
    """Send a command to a chaser of a running mission. Status 1 when refused, 2 when there is no
    reply.

    thruster-fault injects a failure of which the chaser is not informed; the scenario must allow it
    with chaser.thruster_faults_by_command. port chooses where on a target of unknown shape the
    chaser docks. arm, disarm and kill concern all robots of a gateway.
    """
    from chaserdock_protocol.messages import PortRequest

    from chaserdock.launch.operator import (
        send_arming,
        send_command,
        send_port_request,
        send_thruster_fault,
    )

    if what.value in ("arm", "disarm", "kill"):
        others = ("number", "offset", "thruster", "fault", "factor", "before", *_PORT_OPTIONS)
        refuse_options(context, others, f"not with {what.value}")
        done = send_arming(link.link(timeout_s=timeout), what.value, timeout, operator)
        value = {"accepted": done.accepted, "reason": done.reason}
        word = "accepted" if done.accepted else "refused"
        print_result(as_json, value, [f"{word}: {done.reason}"])
        raise typer.Exit(0 if done.accepted else 1)
    if number is None:
        raise fail(f"{what.value}: needs the number of a chaser")
    if what is not CommandName.port:
        refuse_options(context, _PORT_OPTIONS, "only with port")
    if what is CommandName.port:
        others = ("offset", "thruster", "fault", "factor", "before")
        refuse_options(context, others, "not with port")
        request = PortRequest(
            chaser=number,
            image=None if image is None else _number_of(image),
            pixel=pixel,
            point_m=point,
            find=None if find is None else find.value,
            radii_m=radii,
            operator=operator,
        )
        reply = send_port_request(link.link(timeout_s=timeout), request, timeout)
    elif what is CommandName.thruster_fault:
        refuse_options(context, ("offset", "before"), "not with thruster-fault")
        if thruster is None or fault is None:
            raise fail("thruster-fault: needs --thruster and --fault")
        reply = send_thruster_fault(
            link.link(timeout_s=timeout), number, thruster, fault.value, factor, timeout, operator
        )
    else:
        refuse_options(context, ("fault", "factor"), "only with thruster-fault")
        reply = send_command(
            link.link(timeout_s=timeout),
            what.value,
            number,
            offset,
            timeout,
            thruster,
            operator,
            before,
        )
    _print_reply(reply, as_json)


_PORT_OPTIONS = ("image", "pixel", "point", "find", "radii")


def _number_of(image: str) -> int:
    """Return the number of the chaser that an image is named by."""
    head, _, number = image.partition("/")
    if head != "chaser" or not number.isascii() or not number.isdigit() or int(number) > 255:
        raise fail(f"--image: {image!r} is not chaser/N, with N from 0 to 255")
    return int(number)


def _print_reply(reply: CommandReply, as_json: bool) -> None:
    """Print a reply and exit with status 0 or 1."""
    value = {
        "accepted": reply.accepted,
        "reason": reply.reason,
        "sim_time_s": reply.sim_time_ns / 1e9,
    }
    print_result(as_json, value, [f"{'accepted' if reply.accepted else 'refused'}: {reply.reason}"])
    raise typer.Exit(0 if reply.accepted else 1)


@with_link_options("listen", "lease", joins_run=True)
def status(
    *,
    link: LinkOptions,
    duration: Annotated[float, typer.Option(min=0.1, max=3600.0, help="seconds to listen")] = 3.0,
    as_json: JsonOpt = False,
) -> None:
    """Show the processes on a mission's network, the tick, and each chaser's phase. Status 2
    without any process.
    """
    from rich.console import Console

    from chaserdock.launch.status import observe, table_of

    observed = observe(link.link(timeout_s=duration), duration)
    if as_json:
        print_result(True, observed.as_dict(), ())
    else:
        Console().print(table_of(observed))


@with_link_options(joins_run=True)
def view(
    log: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[LOG]",
            help="folder of a run, its mission.mcap, or the files of a rotated log; the running "
            "mission by default",
        ),
    ] = None,
    host: Annotated[
        str,
        typer.Option(
            help="address to serve the page on; anyone who has its URL can command the mission"
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option(min=1, max=65535, help="port; the first free one from 8080 by default"),
    ] = None,
    dark: Annotated[bool, typer.Option("--dark", help="start with dark colours")] = False,
    truth: Annotated[
        bool, typer.Option(help="show ground truth or references where they are readable")
    ] = True,
    at: Annotated[
        float | None, typer.Option(min=0, help="log: pause at this simulated time, seconds")
    ] = None,
    *,
    link: LinkOptions,
    watch_parent: WatchOpt = False,
) -> None:
    """Show a running mission, or a log, in a web browser: scene, images, plots, phases,
    commands.
    """
    from chaserdock.viewer.live import view_live
    from chaserdock.viewer.page import ViewOptions

    options = ViewOptions(host, port, dark, truth, link.run)
    if log:
        from chaserdock.viewer.player import view_log

        raise typer.Exit(view_log(log[0] if len(log) == 1 else log, options, at, watch_parent))
    if at is not None:
        raise fail("--at: needs a log")
    raise typer.Exit(view_live(link.link("viewer"), options, watch_parent))
