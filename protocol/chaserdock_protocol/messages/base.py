# SPDX-License-Identifier: Apache-2.0
"""Base class of messages."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

from .fields import MAX_COUNT, Count


class Message(Struct, frozen=True, kw_only=True):
    """Fields that every message has."""

    seq: Count = 0
    tick: Annotated[int, Meta(ge=-1, le=MAX_COUNT)] = -1
    sim_time_ns: Count = 0
