# SPDX-License-Identifier: Apache-2.0
"""Define the leases of command authority: rules for the chasers, which grant them, and for all
others.

Pure functions. A lease covers a range of the world's ticks, not a span of a clock: no delay of a
message and no error of a clock lets two controllers hold one chaser's lease of the same tick.
"""

from __future__ import annotations

import math
from collections.abc import Collection

from .messages import Lease, Tick, WrenchCommand
from .topics import CONTROLLERS

LEASE_S, LEASE_MAX_S = 0.18, 2.0
"""Shortest and longest lease, s; every lease covers at least two ticks. Shorter: a standby takes
over sooner; longer: a slow machine changes its commander less often.
"""


def lease_ticks(rate_hz: float) -> int:
    """Return the length of a lease at this tick rate."""
    return max(2, math.ceil(LEASE_S * rate_hz))


def longest_lease_ticks(rate_hz: float) -> int:
    """Return the greatest length of a lease at this tick rate."""
    return max(lease_ticks(rate_hz), math.ceil(LEASE_MAX_S * rate_hz))


def defect_of(lease: Lease, rate_hz: float) -> str:
    """Return why no chaser can have stated a lease; empty if it is sound."""
    if not lease.holder:
        return ""
    if commander_of(lease.term) != lease.holder:
        return (
            f"term {lease.term} belongs to {commander_of(lease.term) or 'no controller'}, not to "
            f"{lease.holder}"
        )
    # A command may arrive, and renew the lease, before its tick.
    latest = lease.tick + 2 * longest_lease_ticks(rate_hz)
    if not lease.from_tick <= lease.tick <= lease.until_tick < latest:
        return f"from tick {lease.from_tick} to {lease.until_tick}, stated in tick {lease.tick}"
    return ""


def next_term(term: int, controller: str) -> int:
    """Return the smallest term above ``term`` that belongs to a controller; no two controllers
    share one.
    """
    number = term + 1
    while commander_of(number) != controller:
        number += 1
    return number


def commander_of(term: int) -> str:
    """Return the controller that a term belongs to, empty for 0."""
    return CONTROLLERS[(term - 1) % len(CONTROLLERS)] if term else ""


def is_majority(granted: Collection[int], live: Collection[int]) -> bool:
    """Return whether the chasers ``granted`` are a majority of the ``live`` ones.

    Half of an even number is a majority if it includes the first chaser.
    """
    if not live or not granted:
        return False
    return 2 * len(granted) + (min(live) in granted) > len(live)


def no_command(chaser: int, tick: Tick) -> WrenchCommand:
    """Return the message that tells a waiting chaser that nobody commands a tick."""
    zero = (0.0, 0.0, 0.0)
    return WrenchCommand(
        tick=tick.tick,
        sim_time_ns=tick.sim_time_ns,
        chaser=chaser,
        effective_time_ns=tick.sim_time_ns,
        expires_ns=tick.sim_time_ns,
        mode="none",
        force_N=zero,
        torque_N_m=zero,
    )
