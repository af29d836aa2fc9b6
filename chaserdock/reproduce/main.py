# SPDX-License-Identifier: Apache-2.0
"""``chaserdock reproduce``: fly the plan, write the page."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
from chaserdock_controller.nmpc.open_backend import missing_part
from chaserdock_protocol.errors import errors_of_writing

from chaserdock.campaign.scheduler import AFTER_ACTIVE_RUNS
from chaserdock.campaign.worker import CampaignError
from chaserdock.exit_codes import DONE, FAILED, STOPPED
from chaserdock.launch.signals import stop_on_signals

from .content import sections
from .page import html, markdown
from .plan import SCENARIO, ReproductionPlan, make_plan, needs_open
from .record import ChainRecord, Provenance, provenance, read_record, shown_fields, write_record
from .runner import ReproductionResults, code_digest, fly_missions, fly_studies, results_of, scenario_path

TITLE = "Reproduction of the paper's results"


def reproduce(quick: bool, out: Path, jobs: int, keep_logs: bool) -> int:
    """Fly what has no result yet; write ``reproduction.md`` and ``.html`` into ``out``; return the exit status.

    Without the paper's solver, its chain is taken from the shipped record, and the status is FAILED. Raise CampaignError
    or ScenarioError when a mission or study cannot be flown.
    """
    return fly_plan(make_plan(quick, str(scenario_path(SCENARIO))), out.absolute(), jobs, keep_logs)


def fly_plan(plan: ReproductionPlan, out: Path, jobs: int, keep_logs: bool) -> int:
    """Fly any plan; return the exit status."""
    missing = missing_part()
    flyable = plan if missing is None else without_open(plan)
    with errors_of_writing(out, CampaignError):
        out.mkdir(parents=True, exist_ok=True)
        about = begun(out)
        with stop_on_signals(AFTER_ACTIVE_RUNS) as stop:
            fly_studies(flyable.studies, out, jobs, stop, _report)
            fly_missions(flyable.missions, out, jobs, keep_logs, stop)
        results = results_of(flyable, out)
        recorded = None
        if missing is None:
            _keep_record(plan, results, about, out)
        elif flyable != plan:
            recorded = read_record()
            results = add_recorded(plan, results, recorded)
        write_page(plan, results, out, about, recorded)
    if stop.is_set():
        _report("stopped; repeat the command to resume")
        return STOPPED
    if recorded is not None:
        _report(
            f"chaserdock: the paper's chain was not flown: {missing}; the page shows {recorded.provenance}"
        )
        return FAILED
    return DONE


def begun(out: Path) -> Provenance:
    """Return where and when the first run of this code into ``out`` began; later calls only resume it."""
    path = out / f"provenance-{code_digest()}.json"
    if not path.exists():
        path.write_bytes(msgspec.json.encode(provenance()))
    return msgspec.json.decode(path.read_bytes(), type=Provenance)


def without_open(plan: ReproductionPlan) -> ReproductionPlan:
    """Return the part of a plan that does not need the paper's solver."""
    return ReproductionPlan(
        plan.quick,
        plan.duration_s,
        tuple(m for m in plan.missions if not needs_open(m)),
        tuple(c for c in plan.studies if not needs_open(c)),
    )


def add_recorded(
    plan: ReproductionPlan, results: ReproductionResults, record: ChainRecord
) -> ReproductionResults:
    """Return results with the recorded runs of the plan that need the paper's solver."""
    missions = {m.name: record.missions[m.name] for m in plan.missions if m.name in record.missions}
    studies = {c.name: record.studies[c.name] for c in plan.studies if c.name in record.studies}
    return ReproductionResults({**missions, **results.missions}, {**studies, **results.studies})


def _keep_record(plan: ReproductionPlan, results: ReproductionResults, about: Provenance, out: Path) -> None:
    """Write the flights of the paper's chain as a record, if all of them are finished."""
    missions = [m.name for m in plan.missions if needs_open(m)]
    cases = [c.name for c in plan.studies if needs_open(c)]
    if not missions or not (
        set(missions) <= results.missions.keys() and set(cases) <= results.studies.keys()
    ):
        return
    studies = {
        name: msgspec.structs.replace(r, case=msgspec.structs.replace(r.case, scenario=SCENARIO))
        for name, r in results.studies.items()
        if name in cases
    }
    shown = {name: shown_fields(results.missions[name]) for name in missions}
    write_record(ChainRecord(provenance=about, quick=plan.quick, missions=shown, studies=studies), out)


def write_page(
    plan: ReproductionPlan,
    results: ReproductionResults,
    out: Path,
    about: Provenance,
    recorded: ChainRecord | None,
) -> None:
    """Write the page as Markdown and as HTML."""
    parts = sections(plan, results, about, recorded)
    for name, text in (
        ("reproduction.md", markdown(TITLE, parts)),
        ("reproduction.html", html(TITLE, parts)),
    ):
        (out / name).write_text(text, encoding="utf-8")
        _report(f"wrote {out / name}")


def _report(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
