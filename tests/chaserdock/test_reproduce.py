# SPDX-License-Identifier: Apache-2.0
"""`chaserdock reproduce`: plan, arithmetic of the tables, page, resumption."""

from __future__ import annotations

import math
import re
import subprocess
import threading
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from chaserdock_protocol.scenario import load_scenario
from harness import finished
from hypothesis import given
from hypothesis import strategies as st

from chaserdock.campaign.plan import Run
from chaserdock.campaign.worker import CampaignError, FinishedRun
from chaserdock.evaluation.study_cases import StudyCase, StudyError, StudyResult, line_of, read_lines
from chaserdock.reproduce import main as reproduce_main
from chaserdock.reproduce.content import sections
from chaserdock.reproduce.main import add_recorded, fly_plan, without_open
from chaserdock.reproduce.page import PageSection, Table, html, markdown
from chaserdock.reproduce.paper import PAPER_S, ROWS
from chaserdock.reproduce.plan import (
    CHAIN,
    COLUMNS,
    DRAWS,
    INFERRED,
    NOMINAL_OFFSET_M,
    NOMINAL_ROTATION_RAD,
    QUICK_S,
    SCENARIO,
    TRACKING,
    Mission,
    ReproductionPlan,
    dispersed_start,
    make_plan,
    needs_open,
    table_group,
)
from chaserdock.reproduce.record import (
    ChainRecord,
    Provenance,
    commit_of,
    provenance,
    read_record,
    shown_fields,
    write_record,
)
from chaserdock.reproduce.runner import (
    ReproductionResults,
    code_digest,
    fly_missions,
    mission_run,
    open_cases,
    results_of,
    scenario_path,
)
from chaserdock.reproduce.tables import (
    best_runs,
    errors_of_study,
    errors_of_summary,
    floor_of_study,
    over_two_minutes,
    own_requirements,
    spread,
    verdict,
    with_images,
)
from chaserdock.reproduce.trends import changes, pitch_rad, spikes, trend_verdict, trends

PATH = str(scenario_path(SCENARIO))


def plan(quick: bool) -> ReproductionPlan:
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


def test_full_plan_repeats_nine_rows_from_three_starts() -> None:
    groups = [m.group for m in plan(False).missions]
    studies = {c.name for c in plan(False).studies}
    for column in COLUMNS:
        for row in ROWS:
            group = table_group(column, row.name)
            assert groups.count(group) == len(DRAWS) == 3
            assert {f"{group}/{draw}" for draw in DRAWS} <= studies
    assert sum(group.startswith("mission/") for group in groups) == 8


def test_draws_have_the_same_starts_in_all_rows_within_the_bounds() -> None:
    starts = {}
    for m in plan(False).missions:
        if m.group.startswith("table/"):
            s = mission_run(m)[1]
            c, t = s.chasers[0], s.target
            starts.setdefault(m.seed, set()).add(
                (c.start_offset_m, c.start_rotation_rad, t.q_wxyz, t.velocity_m_s, t.omega_rad_s)
            )
    assert [len(starts[draw]) for draw in DRAWS] == [1, 1, 1]
    assert len(set.union(*starts.values())) == 3
    for ((offset, rotation, q, velocity, omega),) in starts.values():
        assert np.abs(np.subtract(offset, NOMINAL_OFFSET_M)).max() <= 0.05
        assert np.abs(np.subtract(rotation, NOMINAL_ROTATION_RAD)).max() <= 0.05
        assert 2 * math.acos(q[0]) <= 0.2 * math.sqrt(3)
        assert np.abs(np.divide(velocity, (0.015, 0.0075, 0.03)) - 1).max() <= 0.2
        assert np.abs(np.divide(omega, (0.015, 0.045, 0.03)) - 1).max() <= 0.2
    assert dispersed_start(0) == dispersed_start(0) != dispersed_start(1)


def test_paper_settings_equal_the_reference() -> None:
    runs = {m.group: mission_run(m)[1] for m in plan(False).missions}
    for row in ROWS:
        for column in (CHAIN, "paper"):
            s = runs[table_group(column, row.name)]
            c, t = s.controller, s.target
            assert (c.horizon_s, c.dt_s, c.falloff) == (row.horizon_s, row.dt_s, row.falloff)
            weights = (c.weight_position, c.weight_orientation, c.weight_force, c.weight_torque)
            assert weights == (65.0, 35.0, 3.5, 40.0)
            assert (c.weight_final_position, c.weight_final_orientation) == (3250.0, 1750.0)
            assert (c.integrator, c.feed_forward) == ("euler", False)
            assert (s.time.rate_hz, s.time.image_hz) == (30, 30)
            assert (s.camera.width_px, s.camera.height_px, s.camera.hfov_deg) == (1280, 720, 60.0)
            assert (t.model, s.navigation.grade) == ("paper", "exact")
            assert (s.chaser.mass_kg, s.chaser.force_max_N, s.chaser.torque_max_N_m) == (30.0, 2.0, 0.05)
            assert s.chasers[0].position_m == (1.0, 0.0, 0.0)
            parts = (s.perception.name, s.estimator.name, c.solver)
            ours = ("default", "joint", "rti")
            assert parts == (("paper", "paper", "open") if column == CHAIN else ours)


def test_nominal_start_is_that_of_the_scenario() -> None:
    s = load_scenario(Path(PATH))
    assert (s.target.velocity_m_s, s.target.omega_rad_s) == ((0.015, 0.0075, 0.03), (0.015, 0.045, 0.03))
    assert s.chasers[0].start_offset_m == NOMINAL_OFFSET_M
    assert s.chasers[0].start_rotation_rad == NOMINAL_ROTATION_RAD
    assert math.hypot(0.42, 0.3927) == pytest.approx(0.575, abs=1e-4)


@pytest.mark.parametrize("quick", [True, False])
def test_missions_in_the_papers_settings_have_exact_navigation(quick: bool) -> None:
    for m in plan(quick).missions:
        if m.group.startswith(("mission/paper", f"mission/{CHAIN}")):
            s = mission_run(m)[1]
            assert (s.navigation.grade, s.time.latency_s, s.controller.integrator) == ("exact", 0.0, "euler")
            assert s.duration_s >= 75.0


def test_default_settings_equal_the_scenario_defaults() -> None:
    wanted = {m.group: mission_run(m)[1] for m in plan(False).missions}
    ours = wanted[table_group("default", "baseline")]
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
        "target_estimate": {
            "max_orientation_error_rad": 0.003,
            "orientation_rms_rad": 0.001,
            "nees_mean": 6.0,
        },
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


def complete(p: ReproductionPlan, factor: float = 1.0) -> ReproductionResults:
    """Results that are ``factor`` times the paper's baseline everywhere."""
    position, orientation = factor * ROWS[0].position_mse_m2, factor * ROWS[0].orientation_mse_rad2
    missions = {m.name: summary(position, orientation) for m in p.missions}
    return ReproductionResults(missions, {c.name: study_result(c, position, orientation) for c in p.studies})


ABOUT = Provenance(date="2026-11-23", commit="0123456789ab-dirty", machine="a machine")


@pytest.mark.parametrize(
    ("ratio", "text"),
    [
        (1.0, "met"),
        (0.5, "met"),
        (2.0, "met"),
        (0.49, "smaller than the paper by 2.04 times"),
        (0.01, "smaller than the paper by 100 times"),
        (2.1, "larger than the paper by 2.1 times"),
        (math.inf, "larger than the paper by inf times"),
        (0.0, "zero, unlike the paper"),
        (-1.0, "opposite to the paper"),
        (math.nan, "not measured"),
    ],
)
def test_verdict_is_two_sided(ratio: float, text: str) -> None:
    assert verdict(ratio, (0.5, 2.0)) == text


@given(st.floats(1e-6, 1e6))
def test_verdict_treats_smaller_and_larger_alike(ratio: float) -> None:
    assert (verdict(ratio) == "met") == (verdict(1.0 / ratio) == "met") == (1 / 1.35 <= ratio <= 1.35)


@pytest.mark.parametrize("band", [(0.0, 2.0), (1.1, 2.0), (0.5, 0.9)])
def test_verdict_needs_a_band_around_one(band: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="band"):
        verdict(1.0, band)


def test_spread_is_least_median_greatest() -> None:
    s = spread([3.0, 1.0, 7.0])
    assert (s.least, s.median, s.greatest, s.runs) == (1.0, 3.0, 7.0, 3)
    with pytest.raises(ValueError, match="no runs"):
        spread([])


def test_missing_values_become_nan() -> None:
    nothing = summary(0.01, 0.002)
    nothing["chasers"]["0"]["steady"]["position_mse_m2"] = None
    assert math.isnan(errors_of_summary(nothing).position)
    assert errors_of_summary(summary(0.01, 0.002, False)).failed


def test_incomplete_group_has_no_runs() -> None:
    p = plan(False)
    results, group = complete(p), table_group("paper", "baseline")
    assert len(with_images(p, results, group)) == 3
    assert best_runs(p, results, group)[1] == "images"
    del results.missions[f"{group}/1"]
    assert with_images(p, results, group) == []
    assert best_runs(p, results, group)[1] == "perfect knowledge"
    del results.studies[f"{group}/2"]
    assert best_runs(p, results, group)[0] == []


def test_default_must_be_close_to_the_lower_bound() -> None:
    p = plan(False)
    for factor, met in ((1.0, True), (1.19, True), (1.21, False)):
        results = complete(p)
        for draw in DRAWS:
            name = f"{table_group('paper', 'baseline')}/{draw}"
            floor_m2_s = 1.64e-2 * 120 / factor
            results.studies[name] = study_result(results.studies[name].case, 1.64e-2, 3.94e-3, floor_m2_s)
            assert floor_of_study(results.studies[name]) == pytest.approx(floor_m2_s / 120)
        assert own_requirements(p, results)[0].met is met


def test_steady_state_has_a_limit() -> None:
    p, results = plan(False), complete(plan(False))
    assert [r.met for r in own_requirements(p, results)[1:]] == [True, True]
    for m in p.missions:
        results.missions[m.name]["chasers"]["0"]["steady"]["position_mse_m2"] = 1e-5
    assert [r.met for r in own_requirements(p, results)[1:]] == [True, False]


# -- trends -----------------------------------------------------------------------------------------------


def test_trend_is_judged_by_direction_size_and_start() -> None:
    assert trend_verdict([0.05, 0.06, 0.07], 0.066) == "met"
    assert trend_verdict([0.010, 0.012, 0.013], 0.067) == "smaller than the paper by 5.58 times"
    assert trend_verdict([-0.1, -0.2, -0.3], 0.1) == "opposite to the paper"
    assert trend_verdict([-0.1, 0.2, 0.3], 0.15) == "met; sign depends on the start"


def test_changes_compare_equal_starts() -> None:
    p = plan(True)
    results, row = complete(p), ROWS[4]
    for draw, factor in zip(DRAWS, (2.0, 3.0, 4.0), strict=True):
        for name, own in ((ROWS[0].name, factor), (row.name, factor * 1.1)):
            key = f"{table_group('paper', name)}/{draw}"
            results.studies[key] = study_result(results.studies[key].case, own * 1e-2, own * 1e-3)
    assert changes(p, results, "paper", row, "position") == pytest.approx([0.1, 0.1, 0.1])
    shown = next(t for t in trends(p, results) if t.name == "dt=1/30, position")
    assert shown.ours["paper"][1] == "opposite to the paper"


def test_explanations_quote_measurements_or_say_unexplained() -> None:
    p = plan(True)
    found = {t.name: t.explanation for t in trends(p, complete(p))}
    assert found["T=10, position"].startswith(
        "Unexplained: delays of the command up to 1 s give at most 0.0164 m^2"
    )
    assert found["dt=1/30, position"].startswith("Unexplained: dt = 1/30 s alone changes the error by +0.0 %")
    results = complete(p)
    for name, factor in (("dt = 1/30 s", 1.1), ("dt = 1/30 s, stage weights by 3", 1.01)):
        key = f"ingredient/{name}"
        results.studies[key] = study_result(results.studies[key].case, factor * 1.64e-2, 3.94e-3)
    key = "delay/10/0.5"
    results.studies[key] = study_result(results.studies[key].case, 2.0, 3.94e-3)
    found = {t.name: t.explanation for t in trends(p, results)}
    assert "+10.0 %, with stage weights by 3 by +1.0 %" in found["dt=1/30, position"]
    assert "0.0164 m^2 at 0.4 s, 2 m^2 at 0.5 s (paper: 1.26)" in found["T=10, position"]
    without = ReproductionResults(
        results.missions, {k: v for k, v in results.studies.items() if k.startswith("table/")}
    )
    found = {t.name: t.explanation for t in trends(p, without)}
    assert found["dt=1/30, position"] == found["T=10, position"] == "unexplained"


def test_spike_is_a_large_ratio_of_a_whole_flight() -> None:
    p = plan(True)
    results, name = complete(p), f"mission/{CHAIN}/{TRACKING}/0"
    assert spikes(results)[CHAIN].verdict == "no spike, unlike the paper"
    results.missions[name]["target_estimate"]["max_orientation_error_rad"] = 0.0051
    assert spikes(results)[CHAIN].verdict == "met"
    results.missions[name]["sim_time_s"] = 60.0
    assert CHAIN not in spikes(results)


def test_pitch_of_the_papers_target() -> None:
    assert pitch_rad(0.0) == 0.0
    # The pitch begins with the rate about Y.
    assert pitch_rad(0.1) == pytest.approx(0.0045, rel=1e-2)


def test_row_labels_follow_the_paper() -> None:
    assert [row.label for row in ROWS][3:6] == ["dt=1/5", "dt=1/30", "alpha=10 %"]
    assert ROWS[-1].label == "dt=1/30, alpha=30 %"


def test_failed_solve_counts_as_failed_run() -> None:
    case = StudyCase(name="x", scenario=PATH)
    good = study_result(case, 1.0, 1.0)
    assert not errors_of_study(good).failed
    assert errors_of_study(msgspec.structs.replace(good, failed_solves=3)).failed


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
    section = PageSection(
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


def test_page_of_a_complete_plan_has_all_rows_and_its_provenance() -> None:
    p = plan(False)
    parts = sections(p, complete(p), ABOUT, None)
    text = markdown("t", parts)
    assert "NOT COMPLETE" not in text
    assert "2026-11-23, commit 0123456789ab-dirty, a machine" in text
    assert 'navigation.grade = "exact"' in text
    for row in ROWS:
        assert f"| {row.label} | {row.position_mse_m2 * 1e2:.4g} | 1.64 / 1.64 / 1.64 |" in text
    assert "| baseline, position | 1 / 1 / 1 | met (images) | 1 / 1 / 1 | met (images) |" in text
    assert (
        "| T=0.5, position | 0.0253 / 0.0253 / 0.0253 | smaller than the paper by 39.5 times (images) |"
        in text
    )
    checker = _Checker()
    checker.feed(html("t", parts))
    assert checker.open == []
    assert checker.links == []


def test_page_reports_missing_results() -> None:
    p = plan(True)
    text = markdown("t", sections(p, ReproductionResults({}, {}), ABOUT, None))
    n, k = len(p.missions), len(p.studies)
    assert f"NOT COMPLETE: {n} of {n} runs with images and {k} of {k} on perfect knowledge" in text
    assert "chaserdock reproduce --quick" in text
    assert "met (" not in text


# -- the paper's chain without its solver -----------------------------------------------------------------


def record_of(p: ReproductionPlan) -> ChainRecord:
    results = complete(p)
    return ChainRecord(
        provenance=ABOUT,
        quick=p.quick,
        missions={m.name: shown_fields(results.missions[m.name]) for m in p.missions if needs_open(m)},
        studies={c.name: results.studies[c.name] for c in p.studies if needs_open(c)},
    )


def test_record_stands_in_for_the_papers_chain(tmp_path: Path) -> None:
    p = plan(True)
    write_record(record_of(p), tmp_path)
    record, others = read_record(tmp_path), without_open(p)
    assert not any(map(needs_open, (*others.missions, *others.studies)))
    results = add_recorded(p, complete(others), record)
    assert results.missions.keys() == {m.name for m in p.missions}
    text = markdown("t", sections(p, results, provenance(), record))
    assert "The paper's chain was NOT flown with the rest" in text
    assert f"those of the last recorded quick flights: {ABOUT}." in text
    assert "NOT COMPLETE" not in text


def test_missing_solver_is_one_error_and_a_failed_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    case = StudyCase(name="table/chain/baseline/0", scenario=PATH, overrides=("controller.solver='open'",))
    p = ReproductionPlan(True, 40.0, (), (case,))
    record = ChainRecord(
        provenance=ABOUT, quick=True, missions={}, studies={case.name: study_result(case, 1.0, 1.0)}
    )
    monkeypatch.setattr(reproduce_main, "missing_part", lambda: "solver 'open' needs cargo")
    monkeypatch.setattr(reproduce_main, "read_record", lambda: record)
    assert fly_plan(p, tmp_path, 1, False) == 1
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("chaserdock:")]
    assert errors == [
        f"chaserdock: the paper's chain was not flown: solver 'open' needs cargo; the page shows {ABOUT}"
    ]


def test_commit_of_a_folder_without_git_is_unknown(tmp_path: Path) -> None:
    assert commit_of(tmp_path).startswith("unknown (chaserdock ")
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    (tmp_path / "a").write_text("1")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["add", "a"], ["commit", "-qm", "a"]):
        subprocess.run([*git, *command], check=True)
    assert re.fullmatch("[0-9a-f]{12}", commit_of(tmp_path))
    (tmp_path / "a").write_text("2")
    assert re.fullmatch("[0-9a-f]{12}-dirty", commit_of(tmp_path))


# -- flying -----------------------------------------------------------------------------------------------


def test_incomplete_study_line_counts_as_not_flown(tmp_path: Path) -> None:
    cases = tuple(StudyCase(name=name, scenario=PATH) for name in "abc")
    path = tmp_path / "studies" / f"{code_digest()}-0.jsonl"
    path.parent.mkdir(parents=True)
    lines = [line_of(study_result(c, 1.0, 1.0)) for c in cases]
    path.write_text(lines[0] + lines[1][:40])
    assert list(results_of(ReproductionPlan(True, 40.0, (), cases), tmp_path).studies) == ["a"]
    assert [c.name for c in open_cases(cases, tmp_path)] == ["b", "c"]
    changed = (StudyCase(name="a", scenario=PATH, delay_s=0.1),)
    assert open_cases(changed, tmp_path) == list(changed)


def test_mission_without_summary_is_flown_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    attempts: list[str] = []

    def crash(run: Run, *_: Any) -> FinishedRun:
        attempts.append(run.name)
        return FinishedRun(run.name, 2, None, "chaserdock: no port")

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
    group = table_group("paper", "baseline")
    runs = tuple(
        Mission(f"{group}/{seed}", group, SCENARIO, seed, (*small, "time.image_hz=15")) for seed in range(2)
    )
    cases = tuple(
        StudyCase(name=n, scenario=PATH, overrides=(*small, "time.image_hz=15"), floor=True)
        for n in (f"{group}/0", f"start/{INFERRED}")
    )
    cut = ReproductionPlan(True, 25.0, runs, cases)
    assert fly_plan(cut, tmp_path, 2, False) == 0
    flights = capsys.readouterr()
    assert "2 studies to fly, 0 are finished" in flights.err
    assert "2/2 run" in flights.out
    pages = [(tmp_path / f"reproduction.{kind}").read_text() for kind in ("md", "html")]
    table = pq.read_table(tmp_path / "results.parquet").to_pylist()
    assert [(row["vary.group"], row["seed"]) for row in table] == [(group, 0), (group, 1)]
    results = results_of(cut, tmp_path)
    seen, study = with_images(cut, results, group)[0], results.studies[f"{group}/0"]
    perfect = errors_of_study(study)
    assert not seen.failed
    # The cost of vision is small, even with images in which the marker is only 20 pixels wide at the start: half of the error
    # under perfect knowledge comes in addition, mostly by the tilt of a single marker that nothing moves.
    assert perfect.position < seen.position < 1.7 * perfect.position
    assert floor_of_study(study) < perfect.position
    assert fly_plan(cut, tmp_path, 2, False) == 0
    assert "run" not in capsys.readouterr().out
    assert [(tmp_path / f"reproduction.{kind}").read_text() for kind in ("md", "html")] == pages
