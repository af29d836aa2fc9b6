# SPDX-License-Identifier: Apache-2.0
"""Free family of starts: drawn at random, fitted to the paper's baseline row only, then flown in
its other rows by the controller alone.

The paper states no start. If one could explain its table, a start that meets the baseline row would
bring out the changes of the other rows, which are not fitted.

``python -m chaserdock.experiments.reproduction.free_starts FOLDER`` reads a planned flight, whose
seed draws the start, as JSON from standard input and writes ``FOLDER/summary.json``.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.scenario.bodies import Target

from chaserdock.experiments.controller_flight import fly_alone, write_summary
from chaserdock.experiments.plan import PlannedFlight

from .paper import BASELINE, PAPER_S, ROWS, PaperRow
from .plan import NOMINAL_ROTATION_RAD, QUICK_S, RATE_BOUND
from .tables import LOST_M, QUANTITIES, Errors, errors_of, paper_value

SPEED_BOUND_M_S = 0.03  # m/s
"""Bound of each component of the chaser's initial velocity: about the target's speed, 0.034 m/s, so
that starts at rest beside the target and at rest in the world are both within it.
"""
TOLERANCE = 0.02
"""Greatest share by which both errors of a fitted start may miss the paper's baseline row. Smaller:
more flights; larger: the row is met worse.
"""
MOST_FLIGHTS = 8
"""Flights in which a start must be fitted; most need three. More only help a start that does not
converge.
"""
_POSITION_EXPONENT, _ANGLE_EXPONENT = 2.5, 2.0
"""Growth of the errors with distance and angle: under a bounded force the time to come back grows
with the root of the distance; torque is bounded less. They only set how fast the fit converges.
"""
_SLOW_ROW = "T=0.5"
"""Row that is flown to the end, as it settles for longer than the others."""


@dataclass(frozen=True)
class FreeStart:
    """A start but for distance and angle: ``direction`` (3,) of the offset, TRF; ``axis`` (3,) of
    the rotation, CRF; the target's attitude, velocity and rate (WRF, body); the chaser's velocity
    (WRF). SI units.
    """

    direction: Array
    axis: Array
    q_wxyz: Array
    target_velocity_m_s: Array
    target_omega_rad_s: Array
    velocity_m_s: Array

    def overrides(self, distance_m: float, angle_rad: float) -> tuple[str, ...]:
        """Return the scenario overrides of this start."""
        return (
            f"chasers.0.start_offset_m={(distance_m * self.direction).tolist()}",
            f"chasers.0.start_rotation_rad={(angle_rad * self.axis).tolist()}",
            f"chasers.0.start_velocity_m_s={self.velocity_m_s.tolist()}",
            f"target.q_wxyz={self.q_wxyz.tolist()}",
            f"target.velocity_m_s={self.target_velocity_m_s.tolist()}",
            f"target.omega_rad_s={self.target_omega_rad_s.tolist()}",
        )


def drawn_start(seed: int) -> FreeStart:
    """Return a random start. Uniform: the direction on the half sphere away from the target, so
    that no start is nearer to it than the reference pose; the axis on the sphere; the target's
    attitude over all rotations; velocities within their bounds.
    """
    rng = np.random.default_rng([seed, 0xF4EE])
    direction, axis, q = (_unit(rng.standard_normal(n)) for n in (3, 3, 4))
    direction[0] = abs(direction[0])  # the reference pose is on the target's +X axis
    target = Target()
    shares = 1.0 + rng.uniform(-RATE_BOUND, RATE_BOUND, 6)
    return FreeStart(
        direction,
        axis,
        q,
        target.velocity_m_s * shares[:3],
        target.omega_rad_s * shares[3:],
        rng.uniform(-SPEED_BOUND_M_S, SPEED_BOUND_M_S, 3),
    )


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


@dataclass(frozen=True)
class Fit:
    """Distance and angle of a start with its errors of the baseline row; ``met``: within TOLERANCE
    of the paper's.
    """

    distance_m: float
    angle_rad: float
    errors: Errors
    met: bool


def fitted(errors_at: Callable[[float, float], Errors]) -> Fit:
    """Fit distance (m) and angle (rad) so that the errors are those of the paper's baseline row.

    Each error grows mainly with its own parameter, as a power; every flight corrects both by that.
    """
    distance_m, angle_rad = LOST_M, math.hypot(*NOMINAL_ROTATION_RAD)
    for left in reversed(range(MOST_FLIGHTS)):
        errors = errors_at(distance_m, angle_rad)
        position, orientation = (errors.of(q) / paper_value(BASELINE, q) for q in QUANTITIES)
        met = max(abs(position - 1.0), abs(orientation - 1.0)) <= TOLERANCE
        if met or not left:
            return Fit(distance_m, angle_rad, errors, met)
        distance_m *= position ** (-1.0 / _POSITION_EXPONENT)
        angle_rad = min(angle_rad * orientation ** (-1.0 / _ANGLE_EXPONENT), math.pi)
    raise AssertionError("a fit has flights")


def fly_free_start(flight: PlannedFlight) -> Mapping[str, Any]:
    """Return a summary whose table ``free`` holds the fit and, if it is met, the errors by row."""
    start = drawn_start(flight.seed)

    def errors_of_row(row: PaperRow, distance_m: float, angle_rad: float) -> Errors:
        length = f"duration_s={PAPER_S if row.name == _SLOW_ROW else QUICK_S}"
        sets = (*row.overrides, *flight.overrides, length, *start.overrides(distance_m, angle_rad))
        return errors_of(fly_alone(load_scenario(Path(flight.scenario), sets)))

    fit = fitted(lambda *at: errors_of_row(BASELINE, *at))
    rows = {BASELINE.name: fit.errors}
    for row in ROWS[1:] if fit.met else ():
        rows[row.name] = errors_of_row(row, fit.distance_m, fit.angle_rad)
    return {
        "seed": flight.seed,
        "ended": "completed",
        "not_judged": ["success: the controller flew alone, against no criteria"],
        "free": {
            "distance_m": fit.distance_m,
            "angle_rad": fit.angle_rad,
            "met": fit.met,
            "rows": {name: {q: e.of(q) for q in QUANTITIES} for name, e in rows.items()},
        },
    }


if __name__ == "__main__":
    sys.exit(write_summary(fly_free_start))
