# SPDX-License-Identifier: Apache-2.0
"""Plan of a reproduction: missions with images, and studies of the controller on perfect knowledge."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

from chaserdock.evaluation.study_cases import StudyCase

from .paper import PAPER_S, ROWS

QUICK_S = 40.0
SCENARIO = "paper-single"
"""The scenario of every single-chaser run: the paper's settings and its baseline row."""

INFERRED = "inferred"
"""The start of ``paper-single``, used for every row with images."""

_ROLLED = "chasers.0.start_rotation_rad=[0.575, 0.0, 0.0]"
STARTS: dict[str, tuple[str, ...]] = {
    INFERRED: (),
    "closing": (_ROLLED,),
    "receding": (
        "chasers.0.position_m=[-1.0, 0.0, 0.0]",
        "chasers.0.q_wxyz=[1.0, 0.0, 0.0, 0.0]",
        "chasers.0.start_offset_m=[-0.85, 0.0, 0.0]",
        _ROLLED,
    ),
}
"""All are 0.85 m straight back, turned by 0.575 rad, at rest in WRF. The target moves away from a chaser behind it (the
paper's chaser 0, ``receding``) and towards one in front of it (its chaser 3, the others). ``inferred`` is turned about
an axis that reproduces both errors of the baseline, the others about the body's X."""

COLUMNS: dict[str, tuple[str, ...]] = {
    "paper": (),
    "default": (
        "controller.integrator='rk4'",
        "controller.feed_forward=true",
        "time.rate_hz=15",
        "time.image_hz=15",
        "time.latency_s=0.0333333333333333",
    ),
}
"""Overrides of ``paper-single``: none for the paper's settings, the scenario defaults for ours."""


@dataclass(frozen=True)
class Mission:
    """One run of ``chaserdock run``. Runs of one ``group`` are averaged."""

    name: str
    group: str
    scenario: str
    seed: int = 0
    overrides: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plan:
    """All missions and studies. ``duration_s``: of each single-chaser run."""

    quick: bool
    duration_s: float
    missions: tuple[Mission, ...]
    studies: tuple[StudyCase, ...]


def table_group(start: str, column: str, row: str) -> str:
    """Return the group of a table cell, for missions and studies."""
    return f"{start}/{column}/{row}"


def _repeat(group: str, scenario: str, seeds: range, *overrides: str) -> list[Mission]:
    return [Mission(f"{group}/{seed}", group, scenario, seed, overrides) for seed in seeds]


_PAPER_VIEW = (
    "camera.width_px=1280",
    "camera.height_px=720",
    "time.rate_hz=30",
    "time.image_hz=30",
    "time.latency_s=0.0",
    "controller.integrator='euler'",
    "controller.feed_forward=false",
)


def missions(quick: bool, duration_s: float) -> tuple[Mission, ...]:
    """Return the flights with images; the table comes first."""
    seeds, length = range(1 if quick else 3), f"duration_s={duration_s}"
    out: list[Mission] = []
    # From the other starts the studies cover all rows; images confirm the baseline.
    for start, turned in STARTS.items():
        for column, settings in COLUMNS.items():
            for row in ROWS:
                baseline, default = row.name == "baseline", column == "default"
                if (start != INFERRED and (default or not baseline)) or (quick and default and not baseline):
                    continue
                group = table_group(start, column, row.name)
                out += _repeat(group, SCENARIO, seeds, *row.overrides, *settings, *turned, length)
    out += _repeat("estimator/paper", SCENARIO, seeds, "estimator.name='paper'", length)
    servicer = ("target.model='servicer'", *COLUMNS["default"], length)
    out += _repeat("target/servicer", SCENARIO, seeds, *servicer)
    for name in ("two-chaser-tracking", "four-chaser-docking", "collision-avoidance"):
        shorter = ("duration_s=60.0",) if quick and name == "two-chaser-tracking" else ()
        out += _repeat(f"mission/default/{name}", name, range(1), *shorter)
        if not quick:
            out += _repeat(f"mission/paper/{name}", name, range(1), *_PAPER_VIEW)
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
    "solved to convergence (ipopt)": ("controller.solver='ipopt'",),
    "the paper's kind of solver (alpaqa: PANOC)": ("controller.solver='alpaqa'",),
}

_STARTS: dict[str, tuple[str, ...]] = {
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


def has_alpaqa() -> bool:
    """Return whether the extra ``alpaqa`` is installed. Without it the page states that its studies are omitted."""
    return find_spec("alpaqa") is not None


def measured_solvers() -> tuple[str, ...]:
    """Return the solvers whose solve time is measured: ours, a converging one and, if installed, one of the paper's kind."""
    return ("rti", "ipopt", "alpaqa") if has_alpaqa() else ("rti", "ipopt")


DELAYS_S = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
DELAYED_HORIZONS_S = (3.0, 10.0)


def studies(scenario: str, duration_s: float) -> tuple[StudyCase, ...]:
    """Return the flights of the scenario file ``scenario`` on perfect knowledge."""
    length = f"duration_s={duration_s}"
    out: list[StudyCase] = []

    def add(name: str, *overrides: str, floor: bool = False, delay_s: float | None = None) -> None:
        out.append(
            StudyCase(
                name=name,
                scenario=scenario,
                overrides=(*overrides, length),
                floor=floor,
                delay_s=delay_s,
            )
        )

    for start, turned in STARTS.items():
        for column, settings in COLUMNS.items():
            for row in ROWS:
                # One lower bound per start: the row affects it only through the rotation of the chaser.
                floor = row.name == "baseline" and column == "paper"
                add(table_group(start, column, row.name), *row.overrides, *settings, *turned, floor=floor)
    for name, changed in _STARTS.items():
        add(f"start/{name}", *changed, floor=True)
    for name, changed in _INGREDIENTS.items():
        if "alpaqa" in name and not has_alpaqa():
            continue
        # Other solvers take ten to a hundred times as long: they fly the transient only.
        short = ("duration_s=30.0",) if "controller.solver" in changed[0] else ()
        case = StudyCase(name=f"ingredient/{name}", scenario=scenario, overrides=(*changed, length, *short))
        out.append(case)
    for horizon_s in DELAYED_HORIZONS_S:
        changed = f"controller.horizon_s={horizon_s}"
        for delay_s in DELAYS_S:
            add(f"delay/{horizon_s:g}/{delay_s:g}", changed, delay_s=delay_s)
        for solver in measured_solvers():
            overrides = (changed, f"controller.solver='{solver}'", "duration_s=30.0")
            name = f"measured/{horizon_s:g}/{solver}"
            out.append(StudyCase(name=name, scenario=scenario, overrides=overrides, delay_measured=True))
    return tuple(out)


def make_plan(quick: bool, scenario: str) -> Plan:
    """Return the whole plan; ``scenario`` is the path of ``paper-single``."""
    duration_s = QUICK_S if quick else PAPER_S
    return Plan(quick, duration_s, missions(quick, duration_s), studies(scenario, duration_s))
