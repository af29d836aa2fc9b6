# SPDX-License-Identifier: Apache-2.0
"""Report of a campaign of seeds alone: quantiles, intervals, outcomes, worst runs, commands."""

from __future__ import annotations

import html
import math
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from harness import finished
from msgspec import to_builtins
from typer.main import get_command

from chaserdock.cli.main import app
from chaserdock.criterion import Criterion, Outcome, criterion
from chaserdock.experiments.campaign import fly_campaign
from chaserdock.experiments.campaign_file import load_campaign
from chaserdock.experiments.metric_sections import metric_sections
from chaserdock.experiments.metrics import (
    Metric,
    RunValue,
    metrics,
    nees_band,
    quantile,
    quantile_interval,
)
from chaserdock.experiments.page import Table
from chaserdock.experiments.results import in_part, qualification, rate, rows_of
from chaserdock.experiments.worker import FlightOutcome, Workers
from chaserdock.terminal import COLUMNS

SEEDS = 'name = "seeds"\nscenario = "single"\nseeds = 12\n[set]\nduration_s = 1.0\n'
NOT_JUDGED = "the flight ends at 1 s, its approach is at 60 s"


def summary(run: int) -> dict[str, Any]:
    """Summary of a run of two chasers: 3 and 9 fail, 5 is not judged in full, 7 never docks."""
    worst_mm = 10.0 - run / 10.0 if run != 3 else 12.5
    criteria = [
        criterion("p", "steady position RMS", 1.0, 11.0, "mm", 0),
        criterion("p", "steady position RMS", worst_mm, 11.0, "mm", 1),
        criterion("d", "docking pose since", None if run == 9 else 30.0 + run, 50.0, "s", 0),
        criterion("k", "between chasers", 0.5 + run / 100.0, 0.3, "m", side="at least"),
    ]
    skipped = [f"success.docked, chaser 1: {NOT_JUDGED}"] if run == 5 else []
    if run == 5:
        criteria[2] = Criterion(
            key="d", name="docking pose since", outcome="not judged", chaser=1, unit="s",
            limit=50.0, note=NOT_JUDGED,
        )  # fmt: skip
    failures = [c.failure for c in criteria if c.outcome == "not met"]
    return {
        "success": not failures,
        "failures": failures,
        "not_judged": skipped,
        "doubts": [],
        "ended": "completed at 1.00 s",
        "digest": "d",
        "criteria": [to_builtins(c) for c in criteria],
        "chasers": {"0": {"impulse_N_s": 5.0, "relative_estimate": {"nees_mean": 4.0 + run}}},
        "target_estimate": {"nees_mean": 6.0 + run / 100.0},
    }


@pytest.fixture
def flown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a campaign whose flights are as ``summary`` says; failures left a log."""
    (tmp_path / "c.toml").write_text(SEEDS)

    def fly(flight: Any, _: str, logs: Path) -> FlightOutcome:
        found, log = summary(flight.seed), logs / flight.name / "mission.mcap"
        if not found["success"]:
            log.parent.mkdir(parents=True, exist_ok=True)
            log.touch()
            if flight.seed == 9:
                (log.parent / "report.html").touch()
        kept = None if found["success"] else str(log)
        return FlightOutcome(flight.name, 0 if found["success"] else 1, found, "", kept)

    monkeypatch.setattr("chaserdock.experiments.worker.fly", fly)
    monkeypatch.chdir(tmp_path)
    assert fly_campaign(Path("c.toml"), None, Workers(), None) == 0
    return tmp_path / "campaigns" / "seeds"


def outcomes() -> dict[str, FlightOutcome]:
    return {str(k): FlightOutcome(str(k), 0, summary(k), "") for k in range(12)}


def rows() -> list[dict[str, Any]]:
    return [{"run": str(k), "index": k} for k in range(12)]


def test_intervals_of_quantiles_are_the_published_ranks() -> None:
    """Ranks of the 95 % interval of a median: 2 and 9 of 10, 6 and 15 of 20, 40 and 61 of 100
    (Conover's table A3 by the binomial distribution). The smallest number of values that bounds
    their 95 % quantile from above at this confidence is 72: 0.95^72 < 0.025.
    """
    for number, ranks in ((10, (2, 9)), (20, (6, 15)), (100, (40, 61))):
        values = [float(k) for k in range(number, 0, -1)]
        assert quantile_interval(values, 0.5) == ranks
    values = [float(k) for k in range(1, 73)]
    assert quantile_interval(values[:71], 0.95)[1] is None
    assert quantile_interval(values, 0.95)[1] == 72.0


def test_quantiles_are_values_of_runs_also_among_runs_that_never_got_there() -> None:
    values = [float(k) for k in range(1, 21)]
    assert [quantile(values, share) for share in (0.05, 0.5, 0.95, 1.0)] == [1.0, 10.0, 19.0, 20.0]
    late = [1.0, 2.0, math.inf, math.inf]
    assert [quantile(late, share) for share in (0.5, 0.95)] == [2.0, math.inf]
    with pytest.raises(ValueError, match="no values"):
        quantile([], 0.5)


def test_band_of_the_mean_nees_is_that_of_chi_square_tables() -> None:
    """Chi-square at 2.5 and 97.5 %: 1.237 and 14.449 for 6 degrees of freedom, 40.482 and 83.298
    for 60.
    """
    assert nees_band(1) == pytest.approx((1.237, 14.449), abs=6e-4)
    assert nees_band(10) == pytest.approx((4.0482, 8.3298), abs=6e-5)


def test_metric_has_the_worst_chaser_of_each_run_and_runs_that_never_got_there() -> None:
    found = {m.name: m for m in metrics(rows(), outcomes())}
    steady = found["steady position RMS"]
    assert [r.value for r in steady.runs[:4]] == [10.0, 9.9, 9.8, 12.5]
    assert [r.run for r in steady.worst(3)] == [3, 0, 1]
    docking = found["docking pose since"]
    assert docking.runs[9].value == math.inf
    assert [r.run for r in docking.worst(2)] == [9, 11]
    assert [r.run for r in found["between chasers"].worst(2)] == [0, 1]
    # Not in a row of its own where a criterion has the name; none where all values are equal.
    assert "impulse, all chasers" not in found
    equal = Metric("x", "m", "at most", tuple(RunValue(k, 1.0) for k in range(3)))
    assert equal.worst(3) == []


def test_criterion_that_is_not_judged_for_a_chaser_is_not_met() -> None:
    found = {m.name: m for m in metrics(rows(), outcomes())}
    docking = found["docking pose since"]
    run = docking.runs[5]
    assert (run.outcome, run.value, run.note) == ("not judged", None, NOT_JUDGED)
    counted: tuple[Outcome, ...] = ("met", "not met", "not judged")
    assert [docking.count(o) for o in counted] == [10, 1, 1]
    (section,) = (s for s in metric_sections([docking]) if s.title == "Criteria")
    (table,) = section.parts
    assert isinstance(table, Table)
    assert table.rows[0][:5] == ("docking pose since", "≤ 50 s", "10", "1", "1")
    assert table.rows[0][5].startswith("90.9 % (")


def test_run_that_is_not_judged_in_full_is_no_pass(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(SEEDS)
    plan = load_campaign(tmp_path / "c.toml")
    done = {f.name: FlightOutcome(f.name, 0, summary(f.seed), "") for f in plan.flights}
    for name, outcome in done.items():
        if outcome.summary and outcome.summary["failures"]:
            done[name] = FlightOutcome(name, 1, outcome.summary, "")
    table = rows_of(plan, done)
    assert [r["index"] for r in table if in_part(r)] == [5]
    assert rate(table).startswith("9 of 11 passed, 81.8 %")
    assert qualification(table) == ["1 not judged in full"]
    assert rate([r for r in table if in_part(r)]) == "1 flown"


def test_campaign_of_seeds_alone_shows_distributions_outcomes_and_worst_runs(flown: Path) -> None:
    text = (flown / "report.html").read_text()
    assert "9 of 11 passed, 81.8 %" in text
    for title in ("Outcomes by cause", "Criteria", "Quantiles", "Distributions"):
        assert f"<h2>{title}</h2>" in text
    assert '<i class="good" style="flex:9"' in text
    assert '<i class="partial" style="flex:1"' in text
    assert text.count('<i class="bad" style="flex:1"') == 2
    assert "limit 11" in text
    assert "median" in text
    assert re.search(r"mean 6\.0\d, within the 95 % band", text)
    assert "mean 9.50, outside the 95 % band" in text
    assert 'Worst: <a href="#run-3">run 3</a> (12.5 mm)' in text


def test_links_of_the_report_exist(flown: Path) -> None:
    text = (flown / "report.html").read_text()
    links = re.findall(r'href="([^"]*)"', text)
    anchors = {link[1:] for link in links if link.startswith("#run-")}
    files = {link for link in links if not link.startswith("#")}
    assert len(anchors) > 3
    assert all(f'id="{anchor}"' in text for anchor in anchors)
    assert sum(link.endswith("mission.mcap") for link in files) == 2
    assert sum(link.endswith("report.html") for link in files) == 1
    assert "results.parquet" in files
    assert all((flown / link).is_file() for link in files)


def commands_of(text: str, verb: str) -> list[list[str]]:
    found = re.findall(rf"<code>(chaserdock {verb} .*?)</code>", text)
    return [shlex.split(html.unescape(command)) for command in found]


def test_commands_of_the_report_parse_and_name_what_is_there(flown: Path) -> None:
    text = (flown / "report.html").read_text()
    (report,) = commands_of(text, "report")
    assert Path(report[2]).is_file()
    repeats = [c for c in commands_of(text, "campaign") if c[-1] != "N"]
    assert len(repeats) == len(re.findall(r'id="run-\d', text)) > 3
    for command in (*repeats, report):
        program: Any = get_command(app)
        inner = program.commands[command[1]]
        values = inner.make_context(command[1], command[2:]).params
        assert values["only" if command[1] == "campaign" else "log"] is not None
    assert load_campaign(Path(repeats[0][2])).name == "seeds"


@pytest.mark.slow
def test_command_of_the_report_repeats_a_run(tmp_path: Path) -> None:
    """A run of the controller alone, which takes seconds; no criterion judges it."""
    file, out = tmp_path / "c.toml", tmp_path / "o"
    file.write_text(SEEDS.replace("12", "2").replace("1.0", "3.0\nsettling_s = 1.0") + "[alone]\n")
    arguments = ("campaign", str(file), "--out", str(out), "--jobs", "1")
    status, said = finished(*arguments, timeout_s=600.0)
    assert status == 0, said
    assert "2 not judged in full" in said
    assert "passed" not in said
    text = (out / "report.html").read_text()
    command = next(c for c in commands_of(text, "campaign") if c[-1] == "1")
    status, said = finished(*command[1:], timeout_s=600.0)
    assert status == 0, said
    assert said.startswith("run 1 (")


def test_campaign_ends_with_three_lines_that_fit(
    flown: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    fly_campaign(Path("c.toml"), None, Workers(), None)
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("seeds: 9 of 11 passed, 81.8 % (95 %:")
    assert said[1].endswith(": campaigns/seeds/report.html")
    assert said[-1].endswith(": chaserdock campaign c.toml --only 3")
    assert len(said) == 3
    assert max(map(len, said)) <= COLUMNS
