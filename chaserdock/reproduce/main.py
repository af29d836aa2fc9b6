"""Plan, flights, tables, page: what the verb ``reproduce`` does."""

from __future__ import annotations

import sys
from pathlib import Path

from chaserdock.exit_codes import DONE, STOPPED

from .content import sections
from .page import html, markdown
from .plan import SCENARIO, Plan, make_plan
from .runner import Results, Runner, scenario_path

TITLE = "The paper, flown again"


def reproduce(quick: bool, out: Path, jobs: int, keep_logs: bool) -> int:
    """Flies what is not flown yet and writes ``reproduction.md`` and ``.html`` into ``out``; the exit status.

    Raises ReproduceError or ScenarioError when something could not be flown at all.
    """
    return fly_plan(make_plan(quick, str(scenario_path(SCENARIO))), out, jobs, keep_logs)


def fly_plan(plan: Plan, out: Path, jobs: int, keep_logs: bool) -> int:
    """The same for any plan."""
    runner = Runner(out, jobs, keep_logs, _say)
    try:
        results, status = runner.fly(plan), DONE
    except KeyboardInterrupt:
        results, status = runner.results(plan), STOPPED
        _say("interrupted; the same command goes on from here")
    write_page(plan, results, out)
    return status


def write_page(plan: Plan, results: Results, out: Path) -> None:
    """Writes both forms of the page."""
    parts = sections(plan, results)
    for name, text in (
        ("reproduction.md", markdown(TITLE, parts)),
        ("reproduction.html", html(TITLE, parts)),
    ):
        (out / name).write_text(text, encoding="utf-8")
        _say(f"written: {out / name}")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
