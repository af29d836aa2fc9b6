# SPDX-License-Identifier: Apache-2.0
"""`chaserdock reproduce`: plan, arithmetic of the tables, page, resumption."""

from __future__ import annotations

import math
import re
import subprocess
from collections.abc import Mapping
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario
from harness import finished
from hypothesis import given
from hypothesis import strategies as st

from chaserdock.experiments.page import PageSection, Table, html, markdown
from chaserdock.experiments.plan import Alone, ExperimentError, ExperimentPlan, PlannedFlight
from chaserdock.experiments.provenance import Provenance, provenance
from chaserdock.experiments.reproduction import free_starts
from chaserdock.experiments.reproduction import reproduce as reproduction
from chaserdock.experiments.reproduction.content import pitch_rad, sections
from chaserdock.experiments.reproduction.earlier import read_earlier
from chaserdock.experiments.reproduction.flown import flights_section
from chaserdock.experiments.reproduction.free_starts import (
    SPEED_BOUND_M_S,
    TOLERANCE,
    drawn_start,
    fitted,
    fly_free_start,
)
from chaserdock.experiments.reproduction.paper import BASELINE, PAPER_S, ROWS
from chaserdock.experiments.reproduction.plan import (
    CODE,
    COLUMNS,
    DEFAULT,
    DRAWS,
    NOMINAL_OFFSET_M,
    NOMINAL_ROTATION_RAD,
    QUICK_S,
    SCENARIO,
    TRACKING,
    WRITTEN,
    code_digest,
    dispersed_start,
    draws_of,
    flight_of,
    make_plan,
    mission,
    mission_name,
    missions_of,
    needs_open,
    table_name,
)
from chaserdock.experiments.reproduction.reproduce import fly_and_report
from chaserdock.experiments.reproduction.tables import (
    QUANTITIES,
    Errors,
    Summaries,
    changes,
    comes_out,
    errors_of,
    over_two_minutes,
    paper_value,
    results_by_label,
    spread,
    verdict,
)
from chaserdock.experiments.reproduction.trends import trend_rows
from chaserdock.experiments.worker import fly, results_of

PATH = find_scenario(SCENARIO)
plan = cache(make_plan)


def scenario_of(flight: PlannedFlight) -> Scenario:
    return load_scenario(Path(flight.scenario), flight.overrides)


def table_flights(p: ExperimentPlan) -> list[PlannedFlight]:
    return [f for f in p.flights if f.label.startswith("table/")]


# -- the plan --------------------------------------------------------------------------------------


@pytest.mark.parametrize("quick", [True, False])
def test_every_flight_of_the_plan_is_valid_and_unique(quick: bool) -> None:
    flights = plan(quick).flights
    assert len({f.label for f in flights}) == len({f.name for f in flights}) == len(flights)
    single = [f for f in flights if f not in missions_of(plan(quick))]
    whole = [f for f in single if not f.label.startswith("free/")]
    assert {scenario_of(f).duration_s for f in whole} == {QUICK_S if quick else PAPER_S}
    assert len(flights) - len(single) == (0 if quick else 7)


def test_full_plan_repeats_nine_rows_from_three_starts() -> None:
    names = {f.label for f in table_flights(plan(False))}
    wanted = {
        table_name(column, row, draw)
        for column in COLUMNS
        for row in ROWS
        for draw in draws_of(False, column, row)
    }
    assert names == wanted
    flown = {column: [len(draws_of(False, column, row)) for row in ROWS] for column in COLUMNS}
    assert flown == {WRITTEN: [3, *[0] * 8], CODE: [3] * 9, DEFAULT: [3, *[1] * 8]}


def test_draws_have_the_same_starts_in_all_rows_within_the_bounds() -> None:
    starts = {}
    for flight in table_flights(plan(False)):
        s = scenario_of(flight)
        c, t = s.chasers[0], s.target
        start = (
            c.start_offset_m,
            c.start_rotation_rad,
            t.q_wxyz,
            t.velocity_m_s,
            t.omega_rad_s,
            s.seed,
        )
        starts.setdefault(flight.label[-1], set()).add(start)
    assert {draw: len(found) for draw, found in starts.items()} == {"0": 1, "1": 1, "2": 1}
    assert len(set.union(*starts.values())) == 3
    for ((offset, rotation, q, velocity, omega, _),) in starts.values():
        assert np.abs(np.subtract(offset, NOMINAL_OFFSET_M)).max() <= 0.05
        assert np.abs(np.subtract(rotation, NOMINAL_ROTATION_RAD)).max() <= 0.05
        assert 2 * math.acos(q[0]) <= 0.2 * math.sqrt(3)
        assert np.abs(np.divide(velocity, (0.015, 0.0075, 0.03)) - 1).max() <= 0.2
        assert np.abs(np.divide(omega, (0.015, 0.045, 0.03)) - 1).max() <= 0.2
    assert dispersed_start(0) == dispersed_start(0) != dispersed_start(1)


def test_paper_settings_equal_the_reference() -> None:
    cases = {f.label: scenario_of(f) for f in plan(False).flights if f.label.endswith("/0")}
    for row in ROWS:
        for column, perception in ((WRITTEN, "paper"), (CODE, "paper_iterative")):
            if table_name(column, row, 0) not in cases:
                continue
            s = cases[table_name(column, row, 0)]
            c, t = s.controller, s.target
            assert (c.horizon_s, c.dt_s, c.falloff) == (row.horizon_s, row.dt_s, row.falloff)
            weights = (c.weight_position, c.weight_orientation, c.weight_force, c.weight_torque)
            assert weights == (65.0, 35.0, 3.5, 40.0)
            assert (c.weight_final_position, c.weight_final_orientation) == (3250.0, 1750.0)
            assert (c.integrator, c.feed_forward, s.time.latency_s) == ("euler", False, 0.0)
            assert (s.time.rate_hz, s.time.image_hz) == (30, 30)
            assert (s.camera.width_px, s.camera.height_px, s.camera.hfov_deg) == (1280, 720, 60.0)
            assert (t.model, s.navigation.grade) == ("paper", "exact")
            assert (s.chaser.mass_kg, s.chaser.force_max_N, s.chaser.torque_max_N_m) == (
                30.0,
                2.0,
                0.05,
            )
            assert s.chasers[0].position_m == (1.0, 0.0, 0.0)
            assert (s.perception.name, s.estimator.name, c.solver) == (perception, "paper", "open")


def test_nominal_start_is_that_of_the_scenario() -> None:
    s = load_scenario(PATH)
    assert (s.target.velocity_m_s, s.target.omega_rad_s) == (
        (0.015, 0.0075, 0.03),
        (0.015, 0.045, 0.03),
    )
    assert s.chasers[0].start_offset_m == NOMINAL_OFFSET_M
    assert s.chasers[0].start_rotation_rad == NOMINAL_ROTATION_RAD
    assert math.hypot(0.42, 0.3927) == pytest.approx(0.575, abs=1e-4)


def test_missions_of_the_papers_chain_have_its_settings() -> None:
    chains = [f for f in missions_of(plan(False)) if f.varied["chain"] != DEFAULT]
    assert len(chains) == 4
    for flight in chains:
        s = scenario_of(flight)
        assert (s.navigation.grade, s.time.latency_s, s.controller.integrator) == (
            "exact",
            0.0,
            "euler",
        )
        assert (s.estimator.name, s.controller.solver, s.time.image_hz) == ("paper", "open", 30)


def test_default_settings_equal_the_scenario_defaults() -> None:
    label = table_name(DEFAULT, BASELINE, 0)
    flight = next(f for f in plan(False).flights if f.label == label)
    ours, plain = scenario_of(flight), load_scenario(PATH.with_name("single.toml"))
    assert ours.controller == plain.controller
    assert (ours.perception, ours.estimator) == (plain.perception, plain.estimator)
    assert ours.time.model_copy(update={"latency_s": plain.time.latency_s}) == plain.time
    assert ours.time.latency_s == pytest.approx(plain.time.latency_s, abs=1e-12)


# -- arithmetic ------------------------------------------------------------------------------------


@given(st.floats(0, 10), st.floats(0, 10), st.floats(1, PAPER_S))
def test_mean_over_two_minutes_lies_between_its_parts(
    whole: float, steady: float, flown_s: float
) -> None:
    value = over_two_minutes(whole, steady, flown_s)
    assert min(whole, steady) - 1e-12 <= value <= max(whole, steady) + 1e-12
    assert over_two_minutes(whole, steady, PAPER_S) == pytest.approx(whole)


def test_mean_over_two_minutes_by_hand() -> None:
    # 40 s at a mean of 0.06 and 80 s at 0.003
    assert over_two_minutes(0.06, 0.003, 40.0) == pytest.approx((40 * 0.06 + 80 * 0.003) / 120)
    with pytest.raises(ValueError, match="flown_s"):
        over_two_minutes(1.0, 1.0, 121.0)


def result_of(position: float, orientation: float) -> dict[str, Any]:
    return {
        "sim_time_s": 120.0,
        "chasers": {
            "0": {
                "position_mse_m2": position,
                "orientation_mse_rad2": orientation,
                "steady": {"position_mse_m2": 1e-6, "orientation_mse_rad2": 1e-7},
                "min_distance_target_m": 0.9,
            }
        },
        "solver": {"solve_s": {"p50": 1e-3}},
        "floor_m2_s": 1.5,
    }


def mission_result() -> dict[str, Any]:
    docked = {
        "steady": {"position_mse_m2": 1e-6, "orientation_mse_rad2": 1e-6},
        "min_distance_target_m": 0.98,
        "docked": True,
        "dock_time_s": 97.3,
        "reached_time_s": None,
    }
    estimate = {
        "orientation_rms_rad": 0.001,
        "max_orientation_error_rad": 0.003,
        "max_orientation_error_at_s": 100.0,
    }
    return {
        "chasers": {"0": docked},
        "min_distance_chasers_m": 1.4,
        "target_estimate": estimate,
    }


def complete(p: ExperimentPlan) -> Summaries:
    """Results with the errors of the paper's baseline everywhere."""
    errors = BASELINE.position_mse_m2, BASELINE.orientation_mse_rad2
    missions = missions_of(p)
    results = {
        f.label: mission_result() if f in missions else result_of(*errors) for f in p.flights
    }
    return results | {name: free_result() for name in results if name.startswith("free/")}


def free_result(factors: Mapping[str, float] | None = None) -> dict[str, Any]:
    """A free start with the errors of the paper's baseline, times a factor in some rows."""
    known = factors or {}
    rows = {
        row.name: {q: paper_value(BASELINE, q) * known.get(row.name, 1.0) for q in QUANTITIES}
        for row in ROWS
    }
    return {"free": {"distance_m": 0.9, "angle_rad": 0.5, "met": True, "rows": rows}}


def scale(results: Summaries, label: str, factor: float) -> None:
    """Multiply the errors of a flight."""
    own = results[label]["chasers"]["0"]
    own["position_mse_m2"] *= factor
    own["orientation_mse_rad2"] *= factor


ABOUT = Provenance(date="2026-11-23", commit="0123456789ab-dirty", machine="a machine")


def page_of(p: ExperimentPlan, results: Summaries, quick: bool = False, **options: Any) -> str:
    flown = dict.fromkeys(results, ABOUT)
    return markdown("t", sections(p, results, flown, quick, **options))


@pytest.mark.parametrize(
    ("ratio", "text"),
    [
        (1.0, "met"),
        (0.5, "met"),
        (2.0, "met"),
        (0.49, "smaller"),
        (0.0, "smaller"),
        (2.1, "larger"),
        (math.inf, "larger"),
        (-1.0, "opposite"),
        (math.nan, "not measured"),
    ],
)
def test_verdict_is_two_sided(ratio: float, text: str) -> None:
    assert verdict(ratio, (0.5, 2.0)) == text


@given(st.floats(1e-6, 1e6))
def test_verdict_is_symmetric_in_smaller_and_larger(ratio: float) -> None:
    assert (
        (verdict(ratio) == "met") == (verdict(1.0 / ratio) == "met") == (1 / 1.35 <= ratio <= 1.35)
    )


@pytest.mark.parametrize("band", [(0.0, 2.0), (1.1, 2.0), (0.5, 0.9)])
def test_verdict_needs_a_band_around_one(band: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="band"):
        verdict(1.0, band)


def test_spread_is_least_median_greatest() -> None:
    s = spread([3.0, 1.0, 7.0])
    assert (s.least, s.median, s.greatest, s.number) == (1.0, 3.0, 7.0, 3)
    with pytest.raises(ValueError, match="no values"):
        spread([])


@pytest.mark.parametrize(
    "changed",
    [
        {"min_distance_target_m": 0.34},
        {"steady_position_mse_m2": 0.73},
        {"steady_position_mse_m2": math.nan},
    ],
)
def test_flight_fails_by_a_small_distance_or_without_coming_nearer(
    changed: dict[str, float],
) -> None:
    good = result_of(1.0, 1.0)
    assert not errors_of(good).failed
    own = good["chasers"]["0"]
    own["steady"]["position_mse_m2"] = changed.pop("steady_position_mse_m2", 1e-6)
    own |= changed
    assert errors_of(good).failed


# -- trends ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "paper", "out"),
    [
        ([0.05, 0.06, 0.07], 0.066, True),
        ([0.010, 0.012, 0.013], 0.067, False),  # too small
        ([-0.1, -0.2, -0.3], 0.1, False),  # opposite
        ([-0.1, 0.2, 0.3], 0.15, False),  # depends on the start
    ],
)
def test_trend_comes_out_by_direction_from_every_start_and_size(
    values: list[float], paper: float, out: bool
) -> None:
    assert comes_out(values, paper) is out


def test_changes_compare_equal_starts() -> None:
    results, row = complete(plan(False)), ROWS[4]
    for draw, factor in zip(DRAWS, (2.0, 3.0, 4.0), strict=True):
        scale(results, table_name(CODE, BASELINE, draw), factor)
        scale(results, table_name(CODE, row, draw), factor * 0.866)
    assert changes(results, CODE, row, "position") == pytest.approx([-0.134] * 3)
    del results[table_name(CODE, BASELINE, 1)]
    assert len(changes(results, CODE, row, "position")) == 2
    shown = next(r for r in trend_rows(results) if r[0] == "dt=1/30")
    assert shown[1:3] == ("-13.4 %; -1.3 %", "-13.4 % yes; -13.4 % no")


def explanations(results: Summaries) -> dict[str, str]:
    return {row[0]: row[-1] for row in trend_rows(results)}


def test_explanations_quote_measurements_or_say_unexplained() -> None:
    results = complete(plan(False))
    found = explanations(results)
    late = "the controller alone has 0.0164 m^2, 0.0164 if 1 s late, the paper 1.26."
    assert found["T=10"] == f"Unexplained: {late} The median solve of OpEn took 1.0 ms here."
    assert found["dt=1/30"].startswith("Unexplained: position +0.0 % alone, +0.0 % with")
    unexplained = "unexplained by the start, which changes the baseline by 0 %"
    assert (
        found["alpha=10 %"]
        == f"Position {unexplained}; orientation {unexplained}. The paper states no spread."
    )
    assert found["alpha=60 %"] == "As for alpha=10 %."
    for name, factor in (
        ("alone/dt=1-30", 1.1),
        ("weights/dt=1-30", 1.01),
        ("delay/T=10/0.5", 1e3),
    ):
        scale(results, name, factor)
    scale(results, table_name(CODE, BASELINE, 1), 1.5)
    found = explanations(results)
    assert "position +10.0 % alone, +1.0 % with stage weights times 0.33" in found["dt=1/30"]
    assert found["T=10"].startswith(
        "A late command gives as much: the controller alone has 0.0164 m^2, "
    )
    assert "0.0164 if 0.3 s late, divergence if 0.5 s late, the paper 1.26." in found["T=10"]
    assert found["alpha=10 %"].startswith(
        "Position not separable from the start, which changes the baseline"
    )
    assert explanations({})["T=0.5"] == explanations({})["alpha=10 %"] == "-"


def test_trend_that_comes_out_needs_no_explanation() -> None:
    results, row = complete(plan(False)), ROWS[3]
    for draw in DRAWS:
        errors = row.position_mse_m2, row.orientation_mse_rad2
        results[table_name(CODE, row, draw)] = result_of(*errors)
    assert explanations(results)["dt=1/5"] == "It comes out."


def test_pitch_of_the_papers_target() -> None:
    assert pitch_rad(0.0) == 0.0
    # The pitch begins with the rate about Y.
    assert pitch_rad(0.1) == pytest.approx(0.0045, rel=1e-2)


def test_row_labels_follow_the_paper() -> None:
    assert [row.label for row in ROWS][3:6] == ["dt=1/5", "dt=1/30", "alpha=10 %"]
    assert ROWS[-1].label == "dt=1/30, alpha=30 %"


# -- the page --------------------------------------------------------------------------------------


class _Checker(HTMLParser):
    """Counts cells by row and checks that every tag is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []
        self.cells: list[int] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag == "tr":
            self.cells.append(0)
        if tag in ("td", "th"):
            self.cells[-1] += 1
        if tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_page_is_well_formed_and_escaped() -> None:
    section = PageSection(
        "A <b> & c",
        ("text with <script> in `a < b`", Table(("a | b", "n"), (("x | <y>", "1"), ("z", "2")))),
    )
    text = html("t & u", [section])
    checker = _Checker()
    checker.feed(text)
    assert checker.open == []
    assert checker.cells == [2, 2, 2]
    assert "<script>" not in text
    assert "<code>a &lt; b</code>" in text
    lines = markdown("t", [section]).splitlines()
    assert "| x \\| <y> | 1 |" in lines
    with pytest.raises(ValueError, match="3 cells under 2"):
        Table(("a", "b"), (("1", "2", "3"),))


def test_page_of_a_complete_plan_has_all_rows_and_its_provenance() -> None:
    p = plan(False)
    parts = sections(p, complete(p), dict.fromkeys(complete(p), ABOUT), quick=False)
    text = markdown("t", parts)
    assert "NOT COMPLETE" not in text
    assert "2026-11-23, commit 0123456789ab-dirty" in text
    assert "Machine: a machine." in text
    assert 'navigation.grade = "exact"' in text
    assert "| baseline | 1.64 | 1 (1 to 1) met | 1 (1 to 1) met | 1 (1 to 1) met |" in text
    small = "0.0253 (0.0253 to 0.0253) smaller"
    assert f"| T=0.5 | 64.8 | - | {small} | 0.0253 smaller |" in text
    assert f"| {CODE} | 0 of 8 | 0 of 8 | 7 of 9 | 7 of 9 | 0 of 27 |" in text
    assert f"| {TRACKING} | ours | 1 | 0.057 | 0.980 | 1.400 | 0 docked at 97 s |" in text
    assert "at most 0.172 deg, 3.0 times the RMS, at 100 s" in text
    checker = _Checker()
    checker.feed(html("t", parts))
    assert checker.open == []
    assert [link for link in checker.links if not link.startswith("#")] == []


def test_page_reports_missing_results() -> None:
    p = plan(True)
    text = page_of(p, {}, quick=True)
    n = len(p.flights)
    assert f"NOT COMPLETE: {n} of {n} flights have no result" in text
    assert "chaserdock reproduce --quick" in text
    assert not re.search(r"\d met", text)
    assert "Not judged: the trends of the table are not flown." in text


def test_lines_of_the_page_are_short_but_for_tables() -> None:
    lines = page_of(plan(False), complete(plan(False))).splitlines()
    assert max(len(line) for line in lines if not line.startswith("| ")) <= 120


def test_trends_lead_beside_what_a_constant_scores() -> None:
    text = page_of(plan(False), complete(plan(False)))
    lead = " ".join(text.split("## Trends")[0].split())
    assert lead.index("are not reproduced. Of the trends") < lead.index("agreement of tracking")
    assert "7 of 9 and 7 of 9, as those rows lie within 19 % of it" in lead
    constant = "| a constant, the paper's baseline row | 0 of 8 | 0 of 8 | 7 of 9 | 7 of 9 | - |"
    assert constant in lead
    assert "| the paper | 8 of 8 | 8 of 8 | 9 of 9 | 9 of 9 | 3 of 27 |" in lead
    assert text.index("## Trends") < text.index("## Free starts") < text.index("## Table: pos")


def test_failed_flights_and_trends_of_a_chain_are_counted() -> None:
    results = complete(plan(False))
    for row in ROWS:
        for draw in DRAWS:
            errors = row.position_mse_m2, row.orientation_mse_rad2
            results[table_name(CODE, row, draw)] = result_of(*errors)
    results[table_name(CODE, BASELINE, 1)]["chasers"]["0"]["min_distance_target_m"] = 0.3
    text = page_of(plan(False), results)
    assert f"| {CODE} | 8 of 8 | 8 of 8 | 9 of 9 | 9 of 9 | 1 of 27 |" in text
    assert f'The paper\'s trends are reproduced with "{CODE}".' in text


# -- free starts -----------------------------------------------------------------------------------


def test_free_start_is_fitted_to_the_baseline_row() -> None:
    """Errors that grow with other powers, and each with the other parameter, too."""
    tried: list[tuple[float, float]] = []

    def errors_at(distance_m: float, angle_rad: float) -> Errors:
        tried.append((distance_m, angle_rad))
        position = 0.03 * distance_m**2.2 + 0.002 * angle_rad
        return Errors(position, 0.008 * angle_rad**1.7 + 0.0004 * distance_m, 0.0, failed=False)

    fit = fitted(errors_at)
    assert fit.met
    assert len(tried) <= 5
    assert (fit.distance_m, fit.angle_rad) == tried[-1]
    for q in QUANTITIES:
        assert fit.errors.of(q) == pytest.approx(paper_value(BASELINE, q), rel=TOLERANCE)


def test_start_that_cannot_meet_the_baseline_row_is_given_up() -> None:
    fit = fitted(lambda *_: Errors(1.0, 1.0, 0.0, failed=False))
    assert not fit.met


@pytest.mark.parametrize("seed", range(3))
def test_free_starts_are_valid_scenarios_and_repeatable(seed: int) -> None:
    start = drawn_start(seed)
    assert start.overrides(0.9, 0.5) == drawn_start(seed).overrides(0.9, 0.5)
    assert start.overrides(0.9, 0.5) != drawn_start(seed + 1).overrides(0.9, 0.5)
    s = load_scenario(PATH, start.overrides(0.9, 0.5))
    offset, rotation = s.chasers[0].start_offset_m, s.chasers[0].start_rotation_rad
    assert math.hypot(*offset) == pytest.approx(0.9)
    assert offset[0] >= 0.0  # away from the target
    assert math.hypot(*rotation) == pytest.approx(0.5)
    assert np.abs(np.divide(s.target.omega_rad_s, (0.015, 0.045, 0.03)) - 1).max() <= 0.2
    assert np.abs(s.chasers[0].start_velocity_m_s).max() <= SPEED_BOUND_M_S


def test_free_start_flies_all_rows_from_the_fitted_start(monkeypatch: pytest.MonkeyPatch) -> None:
    flown: list[Scenario] = []

    def fly(scenario: Scenario) -> dict[str, Any]:
        flown.append(scenario)
        factor = 1.1 if len(flown) == 1 else 1.0
        own = result_of(*(factor * paper_value(BASELINE, q) for q in QUANTITIES))
        return own | {"sim_time_s": PAPER_S}

    monkeypatch.setattr(free_starts, "fly_alone", fly)
    flight = next(f for f in plan(False).flights if f.label == "free/1")
    found = fly_free_start(flight)["free"]
    assert found["met"]
    assert list(found["rows"]) == [row.name for row in ROWS]
    assert flown[0].chasers[0].start_offset_m != flown[1].chasers[0].start_offset_m
    rest = flown[1:]
    assert {(s.chasers[0].start_offset_m, s.target.q_wxyz) for s in rest} == {
        (rest[0].chasers[0].start_offset_m, rest[0].target.q_wxyz)
    }
    rows = [(s.controller.horizon_s, s.controller.dt_s, s.controller.falloff) for s in rest]
    assert rows == [(row.horizon_s, row.dt_s, row.falloff) for row in ROWS]
    assert {s.controller.solver for s in flown} == {"open"}


def test_free_starts_are_judged_on_the_trends_with_their_spread() -> None:
    results = complete(plan(False))
    for k, factor in enumerate((1.05, 1.06, 1.5)):
        results[f"free/{k}"] = free_result({"dt=1-5": factor})
    results["free/3"]["free"]["met"] = False
    text = page_of(plan(False), results)
    assert "| dt=1/5 | +5.5 % | +0.0 % (+0.0 % to +50.0 %) | 2 of 9 | +23.6 % | " in text
    conclusion = " ".join(text.split("## Table")[0].split())
    assert (
        "Of 10 starts, 9 meet the baseline row; the best of them brings out 1 of the 16 trends, "
        "and those that come out from any start are dt=1/5 (position): a start "
        "does not explain the paper's table." in conclusion
    )


def test_free_start_with_the_papers_table_explains_it() -> None:
    results = complete(plan(False))
    rows = {row.name: {q: paper_value(row, q) for q in QUANTITIES} for row in ROWS}
    for name in [name for name in results if name.startswith("free/")]:
        results[name]["free"]["rows"] = rows
    text = page_of(plan(False), results)
    assert "a start explains the paper's table." in " ".join(text.split())
    assert "| free starts, controller alone | 8 of 8 | 8 of 8 | 9 of 9 | 9 of 9 | - |" in text


# -- an earlier page -------------------------------------------------------------------------------

EARLIER = f"""# A page
## Result
flown on 2026-11-20,
commit fedcba987654, a machine.

| chain | failed flights |
| --- | ---: |
| {CODE} | 11 of 27 |

## Table: position

| row | paper, 1e-2 m^2 | {WRITTEN} | {CODE} | {DEFAULT} |
| --- | ---: | ---: | ---: | ---: |
| baseline | 1.64 | - | 1.1 met | 1.2 met [2026-11-01 0123456789ab] |
| T=10 | 126 | - | 4 (2 to 7) larger | 0.1 smaller |

## Trends

| trend | paper | {CODE} | {DEFAULT} | controller alone | explanation |
| --- | --- | --- | --- | --- | --- |
| T=10 | x 2; x 2 | +10.0 % yes; +9.0 % no | x 2 no; x 2 no | - | why \\| how |
"""
MARK = "[2026-11-20 fedcba987654]"


def test_earlier_cells_stand_marked_where_a_row_is_not_flown() -> None:
    p, page = plan(False), read_earlier(EARLIER)
    results = complete(p)
    for row in (ROWS[0], ROWS[2]):  # one start of three is missing
        del results[table_name(CODE, row, 2)]
    for draw in DRAWS:
        del results[table_name(DEFAULT, BASELINE, draw)]
    text = page_of(p, results, earlier=page)
    assert f"| 1.1 met {MARK} | 1.2 met [2026-11-01 0123456789ab] |" in text
    assert f"| 4 (2 to 7) larger {MARK} | 0.013 smaller |" in text
    assert f"| +10.0 % yes; +9.0 % no {MARK} | x 2 no; x 2 no {MARK} | +0.0 %; +0.0 % |" in text
    assert f"| {CODE} | 1 of 1 | 0 of 1 |" in text
    assert "the headline and the counts of this table include such cells" in " ".join(text.split())
    assert "NOT COMPLETE: 5 of " in text
    assert read_earlier(text).cells["Table: position", "T=10", CODE].endswith(MARK)


def test_lower_bound_needs_the_nominal_start() -> None:
    results = complete(plan(False))
    assert "m^2 from the nominal start" in " ".join(page_of(plan(False), results).split())
    del results["alone/baseline"]
    assert "Lower bound" not in page_of(plan(False), results)


def test_complete_rows_replace_earlier_cells() -> None:
    text = page_of(plan(False), complete(plan(False)), earlier=read_earlier(EARLIER))
    assert "[20" not in text


@pytest.mark.parametrize("text", ["", "# A page\n## Result\n| a | b |\n| --- | --- |\n| 1 | 2 |\n"])
def test_earlier_page_must_be_one_of_the_command(tmp_path: Path, text: str) -> None:
    (tmp_path / "page.md").write_text(text)
    with pytest.raises(ExperimentError, match=r"--earlier .*page\.md: not a page of"):
        reproduction.reproduce(True, tmp_path / "out", 1, tmp_path / "page.md")


def test_flights_section_counts_flights_by_row_date_and_commit() -> None:
    p = plan(False)
    flown = dict.fromkeys((f.label for f in p.flights), ABOUT)
    flown[table_name(CODE, BASELINE, 2)] = Provenance(date="2026-11-24", commit="c", machine="b")
    (text, table) = flights_section(p, flown).parts
    assert isinstance(table, Table)
    cells = {row[0]: dict(zip(table.header, row, strict=True)) for row in table.rows}
    one = "2 on 2026-11-23 at 0123456789ab-dirty; 1 on 2026-11-24 at c (of 3)"
    assert cells["baseline"][CODE] == one
    assert cells["missions"][WRITTEN] == "1 on 2026-11-23 at 0123456789ab-dirty (of 1)"
    assert cells["free starts"]["controller alone"].endswith("(of 10)")
    assert "Machine: a machine; b." in str(text)
    planned = sum(int(n) for row in table.rows for n in re.findall(r"of (\d+)\)", " ".join(row)))
    assert planned == len(p.flights)


# -- flying ----------------------------------------------------------------------------------------


def test_missing_solver_is_one_error_and_a_failed_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = flight_of("alone/baseline", SCENARIO, ("controller.solver='open'",), Alone())
    assert needs_open(flight)
    monkeypatch.setattr(reproduction, "missing_part", lambda: "solver 'open' needs cargo")
    assert fly_and_report(ExperimentPlan("x", (flight,)), tmp_path) == 1
    errors = [
        line for line in capsys.readouterr().err.splitlines() if line.startswith("chaserdock:")
    ]
    assert errors == ["chaserdock: the paper's chain was not flown: solver 'open' needs cargo"]
    assert "NOT COMPLETE: 1 of 1 flights" in (tmp_path / "reproduction.md").read_text()


def test_result_with_other_settings_counts_as_not_flown() -> None:
    flights = [
        flight_of("a", SCENARIO, (), Alone()),
        flight_of("a", SCENARIO, (), Alone(0.1)),
        flight_of("a", SCENARIO, ("duration_s=40.0",), Alone()),
        flight_of("a", SCENARIO, ()),
    ]
    assert len({f.name for f in flights}) == 4


@pytest.mark.parametrize("alone", [None, Alone()])
def test_table_flight_is_one_process_and_its_result_states_date_commit_and_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, alone: Alone | None
) -> None:
    table = next(f for f in plan(False).flights if f.label == table_name(CODE, BASELINE, 0))
    flight = table if alone is None else flight_of("a", SCENARIO, (), alone)
    started: list[tuple[list[str], str]] = []

    def start(command: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        started.append((command, options["input"]))
        return subprocess.CompletedProcess(command, 2, "", "no summary")

    monkeypatch.setattr("chaserdock.experiments.worker.subprocess", SimpleNamespace(run=start))
    outcome = fly(flight, "none", tmp_path)
    ((command, given_input),) = started
    assert command[1:3] == ["-m", "chaserdock.experiments.controller_flight"]
    assert msgspec.json.decode(given_input, type=PlannedFlight) == flight
    assert (outcome.flown, outcome.code) == (provenance(), code_digest())


def test_flight_that_crashes_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = flight_of(table_name(DEFAULT, BASELINE, 0), SCENARIO, ())
    broken = msgspec.structs.replace(flight, overrides=("controller.dt_s=-1",))
    assert fly_and_report(ExperimentPlan("x", (broken,)), tmp_path) == 1
    assert f"chaserdock: {flight.label}: " in capsys.readouterr().err
    assert results_of(ExperimentPlan("x", (broken,)), tmp_path) == {}


def test_bad_input_prints_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    status, said = finished("reproduce", "--quick", "--out", str(tmp_path / "file"))
    assert status == 2
    assert said.strip() == f"chaserdock: {tmp_path / 'file'}: cannot be written: File exists"


@pytest.mark.slow
def test_small_plan_is_flown_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A flight with small images, its lower bound, and a mission; a second call flies nothing and
    writes an equal page.
    """
    small = ("camera.width_px=480", "camera.height_px=270", "time.rate_hz=15", "time.image_hz=15")
    short = (*small, "duration_s=21.0")
    seen_label = table_name(DEFAULT, BASELINE, 0)
    flights = (
        flight_of(seen_label, SCENARIO, short),
        flight_of("floor/0", SCENARIO, short, Alone(floor=True)),
        mission(TRACKING, DEFAULT, (*small, "duration_s=3.0", "settling_s=2.0")),
    )
    cut = ExperimentPlan("cut", flights)
    assert fly_and_report(cut, tmp_path) == 0
    assert f"3/3 {TRACKING}, ours (" in capsys.readouterr().out
    results = results_by_label(cut, results_of(cut, tmp_path))
    seen = errors_of(results[seen_label])
    floor_m2_s = results["floor/0"]["floor_m2_s"]
    assert not seen.failed
    assert floor_m2_s < PAPER_S * seen.position < 2.0 * floor_m2_s
    flown = results[mission_name(TRACKING, DEFAULT)]
    assert 2.0 <= flown["target_estimate"]["max_orientation_error_at_s"] <= 3.0
    assert 0.9 < min(c["min_distance_target_m"] for c in flown["chasers"].values()) < 1.2
    pages = [(tmp_path / f"reproduction.{kind}").read_text() for kind in ("md", "html")]
    assert fly_and_report(cut, tmp_path) == 0
    assert "/3 " not in capsys.readouterr().out
    assert [(tmp_path / f"reproduction.{kind}").read_text() for kind in ("md", "html")] == pages
