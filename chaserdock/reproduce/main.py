# SPDX-License-Identifier: Apache-2.0
"""``chaserdock reproduce``: fly the plan, write the page."""

from __future__ import annotations

import sys
from pathlib import Path

from chaserdock.campaign.scheduler import stop_on_signal
from chaserdock.campaign.worker import CampaignError
from chaserdock.exit_codes import DONE, STOPPED

from .content import sections
from .page import html, markdown
from .plan import SCENARIO, Plan, make_plan
from .runner import Results, fly_missions, fly_studies, results_of, scenario_path

TITLE = "Reproduction of the paper's results"


def reproduce(quick: bool, out: Path, jobs: int, keep_logs: bool) -> int:
    """Fly what has no result yet; write ``reproduction.md`` and ``.html`` into ``out``; return the exit status.

    Raise CampaignError or ScenarioError when a mission or study cannot be flown.
    """
    return fly_plan(make_plan(quick, str(scenario_path(SCENARIO))), out.absolute(), jobs, keep_logs)


def fly_plan(plan: Plan, out: Path, jobs: int, keep_logs: bool) -> int:
    """Fly any plan; return the exit status."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with stop_on_signal() as stop:
            fly_studies(plan.studies, out, jobs, stop, _report)
            fly_missions(plan.missions, out, jobs, keep_logs, stop)
    except OSError as error:
        raise CampaignError(f"{out}: cannot be written: {error.strerror or error}") from None
    write_page(plan, results_of(plan, out), out)
    if stop.is_set():
        _report("stopped; repeat the command to resume")
        return STOPPED
    return DONE


def write_page(plan: Plan, results: Results, out: Path) -> None:
    """Write the page as Markdown and as HTML."""
    parts = sections(plan, results)
    for name, text in (
        ("reproduction.md", markdown(TITLE, parts)),
        ("reproduction.html", html(TITLE, parts)),
    ):
        (out / name).write_text(text, encoding="utf-8")
        _report(f"wrote {out / name}")


def _report(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
