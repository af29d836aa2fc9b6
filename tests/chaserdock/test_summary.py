# SPDX-License-Identifier: Apache-2.0
"""summary.json: its fields equal those of the typed summary and of docs/summary.md."""

from __future__ import annotations

import errno
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_protocol.errors import WriteError
from chaserdock_protocol.recording.log import logged_scenario
from harness import ROOT
from motion_cases import table_of

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summarize, summary_of
from chaserdock.launch import launcher
from chaserdock.launch.progress import ProgressReporter, Show
from chaserdock.summary import Summary

GOLDEN = ROOT / "tests" / "golden" / "two-chasers.mcap"
RUN_ONLY = {"peak_memory_bytes", "cpu_s", "run_failure"}
DETUMBLING_ONLY = {"stack"}
PLUMES_ONLY = {"plumes"}
IN_SOME_FLIGHTS = {
    "capture",
    "passive_safety",
    "rendezvous",
    "estimated_tracking",
    "sightings",
}
"""Fields of a chaser."""


def documented() -> set[str]:
    """Return the names in code font in the first column of the table."""
    rows = re.findall(r"^\| (`[^|]*) \|", (ROOT / "docs" / "summary.md").read_text(), re.MULTILINE)
    return {name for row in rows for name in re.findall(r"`([^`]*)`", row)}


def test_typed_summary_has_the_produced_fields() -> None:
    produced: dict[str, Any] = summarize(GOLDEN)
    assert set(produced) | RUN_ONLY | DETUMBLING_ONLY | PLUMES_ONLY == set(
        Summary.__struct_fields__
    )
    assert Summary.from_dict(produced).digest == produced["digest"]


def test_documented_fields_equal_the_produced_fields() -> None:
    produced = summarize(GOLDEN)
    names = {name.removeprefix("chasers.<id>.").partition(".")[0] for name in documented()}
    chaser = next(iter(produced["chasers"].values()))
    expected = (set(produced) - {"chasers"}) | set(chaser) | IN_SOME_FLIGHTS
    expected |= RUN_ONLY | DETUMBLING_ONLY | PLUMES_ONLY
    assert names == expected


def test_estimate_is_judged_relative_to_each_chaser() -> None:
    """A shift of one chaser's estimated pose by 15 mm is its error, and violates the criterion; a
    common drift does not.
    """
    flight = load_flight(GOLDEN)
    limits = flight.scenario.success.model_copy(update={"max_estimate_position_m": 0.005})
    scenario = flight.scenario.model_copy(update={"success": limits, "settling_s": 1.0})
    before = summary_of(replace(flight, scenario=scenario))
    assert before["chasers"]["0"]["relative_estimate"]["max_position_error_m"] < 0.004
    assert not [f for f in before["failures"] if "estimated pose" in f]

    history = flight.relative[0]
    shifted = replace(history, position_m=history.position_m + np.array([0.009, 0.0, 0.012]))
    after = summary_of(replace(flight, scenario=scenario, relative={**flight.relative, 0: shifted}))
    error = after["chasers"]["0"]["relative_estimate"]
    assert abs(error["position_rms_m"] - 0.015) < 0.004
    assert error["nees_mean"] > 5.0 * before["chasers"]["0"]["relative_estimate"]["nees_mean"]
    (failure,) = [f for f in after["failures"] if "estimated pose" in f]
    assert failure.startswith(
        "chaser 0: largest position error of its estimated pose relative to the target"
    )

    drifted = replace(flight.estimate, position_m=flight.estimate.position_m + 0.02)
    common = summary_of(replace(flight, scenario=scenario, estimated=table_of(drifted)))
    assert common["target_estimate"]["position_rms_m"] > 0.03
    assert not [f for f in common["failures"] if "error" in f]


def test_estimate_without_relative_poses_is_judged_by_the_target() -> None:
    flight = load_flight(GOLDEN)
    limits = flight.scenario.success.model_copy(update={"max_estimate_position_m": 1e-9})
    scenario = flight.scenario.model_copy(update={"success": limits, "settling_s": 1.0})
    failures = summary_of(replace(flight, scenario=scenario, relative={}))["failures"]
    assert any(f.startswith("largest position error of the estimate") for f in failures)


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
