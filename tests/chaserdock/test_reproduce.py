# SPDX-License-Identifier: Apache-2.0
"""`chaserdock reproduce`: plan, arithmetic of the tables, page, resumption."""

from __future__ import annotations

import math
import threading
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import msgspec
import pyarrow.parquet as pq
import pytest
from chaserdock_protocol.scenario import load_scenario
from harness import finished
from hypothesis import given
from hypothesis import strategies as st

from chaserdock.campaign.plan import Run
from chaserdock.campaign.worker import CampaignError, Result
from chaserdock.evaluation.study_cases import StudyCase, StudyError, StudyResult, line_of, read_lines
from chaserdock.reproduce.content import sections
from chaserdock.reproduce.main import fly_plan
from chaserdock.reproduce.page import Section, Table, html, markdown
from chaserdock.reproduce.paper import PAPER_S, ROWS
from chaserdock.reproduce.plan import INFERRED, QUICK_S, SCENARIO, Mission, Plan, make_plan, table_group
from chaserdock.reproduce.runner import (
    Results,
    code_digest,
    fly_missions,
    mission_run,
    open_cases,
    results_of,
    scenario_path,
)
from chaserdock.reproduce.tables import (
    errors_of_study,
    errors_of_summary,
    floor_of_study,
    flown,
    mean,
    over_two_minutes,
    requirements,
    steady_requirements,
)

PATH = str(scenario_path(SCENARIO))


def plan(quick: bool) -> Plan:
    return make_plan(quick, PATH)


# -- the plan ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("quick", [True, False])
def test_every_run_of_the_plan_is_valid_and_unique(quick: bool) -> None:
    p = plan(quick)
    assert len({m.name for m in p.missions}) == len(p.missions)
    assert len({mission_run(m)[0].name for m in p.missions}) == len(p.missions)
    assert len({c.name for c in p.studies}) == len(p.studies)
    lengths = {mission_run(m)[1].duration_s for m in p.missions if m.scenario == SCENARIO}
    assert lengths == {QUICK_S if quick else PAPER_S}
    for case in p.studies:
        load_scenario(Path(case.scenario), case.overrides)


def test_full_plan_repeats_nine_rows_three_times() -> None:
    groups = [m.group for m in plan(False).missions]
    studies = {c.name for c in plan(False).studies}
    for column in ("paper", "default"):
        for row in ROWS:
            assert groups.count(table_group(INFERRED, column, row.name)) == 3
            times = 3 if row.name == "baseline" and column == "paper" else 0
            for start in ("closing", "receding"):
                assert groups.count(table_group(start, column, row.name)) == times
                assert table_group(start, column, row.name) in studies
    missions = {m.group for m in plan(False).missions if m.group.startswith("mission/")}
    assert len(missions) == 6  # three missions in both settings


def test_paper_settings_equal_the_reference() -> None:
    wanted = {m.group: mission_run(m)[1] for m in plan(False).missions}
    for row in ROWS:
        s = wanted[table_group(INFERRED, "paper", row.name)]
        assert (s.controller.horizon_s, s.controller.dt_s, s.controller.falloff) == (
            row.horizon_s,
            row.dt_s,
            row.falloff,
        )
        c, t = s.controller, s.target
        weights = (c.weight_position, c.weight_orientation, c.weight_force, c.weight_torque)
        assert weights == (65.0, 35.0, 3.5, 40.0)
        assert (c.weight_final_position, c.weight_final_orientation) == (3250.0, 1750.0)
        assert (c.integrator, c.feed_forward) == ("euler", False)
        assert (s.time.rate_hz, s.time.image_hz) == (30, 30)
        assert (s.camera.width_px, s.camera.height_px, s.camera.hfov_deg) == (1280, 720, 60.0)
        assert (t.model, t.velocity_m_s, t.omega_rad_s) == (
            "paper",
            (0.015, 0.0075, 0.03),
            (0.015, 0.045, 0.03),
        )
        assert (s.chaser.mass_kg, s.chaser.force_max_N, s.chaser.torque_max_N_m) == (30.0, 2.0, 0.05)
        assert (s.chasers[0].start_offset_m, s.chasers[0].start_rotation_rad) == (
            (0.85, 0, 0),
            (0.42, 0, -0.3927),
        )
        assert s.chasers[0].position_m == (1.0, 0.0, 0.0)
        assert math.hypot(0.42, 0.3927) == pytest.approx(0.575, abs=1e-4)


def test_default_settings_equal_the_scenario_defaults() -> None:
    wanted = {m.group: mission_run(m)[1] for m in plan(False).missions}
    ours = wanted[table_group(INFERRED, "default", "baseline")]
    plain = load_scenario(Path(PATH).with_name("single.toml"))
    assert ours.controller == plain.controller
    assert ours.time.model_copy(update={"latency_s": plain.time.latency_s}) == plain.time
    assert ours.time.latency_s == pytest.approx(plain.time.latency_s, abs=1e-12)


# -- arithmetic -------------------------------------------------------------------------------------------


@given(st.floats(0, 10), st.floats(0, 10), st.floats(1, PAPER_S))
def test_mean_over_two_minutes_lies_between_its_parts(whole: float, steady: float, flown_s: float) -> None:
    value = over_two_minutes(whole, steady, flown_s)
    assert min(whole, steady) - 1e-12 <= value <= max(whole, steady) + 1e-12
    assert over_two_minutes(whole, steady, PAPER_S) == pytest.approx(whole)


def test_mean_over_two_minutes_by_hand() -> None:
    # 40 s at a mean of 0.06 and 80 s at 0.003
    assert over_two_minutes(0.06, 0.003, 40.0) == pytest.approx((40 * 0.06 + 80 * 0.003) / 120)
    with pytest.raises(ValueError, match="flown_s"):
        over_two_minutes(1.0, 1.0, 121.0)


def summary(position: float, orientation: float, success: bool = True) -> dict[str, Any]:
    chaser = {
        "position_mse_m2": position,
        "orientation_mse_rad2": orientation,
        "steady": {"position_mse_m2": 1e-6, "orientation_mse_rad2": 1e-7},
        "docked": False,
        "dock_time_s": None,
        "reached_time_s": None,
        "min_distance_target_m": 1.0,
    }
    return {
        "chasers": {"0": chaser},
        "success": success,
        "failures": [] if success else ["1 collisions, at most 0 allowed"],
        "sim_time_s": 120.0,
        "min_distance_chasers_m": None,
    }


def study_result(case: StudyCase, position: float, orientation: float, floor: float = 1.5) -> StudyResult:
    return StudyResult(
        case=case,
        duration_s=120.0,
        position_mse_m2=position,
        orientation_mse_rad2=orientation,
        steady_position_mse_m2=1e-6,
        steady_orientation_mse_rad2=1e-7,
        failed_solves=0,
        solve_p50_s=1e-3,
        solve_max_s=2e-3,
        floor_m2_s=floor if case.floor else None,
    )


def complete(p: Plan, factor: float = 1.0) -> Results:
    """Results that are ``factor`` times the paper's baseline everywhere."""
    position, orientation = factor * ROWS[0].position_mse_m2, factor * ROWS[0].orientation_mse_rad2
    missions = {m.name: summary(position, orientation) for m in p.missions}
    return Results(missions, {c.name: study_result(c, position, orientation) for c in p.studies})


def test_mean_of_runs_counts_failures() -> None:
    both = mean(
        [
            errors_of_summary(summary(0.01, 0.002), 120.0),
            errors_of_summary(summary(0.03, 0.004, False), 120.0),
        ]
    )
    assert (both.position, both.orientation) == (pytest.approx(0.02), pytest.approx(0.003))
    assert (both.runs, both.failed) == (2, 1)
    with pytest.raises(ValueError, match="no runs"):
        mean([])


def test_missing_values_become_nan() -> None:
    nothing = summary(0.01, 0.002)
    nothing["chasers"]["0"]["steady"]["position_mse_m2"] = None
    assert math.isnan(errors_of_summary(nothing, 40.0).position)


def test_incomplete_group_has_no_mean() -> None:
    p = plan(False)
    results, group = complete(p), table_group(INFERRED, "paper", "baseline")
    assert flown(p, results, group) is not None
    del results.missions[f"{group}/1"]
    assert flown(p, results, group) is None
    assert requirements(p, results, INFERRED) is None
    assert requirements(p, results, "closing") is not None


@pytest.mark.parametrize(
    ("factor", "met"), [(1.0, True), (1.14, True), (1.16, False), (0.86, True), (0.84, False)]
)
def test_baseline_must_be_within_fifteen_percent(factor: float, met: bool) -> None:
    p = plan(False)
    held = requirements(p, complete(p, factor), INFERRED)
    assert held is not None
    assert [r.met for r in held if r.what.startswith("baseline")] == [met, met]


def test_other_rows_may_be_at_most_35_percent_worse() -> None:
    p = plan(False)
    for factor, met in ((0.1, True), (1.1, True), (1.2, False)):
        held = requirements(p, complete(p, factor), INFERRED)
        assert held is not None
        # 1.42 e-2 is the least that the paper has: 1.64 of it is a ratio of 1.155
        assert next(r.met for r in held if r.what.startswith("dt=1/30: position")) is met


def test_default_must_be_close_to_the_lower_bound() -> None:
    p = plan(False)
    for floor_m2_s, met in (
        (1.64e-2 * 120, True),
        (1.64e-2 * 120 / 1.19, True),
        (1.64e-2 * 120 / 1.21, False),
    ):
        results = complete(p)
        name = table_group(INFERRED, "paper", "baseline")
        case = results.studies[name].case
        results.studies[name] = study_result(case, 1.64e-2, 3.94e-3, floor_m2_s)
        held = requirements(p, results, INFERRED)
        assert held is not None
        assert held[-1].met is met
        assert floor_of_study(results.studies[name]) == pytest.approx(floor_m2_s / 120)


def test_steady_state_has_a_limit() -> None:
    p, results = plan(False), complete(plan(False))
    assert [r.met for r in steady_requirements(p, results)] == [True, True]
    for m in p.missions:
        results.missions[m.name]["chasers"]["0"]["steady"]["position_mse_m2"] = 1e-5
    assert [r.met for r in steady_requirements(p, results)] == [True, False]


def test_row_labels_follow_the_paper() -> None:
    assert [row.label for row in ROWS][3:6] == ["dt=1/5", "dt=1/30", "alpha=10 %"]
    assert ROWS[-1].label == "dt=1/30, alpha=30 %"


def test_failed_solve_counts_as_failed_run() -> None:
    case = StudyCase(name="x", scenario=PATH)
    good = study_result(case, 1.0, 1.0)
    assert errors_of_study(good).failed == 0
    bad = msgspec.structs.replace(good, failed_solves=3)
    assert errors_of_study(bad).failed == 1


# -- the page ---------------------------------------------------------------------------------------------


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
    section = Section(
        "A <b> & c", ("text with <script>", Table(("a | b", "n"), (("x | <y>", "1"), ("z", "2"))))
    )
    text = html("t & u", [section])
    checker = _Checker()
    checker.feed(text)
    assert checker.open == []
    assert checker.cells == [2, 2, 2]
    assert "<script>" not in text
    lines = markdown("t", [section]).splitlines()
    assert "| x \\| <y> | 1 |" in lines
    with pytest.raises(ValueError, match="3 cells under 2"):
        Table(("a", "b"), (("1", "2", "3"),))


def test_page_of_a_complete_plan_has_all_rows() -> None:
    p = plan(False)
    parts = sections(p, complete(p))
    text = markdown("t", parts)
    assert "NOT COMPLETE" not in text
    for row in ROWS:
        assert f"| {row.label} | {row.position_mse_m2 * 1e2:.4g} | 1.64 | 1.64 |" in text
    assert "| baseline: position MSE within 15 % | 1.000 of the paper's, with images | yes |" in text
    checker = _Checker()
    checker.feed(html("t", parts))
    assert checker.open == []
    assert checker.links == []


def test_page_reports_missing_results() -> None:
    p = plan(True)
    text = markdown("t", sections(p, Results({}, {})))
    n, k = len(p.missions), len(p.studies)
    assert f"NOT COMPLETE: {n} of {n} runs with images and {k} of {k} on perfect knowledge" in text
    assert "yes |" not in text


# -- flying -----------------------------------------------------------------------------------------------


def test_incomplete_study_line_counts_as_not_flown(tmp_path: Path) -> None:
    cases = tuple(StudyCase(name=name, scenario=PATH) for name in "abc")
    path = tmp_path / "studies" / f"{code_digest()}-0.jsonl"
    path.parent.mkdir(parents=True)
    lines = [line_of(study_result(c, 1.0, 1.0)) for c in cases]
    path.write_text(lines[0] + lines[1][:40])
    assert list(results_of(Plan(True, 40.0, (), cases), tmp_path).studies) == ["a"]
    assert [c.name for c in open_cases(cases, tmp_path)] == ["b", "c"]
    changed = (StudyCase(name="a", scenario=PATH, delay_s=0.1),)
    assert open_cases(changed, tmp_path) == list(changed)


def test_mission_without_summary_is_flown_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    attempts: list[str] = []

    def crash(run: Run, *_: Any) -> Result:
        attempts.append(run.name)
        return Result(run.name, 2, None, "chaserdock: no port")

    monkeypatch.setattr("chaserdock.campaign.worker.fly", crash)
    missions = (Mission("group/0", "group", SCENARIO),)
    for _ in range(2):
        with pytest.raises(CampaignError, match="group: chaserdock: no port"):
            fly_missions(missions, tmp_path, 1, False, threading.Event())
    assert len(attempts) == 2


def test_invalid_study_line_is_named(tmp_path: Path) -> None:
    path = tmp_path / "cases.jsonl"
    path.write_text(line_of(StudyCase(name="a", scenario=PATH)) + '{"name": 3, "scenario": "x"}\n')
    with pytest.raises(StudyError, match=r"line 2: Expected `str`, got `int` - at `\$.name`"):
        read_lines(path, StudyCase)
    with pytest.raises(StudyError, match="cannot be read"):
        read_lines(tmp_path / "none", StudyCase)


def test_bad_input_prints_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    status, said = finished("reproduce", "--quick", "--out", str(tmp_path / "file"))
    assert status == 2
    assert said.strip() == f"chaserdock: {tmp_path / 'file'}: cannot be written: File exists"
    cases = tmp_path / "cases.jsonl"
    cases.write_text(line_of(StudyCase(name="a", scenario=PATH, overrides=("controller.dt_s=-1",))))
    status, said = finished("study", str(cases), "--out", str(tmp_path / "results"))
    assert status == 2
    assert "controller.dt_s" in said
    assert "Traceback" not in said


@pytest.mark.slow
def test_small_plan_is_flown_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two missions with small images and two studies; a second call flies nothing and writes an equal page."""
    small = ("duration_s=25.0", "camera.width_px=480", "camera.height_px=270", "time.rate_hz=15")
    group = table_group(INFERRED, "paper", "baseline")
    runs = tuple(
        Mission(f"{group}/{seed}", group, SCENARIO, seed, (*small, "time.image_hz=15")) for seed in range(2)
    )
    cases = tuple(
        StudyCase(name=n, scenario=PATH, overrides=(*small, "time.image_hz=15"), floor=True)
        for n in (group, "start/again")
    )
    cut = Plan(True, 25.0, runs, cases)
    assert fly_plan(cut, tmp_path, 2, False) == 0
    flights = capsys.readouterr()
    assert "2 studies to fly, 0 are finished" in flights.err
    assert "2/2 run" in flights.out
    pages = [(tmp_path / f"reproduction.{kind}").read_text() for kind in ("md", "html")]
    table = pq.read_table(tmp_path / "results.parquet").to_pylist()
    assert [(row["vary.group"], row["seed"]) for row in table] == [(group, 0), (group, 1)]
    results = results_of(cut, tmp_path)
    seen, perfect = flown(cut, results, group), errors_of_study(results.studies[group])
    assert seen is not None
    assert seen.failed == 0
    # The cost of vision is small, even with images in which the marker is only 20 pixels wide at the start.
    assert perfect.position < seen.position < 1.4 * perfect.position
    assert floor_of_study(results.studies[group]) < perfect.position
    assert fly_plan(cut, tmp_path, 2, False) == 0
    assert "run" not in capsys.readouterr().out
    assert [(tmp_path / f"reproduction.{kind}").read_text() for kind in ("md", "html")] == pages
