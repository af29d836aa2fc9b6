# SPDX-License-Identifier: Apache-2.0
"""Plan of a reproduction: single-chaser flights of the paper's table, flights that explain,
missions of several chasers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.scenario.bodies import Target
from msgspec import Struct

from chaserdock.evaluation.study_cases import StudyCase

from .paper import BASELINE, PAPER_S, ROWS, PaperRow

QUICK_S = 40.0
SCENARIO = "paper-single"
"""The scenario of every single-chaser flight: the paper's settings and its baseline row."""

DRAWS = range(3)
"""The paper flew every row three times. Ours differ by their dispersed start; equal draws have
equal starts in all rows.
"""

NOMINAL_OFFSET_M = (0.85, 0.0, 0.0)
NOMINAL_ROTATION_RAD = (0.42, 0.0, -0.3927)
"""The start of ``paper-single``, from the reference pose: in TRF, and as a rotation vector in body
axes.
"""

OFFSET_BOUND_M = 0.05
ROTATION_BOUND_RAD = 0.05
ATTITUDE_BOUND_RAD = 0.2
RATE_BOUND = 0.2
"""Bounds of the dispersed starts, uniform about the nominal one: each component of the chaser's
offset and of its rotation vector; each component of the rotation vector of the target's initial
attitude; each component of the target's velocity and angular velocity, as a share of its value."""

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
"""Overrides of ``paper-single``, whose controller has the paper's settings. The paper's chain:
perception, combiner, and OpEn, with EPnP as the paper writes, or with the PnP of its authors'
public code. Ours: the default settings."""


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


class Mission(Struct, frozen=True):
    """A shipped scenario of several chasers, flown with images in the settings of a column."""

    scenario: str
    column: str
    overrides: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """A name that is unique in the plan."""
        return f"{self.scenario}, {self.column}"


@dataclass(frozen=True)
class ReproductionPlan:
    """All flights. ``duration_s``: of each single-chaser flight."""

    quick: bool
    duration_s: float
    cases: tuple[StudyCase, ...]
    missions: tuple[Mission, ...]


def needs_open(item: Mission | StudyCase) -> bool:
    """Return whether a flight uses OpEn, the paper's solver."""
    return OPEN in item.overrides


def table_name(column: str, row: PaperRow, draw: int) -> str:
    """Return the name of a flight of the table."""
    return f"table/{column}/{row.name}/{draw}"


def draws_of(quick: bool, column: str, row: PaperRow) -> range:
    """Return the starts from which a row is flown: ours from one beyond the baseline row; EPnP in
    that row only.
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
"""Factors of the stage weights that keep the sum of the stage costs when dt changes."""
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
"""Delays of the command with which the rows with failed runs are flown."""


def _table(quick: bool, scenario: str, length: str) -> list[StudyCase]:
    """Return the flights of the paper's table, with images; first one of each row."""
    out = []
    for draw in DRAWS:
        for column, settings in COLUMNS.items():
            for row in ROWS:
                if draw in draws_of(quick, column, row):
                    sets = (*row.overrides, *settings, *dispersed_start(draw), length)
                    name = table_name(column, row, draw)
                    out.append(StudyCase(name=name, scenario=scenario, overrides=sets, images=True))
    return out


def _explanations(scenario: str, length: str) -> list[StudyCase]:
    """Return the flights of the paper's controller alone, on perfect knowledge from the nominal
    start, and lower bounds.
    """
    out = []

    def add(name: str, *overrides: str, floor: bool = False, delay_s: float | None = None) -> None:
        sets = (*overrides, length)
        out.append(
            StudyCase(name=name, scenario=scenario, overrides=sets, floor=floor, delay_s=delay_s)
        )

    for draw in DRAWS:
        add(floor_name(draw), *dispersed_start(draw), floor=True)
    for row in ROWS:
        add(f"alone/{row.name}", *row.overrides, OPEN, floor=row == BASELINE)
        if row.name in STAGE_WEIGHTS:
            add(
                f"weights/{row.name}",
                *row.overrides,
                *_stage_weights(STAGE_WEIGHTS[row.name]),
                OPEN,
            )
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


def _missions() -> list[Mission]:
    """Return the paper's missions of several chasers: ours as shipped; EPnP only where the paper
    reports a spike.
    """
    out = [Mission(TRACKING, WRITTEN, (*_PAPER_SETTINGS, *COLUMNS[WRITTEN]))]
    for scenario in MISSIONS:
        out.append(Mission(scenario, CODE, (*_PAPER_SETTINGS, *COLUMNS[CODE])))
        out.append(Mission(scenario, DEFAULT))
    return out


def make_plan(quick: bool, scenario: str) -> ReproductionPlan:
    """Return the whole plan; ``scenario`` is the path of ``paper-single``. A quick plan has one
    short flight per row.
    """
    duration_s = QUICK_S if quick else PAPER_S
    length = f"duration_s={duration_s}"
    cases = (*_explanations(scenario, length), *_table(quick, scenario, length))
    return ReproductionPlan(quick, duration_s, cases, () if quick else tuple(_missions()))
