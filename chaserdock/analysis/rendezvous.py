# SPDX-License-Identifier: Apache-2.0
"""Criteria of published rendezvous and docking tasks, evaluated on the motion of the bodies at
every tick.

They are ``success.speed_limit``, ``approach_cone``, ``arrival`` and ``abort_clear_m``. Motion is in
WRF, in an orbit the Hill frame; distances are between centres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.rendezvous import Arrival, ConeLimit, SpeedLimit

from chaserdock.criterion import Criterion, criterion

from .flight import RecordedFlight

RendezvousResult = dict[str, float | None]


def rendezvous_of(flight: RecordedFlight, chaser: int) -> RendezvousResult | None:
    """Return what the criteria judge of a chaser's flight, as plain values for JSON; None if the
    scenario has none of them.

    ``speed_margin_m_s``: least margin to the speed limit. ``cone_angle_rad``: largest angle from
    the cone's axis. ``arrived_s``, ``arrived_speed_m_s``: time and speed of the arrival.
    ``abort_s``: begin of the first abort. ``abort_clear_m``: since then, the least half edge of a
    cube about the target with the chaser's centre on its surface. A value is None if the flight has
    no such part.
    """
    success = flight.scenario.success
    if all(
        c is None
        for c in (
            success.speed_limit,
            success.approach_cone,
            success.arrival,
            success.abort_clear_m,
        )
    ):
        return None
    own, target = flight.motion.pair(chaser)
    offset = rotations.rotate_inverse(target.q_wxyz, own.position_m - target.position_m)
    speed = np.linalg.norm(own.velocity_m_s - target.velocity_m_s, axis=1)
    with_speed = bool(np.isfinite(speed).all())  # a reference may measure no velocities
    time_s, abort_s, n = target.time_s, _first_abort_s(flight, chaser), len(target.time_s)
    before = n if abort_s is None else int(np.searchsorted(time_s, abort_s))
    arrival = success.arrival if with_speed else None
    limit = success.speed_limit if with_speed else None
    arrived = _arrival(arrival, time_s[:before], offset[:before], speed[:before])
    return {
        "speed_margin_m_s": _speed_margin(limit, offset[:before], speed[:before]),
        "cone_angle_rad": _largest_angle(success.approach_cone, offset[:before]),
        **arrived,
        "abort_s": abort_s,
        "abort_clear_m": float(np.abs(offset[before:]).max(axis=1).min()) if before < n else None,
    }


def _first_abort_s(flight: RecordedFlight, chaser: int) -> float | None:
    history = flight.references.get(chaser)
    return (
        next((at_s for at_s, phase in history.phases if phase == "abort"), None)
        if history
        else None
    )


def _speed_margin(limit: SpeedLimit | None, offset: Array, speed: Array) -> float | None:
    if limit is None:
        return None
    distance = np.linalg.norm(offset, axis=1)
    inside = distance <= (math.inf if limit.within_m is None else limit.within_m)
    margins = limit.speed_m_s + limit.per_s * (distance[inside] - limit.from_m) - speed[inside]
    return float(margins.min()) if len(margins) else None


def _largest_angle(cone: ConeLimit | None, offset: Array) -> float | None:
    if cone is None:
        return None
    distance = np.linalg.norm(offset, axis=1)
    inside = distance <= cone.within_m
    axis = np.asarray(cone.axis) / np.linalg.norm(cone.axis)
    along = offset[inside] @ axis
    across = np.linalg.norm(offset[inside] - along[:, None] * axis, axis=1)
    return float(np.arctan2(across, along).max()) if inside.any() else None


def _arrival(
    arrival: Arrival | None, time_s: Array, offset: Array, speed: Array
) -> RendezvousResult:
    if arrival is None:
        return {"arrived_s": None, "arrived_speed_m_s": None}
    near = np.linalg.norm(offset, axis=1) <= arrival.distance_m
    slow = near & (speed <= (math.inf if arrival.speed_m_s is None else arrival.speed_m_s))
    first = np.flatnonzero(slow)
    if not len(first):
        return {"arrived_s": None, "arrived_speed_m_s": None}
    return {"arrived_s": float(time_s[first[0]]), "arrived_speed_m_s": float(speed[first[0]])}


def rendezvous_criteria(result: dict[str, Any], s: Scenario) -> Iterator[Criterion]:
    """Yield these criteria for each chaser of a summary."""
    for i, c in result["chasers"].items():
        if (found := c.get("rendezvous")) is not None:
            yield from _of_chaser(int(i), found, s, result["sim_time_s"])


def _of_chaser(i: int, found: RendezvousResult, s: Scenario, end_s: float) -> Iterator[Criterion]:
    success, cone = s.success, s.success.approach_cone
    margin, clear = found["speed_margin_m_s"], found["abort_clear_m"]
    if success.speed_limit is not None:
        value = None if margin is None else margin * 1e3
        yield criterion(
            "speed_limit", "below the speed limit", value, 0.0, "mm/s", i, "at least", unseen=True
        )
    if cone is not None:
        angle = _degrees(found["cone_angle_rad"])
        note = f"within {cone.within_m:g} m of the target"
        yield criterion(
            "approach_cone",
            "off the approach cone",
            angle,
            cone.half_angle_deg,
            "°",
            i,
            note=note,
            unseen=True,
        )
    if (arrival := success.arrival) is not None and i in arrival.chasers:
        slow = "" if arrival.speed_m_s is None else f", at {arrival.speed_m_s:g} m/s or less"
        yield criterion(
            "arrival",
            "arrived at",
            found["arrived_s"],
            end_s if arrival.within_s is None else arrival.within_s,
            "s",
            i,
            note=f"within {arrival.distance_m:g} m of the target{slow}",
        )
    if success.abort_clear_m is not None:
        yield criterion(
            "abort_clear_m",
            "clear after abort",
            clear,
            success.abort_clear_m,
            "m",
            i,
            "at least",
            note="half edge of a cube about the target",
            unseen=True,
        )


def rendezvous_text(found: RendezvousResult) -> str:
    """Format the values as part of a line."""
    parts = [
        ("least margin to the speed limit {:.3f} m/s", found["speed_margin_m_s"]),
        ("at most {:.2f}° off the cone's axis", _degrees(found["cone_angle_rad"])),
        ("arrived at {:.1f} s", found["arrived_s"]),
        ("aborted at {:.1f} s", found["abort_s"]),
        ("clear of it by {:.2f} m since", found["abort_clear_m"]),
    ]
    return "".join(f"; {text.format(value)}" for text, value in parts if value is not None)


def _degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else math.degrees(angle_rad)
