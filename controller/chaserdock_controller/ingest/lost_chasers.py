"""Chasers that the controller has lost: obstacles to the others where they should be, wider the longer nothing is heard.

They are taken to coast, as a chaser does whose process is gone; one that lives and brakes by itself is within what is added
for a while. A chaser that has been away for ``FORGOTTEN_S`` may be anywhere, and is no obstacle any more, which is told.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.extrapolation import extrapolate
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.messages.fields import Level

from chaserdock_controller.nmpc import NmpcInput

ABSENT_S = 0.3
"""Unheard of for so long a chaser is absent."""
FORGOTTEN_S = 60.0
FIRST_M, GROWTH_M_S, MOST_M = 0.02, 0.01, 0.3
_LIMIT = 1e-3
"""N and N m: what an absent chaser's row may steer by, as the solver wants some room; it moves it by a millimetre."""


def margin_m(away_s: float) -> float:
    """What is added to the distance that others keep from a chaser unheard of for so long."""
    return min(MOST_M, FIRST_M + GROWTH_M_S * max(0.0, away_s))


@dataclass
class LostChasers:
    """The last odometry of every chaser, and who is away; ``told``: who has been said to be."""

    known: dict[int, Odometry] = field(default_factory=dict)
    told: set[int] = field(default_factory=set)

    def take(self, here: Mapping[int, Odometry], now_ns: int) -> list[tuple[Level, str]]:
        """Notes who is here; what is to be told of who is not."""
        self.known.update(here)
        away = self.away(now_ns)
        events: list[tuple[Level, str]] = []
        for i in sorted(self.told - away.keys()):
            back = i in here
            how = "is heard again" if back else f"unheard of for {FORGOTTEN_S:g} s, is no obstacle any more"
            events.append(("info" if back else "warning", f"chaser {i}: {how}"))
        for i in sorted(away.keys() - self.told):
            events.append(("warning", f"chaser {i}: absent: the others keep clear of where it should be"))
        self.told = set(away)
        return events

    def away(self, now_ns: int) -> dict[int, Odometry]:
        """LostChasers chasers that are obstacles, by their last odometry."""
        return {
            i: o
            for i, o in sorted(self.known.items())
            if ABSENT_S <= (now_ns - o.sim_time_ns) / 1e9 <= FORGOTTEN_S
        }


def coasting(last: Odometry, from_ns: int, times_s: Array) -> Array:
    """Positions (K, 3), WRF, of a chaser by its last odometry, ``times_s`` (K,) after ``from_ns``."""
    ahead = extrapolate(last, last.tick, from_ns)
    return np.asarray(ahead.position_m) + times_s[:, None] * np.asarray(ahead.velocity_m_s)


def with_lost_chasers(
    problem: NmpcInput, away: Mapping[int, Odometry], from_ns: int, step_s: float
) -> NmpcInput:
    """The problem with a row for each absent chaser after the others': it coasts and avoids nobody, and they avoid it.

    ``from_ns``: the time of stage 0. The margin is that of the horizon's end.
    """
    if not away:
        return problem
    n, nodes = problem.references.shape[:2]
    times_s = step_s * np.arange(nodes)
    states, references = [], []
    for last in away.values():
        places, q = coasting(last, from_ns, times_s), np.asarray(last.q_wxyz)
        states.append(np.concatenate([places[0], last.velocity_m_s, q, np.zeros(3)]))
        references.append(np.concatenate([places, np.tile(q, (nodes, 1))], axis=1))
    total = n + len(away)
    between = np.zeros((total, total))
    between[:n, :n] = problem.min_distance_chasers_m
    least_m = float(np.max(problem.min_distance_chasers_m))
    for row, last in enumerate(away.values(), start=n):
        away_s = (from_ns - last.sim_time_ns) / 1e9 + float(times_s[-1])
        between[row, :n] = between[:n, row] = least_m + margin_m(away_s)
    to_target = problem.min_distance_target_m
    corridors = problem.corridors
    if corridors is not None:
        corridors = np.concatenate([corridors, np.zeros((len(away), *corridors.shape[1:]))])
    return replace(
        problem,
        states=np.concatenate([problem.states, states]),
        references=np.concatenate([problem.references, references]),
        u_ref=np.concatenate([problem.u_ref, np.zeros((len(away), *problem.u_ref.shape[1:]))]),
        min_distance_target_m=np.concatenate([to_target, np.zeros((len(away), *to_target.shape[1:]))]),
        min_distance_chasers_m=between,
        input_max=np.concatenate([problem.input_max, np.full((len(away), 6), _LIMIT)]),
        corridors=corridors,
    )
