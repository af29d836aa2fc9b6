# SPDX-License-Identifier: Apache-2.0
"""Messages for joining and leaving a mission."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

from .base import Message
from .fields import Counts, Names, Text


class Presence(Message, frozen=True, kw_only=True):
    """Heartbeat of a process. ``heard``: processes whose presence it has received, name to instance."""

    process: Text
    instance: Text
    heard: Names


class Farewell(Message, frozen=True, kw_only=True):
    """Last message of a process: the number of messages that it has published on each key."""

    process: Text
    published: Counts


class JoinRequest(Struct, frozen=True, kw_only=True):
    """Request of a process to join the mission, before it declares any topic."""

    process: Text
    instance: Text


class JoinReply(Struct, frozen=True, kw_only=True):
    """The world's reply: the resolved scenario as JSON, or the reason of a rejection."""

    accepted: bool
    reason: Text
    run_id: Text = ""
    mode: Literal["lockstep", "realtime"] = "lockstep"
    scenario_json: Annotated[str, Meta(max_length=2_000_000)] = ""
