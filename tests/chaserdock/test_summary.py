# SPDX-License-Identifier: Apache-2.0
"""summary.json: its fields equal those of the typed summary and of docs/summary.md."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_protocol.errors import WriteError
from chaserdock_protocol.messages import Innovation, Message, TargetEstimate
from chaserdock_protocol.recording.log import Record, logged_scenario
from harness import ROOT
from motion_cases import rewritten, table_of
from msgspec import structs

from chaserdock.analysis.figures import innovations
from chaserdock.analysis.flight import InnovationHistory, load_flight
from chaserdock.analysis.plots import MissingData
from chaserdock.analysis.report import _chasers
from chaserdock.analysis.summary import summarize, summary_of, text_of
from chaserdock.analysis.time_series import load_traces
from chaserdock.launch import launcher
from chaserdock.launch.progress import ProgressReporter, Show
from chaserdock.summary import Summary

GOLDEN = ROOT / "tests" / "golden" / "two-chasers.mcap"
RUN_ONLY = {"peak_memory_bytes", "cpu_s", "run_failure"}
DETUMBLING_ONLY = {"stack"}
PLUMES_ONLY = {"plumes"}
MAPS_ONLY = {"mapping"}
IN_SOME_FLIGHTS = {
    "capture",
    "passive_safety",
    "assurance",
    "rendezvous",
    "estimated_tracking",
    "sightings",
    "innovations",
}
"""Fields of a chaser."""


def documented() -> set[str]:
    """Return the names in code font in the first column of the table."""
    rows = re.findall(r"^\| (`[^|]*) \|", (ROOT / "docs" / "summary.md").read_text(), re.MULTILINE)
    return {name for row in rows for name in re.findall(r"`([^`]*)`", row)}


def test_typed_summary_has_the_produced_fields() -> None:
    produced: dict[str, Any] = summarize(GOLDEN)
    assert set(produced) | RUN_ONLY | DETUMBLING_ONLY | PLUMES_ONLY | MAPS_ONLY == set(
        Summary.__struct_fields__
    )
    assert Summary.from_dict(produced).digest == produced["digest"]


def test_documented_fields_equal_the_produced_fields() -> None:
    produced = summarize(GOLDEN)
    names = {name.removeprefix("chasers.<id>.").partition(".")[0] for name in documented()}
    chaser = next(iter(produced["chasers"].values()))
    expected = (set(produced) - {"chasers"}) | set(chaser) | IN_SOME_FLIGHTS
    expected |= RUN_ONLY | DETUMBLING_ONLY | PLUMES_ONLY | MAPS_ONLY
    assert names == expected


def test_innovations_show_the_mean_of_the_used_and_what_is_beyond_the_band() -> None:
    """The band ends at 14.45 for six degrees of freedom; nothing of it is judged."""
    flight = load_flight(GOLDEN)
    history = InnovationHistory(
        time_s=np.array([0.1, 0.6, 0.7, 0.8, 0.9]),
        squared=np.array([90.0, 3.0, 15.0, 60.0, 14.4]),
        freedoms=np.full(5, 6.0),
        used=np.array([True, True, True, False, True]),
    )
    shown = summary_of(replace(flight, innovations={1: history}))
    chasers = shown["chasers"]
    assert "innovations" not in chasers["0"]
    assert chasers["1"]["innovations"] == {
        "used": 3,
        "rejected": 1,
        "mean_per_freedom": pytest.approx(32.4 / 18.0),
        "rejected_mean_per_freedom": 10.0,
        "above_share": 0.5,
    }
    before = summary_of(flight)
    for name in ("failures", "not_judged", "doubts"):
        assert shown[name] == before[name]
    assert Summary.from_dict(shown).as_dict() == Summary.from_dict(shown | {}).as_dict()
    line = " ".join(text_of(shown).partition("  chaser 1:")[2].split())
    assert "; mean NIS 1.80 per degree of freedom, 50.0 % above the 95 % band" in line
    early = summary_of(replace(flight, innovations={1: replace(history, time_s=np.zeros(5))}))
    assert early["chasers"]["1"]["innovations"]["above_share"] is None
    assert "NIS" not in text_of(early)


def test_innovations_of_a_log_are_collected_by_chaser(tmp_path: Path) -> None:
    """A log from before them states none."""

    def stating(innovations: Callable[[TargetEstimate], Any], name: str) -> Path:
        def changed(record: Record) -> Message:
            estimate = record.message
            if not isinstance(estimate, TargetEstimate):
                return estimate
            return structs.replace(estimate, innovations=innovations(estimate))

        return rewritten(GOLDEN, tmp_path / name, changed)

    def two(estimate: TargetEstimate) -> tuple[Innovation, ...]:
        one = Innovation(
            chaser=1, sim_time_ns=estimate.sim_time_ns, squared=4.5, freedoms=6, used=True
        )
        return one, structs.replace(one, squared=99.0, used=False)

    assert load_flight(stating(lambda _: None, "early.mcap")).innovations == {}
    log = stating(two, "mission.mcap")
    (found,) = load_flight(log).innovations.values()
    assert found.squared.tolist() == [4.5, 99.0] * (len(found.used) // 2)
    assert found.used.tolist() == [True, False] * (len(found.used) // 2)
    assert found.freedoms.tolist() == [6.0] * len(found.used)


def test_innovations_are_drawn_and_listed_where_they_are_stated() -> None:
    """By chaser, rejected ones by themselves."""
    flight = replace(load_flight(GOLDEN), innovations={})
    time_s = np.linspace(0.6, 1.1, 8)
    history = InnovationHistory(time_s, np.full(8, 3.0), np.full(8, 6.0), time_s < 1.0)
    stated = replace(flight, innovations={0: history})
    drawn = innovations(stated, load_traces(GOLDEN, flight.scenario)).axes[0]
    used, rejected, *_ = drawn.lines
    np.testing.assert_array_equal(np.asarray(used.get_ydata()), np.full(6, 0.5))
    assert np.size(rejected.get_xdata()) == 2
    head = "NIS per degree of freedom; above the 95 % band"
    assert head in _chasers(stated, summary_of(stated))
    assert head not in _chasers(flight, summary_of(flight))
    with pytest.raises(MissingData, match="states no innovations"):
        innovations(flight, load_traces(GOLDEN, flight.scenario))


def test_estimate_is_judged_relative_to_each_chaser() -> None:
    """A shift of one chaser's estimated pose by 15 mm is its error, and violates the criterion; a
    common drift does not.
    """
    flight = load_flight(GOLDEN)
    limits = flight.scenario.success.model_copy(update={"max_estimate_position_m": 0.005})
    scenario = flight.scenario.model_copy(update={"success": limits, "settling_s": 1.0})
    before = summary_of(replace(flight, scenario=scenario))
    assert before["chasers"]["0"]["relative_estimate"]["max_position_error_m"] < 0.004
    assert not [f for f in before["failures"] if "position estimate" in f]

    history = flight.relative[0]
    shifted = replace(history, position_m=history.position_m + np.array([0.009, 0.0, 0.012]))
    after = summary_of(replace(flight, scenario=scenario, relative={**flight.relative, 0: shifted}))
    error = after["chasers"]["0"]["relative_estimate"]
    assert abs(error["position_rms_m"] - 0.015) < 0.004
    assert error["nees_mean"] > 5.0 * before["chasers"]["0"]["relative_estimate"]["nees_mean"]
    (failure,) = [f for f in after["failures"] if "position estimate" in f]
    assert failure.startswith("position estimate, chaser 0: ")

    drifted = replace(flight.estimate, position_m=flight.estimate.position_m + 0.02)
    common = summary_of(replace(flight, scenario=scenario, estimated=table_of(drifted)))
    assert common["target_estimate"]["position_rms_m"] > 0.03
    assert not [f for f in common["failures"] if "error" in f]


def test_estimate_without_relative_poses_is_judged_by_the_target() -> None:
    flight = load_flight(GOLDEN)
    limits = flight.scenario.success.model_copy(update={"max_estimate_position_m": 1e-9})
    scenario = flight.scenario.model_copy(update={"success": limits, "settling_s": 1.0})
    failures = summary_of(replace(flight, scenario=scenario, relative={}))["failures"]
    assert any(f.startswith("position estimate: ") for f in failures)


def test_a_verdict_that_cannot_be_written_is_shown_and_is_a_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, _: str) -> None:
        raise WriteError(path, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))

    shutil.copy(GOLDEN, tmp_path / "mission.mcap")
    monkeypatch.setattr(launcher, "write_atomically", full)
    reporter = ProgressReporter(logged_scenario(GOLDEN)[0], Show.none)
    outcome = launcher.judge(launcher.Fleet(), tmp_path, None, reporter)
    assert outcome.status == 1
    assert outcome.summary is not None
    text = f"{tmp_path / 'summary.json'}: cannot be written: No space left on device"
    assert text in outcome.summary["failures"]
