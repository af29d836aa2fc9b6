"""How captures went, for the summary: from the truth's touches and latches, and the phases that the controller told."""

from __future__ import annotations

from typing import Any

import numpy as np
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_protocol.scenario import Scenario

from .flight import Flight

_CONTACT_SLACK_M = 0.02


def capture_of(flight: Flight, chaser: int) -> dict[str, Any] | None:
    """A chaser's capture as plain values for JSON; None where it has no port.

    ``latched``: at the end; ``latch_time_s`` and the figures at contact are those of the touch at which it closed.
    """
    if flight.scenario.docking.port_of(chaser) is None:
        return None
    touches = [t for t in flight.world.touches if t.chaser == chaser]
    closed = [t for t in touches if t.latched]
    last = closed[-1] if closed else None
    told = flight.told.get(chaser)
    return {
        "latched": chaser in flight.world.latched,
        "verified": told is not None and told.phases[-1][1] == "verified",
        "latch_time_s": None if last is None else last.sim_time_ns / 1e9,
        "contact_lateral_m": None if last is None else last.lateral_m,
        "contact_angle_rad": None if last is None else last.angle_rad,
        "contact_closing_m_s": None if last is None else last.closing_m_s,
        "contact_lateral_speed_m_s": None if last is None else last.lateral_speed_m_s,
        "probe_touches": len(touches),
        "refused": [t.refused for t in touches if not t.latched],
    }


def nearest_allowed_m(s: Scenario, chaser: int) -> float:
    """How near to the target's centre a chaser may come: its limit, or, where it is captured, as near as that asks."""
    port, limit = s.docking.port_of(chaser), s.limits.min_distance_target_m
    if port is None:
        return limit
    held_m = float(np.linalg.norm(centre_offset(port, s.chaser.probe_reach_m, 0.0)))
    return min(limit, held_m - _CONTACT_SLACK_M)


def capture_failures(result: dict[str, Any], s: Scenario) -> list[str]:
    """Which of the chasers that are to be latched are not, in words."""
    out = []
    for i in s.success.latched:
        capture = result["chasers"].get(str(i), {}).get("capture")
        if capture is None or not capture["latched"]:
            refused = capture["refused"] if capture else []
            out.append(
                f"chaser {i} is not latched" + (f"; a touch was refused: {refused[-1]}" if refused else "")
            )
        elif not capture["verified"]:
            out.append(f"chaser {i} is latched, but not verified by a pull")
    return out


def capture_text(capture: dict[str, Any]) -> str:
    """A capture for people, part of a line."""
    if capture["latch_time_s"] is None:
        return "; never latched"
    state = "verified" if capture["verified"] else "latched" if capture["latched"] else "let go"
    return (
        f"; {state}, latched at {capture['latch_time_s']:.1f} s: {capture['contact_lateral_m'] * 1e3:.2f} mm and "
        f"{np.degrees(capture['contact_angle_rad']):.2f} deg off, closing at "
        f"{capture['contact_closing_m_s'] * 1e3:.1f} mm/s"
    )
