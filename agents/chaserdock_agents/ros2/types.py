# SPDX-License-Identifier: Apache-2.0
"""Provide the message and service types of ROS 2 Jazzy, which Kilted shares: CDR and type hashes.

The hash (REP 2016, RIHS01) of a type is part of its keys on the network. Messages come with
rosbags; services are defined here, those with arguments by the files of the ROS package
``chaserdock_interfaces`` beside this module. Messages of PX4 are defined by the files in
``px4_msgs``: names and types of the fields, which are all that CDR and hash depend on.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TYPES = get_typestore(Stores.ROS2_JAZZY)
"""Types by name, such as ``nav_msgs/msg/Odometry``."""

TRIGGER, GOTO, SELECT_THRUSTER = (
    "std_srvs/srv/Trigger",
    "chaserdock_interfaces/srv/Goto",
    "chaserdock_interfaces/srv/SelectThruster",
)
INTERFACES = Path(__file__).with_name("chaserdock_interfaces")
_REPLY = "---\nbool success\nstring message\n"
# The member that a structure without any has in CDR.
_NOTHING = ("structure_needs_at_least_one_member", (Nodetype.BASE, ("uint8", 0)))


def _name(type_name: str) -> Any:
    return (Nodetype.NAME, type_name)


def _register_service(name: str, definition: str) -> None:
    """Add the types that a service consists of.

    These are request, response, event, and the service itself, which has a hash only.
    """
    request, _, response = definition.partition("---\n")
    types: dict[str, Any] = {}
    for part, text in (("Request", request), ("Response", response)):
        (fields,) = get_types_from_msg(text, f"{name}_{part}".replace("/srv/", "/msg/")).values()
        types[f"{name}_{part}"] = (fields[0], fields[1] or [_NOTHING])
    types[f"{name}_Event"] = (
        [],
        [
            ("info", _name("service_msgs/msg/ServiceEventInfo")),
            ("request", (Nodetype.SEQUENCE, (_name(f"{name}_Request"), 1))),
            ("response", (Nodetype.SEQUENCE, (_name(f"{name}_Response"), 1))),
        ],
    )
    parts = (
        ("request_message", "Request"),
        ("response_message", "Response"),
        ("event_message", "Event"),
    )
    types[name] = ([], [(field, _name(f"{name}_{part}")) for field, part in parts])
    TYPES.register(types)


# `char` in a definition is uint8 to ROS 2, also in hashes; rosbags hashes it as a type of its own.
_INFO = TYPES.fielddefs["service_msgs/msg/ServiceEventInfo"]
TYPES.fielddefs["service_msgs/msg/ServiceEventInfo"] = (
    _INFO[0],
    [
        (
            field,
            (Nodetype.ARRAY, ((Nodetype.BASE, ("uint8", 0)), 16))
            if field == "client_gid"
            else kind,
        )
        for field, kind in _INFO[1]
    ],
)
_register_service(TRIGGER, _REPLY)
for _service in (GOTO, SELECT_THRUSTER):
    _register_service(
        _service, (INTERFACES / f"srv/{_service.rpartition('/')[2]}.srv").read_text("utf-8")
    )
for _message in sorted(Path(__file__).with_name("px4_msgs").glob("*.msg")):
    TYPES.register(get_types_from_msg(_message.read_text("utf-8"), f"px4_msgs/msg/{_message.stem}"))


@cache
def type_hash(type_name: str) -> str:
    """Return the hash of a message or service type, ``RIHS01_`` and 64 hexadecimal digits."""
    return TYPES.hash_rihs01(type_name)


def response(type_name: str, success: bool, message: str) -> Any:
    """Return a response of a service; all have the fields of ``std_srvs/srv/Trigger``."""
    return TYPES.types[f"{type_name}_Response"](success, message)
