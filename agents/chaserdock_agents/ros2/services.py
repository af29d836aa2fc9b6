# SPDX-License-Identifier: Apache-2.0
"""Serve operator commands as services of ROS 2: one per verb and chaser."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, get_args

from chaserdock_protocol.codec import Rejected, check_numbers
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import CommandReply, OperatorCommand, OperatorCommandName

from .conversion import chaser_frame
from .types import GOTO, SELECT_THRUSTER, TRIGGER, response

_WITH_ARGUMENT = {"goto": GOTO, "isolate": SELECT_THRUSTER, "restore": SELECT_THRUSTER}
Ask = Callable[[OperatorCommand], CommandReply | None]
"""Sends a command to the controller; None without a reply. Raises ChaserdockError."""


def services(chasers: int) -> Iterator[tuple[str, str, OperatorCommandName, int]]:
    """Yield name, type, verb and chaser of every service."""
    verbs: tuple[OperatorCommandName, ...] = get_args(OperatorCommandName)
    for chaser in range(chasers):
        for verb in verbs:
            yield f"/{chaser_frame(chaser)}/{verb}", _WITH_ARGUMENT.get(verb, TRIGGER), verb, chaser


def command_of(verb: OperatorCommandName, chaser: int, request: Any) -> OperatorCommand:
    """Return the command that a request asks for. Raises Rejected for numbers that are not
    finite.
    """
    offset = tuple(request.offset_m.tolist()) if verb == "goto" else None
    thruster = int(request.thruster) if _WITH_ARGUMENT.get(verb) == SELECT_THRUSTER else None
    command = OperatorCommand(
        command=verb, chaser=chaser, offset_m=offset, thruster=thruster, operator="ros2"
    )
    check_numbers(command)
    return command


def handler(kind: str, verb: OperatorCommandName, chaser: int, ask: Ask) -> Callable[[Any], Any]:
    """Return a function from a service's request to its response: whether the controller accepted,
    and why not.
    """

    def handle(request: Any) -> Any:
        try:
            reply = ask(command_of(verb, chaser, request))
        except (Rejected, ChaserdockError) as error:
            return response(kind, False, str(error))
        if reply is None:
            return response(kind, False, "no reply from the controller")
        return response(kind, reply.accepted, reply.reason)

    return handle
