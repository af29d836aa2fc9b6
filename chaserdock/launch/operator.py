# SPDX-License-Identifier: Apache-2.0
"""Send operator commands to a running mission."""

from __future__ import annotations

import time
from typing import Literal, TypeVar

from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import (
    ArmingCommand,
    ArmingReply,
    CommandReply,
    OperatorCommand,
    PortRequest,
    ThrusterFaultCommand,
    ThrusterState,
)
from chaserdock_protocol.transport import Link, Node
from msgspec import Struct

from .reach import (
    TO_ARM,
    TO_CHOOSE_PORTS,
    TO_COMMAND,
    TO_INJECT_FAULTS,
    Rights,
    check_rights,
    why_silent,
)


class OperatorError(ChaserdockError):
    """The command is inconsistent, or there is no reply."""


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
    """Send a command to the controller and return its reply.

    ``before_s``: simulated time after which the controller refuses it. Raises OperatorError without
    a reply within ``timeout_s``, RightsError, TransportError.
    """
    if command != "goto" and offset_m is not None:
        raise OperatorError("--offset X Y Z: with goto only")
    if (command in ("isolate", "restore")) != (thruster is not None):
        raise OperatorError(
            "--thruster N: required by isolate and restore, and by no other command"
        )
    request = OperatorCommand(
        command=command,  # type: ignore[arg-type]
        chaser=chaser,
        offset_m=offset_m,
        thruster=thruster,
        operator=operator,
        expires_ns=None if before_s is None else round(before_s * 1e9),
    )
    return _request(link, TO_COMMAND, command, request, timeout_s, "controller", CommandReply)


def send_port_request(link: Link, request: PortRequest, timeout_s: float) -> CommandReply:
    """Let the mapper judge a place on an unknown target and return its reply. Raises OperatorError
    for a request that does not say where in one way, or without a reply; RightsError,
    TransportError.
    """
    if not request.says_one_place:
        raise OperatorError(
            "port: needs either --image and --pixel X Y, or --point X Y Z, or --find, with --radii "
            "MIN MAX for a ring only"
        )
    return _request(link, TO_CHOOSE_PORTS, "port", request, timeout_s, "mapper", CommandReply)


def send_thruster_fault(
    link: Link,
    chaser: int,
    thruster: int,
    kind: ThrusterState,
    factor: float | None,
    timeout_s: float,
    operator: str = "",
) -> CommandReply:
    """Inject a thruster failure in the world and return its reply. Raises OperatorError,
    RightsError, TransportError.
    """
    if (kind == "weak") != (factor is not None):
        raise OperatorError("--factor: required by weak, and by no other kind")
    request = ThrusterFaultCommand(
        chaser=chaser, thruster=thruster, kind=kind, factor=factor, operator=operator
    )
    return _request(
        link, TO_INJECT_FAULTS, "thruster-fault", request, timeout_s, "world", CommandReply
    )


def send_arming(
    link: Link, action: Literal["arm", "disarm", "kill"], timeout_s: float, operator: str = ""
) -> ArmingReply:
    """Arm, disarm or kill the robots of a gateway and return its reply. Raises OperatorError,
    RightsError, TransportError.
    """
    request = ArmingCommand(action=action, operator=operator)
    return _request(link, TO_ARM, action, request, timeout_s, "gateway", ArmingReply)


ReplyT = TypeVar("ReplyT", bound=Struct)


def _request(
    link: Link,
    rights: Rights,
    what: str,
    request: Struct,
    timeout_s: float,
    receiver: str,
    kind: type[ReplyT],
) -> ReplyT:
    check_rights(link, what, rights)
    (key,) = rights.queries
    node = Node("operator", "operator", link)
    try:
        start_s = time.monotonic()
        while time.monotonic() - start_s < timeout_s:
            reply = node.query(key, request, kind, timeout_s)
            if reply is not None:
                return reply
            time.sleep(0.05)  # not connected yet
        raise OperatorError(
            f"no reply from the {receiver} within {timeout_s:g} s; {why_silent(link)}"
        )
    finally:
        node.close()
