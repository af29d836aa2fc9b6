# SPDX-License-Identifier: Apache-2.0
"""The benchmarks: what they share, and that the documentation names commands that exist."""

from __future__ import annotations

import json
import math
import re
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import pytest
from chaserdock_protocol.scenario import load_scenario
from common import (
    SHARED,
    BenchmarkFailed,
    Figures,
    Group,
    KeptResults,
    Options,
    main,
    matching,
    parser_of,
    parts_of,
)
from harness import ROOT
from parts import scale
from parts.rates import RatedFlight, mean_nees

COMMANDS = sorted(
    path.stem
    for path in (ROOT / "benchmarks").glob("*.py")
    if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
)
DOCS = ROOT / "docs"
INDEX = DOCS / "evidence" / "index.md"
GUIDES = [*DOCS.glob("*.md"), INDEX, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
EVIDENCE = [page for page in (DOCS / "evidence").glob("*.md") if page != INDEX]


def groups_of(name: str) -> tuple[Group, ...]:
    """Return the groups of parts of a command; none if it has no parts."""
    source = (ROOT / "benchmarks" / f"{name}.py").read_text(encoding="utf-8")
    return import_module(name).GROUPS if "GROUPS =" in source else ()


def test_at_most_sixteen_commands_each_listed_once() -> None:
    assert len(COMMANDS) <= 16
    rows = re.findall(r"^\| `python benchmarks.*", INDEX.read_text("utf-8"), re.MULTILINE)
    listed = re.findall(r"python benchmarks/(\w+)\.py`", " ".join(rows))
    assert sorted(listed) == COMMANDS


def test_every_part_has_one_name_and_says_what_it_measures() -> None:
    for name in COMMANDS:
        groups = groups_of(name)
        parts = parts_of(groups)
        assert len(parts) == sum(len(group.parts) for group in groups), name
        for part, measure in parts.items():
            assert (measure.__doc__ or "").strip(), (name, part)


def test_commands_in_the_guides_exist() -> None:
    """Every ``python FOLDER/NAME.py --option --only PART`` has the option and the part."""
    tried = 0
    for page in GUIDES:
        for folder, name, arguments in re.findall(
            r"python (benchmarks|docs|release)/([a-z]\w+)\.py([^`\n#]*)", page.read_text("utf-8")
        ):
            script = ROOT / folder / f"{name}.py"
            groups = groups_of(name) if folder == "benchmarks" else ()
            if groups:
                known = parser_of(None, groups).format_help()
            else:
                shared = "".join(f'"--{option}"' for option in SHARED)
                common = (ROOT / "benchmarks" / "common.py").read_text("utf-8")
                known = script.read_text("utf-8") + common + shared
            for option in re.findall(r"--[a-z][a-z-]*", arguments):
                assert re.search(rf"{option}\b", known), (page.name, name, option)
            for wanted in parts_in(arguments) if groups else ():
                assert matching(wanted, parts_of(groups)), (page.name, name, wanted)
            tried += 1
    assert tried > 25


def test_evidence_names_commands_of_today_or_renamed_ones() -> None:
    """Evidence names what was run at its commit; its index says what that is called today. Where it
    names a part alone, that exists.
    """
    table = INDEX.read_text("utf-8").partition("## Commands of earlier")[2]
    renamed = re.findall(r"(\w+)\.py", "".join(re.findall(r"^\| ([^|]*) \|", table, re.M)))
    every = [part for name in COMMANDS for part in parts_of(groups_of(name))]
    for page in EVIDENCE:
        for name in re.findall(r"benchmarks/([a-z]\w+)\.py", page.read_text("utf-8")):
            assert name in COMMANDS or name in renamed, (page.name, name)
        for arguments in re.findall(r"`(--only [^`]+)`", page.read_text("utf-8")):
            for wanted in parts_in(f" {arguments}"):
                assert matching(wanted, every), (page.name, wanted)


def parts_in(arguments: str) -> list[str]:
    """Return the parts that ``--only`` names, without placeholders such as PART."""
    found = re.search(r"--only((?: [\w-]+)+)", arguments.replace("]", " "))
    words = found[1].partition(" --")[0].split() if found else []
    return [word for word in words if word == word.lower()]


@dataclass(frozen=True)
class Flown:
    """An outcome for the tests."""

    seed: int
    causes: tuple[str, ...]


def test_results_are_kept_and_not_flown_again(tmp_path: Path) -> None:
    flown = []

    def fly(seed: int) -> Flown:
        flown.append(seed)
        return Flown(seed, ("late",) * seed)

    path = tmp_path / "results.jsonl"
    first = KeptResults(path, {"part": "a", "set": []}, Flown).of(range(2), fly)
    again = KeptResults(path, {"part": "a", "set": []}, Flown).of(range(3), fly)
    KeptResults(path, {"part": "b", "set": []}, Flown).of(range(1), fly)
    assert again[:2] == first == [Flown(0, ()), Flown(1, ("late",))]
    assert flown == [0, 1, 2, 0]


def test_a_flight_of_several_chasers_is_one_sample_of_the_nees() -> None:
    flights = [
        RatedFlight((), (4.0, 6.0)),
        RatedFlight((), (8.0, 10.0)),
        RatedFlight(("crash",), ()),
    ]
    mean, sigma = mean_nees(flights)
    assert (mean, sigma) == pytest.approx((7.0, 2.0))
    assert all(map(math.isnan, mean_nees(flights[2:])))


def test_a_part_below_its_bar_fails_the_command_after_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def bad(_: Options) -> Figures:
        """Miss the bar."""
        raise BenchmarkFailed("too slow", {"bad_s": 2.0})

    def good(_: Options) -> Figures:
        """Meet it."""
        return {"good_s": 1.0}

    groups = (Group({"kind-bad": bad, "kind-good": good, "other": good}),)
    path = tmp_path / "figures.json"
    monkeypatch.setattr(sys, "argv", ["x", "--only", "kind", "--json", str(path)])
    with pytest.raises(SystemExit, match="kind-bad: too slow"):
        main(None, groups)
    figures = json.loads(path.read_text(encoding="utf-8"))
    assert figures["bad_s"] == 2.0
    assert figures["good_s"] == 1.0


@pytest.mark.slow
def test_every_part_of_a_tick_is_timed(tmp_path: Path) -> None:
    """``mission.py --only scale`` wraps methods of the flight software by name."""
    path = tmp_path / "scenario.toml"
    path.write_text(scale.first(1), encoding="utf-8")
    spent_s = scale.parts_of(load_scenario(path), 3)
    assert all(spent_s[part] > 0.0 for part in scale.PARTS)
