"""An operator's commands to a running mission."""

from __future__ import annotations

import time

from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import CommandReply, OperatorCommand, ThrusterFaultCommand, ThrusterState
from chaserdock_protocol.transport import Link, Node
from msgspec import Struct


class OperatorError(ChaserdockError):
    """The command could not be put to anybody."""


def send_command(
    link: Link,
    command: str,
    chaser: int,
    offset_m: tuple[float, float, float] | None,
    timeout_s: float,
    thruster: int | None = None,
    operator: str = "",
    before_s: float | None = None,
) -> CommandReply:
    """Puts a command to the controller, in the name of ``operator``, to be refused once simulated time has passed
    ``before_s``; raises OperatorError when nobody answers in time, TransportError."""
    if (command == "goto") != (offset_m is not None):
        raise OperatorError("--offset X Y Z goes with goto, and goto needs it")
    if (command in ("isolate", "restore")) != (thruster is not None):
        raise OperatorError("--thruster N goes with isolate and restore, and these need it")
    request = OperatorCommand(
        command=command,  # type: ignore[arg-type]
        chaser=chaser,
        offset_m=offset_m,
        thruster=thruster,
        operator=operator,
        expires_ns=None if before_s is None else round(before_s * 1e9),
    )
    return _answer(link, topics.OPERATE_KEY, request, timeout_s, "controller")


def send_thruster_fault(
    link: Link,
    chaser: int,
    thruster: int,
    kind: ThrusterState,
    factor: float | None,
    timeout_s: float,
    operator: str = "",
) -> CommandReply:
    """Has the world make a thruster fail; raises OperatorError when nobody answers in time, TransportError."""
    if (kind == "weak") != (factor is not None):
        raise OperatorError("--factor goes with weak, and weak needs it")
    request = ThrusterFaultCommand(
        chaser=chaser, thruster=thruster, kind=kind, factor=factor, operator=operator
    )
    return _answer(link, topics.THRUSTER_FAULT_KEY, request, timeout_s, "world")


def _answer(link: Link, key: str, request: Struct, timeout_s: float, who: str) -> CommandReply:
    node = Node("operator", "operator", link)
    try:
        begun_s = time.monotonic()
        while time.monotonic() - begun_s < timeout_s:
            reply = node.query(key, request, CommandReply, timeout_s)
            if reply is not None:
                return reply
            time.sleep(0.05)  # not connected yet
        raise OperatorError(
            f"no {who} answered within {timeout_s:g} s (namespace {link.namespace}, "
            f"connect {', '.join(link.connect)}); is a mission running there?"
        )
    finally:
        node.close()
