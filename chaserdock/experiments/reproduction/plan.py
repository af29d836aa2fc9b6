# SPDX-License-Identifier: Apache-2.0
"""Plan of a reproduction: single-chaser flights of the paper's table, flights that explain its
trends, missions of several chasers.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.scenario.bodies import Target
from chaserdock_protocol.shipped_scenarios import find_scenario

from chaserdock.experiments.plan import (
    ONE_PROCESS,
    Alone,
    ExperimentPlan,
    PlannedFlight,
    plan_flight,
)
from chaserdock.version import sources_digest

from .paper import BASELINE, PAPER_S, ROWS, PaperRow

QUICK_S = 40.0
"""Duration of a quick flight: the transient, and 20 s of steady state."""
SCENARIO = "paper-single"
"""The scenario of every single-chaser flight: the paper's settings and its baseline row."""

DRAWS = range(3)
"""Draws of the dispersed start of each row. The paper flew every row three times. Equal draws have
equal starts in all rows.
"""

NOMINAL_OFFSET_M = (0.85, 0.0, 0.0)  # m, TRF
NOMINAL_ROTATION_RAD = (0.42, 0.0, -0.3927)
"""Start of ``paper-single`` relative to the reference pose: offset in TRF, and rotation vector in
body axes.
"""

OFFSET_BOUND_M = 0.05  # m
ROTATION_BOUND_RAD = 0.05  # rad
ATTITUDE_BOUND_RAD = 0.2  # rad
RATE_BOUND = 0.2  # share
"""Bounds of the dispersed starts, uniform about the nominal one: each component of the chaser's
offset and rotation vector; each component of the rotation vector of the target's initial attitude;
each component of the target's velocity and angular velocity, as a share of its value. They are
assumptions: the paper does not state how repeatable its starts were.
"""

OPEN = "controller.solver='open'"
WRITTEN, CODE, DEFAULT = "as written", "as in the authors' code", "ours"
COLUMNS: dict[str, tuple[str, ...]] = {
    WRITTEN: ("perception.name='paper'", "estimator.name='paper'", OPEN),
    CODE: ("perception.name='paper_iterative'", "estimator.name='paper'", OPEN),
    DEFAULT: (
        "controller.integrator='rk4'",
        "controller.feed_forward=true",
        "time.rate_hz=15",
        "time.image_hz=15",
        "time.latency_s=0.0333333333333333",
    ),
}
"""Overrides of ``paper-single`` in each column. The scenario has the paper's controller settings.
The paper's chain: perception, combiner and OpEn, with EPnP as the paper states or with the PnP of
its authors' public code. Ours: the default settings.
"""


def dispersed_start(draw: int) -> tuple[str, ...]:
    """Return the scenario overrides of a start drawn within the bounds, seeded by ``draw``."""
    rng = np.random.default_rng([draw, 0x9A9E])
    offset = np.add(NOMINAL_OFFSET_M, rng.uniform(-OFFSET_BOUND_M, OFFSET_BOUND_M, 3))
    rotation = np.add(NOMINAL_ROTATION_RAD, rng.uniform(-ROTATION_BOUND_RAD, ROTATION_BOUND_RAD, 3))
    attitude = rotations.exp(rng.uniform(-ATTITUDE_BOUND_RAD, ATTITUDE_BOUND_RAD, 3))
    target = Target()
    velocity = np.multiply(target.velocity_m_s, 1.0 + rng.uniform(-RATE_BOUND, RATE_BOUND, 3))
    omega = np.multiply(target.omega_rad_s, 1.0 + rng.uniform(-RATE_BOUND, RATE_BOUND, 3))
    return (
        f"chasers.0.start_offset_m={offset.tolist()}",
        f"chasers.0.start_rotation_rad={rotation.tolist()}",
        f"target.q_wxyz={attitude.tolist()}",
        f"target.velocity_m_s={velocity.tolist()}",
        f"target.omega_rad_s={omega.tolist()}",
        f"seed={draw}",
    )


def needs_open(flight: PlannedFlight) -> bool:
    """Return whether a flight uses OpEn, the paper's solver."""
    return OPEN in flight.overrides


def table_name(column: str, row: PaperRow, draw: int) -> str:
    """Return the name of a flight of the table."""
    return f"table/{column}/{row.name}/{draw}"


def draws_of(quick: bool, column: str, row: PaperRow) -> range:
    """Return the starts from which a row is flown. Ours flies one start outside the baseline row;
    EPnP flies that row only.
    """
    draws = DRAWS[:1] if quick else DRAWS
    if row == BASELINE or column == CODE:
        return draws
    return draws[:1] if column == DEFAULT else draws[:0]


def floor_name(draw: int) -> str:
    """Return the name of the flight whose lower bound belongs to a start."""
    return f"floor/{draw}"


def _stage_weights(factor: float) -> tuple[str, ...]:
    weights = (("position", 65.0), ("orientation", 35.0), ("force", 3.5), ("torque", 40.0))
    return tuple(f"controller.weight_{name}={weight * factor!r}" for name, weight in weights)


STAGE_WEIGHTS = {"dt=1-5": 2.0, "dt=1-30": 1.0 / 3.0}
"""Factors on the stage weights that keep the sum of the stage costs when dt changes."""
STARTS: dict[str, str] = {
    "0.80 m away": "chasers.0.start_offset_m=[0.8, 0.0, 0.0]",
    "0.90 m away": "chasers.0.start_offset_m=[0.9, 0.0, 0.0]",
    "turned by 0.50 rad": "chasers.0.start_rotation_rad=[0.3652, 0.0, -0.3415]",
    "turned by 0.65 rad": "chasers.0.start_rotation_rad=[0.4748, 0.0, -0.4439]",
}
"""Starts that differ from the nominal one in one respect."""
DELAYS_S: dict[str, tuple[float, ...]] = {
    "T=0.5": (0.1, 0.3, 0.5, 1.0),
    "T=10": (0.1, 0.3, 0.5, 0.7, 1.0),
}
"""Command delays with which the rows that have failed runs are flown."""


@cache
def code_digest() -> str:
    """Return a digest of the flying code and its scenarios, so that flights of another version are
    flown again. Raise ChaserdockError unless all packages are installed.
    """
    return sources_digest(without=Path(__file__).resolve().parent)


def flight_of(
    label: str,
    scenario: str,
    overrides: tuple[str, ...],
    alone: Alone | None = None,
    module: str = "",
    **varied: str,
) -> PlannedFlight:
    """Return a flight of a shipped scenario, with this version of the code."""
    path, code = find_scenario(scenario), code_digest()
    return plan_flight(label, path, overrides, varied=varied, alone=alone, module=module, code=code)


FREE_STARTS = range(10)
"""Seeds of the free starts (free_starts.py). More: their spread is better known; each takes half a
minute of a core.
"""
_FREE_STARTS_MODULE = "chaserdock.experiments.reproduction.free_starts"


def free_name(seed: int) -> str:
    """Return the name of the flights of a free start."""
    return f"free/{seed}"


def _free_starts(quick: bool) -> list[PlannedFlight]:
    """Return the free starts, each of which is fitted and flown in all rows; one if quick."""
    return [
        flight_of(free_name(k), SCENARIO, (OPEN, f"seed={k}"), module=_FREE_STARTS_MODULE)
        for k in (FREE_STARTS[:1] if quick else FREE_STARTS)
    ]


def _table(quick: bool, length: str) -> list[PlannedFlight]:
    """Return the flights of the paper's table; the first start of every row comes first."""
    out = []
    for draw in DRAWS:
        for column, settings in COLUMNS.items():
            for row in ROWS:
                if draw in draws_of(quick, column, row):
                    sets = (*row.overrides, *settings, *dispersed_start(draw), length)
                    name = table_name(column, row, draw)
                    out.append(flight_of(name, SCENARIO, sets, module=ONE_PROCESS))
    return out


def _explanations(length: str) -> list[PlannedFlight]:
    """Return the flights of the paper's controller alone from the nominal start, and those for the
    lower bounds.
    """
    out = []

    def add(label: str, *overrides: str, floor: bool = False, delay_s: float | None = None) -> None:
        out.append(flight_of(label, SCENARIO, (*overrides, length), Alone(delay_s, floor)))

    for draw in DRAWS:
        add(floor_name(draw), *dispersed_start(draw), floor=True)
    for row in ROWS:
        add(f"alone/{row.name}", *row.overrides, OPEN, floor=row == BASELINE)
        if row.name in STAGE_WEIGHTS:
            weights = _stage_weights(STAGE_WEIGHTS[row.name])
            add(f"weights/{row.name}", *row.overrides, *weights, OPEN)
        for delay_s in DELAYS_S.get(row.name, ()):
            add(f"delay/{row.name}/{delay_s:g}", *row.overrides, OPEN, delay_s=delay_s)
    for name, start in STARTS.items():
        add(f"start/{name}", start, OPEN)
    return out


TRACKING = "two-chaser-tracking"
MISSIONS = (TRACKING, "four-chaser-docking", "collision-avoidance")
_PAPER_SETTINGS = (
    "navigation.grade='exact'",
    "time.latency_s=0.0",
    "time.rate_hz=30",
    "time.image_hz=30",
    "camera.width_px=1280",
    "camera.height_px=720",
    "controller.integrator='euler'",
    "controller.feed_forward=false",
)


def mission_name(scenario: str, column: str) -> str:
    """Return the name of a mission of several chasers."""
    return f"{scenario}, {column}"


def mission(scenario: str, column: str, overrides: tuple[str, ...] = ()) -> PlannedFlight:
    """Return a mission of several chasers, in the settings of a column."""
    label = mission_name(scenario, column)
    return flight_of(label, scenario, overrides, mission=scenario, chain=column)


def missions_of(plan: ExperimentPlan) -> list[PlannedFlight]:
    """Return the missions of several chasers of a plan."""
    return [flight for flight in plan.flights if "mission" in flight.varied]


def _missions() -> list[PlannedFlight]:
    """Return the paper's missions of several chasers: ours as shipped; EPnP only where the paper
    reports a spike.
    """
    out = [mission(TRACKING, WRITTEN, (*_PAPER_SETTINGS, *COLUMNS[WRITTEN]))]
    for scenario in MISSIONS:
        out.append(mission(scenario, CODE, (*_PAPER_SETTINGS, *COLUMNS[CODE])))
        out.append(mission(scenario, DEFAULT))
    return out


def make_plan(quick: bool) -> ExperimentPlan:
    """Return the whole plan; a quick one has one short flight per row, and no missions."""
    length = f"duration_s={QUICK_S if quick else PAPER_S}"
    missions = [] if quick else _missions()
    return ExperimentPlan(
        "reproduction",
        (*_explanations(length), *_free_starts(quick), *_table(quick, length), *missions),
    )
