# SPDX-License-Identifier: Apache-2.0
"""Last part of a chaser's way to the target: range, offset and closing speed, with their limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array

from .flight import RecordedFlight
from .mapping import ports_at

_BEYOND_ENTRY = 1.3
"""Largest range shown, in lengths of the corridor: with the end of the alignment before it. Larger:
the corridor becomes small.
"""
_APPROACHING = ("align", "approach", "final", "contact", "docked")
"""Phases shown: from the alignment to contact, or in the docking pose."""


@dataclass(frozen=True)
class Limit:
    """A limit that holds between two ranges, m. At contact both are 0."""

    from_m: float
    to_m: float
    value: float
    name: str


@dataclass(frozen=True)
class DockingApproach:
    """Approach of a chaser at times (K,) s: range (K,) m along the docking axis, offset (K,) m from
    it, and closing speed (K,) m/s. With a port they are those of the probe's tip, and the range is
    0 at contact; else those of the chaser's centre, and the range is 0 in the docking pose.
    """

    time_s: Array
    range_m: Array
    lateral_m: Array
    closing_m_s: Array
    lateral_limits: tuple[Limit, ...]
    closing_limits: tuple[Limit, ...]


def approach_of(flight: RecordedFlight, chaser: int) -> DockingApproach | None:
    """Return the approach of a chaser; None if it has made none."""
    history = flight.references.get(chaser)
    if history is None or not flight.motion.has_pair(chaser):
        return None
    begins = [begin_s for begin_s, _ in history.phases[1:]] + [np.inf]
    spans = [
        (begin_s, end_s)
        for (begin_s, phase), end_s in zip(history.phases, begins, strict=True)
        if phase in _APPROACHING
    ]
    own, target = flight.motion.pair(chaser)
    target = flight.estimated_frame(target)
    times = target.time_s
    inside = np.any([(times >= a) & (times < b) for a, b in spans or [(1.0, 0.0)]], axis=0)
    if np.count_nonzero(inside) < 3:
        return None
    s, port = flight.scenario, flight.scenario.docking.port_of(chaser)
    if port is None:
        place = np.array(s.chasers[chaser].position_m)
        axis, origin = place / np.linalg.norm(place), np.zeros(3)
        chosen = ports_at(flight.maps, s.mapping.latency_s, chaser, times[-1:])
        if chosen[1].any():
            (origin,), (axis,) = chosen
        start_m, ahead = s.approach.dock_distance_m, np.zeros(3)
        furthest = np.inf
        lateral = (Limit(0.0, 0.0, s.approach.docked_position_m, "docked"),)
        away_m = float(np.linalg.norm(place)) - start_m
        closing = (Limit(away_m, 0.0, s.approach.max_speed_m_s, "approach"),)
    else:
        axis, origin = np.asarray(port.axis), np.asarray(port.position_m)
        start_m, ahead = 0.0, np.array([s.chaser.probe_reach_m, 0.0, 0.0])
        d = s.docking
        furthest = _BEYOND_ENTRY * d.entry_m
        parts = ((d.entry_m, d.final_m, d.corridor, "corridor"), (d.final_m, 0.0, d.final, "final"))
        parts = (*parts, (0.0, 0.0, d.tolerances, "contact"))
        lateral = tuple(Limit(a, b, part.lateral_m, name) for a, b, part, name in parts)
        closing = tuple(Limit(a, b, part.closing_m_s, name) for a, b, part, name in parts)
    tip = own.position_m + rotations.rotate(own.q_wxyz, np.broadcast_to(ahead, (len(times), 3)))
    offset = rotations.rotate_inverse(target.q_wxyz, tip - target.position_m) - origin
    along = offset @ axis
    range_m, closing_m_s = along - start_m, -np.gradient(along, times)
    lateral_m = np.linalg.norm(offset - along[:, None] * axis, axis=1)
    shown = inside & (range_m <= furthest)
    if np.count_nonzero(shown) < 3:
        return None
    return DockingApproach(
        times[shown], range_m[shown], lateral_m[shown], closing_m_s[shown], lateral, closing
    )
