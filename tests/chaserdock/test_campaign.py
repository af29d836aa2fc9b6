# SPDX-License-Identifier: Apache-2.0
"""Campaigns: runs defined by a file, table and report, resumption."""

from __future__ import annotations

import html
import json
import math
import re
import signal
import subprocess
import threading
import time
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import msgspec
import pyarrow.parquet as pq
import pytest
from chaserdock_protocol.scenario import ScenarioError, load_scenario
from harness import chaserdock, descendants, finished
from hypothesis import given
from hypothesis import strategies as st

from chaserdock.experiments.campaign_file import load_campaign
from chaserdock.experiments.campaign_report import sections
from chaserdock.experiments.page import html as html_of
from chaserdock.experiments.plan import Alone, ExperimentError, ExperimentPlan
from chaserdock.experiments.results import (
    campaign_command,
    cause_of,
    causes,
    rank_correlation,
    row_of,
    rows_of,
    wilson,
)
from chaserdock.experiments.worker import (
    FlightOutcome,
    Workers,
    fly_plan,
    read_result,
    result_path,
    write_result,
)
from chaserdock.toml_text import toml_value

GRID = """
name = "grid"
scenario = "single"
seeds = [3, 5]
[set]
duration_s = 8.0
[vary."chasers.0.start_offset_m.0"]
values = [-0.05, -0.3]
[vary."controller.solver"]
values = ["rti", "ipopt"]
"""
SAMPLE = """
name = "sample"
scenario = "single"
method = "random"
samples = 20
sample_seed = 7
[vary."target.omega_rad_s.0"]
uniform = [0.0, 0.05]
[vary."chaser.mass_kg"]
normal = [30.0, 1.0]
[vary."controller.integrator"]
values = ["rk4", "euler"]
"""
TINY = """
name = "tiny"
scenario = "single"
[set]
duration_s = 1.0
settling_s = 0.5
"camera.width_px" = 320
"camera.height_px" = 240
"success.steady_position_rms_m" = 0.5
"success.steady_orientation_rms_deg" = 90.0
[vary."chasers.0.start_offset_m.0"]
values = [-0.02, -0.04, -0.06, -0.08]
"""


def campaign_of(text: str, folder: Path) -> ExperimentPlan:
    file = folder / "campaign.toml"
    file.write_text(text)
    return load_campaign(file)


def test_grid_contains_every_combination_with_every_seed(tmp_path: Path) -> None:
    campaign = campaign_of(GRID, tmp_path)
    points = [
        (r.varied["chasers.0.start_offset_m.0"], r.varied["controller.solver"], r.seed)
        for r in campaign.flights
    ]
    assert sorted(points) == sorted(
        (x, s, seed) for x in (-0.05, -0.3) for s in ("rti", "ipopt") for seed in (3, 5)
    )
    assert len({r.name for r in campaign.flights}) == 8
    for run in campaign.flights:
        scenario = load_scenario(Path(run.scenario), run.overrides)
        assert scenario.seed == run.seed
        assert scenario.duration_s == 8.0
        assert scenario.controller.solver == run.varied["controller.solver"]


def test_sample_follows_its_distributions_and_is_reproducible(tmp_path: Path) -> None:
    campaign = campaign_of(SAMPLE, tmp_path)
    rates = [r.varied["target.omega_rad_s.0"] for r in campaign.flights]
    masses = [r.varied["chaser.mass_kg"] for r in campaign.flights]
    assert len(campaign.flights) == 20
    assert all(0.0 <= rate <= 0.05 for rate in rates)
    assert len(set(rates)) == 20
    assert 29.0 < sum(masses) / 20 < 31.0
    assert {r.varied["controller.integrator"] for r in campaign.flights} == {"rk4", "euler"}
    assert campaign_of(SAMPLE, tmp_path) == campaign
    assert campaign_of(SAMPLE.replace("= 7", "= 8"), tmp_path).flights != campaign.flights


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ('scenario = "nowhere"', "nowhere"),
        ("seeds = 0", "c.toml: seeds: must be a whole number from 1 to 100000 or an array of"),
        ("seeds = [-1]", "c.toml: seeds.0: must be a whole number at least 0"),
        ('seeds = "x"', "seeds: must be a whole number from 1 to 100000 or an array of whole"),
        ("set = 5", "set: must be a table (got 5)"),
        ("[vary]\nduration_s = 5", "vary.duration_s: must be a table (got 5)"),
        ("[vary.duration_s]\nvalues = 5", "vary.duration_s.values: must be an array of values"),
        ('[vary.duration_s]\nuniform = [1, "a"]', "uniform.1: must be a number (got 'a')"),
        ("[vary.duration_s]\nnormal = [1]", "normal: must be an array of 2 numbers (got [1])"),
        ("[set]\nduraton_s = 5", "(nothing varied): duraton_s=5: unknown key duraton_s"),
        ("seeds = [1, 1]", "different numbers"),
        ('method = "random"', "require each other"),
        ('[vary."chaser.mass_kg"]\nuniform = [1.0, 2.0]', "a grid needs values"),
        ('[vary."chaser.mass_kg"]\nvalues = []', "must not be empty"),
        ('[vary."chaser.mass_kg"]\nvalues = [1.0]\nnormal = [1.0, 2.0]', "exactly one"),
        ('[vary."chaser.mass_kg"]\nvalues = [-1.0]', "chaser.mass_kg"),
        ('[vary."chaser.weight"]\nvalues = [1.0]', "weight"),
        ('[vary."chaser.mass_kg"]\nvalues = [30.0, 30.0]', "same scenario"),
        ("[vary.seed]\nvalues = [1]", "use seeds instead"),
        ("[vary", "not TOML"),
        ("colour = 1", "colour"),
    ],
)
def test_invalid_file_raises_a_clear_error(tmp_path: Path, wrong: str, message: str) -> None:
    base = 'name = "x"\n' + ("" if wrong.startswith("scenario") else 'scenario = "single"\n')
    (tmp_path / "c.toml").write_text(base + wrong)
    with pytest.raises(ScenarioError, match=re.escape(message)) as caught:
        load_campaign(tmp_path / "c.toml")
    assert "c.toml" in str(caught.value)
    pydantic = re.compile(r"constrained|tuple|dictionary|Field|instance|valid integer|--set")
    assert not pydantic.search(str(caught.value))
    assert len(str(caught.value).splitlines()) == 1


@given(
    st.recursive(
        st.integers(-(2**31), 2**31)
        | st.floats(allow_nan=False, allow_infinity=False)
        | st.booleans()
        | st.text(st.characters(exclude_categories=("Cs",)), max_size=8),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(st.text("ab_", min_size=1), inner, max_size=3)
        ),
    )
)
def test_values_round_trip_through_toml(value: Any) -> None:
    import tomllib

    assert tomllib.loads(f"x = {toml_value(value)}")["x"] == value


def test_wilson_interval_equals_published_values() -> None:
    # R. G. Newcombe, Statistics in Medicine 17 (1998), table I: 81 of 263, 15 of 148, 0 of 20, 1 of
    # 29.
    published = (
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    )
    for passed, total, low, high in published:
        assert wilson(passed, total) == pytest.approx((low, high), abs=6e-5)
    with pytest.raises(ValueError, match="not a pass rate"):
        wilson(0, 0)


def test_rank_correlation_handles_ties_constants_and_missing_values() -> None:
    x = [1.0, 2.0, 3.0, 4.0]
    assert rank_correlation(x, [math.exp(v) for v in x]) == pytest.approx(1.0)
    assert rank_correlation(x, [-v for v in x]) == pytest.approx(-1.0)
    assert rank_correlation([1.0, 2.0, 2.0, 3.0], [1.0, 2.0, 3.0, 4.0]) == pytest.approx(
        0.9486833
    )  # ties have their mean rank
    assert math.isnan(rank_correlation(x, [1.0] * 4))
    assert rank_correlation([*x, 5.0], [*x, math.nan]) == pytest.approx(1.0)


def summary(failures: list[str]) -> dict[str, Any]:
    return {
        "success": not failures,
        "failures": failures,
        "digest": "d",
        "wall_time_s": 1.0,
        "chasers": {
            "0": {
                "steady": {"position_mse_m2": 4e-6, "orientation_mse_rad2": 1e-6},
                "min_distance_target_m": 0.9,
            },
            "1": {
                "steady": {"position_mse_m2": None, "orientation_mse_rad2": 9e-6},
                "min_distance_target_m": 0.8,
            },
        },
        "target_estimate": {"position_rms_m": 1e-4, "max_position_error_m": None},
    }


def outcomes_of(campaign: ExperimentPlan) -> dict[str, FlightOutcome]:
    out = {}
    for k, flight in enumerate(campaign.flights):
        bad = [f"chaser 0: steady RMS: 0.0{k} m"] if k % 2 else []
        log = f"/logs/{k}.mcap" if bad else None
        out[flight.name] = FlightOutcome(flight.name, 1 if bad else 0, summary(bad), "", log)
    return out


def test_row_holds_the_worst_chaser_and_no_wall_clock_values(tmp_path: Path) -> None:
    campaign = campaign_of(GRID, tmp_path)
    rows = rows_of(campaign, outcomes_of(campaign))
    assert rows[0]["steady_position_mse_m2"] == 4e-6
    assert rows[0]["steady_orientation_mse_rad2"] == 9e-6
    assert rows[0]["min_distance_target_m"] == 0.8
    assert rows[0]["success"]
    assert not any("wall" in column for column in rows[0])
    assert math.isnan(rows[0]["estimate_max_position_error_m"])
    assert causes(rows) == [(cause_of("chaser 0: steady RMS: 0.01 m"), 4)]
    first = campaign.flights[0]
    crashed = row_of(0, first, FlightOutcome(first.name, 2, None, "no port"))
    assert not crashed["success"]
    assert crashed["cause"] == "no port"


class LinkCollector(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [v for k, v in attrs if k in ("href", "src") and v and not v.startswith("#")]


def test_report_counts_passes_and_links_failures(tmp_path: Path) -> None:
    campaign = campaign_of(GRID, tmp_path)
    outcomes = outcomes_of(campaign)
    del outcomes[campaign.flights[-1].name]
    rows = rows_of(campaign, outcomes)
    command = campaign_command(Path("/c d.toml"), Path("/logs/here"))
    page = sections(campaign, rows, outcomes, Path("/logs/here"), command)
    text = html_of(campaign.name, page)
    assert "4 of 7 passed" in text
    assert "1 are missing" in text
    again = "chaserdock campaign '/c d.toml' --out /logs/here --only 5"
    assert f"again: <code>{again}</code>" in html.unescape(text)
    collector = LinkCollector()
    collector.feed(text)
    assert {link for link in collector.links if link.endswith(".mcap")} == {
        "../1.mcap",
        "../3.mcap",
        "../5.mcap",
    }
    assert not [link for link in collector.links if link.startswith(("http:", "https:", "//"))]


def test_finished_run_is_not_flown_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = campaign_of(GRID, tmp_path)
    flown: list[str] = []

    def fly(flight: Any, *_: Any) -> FlightOutcome:
        flown.append(flight.name)
        return FlightOutcome(flight.name, 0, summary([]), "")

    monkeypatch.setattr("chaserdock.experiments.worker.fly", fly)
    earlier, crashed = campaign.flights[2:4]
    write_result(tmp_path, FlightOutcome(earlier.name, 1, summary(["far"]), "earlier"))
    write_result(tmp_path, FlightOutcome(crashed.name, 2, None, "no port"))
    progress: list[int] = []
    outcomes = fly_plan(
        campaign,
        tmp_path,
        Workers(),
        lambda ended, total, flight, outcome: progress.append(ended),
        threading.Event(),
    )
    assert sorted(flown) == sorted(f.name for f in campaign.flights if f is not earlier)
    assert list(outcomes) == [f.name for f in campaign.flights]
    assert outcomes[earlier.name].last_words == "earlier"
    assert progress == [2, 3, 4, 5, 6, 7, 8]


def test_result_of_other_code_is_flown_again_after_what_has_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flights = tuple(
        msgspec.structs.replace(f, code="new") for f in campaign_of(GRID, tmp_path).flights[:3]
    )
    write_result(tmp_path, FlightOutcome(flights[0].name, 0, summary([]), "", None, None, "old"))
    write_result(tmp_path, FlightOutcome(flights[1].name, 0, summary([]), "", None, None, "new"))
    flown: list[str] = []

    def fly(flight: Any, *_: Any) -> FlightOutcome:
        flown.append(flight.name)
        return FlightOutcome(flight.name, 0, summary([]), "", None, None, flight.code)

    monkeypatch.setattr("chaserdock.experiments.worker.fly", fly)
    plan, progress, stop = ExperimentPlan("x", flights), [], threading.Event()

    def report(ended: int, *_: Any) -> None:
        progress.append(ended)
        stop.set()

    first = fly_plan(plan, tmp_path, Workers(), report, stop)
    assert [first[f.name].code for f in flights] == ["old", "new", "new"]
    stop.clear()
    second = fly_plan(plan, tmp_path, Workers(), report, stop)
    assert [second[f.name].code for f in flights] == ["new", "new", "new"]
    assert flown == [flights[2].name, flights[0].name]
    assert progress == [2, 3]


def test_damaged_result_raises_an_error(tmp_path: Path) -> None:
    assert read_result(tmp_path, "a") is None
    write_result(tmp_path, FlightOutcome("a", 0, summary([]), ""))
    path = result_path(tmp_path, "a")
    path.write_text(path.read_text()[:-9])
    with pytest.raises(ExperimentError, match="delete it"):
        read_result(tmp_path, "a")


ALONE = """
name = "late"
scenario = "paper-single"
[set]
duration_s = 21.0
[vary."controller.horizon_s"]
values = [1.0, 3.0]
[alone]
delay_s = 0.1
"""


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"0.1": "-0.1"}, "alone.delay_s"),
        ({"0.1": "nan"}, "alone.delay_s"),
        ({"[alone]": "[alone]\nimages = true"}, "alone.images"),
        ({"21.0": "21.0\ntarget.motion = 'torque_free'"}, "must be constant_rates or static"),
        ({'"paper-single"': '"single-thrusters"'}, "needs chaser.actuation"),
        ({"21.0": "3.0"}, r"duration_s (3) ends before settling_s (20)"),
    ],
)
def test_controller_alone_needs_what_it_can_fly(
    tmp_path: Path, changed: dict[str, str], message: str
) -> None:
    (old, new), *_ = changed.items()
    with pytest.raises(ScenarioError, match=re.escape(message)):
        campaign_of(ALONE.replace(old, new), tmp_path)


@pytest.mark.slow
def test_controller_alone_is_flown_and_tabulated(tmp_path: Path) -> None:
    campaign = campaign_of(ALONE, tmp_path)
    assert [f.alone for f in campaign.flights] == [Alone(0.1)] * 2
    mission = campaign_of(ALONE.replace("[alone]\ndelay_s = 0.1", ""), tmp_path)
    assert not {f.name for f in campaign.flights} & {f.name for f in mission.flights}
    campaign_of(ALONE, tmp_path)
    status, said = finished(
        "campaign", str(tmp_path / "campaign.toml"), "--out", str(tmp_path / "alone")
    )
    assert status == 0, said
    rows = table(tmp_path / "alone")
    assert [row["vary.controller.horizon_s"] for row in rows] == [1.0, 3.0]
    # A horizon of 1 s is too short for the transient.
    assert rows[1]["steady_position_mse_m2"] < 1e-3 < rows[0]["steady_position_mse_m2"]


def test_bad_arguments_print_one_line_errors(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(TINY)
    for arguments, message in (
        (("campaign", str(tmp_path / "none.toml")), "none.toml: cannot be read"),
        (("campaign", str(tmp_path / "c.toml"), "--only", "9"), "the runs are 0 to 3"),
        (
            ("campaign", str(tmp_path / "c.toml"), "--only", "1", "--jobs", "2"),
            "--only flies one run",
        ),
        (
            (
                "campaign",
                str(tmp_path / "c.toml"),
                "--out",
                str(tmp_path / "o"),
                "--cluster",
                "tcp://127.0.0.1:9",
            ),
            "no Dask",
        ),
    ):
        status, said = finished(*arguments)
        assert status == 2, said
        assert message in said
        assert "Traceback" not in said


def table(folder: Path) -> list[dict[str, Any]]:
    return [
        {k: v for k, v in row.items() if k != "log"}
        for row in pq.read_table(folder / "results.parquet").to_pylist()
    ]


@pytest.mark.slow
def test_table_is_equal_after_kill_and_resume_and_on_a_cluster(tmp_path: Path) -> None:
    file, here, there = tmp_path / "c.toml", tmp_path / "here", tmp_path / "there"
    file.write_text(TINY.replace(", -0.06, -0.08", ""))
    first = chaserdock(
        "campaign", str(file), "--out", str(here), "--jobs", "1", stdout=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 120
    while not list(here.glob("runs/*/result.json")) and time.monotonic() < deadline:
        time.sleep(0.05)
    children = descendants(first)
    first.kill()
    first.wait()
    for child in children:  # each run has a session of its own and outlives the campaign
        if child.is_running():
            child.send_signal(signal.SIGKILL)
    before = {p: p.stat().st_mtime_ns for p in here.glob("runs/*/result.json")}
    assert len(before) == 1
    status, said = finished(
        "campaign", str(file), "--out", str(here), "--jobs", "2", timeout_s=600.0
    )
    assert status == 0, said
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert len(table(here)) == len({row["digest"] for row in table(here)}) == 2

    from distributed import LocalCluster

    cluster: Any = LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=""
    )
    with cluster:
        status, said = finished(
            "campaign",
            str(file),
            "--out",
            str(there),
            "--cluster",
            cluster.scheduler_address,
            timeout_s=600.0,
        )
    assert status == 0, said
    assert json.dumps(table(there)) == json.dumps(table(here))
