"""Messages of joining a mission and leaving it."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

from .base import Message
from .fields import Counts, Names, Text


class Presence(Message, frozen=True, kw_only=True):
    """Who a process is, and whose presence has reached it: process name to instance (see ``presence``)."""

    process: Text
    instance: Text
    heard: Names


class Farewell(Message, frozen=True, kw_only=True):
    """The last message of a process: how many messages it has published on each key."""

    process: Text
    published: Counts


class JoinRequest(Struct, frozen=True, kw_only=True):
    """A process asks the world to take part, before it opens any topic."""

    process: Text
    instance: Text


class JoinReply(Struct, frozen=True, kw_only=True):
    """The world's answer: the resolved scenario as JSON, or why not."""

    accepted: bool
    reason: Text
    run_id: Text = ""
    mode: Literal["lockstep", "realtime"] = "lockstep"
    scenario_json: Annotated[str, Meta(max_length=2_000_000)] = ""
