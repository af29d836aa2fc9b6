# SPDX-License-Identifier: Apache-2.0
"""Plan of a reproduction: missions with images, and studies of the controller on perfect knowledge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.scenario.bodies import Target

from chaserdock.evaluation.study_cases import StudyCase

from .paper import PAPER_S, ROWS

QUICK_S = 40.0
SCENARIO = "paper-single"
"""The scenario of every single-chaser run: the paper's settings and its baseline row."""

DRAWS = range(3)
"""The paper flew every row three times. Ours differ by their dispersed start; equal draws have equal starts in all rows."""

NOMINAL_OFFSET_M = (0.85, 0.0, 0.0)
NOMINAL_ROTATION_RAD = (0.42, 0.0, -0.3927)
"""The start of ``paper-single``, from the reference pose: in TRF, and as a rotation vector in body axes."""

OFFSET_BOUND_M = 0.05
ROTATION_BOUND_RAD = 0.05
ATTITUDE_BOUND_RAD = 0.2
RATE_BOUND = 0.2
"""Bounds of the dispersed starts, uniform about the nominal one: each component of the chaser's offset and of its rotation
vector; each component of the rotation vector of the target's initial attitude; each component of the target's velocity
and angular velocity, as a share of its value."""

CHAIN = "chain"
COLUMNS: dict[str, tuple[str, ...]] = {
    CHAIN: ("perception.name='paper'", "estimator.name='paper'", "controller.solver='open'"),
    "paper": (),
    "default": (
        "controller.integrator='rk4'",
        "controller.feed_forward=true",
        "time.rate_hz=15",
        "time.image_hz=15",
        "time.latency_s=0.0333333333333333",
    ),
}
"""Overrides of ``paper-single``. ``chain``: the paper's settings and the paper's perception (EPnP), combiner and solver
(OpEn). ``paper``: the paper's settings with our perception, estimator and solver. ``default``: all ours."""


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
    )


@dataclass(frozen=True)
class Mission:
    """One run of ``chaserdock run``. The runs of one ``group`` are shown together."""

    name: str
    group: str
    scenario: str
    seed: int = 0
    overrides: tuple[str, ...] = ()


@dataclass(frozen=True)
class ReproductionPlan:
    """All missions and studies. ``duration_s``: of each single-chaser run."""

    quick: bool
    duration_s: float
    missions: tuple[Mission, ...]
    studies: tuple[StudyCase, ...]


def needs_open(item: Mission | StudyCase) -> bool:
    """Return whether a run uses OpEn, the paper's solver."""
    return "controller.solver='open'" in item.overrides


def table_group(column: str, row: str) -> str:
    """Return the group of a table cell, for missions and studies; ``group/draw`` names a run."""
    return f"table/{column}/{row}"


_PAPER_SETTINGS = (
    "navigation.grade='exact'",
    "time.latency_s=0.0",
    "controller.integrator='euler'",
    "controller.feed_forward=false",
)
_PAPER_VIEW = ("camera.width_px=1280", "camera.height_px=720", "time.rate_hz=30", "time.image_hz=30")
TRACKING = "two-chaser-tracking"
AVOIDANCE = "collision-avoidance"
MULTI_CHASER = (TRACKING, "four-chaser-docking", AVOIDANCE)


def _draws_with_images(quick: bool, column: str, row: str) -> range:
    """Return the draws of a table cell that are flown with images; a quick plan flies few of them."""
    if not quick or (row == "baseline" and column != "default"):
        return DRAWS
    shown = row == "baseline" or (column == CHAIN and row in ("T=0.5", "T=10"))
    return DRAWS[:1] if shown else DRAWS[:0]


def missions(quick: bool, duration_s: float) -> tuple[Mission, ...]:
    """Return the flights with images; the table comes first."""
    length = f"duration_s={duration_s}"
    out: list[Mission] = []

    def add(group: str, draws: range, *overrides: str) -> None:
        for draw in draws:
            sets = (*overrides, *dispersed_start(draw), length)
            out.append(Mission(f"{group}/{draw}", group, SCENARIO, draw, sets))

    for column, settings in COLUMNS.items():
        for row in ROWS:
            draws = _draws_with_images(quick, column, row.name)
            add(table_group(column, row.name), draws, *row.overrides, *settings)
    if not quick:
        add("estimator/paper", DRAWS, "estimator.name='paper'")
        add("target/servicer", DRAWS, "target.model='servicer'", *COLUMNS["default"])
    view = () if quick else _PAPER_VIEW
    for column, settings, scenarios in (
        ("default", (), ("four-chaser-docking", AVOIDANCE) if quick else MULTI_CHASER),
        ("paper", (*_PAPER_SETTINGS, *view), () if quick else MULTI_CHASER),
        (CHAIN, (*_PAPER_SETTINGS, *view, *COLUMNS[CHAIN]), (TRACKING,) if quick else (TRACKING, AVOIDANCE)),
    ):
        for scenario in scenarios:
            group = f"mission/{column}/{scenario}"
            out.append(Mission(f"{group}/0", group, scenario, 0, settings))
    return tuple(out)


_INGREDIENTS: dict[str, tuple[str, ...]] = {
    "RK4 in place of Euler": ("controller.integrator='rk4'",),
    "feed-forward in place of u_ref = 0": ("controller.feed_forward=true",),
    "latency of 1/30 s, compensated": ("time.latency_s=0.0333333333333333",),
    "control at 15 Hz": ("time.rate_hz=15", "time.image_hz=15"),
    "control at 10 Hz": ("time.rate_hz=10", "time.image_hz=10"),
    "force weight times 4": ("controller.weight_force=14.0",),
    "force weight by 4": ("controller.weight_force=0.875",),
    "final weights by 4": (
        "controller.weight_final_position=812.5",
        "controller.weight_final_orientation=437.5",
    ),
    "dt = 1/30 s": ("controller.dt_s=0.0333333333333333",),
    "dt = 1/30 s, stage weights by 3": (
        "controller.dt_s=0.0333333333333333",
        *(
            f"controller.weight_{name}={weight / 3}"
            for name, weight in (("position", 65), ("orientation", 35), ("force", 3.5), ("torque", 40))
        ),
    ),
    "dt = 1/5 s": ("controller.dt_s=0.2",),
    "dt = 1/5 s, stage weights times 2": (
        "controller.dt_s=0.2",
        *(
            f"controller.weight_{name}={weight * 2}"
            for name, weight in (("position", 65), ("orientation", 35), ("force", 3.5), ("torque", 40))
        ),
    ),
    "solved to convergence (ipopt)": ("controller.solver='ipopt'",),
    "the paper's solver (OpEn)": ("controller.solver='open'",),
}

INFERRED = "inferred"
_STARTS: dict[str, tuple[str, ...]] = {
    INFERRED: (),
    "closing, turned about X": ("chasers.0.start_rotation_rad=[0.575, 0.0, 0.0]",),
    "receding, turned about X": (
        "chasers.0.position_m=[-1.0, 0.0, 0.0]",
        "chasers.0.q_wxyz=[1.0, 0.0, 0.0, 0.0]",
        "chasers.0.start_offset_m=[-0.85, 0.0, 0.0]",
        "chasers.0.start_rotation_rad=[0.575, 0.0, 0.0]",
    ),
    "turned the other way": ("chasers.0.start_rotation_rad=[-0.42, 0.0, 0.3927]",),
    "turned about X, the other way": ("chasers.0.start_rotation_rad=[-0.575, 0.0, 0.0]",),
    "turned about Y": ("chasers.0.start_rotation_rad=[0.0, 0.575, 0.0]",),
    "turned about Z": ("chasers.0.start_rotation_rad=[0.0, 0.0, 0.575]",),
    "turned about Z, the other way": ("chasers.0.start_rotation_rad=[0.0, 0.0, -0.575]",),
    "turned by 0.50 rad": ("chasers.0.start_rotation_rad=[0.3652, 0.0, -0.3415]",),
    "turned by 0.65 rad": ("chasers.0.start_rotation_rad=[0.4748, 0.0, -0.4439]",),
    "moving with the target's centre": ("chasers.0.start_velocity_m_s=[0.015, 0.0075, 0.03]",),
    "the target stands still": ("target.motion='static'",),
    "to the side, -Y": ("chasers.0.start_offset_m=[0.0, -0.85, 0.0]",),
    "to the side, +Y": ("chasers.0.start_offset_m=[0.0, 0.85, 0.0]",),
    "oblique, (0.6, 0.64, 0.48)": ("chasers.0.start_offset_m=[0.51, 0.544, 0.408]",),
    "0.75 m in place of 0.85 m": ("chasers.0.start_offset_m=[0.75, 0.0, 0.0]",),
    "0.80 m in place of 0.85 m": ("chasers.0.start_offset_m=[0.8, 0.0, 0.0]",),
    "0.90 m in place of 0.85 m": ("chasers.0.start_offset_m=[0.9, 0.0, 0.0]",),
    "on the reference, at rest": (
        "chasers.0.start_offset_m=[0.0, 0.0, 0.0]",
        "chasers.0.start_rotation_rad=[0.0, 0.0, 0.0]",
    ),
}


SOLVERS = ("rti", "ipopt", "open")
"""Whose solve time is measured: ours, one that converges, and the paper's."""
DELAYS_S = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
DELAYED_HORIZONS_S = (0.5, 3.0, 10.0)
TIMED_HORIZONS_S = (3.0, 10.0)


def studies(quick: bool, scenario: str, duration_s: float) -> tuple[StudyCase, ...]:
    """Return the flights of the scenario file ``scenario`` on perfect knowledge; a quick plan omits most of our default."""
    length = f"duration_s={duration_s}"
    out: list[StudyCase] = []

    def add(name: str, *overrides: str, floor: bool = False, delay_s: float | None = None) -> None:
        sets = (*overrides, length)
        out.append(StudyCase(name=name, scenario=scenario, overrides=sets, floor=floor, delay_s=delay_s))

    for column, settings in COLUMNS.items():
        for row in ROWS:
            if quick and column == "default" and row.name != "baseline":
                continue
            for draw in DRAWS:
                # One lower bound per start: the row affects it only through the rotation of the chaser.
                floor = row.name == "baseline" and column == "paper"
                name = f"{table_group(column, row.name)}/{draw}"
                add(name, *row.overrides, *settings, *dispersed_start(draw), floor=floor)
    for name, changed in _STARTS.items():
        add(f"start/{name}", *changed, floor=True)
    for name, changed in _INGREDIENTS.items():
        # Other solvers take ten to a hundred times as long: they fly the transient only.
        short = ("duration_s=30.0",) if "controller.solver" in changed[0] else ()
        case = StudyCase(name=f"ingredient/{name}", scenario=scenario, overrides=(*changed, length, *short))
        out.append(case)
    for horizon_s in DELAYED_HORIZONS_S:
        for delay_s in DELAYS_S:
            changed = f"controller.horizon_s={horizon_s}"
            add(f"delay/{horizon_s:g}/{delay_s:g}", changed, delay_s=delay_s)
    for horizon_s in TIMED_HORIZONS_S:
        for solver in SOLVERS:
            sets = (f"controller.horizon_s={horizon_s}", f"controller.solver='{solver}'", "duration_s=30.0")
            name = f"measured/{horizon_s:g}/{solver}"
            out.append(StudyCase(name=name, scenario=scenario, overrides=sets, delay_measured=True))
    return tuple(out)


def make_plan(quick: bool, scenario: str) -> ReproductionPlan:
    """Return the whole plan; ``scenario`` is the path of ``paper-single``."""
    duration_s = QUICK_S if quick else PAPER_S
    return ReproductionPlan(
        quick, duration_s, missions(quick, duration_s), studies(quick, scenario, duration_s)
    )
