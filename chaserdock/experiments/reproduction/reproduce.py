# SPDX-License-Identifier: Apache-2.0
"""``chaserdock reproduce``: fly the paper's experiments, write the page."""

from __future__ import annotations

import sys
from pathlib import Path

from chaserdock_controller.nmpc.open_backend import missing_part
from chaserdock_protocol.errors import errors_of_writing
from chaserdock_protocol.output_files import write_atomically

from chaserdock.exit_codes import DONE, FAILED, STOPPED
from chaserdock.experiments.page import Picture, html, markdown
from chaserdock.experiments.plan import ExperimentError, ExperimentPlan
from chaserdock.experiments.worker import ExperimentProgress, Workers, fly_plan
from chaserdock.launch.signals import stop_on_signals

from .content import sections
from .earlier import NO_PAGE, EarlierPage, read_earlier
from .flown import flown_by_label
from .plan import make_plan, needs_open
from .tables import results_by_label

TITLE = "Comparison with the paper's results"


def reproduce(quick: bool, out: Path, jobs: int, earlier: Path | None = None) -> int:
    """Fly what has no result yet; write ``reproduction.md`` and ``.html`` into ``out``; return the
    exit status.

    Cells of the ``earlier`` page stand where a row is not flown. Without the paper's solver its
    chain is left out, and the status is FAILED. Raise ExperimentError or ScenarioError when a
    flight is not possible.
    """
    page = NO_PAGE if earlier is None else _read_page(earlier)
    return fly_and_report(make_plan(quick), out.absolute(), quick, jobs, page)


def _read_page(path: Path) -> EarlierPage:
    """Read an earlier page. Raise ExperimentError."""
    try:
        return read_earlier(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ExperimentError) as error:
        raise ExperimentError(f"--earlier {path}: {error}") from None


def fly_and_report(
    plan: ExperimentPlan,
    out: Path,
    quick: bool = False,
    jobs: int = 1,
    earlier: EarlierPage = NO_PAGE,
) -> int:
    """Fly any plan of the reproduction; return the exit status."""
    missing = missing_part()
    flights = tuple(f for f in plan.flights if missing is None or not needs_open(f))
    with errors_of_writing(out, ExperimentError):
        out.mkdir(parents=True, exist_ok=True)
        with stop_on_signals("stopping after the active flights") as stop:
            flyable = ExperimentPlan(plan.name, flights)
            outcomes = fly_plan(flyable, out, Workers(jobs), ExperimentProgress(), stop)
        results, flown = results_by_label(plan, outcomes), flown_by_label(plan, outcomes)
        parts = sections(plan, results, flown, quick, earlier)
        pictures = [p for section in parts for p in section.parts if isinstance(p, Picture)]
        for name, text in (
            *((picture.path, picture.file) for picture in pictures),
            ("reproduction.md", markdown(TITLE, parts)),
            ("reproduction.html", html(TITLE, parts)),
        ):
            (out / name).parent.mkdir(exist_ok=True)
            write_atomically(out / name, text)
            _report(f"wrote {out / name}")
    if stop.is_set():
        _report("stopped; repeat the command to resume")
        return STOPPED
    for flight in flights:
        if outcomes[flight.name].summary is None:
            _report(f"chaserdock: {flight.label}: {outcomes[flight.name].last_words}")
    if missing is not None and len(flights) < len(plan.flights):
        _report(f"chaserdock: the paper's chain was not flown: {missing}")
    complete = all(f.name in outcomes and outcomes[f.name].summary for f in plan.flights)
    return DONE if complete else FAILED


def _report(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
