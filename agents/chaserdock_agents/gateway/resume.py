# SPDX-License-Identifier: Apache-2.0
"""Keep in a file which mission a gateway has begun, so that one that is started after it was killed
takes it up again.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

import msgspec
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.scenario import Scenario


class ResumeError(ChaserdockError):
    """The file of a mission is not one, or of another mission."""


class BegunMission(msgspec.Struct, frozen=True, kw_only=True):
    """A mission that has begun. ``start_ns``: its tick 0 by the host's clock. ``scenario``: digest
    of its scenario.
    """

    run_id: str
    start_ns: int
    scenario: str


def digest_of(scenario: Scenario) -> str:
    """Return what two scenarios share only if they are equal."""
    return hashlib.sha256(scenario.model_dump_json().encode()).hexdigest()


def begun_mission(path: Path, scenario: Scenario, now_ns: int) -> BegunMission | None:
    """Return the mission that a file states, None without a file. Raises ResumeError."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ResumeError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        begun = msgspec.json.decode(content, type=BegunMission)
    except msgspec.MsgspecError as error:
        raise ResumeError(f"{path}: states no mission ({error}); remove it") from None
    if begun.scenario != digest_of(scenario):
        raise ResumeError(f"{path}: states a mission of another scenario; remove it to begin anew")
    if begun.start_ns > now_ns:
        raise ResumeError(f"{path}: states a mission from before the last boot; remove it")
    return begun


def note_mission(path: Path, begun: BegunMission) -> None:
    """Write the file of a mission. Raises WriteError."""
    write_atomically(path, msgspec.json.encode(begun))


def forget_mission(path: Path) -> None:
    """Remove the file of a mission that is over."""
    with suppress(OSError):
        path.unlink()
