# SPDX-License-Identifier: Apache-2.0
"""Maps of a target of unknown shape, judged on the motion of the bodies.

The frame of a map is fixed to the target, but nobody knows how: it is fitted to the flight, and
errors of poses are those that remain.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import LandmarkMap
from chaserdock_protocol.scenario import Scenario

from chaserdock.criterion import Criterion, criterion

from .motion import Track


@dataclass(frozen=True, eq=False)
class FittedFrame:
    """Frame of a map on the target: ``q_wxyz`` (4,) takes it to the target's own frame, in which
    ``origin_m`` (3,) is its origin.
    """

    q_wxyz: Array
    origin_m: Array

    @classmethod
    def of(cls, estimate: Track, true: Track) -> FittedFrame:
        """Return the fit of estimated poses to true ones at the same times (K,), at least one."""
        turns = rotations.multiply(rotations.conjugate(true.q_wxyz), estimate.q_wxyz)
        mean = rotations.normalize(turns[0])
        for _ in range(_ROUNDS):
            off = rotations.log(rotations.multiply(rotations.conjugate(mean), turns))
            mean = rotations.normalize(rotations.multiply(mean, rotations.exp(off.mean(axis=0))))
        away = rotations.rotate_inverse(true.q_wxyz, estimate.position_m - true.position_m)
        return cls(mean, away.mean(axis=0))

    def frame_of(self, target: Track) -> Track:
        """Return the motion of the map's frame, by that of the target."""
        arm = rotations.rotate(target.q_wxyz, self.origin_m)
        omega_w = rotations.rotate(target.q_wxyz, target.omega_rad_s)
        return Track(
            target.time_s,
            target.position_m + arm,
            target.velocity_m_s + np.cross(omega_w, arm),
            rotations.multiply(target.q_wxyz, self.q_wxyz),
            rotations.rotate_inverse(self.q_wxyz, target.omega_rad_s),
            target.sigma_m,
            target.sigma_rad,
        )


_ROUNDS = 5
"""Repetitions of the mean of rotations, which are within some degrees of each other."""


def ports_at(
    maps: list[LandmarkMap], latency_s: float, chaser: int, time_s: Array
) -> tuple[Array, Array]:
    """Return positions and axes (K, 3), frame of the map, of a chaser's chosen port at times (K,),
    by the maps that count then; zero before it has one.
    """
    found = [
        (m.sim_time_ns / 1e9 + latency_s, p) for m in maps for p in m.ports if p.chaser == chaser
    ]
    places = np.array([np.zeros((2, 3)), *((p.position_m, p.axis) for _, p in found)])
    rows = np.searchsorted([at_s for at_s, _ in found], time_s + _SAME_S, side="right")
    return places[rows, 0], places[rows, 1]


_SAME_S = 1e-6
"""Difference of two times, s, that are the same but for rounding."""


def mapping_of(maps: list[LandmarkMap], target: Track | None) -> dict[str, Any] | None:
    """Return what a flight's maps show, as plain values for JSON; None in a flight without any.

    ``target``: its motion, None if unknown; the figures of the rate are then None.
    """
    if not maps:
        return None
    found = [(m, rate_error(m, target)) for m in maps if m.motion is not None]
    first, last = (found[0], found[-1]) if found else (None, None)
    return {
        "status": maps[-1].status,
        "maps": len(found),
        "first_map_s": None if first is None else first[0].sim_time_ns / 1e9,
        "first_rate_error_share": None if first is None else first[1],
        "rate_error_share": None if last is None else last[1],
        "scale_sigma_share": None if last is None else last[0].scale_share,
        "landmarks": 0 if last is None else len(last[0].landmarks_m) // 3,
        "residual_px": None if last is None else last[0].residual_px,
        "closed_s": next((m.sim_time_ns / 1e9 for m in maps if m.closed), None),
    }


def rate_error(message: LandmarkMap, target: Track | None) -> float | None:
    """Return the error of a map's rate vector, WRF, as a share of the true rate; None if that is
    not known at its time, or zero.
    """
    if message.motion is None or target is None or not len(target.time_s):
        return None
    row = int(np.argmin(np.abs(target.time_s - message.sim_time_ns / 1e9)))
    true = rotations.rotate(target.q_wxyz[row], target.omega_rad_s[row])
    size = float(np.linalg.norm(true))
    if not math.isfinite(size) or size == 0.0:
        return None
    mapped = rotations.rotate(message.motion.q_wxyz, message.motion.omega_rad_s)
    return float(np.linalg.norm(mapped - true)) / size


def mapping_criteria(result: dict[str, Any], s: Scenario) -> Iterator[Criterion]:
    """Yield the criteria of ``success.map``."""
    limits, found = s.success.map, result.get("mapping") or {}
    if limits is None:
        return
    status = found.get("status", "no message of a mapper")
    note = "" if status == "mapped" else f"status at the end: {status}"
    yield criterion(
        "map", "first map at", found.get("first_map_s"), limits.within_s, "s", note=note,
        met=None if status == "mapped" else False,
    )  # fmt: skip
    share = found.get("rate_error_share")
    yield criterion(
        "map", "rate error of the last map", None if share is None else 100.0 * share,
        limits.rate_percent, "%",
    )  # fmt: skip


def mapping_text(found: dict[str, Any]) -> str:
    """Format the maps of a flight as a line."""
    if found["first_map_s"] is None:
        return f"  no map of the target: {found['status']}"
    rate = found["rate_error_share"]
    known = "" if rate is None else f", rate {100.0 * rate:.2f} % off"
    return (
        f"  map of the target: {found['status']}, {found['landmarks']} landmarks, first at "
        f"{found['first_map_s']:.1f} s{known}, scale within "
        f"{100.0 * found['scale_sigma_share']:.2g} % (1 sigma)"
    )
