# SPDX-License-Identifier: Apache-2.0
"""summary.json: its fields equal those of the typed summary and of docs/summary.md."""

from __future__ import annotations

import re
from typing import Any

from harness import ROOT

from chaserdock.analysis.summary import summarize
from chaserdock.summary import Summary

GOLDEN = ROOT / "tests" / "golden" / "two-chasers.mcap"
RUN_ONLY = {"peak_memory_bytes", "cpu_s"}
DETUMBLING_ONLY = {"stack"}
PLUMES_ONLY = {"plumes"}
IN_SOME_FLIGHTS = {"capture", "passive_safety"}
"""Fields of a chaser."""


def documented() -> set[str]:
    """Return the names in code font in the first column of the table."""
    rows = re.findall(r"^\| (`[^|]*) \|", (ROOT / "docs" / "summary.md").read_text(), re.MULTILINE)
    return {name for row in rows for name in re.findall(r"`([^`]*)`", row)}


def test_typed_summary_has_the_produced_fields() -> None:
    produced: dict[str, Any] = summarize(GOLDEN)
    assert set(produced) | RUN_ONLY | DETUMBLING_ONLY | PLUMES_ONLY == set(Summary.__struct_fields__)
    assert Summary.from_dict(produced).digest == produced["digest"]


def test_documented_fields_equal_the_produced_fields() -> None:
    produced = summarize(GOLDEN)
    names = {name.removeprefix("chasers.<id>.").partition(".")[0] for name in documented()}
    chaser = next(iter(produced["chasers"].values()))
    expected = (set(produced) - {"chasers"}) | set(chaser) | IN_SOME_FLIGHTS
    expected |= RUN_ONLY | DETUMBLING_ONLY | PLUMES_ONLY
    assert names == expected
