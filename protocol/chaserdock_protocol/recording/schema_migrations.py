# SPDX-License-Identifier: Apache-2.0
"""Migrate messages and keys of old logs to the present schema.

On the wire only the present version of a message is accepted. When the meaning or the name of a
field changes, the message's number in ``messages.VERSION`` goes up by one, and a function that
converts the old fields is added here; a log then reads as if it had been recorded today. A new
field with a default needs no migration.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec
from msgspec import Struct

from chaserdock_protocol.codec import MAX_BYTES, Rejected, check_numbers, decode
from chaserdock_protocol.messages import VERSION, encoding_of

T = TypeVar("T", bound=Struct)
Upgrade = Callable[[dict[str, Any]], dict[str, Any]]


def _renamed(**names: str) -> Upgrade:
    """Return an upgrade that renames fields, ``old="new"``."""
    return lambda fields: {names.get(name, name): value for name, value in fields.items()}


def _each(field: str, upgrade: Upgrade) -> Upgrade:
    """Return an upgrade of the structures in list ``field``."""
    return lambda fields: {**fields, field: [upgrade(item) for item in fields.get(field, ())]}


def _bad_image(fields: dict[str, Any]) -> dict[str, Any]:
    return {**fields, "status": "bad_image"} if fields.get("status") == "bad_picture" else fields


def _exact_odometry(fields: dict[str, Any]) -> dict[str, Any]:
    exact = (0.0,) * 9
    names = (
        "position_covariance_m2",
        "velocity_covariance_m2_s2",
        "attitude_covariance_rad2",
        "omega_covariance_rad2_s2",
    )
    return fields | dict.fromkeys(names, exact)


def _net_magnitudes(fields: dict[str, Any]) -> dict[str, Any]:
    """State the magnitudes of the net impulse, as pulses that cancel were not reported."""
    added = {
        "given_magnitude_N_s": "given_impulse_N_s",
        "given_angular_magnitude_N_m_s": "given_angular_impulse_N_m_s",
    }
    return fields | {
        name: [abs(x) for x in fields.get(net, (0.0,) * 3)] for name, net in added.items()
    }


def _observed_controllers(fields: dict[str, Any]) -> dict[str, Any]:
    """Replace the commander that the world named by the controllers that took part."""
    controllers = dict(fields.get("standing_by", {}))
    if fields.get("controller"):
        controllers = {
            fields.get("commander") or "controller": fields.get("instance", ""),
            **controllers,
        }
    names = ("controller", "term", "commander", "instance", "standing_by")
    return {name: value for name, value in fields.items() if name not in names} | {
        "controllers": controllers
    }


UPGRADES: dict[tuple[str, int], Upgrade] = {
    ("Tick", 1): _renamed(pictures="images"),
    ("Tick", 2): _observed_controllers,
    ("Odometry", 1): _exact_odometry,
    ("BodyTruth", 1): _renamed(
        jet_impulse_N_s="thruster_impulse_N_s", jet_open_s="thruster_open_s"
    ),
    ("Sighting", 1): _bad_image,
    ("ActuatorCommand", 1): _each("pulses", _renamed(jet="thruster")),
    ("ThrusterReport", 1): _renamed(jets="thrusters"),
    ("ThrusterReport", 2): _net_magnitudes,
    ("ThrusterFaultCommand", 1): _renamed(jet="thruster"),
    ("OperatorCommand", 1): _renamed(jet="thruster"),
    ("ControllerState", 1): _each("operated", _renamed(jet="thruster")),
}
"""(type, version) -> function from that version's fields, as plain values, to the next version's.
"""

_RENAMED_TYPES = {"JetReport": "ThrusterReport", "JetFaultCommand": "ThrusterFaultCommand"}
_RENAMED_KEYS = ((re.compile(r"chaser/(\d+)/jets"), r"chaser/\1/thrusters"),)

_ENCODING = re.compile(r"application/msgpack;chaserdock\.(\w+)\.v(\d{1,6})")


def current_key(key: str) -> str:
    """Return the present name of a key that a log was recorded with."""
    for pattern, name in _RENAMED_KEYS:
        if pattern.fullmatch(key):
            return pattern.sub(name, key)
    return key


def decode_logged(kind: type[T], payload: bytes, encoding: str) -> T:
    """Return a message of type ``kind`` from a log, upgraded if it is of an older version, and
    checked.

    Raises Rejected as ``codec.decode``; with reason ``encoding`` also when no upgrade leads to the
    present version.
    """
    if encoding == encoding_of(kind):
        return decode(kind, payload, encoding)

    found = _ENCODING.fullmatch(encoding)
    if (
        found is None
        or _RENAMED_TYPES.get(found[1], found[1]) != kind.__name__
        or int(found[2]) > VERSION[kind]
    ):
        raise Rejected(
            "encoding", f"got {encoding!r}, expected {encoding_of(kind)!r} or an older version"
        )
    if len(payload) > MAX_BYTES:
        raise Rejected("size", f"{len(payload)} bytes, at most {MAX_BYTES}")

    try:
        fields = msgspec.msgpack.decode(payload, type=dict[str, Any])
        for version in range(int(found[2]), VERSION[kind]):
            upgrade = UPGRADES.get((kind.__name__, version))
            if upgrade is None:
                raise Rejected(
                    "encoding", f"{kind.__name__}: nothing leads from version {version} to the next"
                )
            fields = upgrade(fields)
        message = msgspec.convert(fields, kind)
    except (
        msgspec.DecodeError,
        RecursionError,
        UnicodeDecodeError,
        LookupError,
        TypeError,
        ValueError,
    ) as error:
        raise Rejected("format", str(error)) from None
    check_numbers(message)
    return message
