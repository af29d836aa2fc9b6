# SPDX-License-Identifier: Apache-2.0
"""``chaserdock reproduce``: fly the plan, write the page."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
from chaserdock_controller.nmpc.open_backend import missing_part
from chaserdock_protocol.errors import errors_of_writing
from chaserdock_protocol.shipped_scenarios import find_scenario

from chaserdock.exit_codes import DONE, FAILED, STOPPED
from chaserdock.launch.signals import stop_on_signals

from .content import sections
from .page import html, markdown
from .plan import SCENARIO, ReproductionPlan, make_plan, needs_open
from .provenance import Provenance, provenance
from .runner import ReproductionError, code_digest, fly, results_of

TITLE = "Reproduction of the paper's results"


def reproduce(quick: bool, out: Path) -> int:
    """Fly what has no result yet; write ``reproduction.md`` and ``.html`` into ``out``; return the
    exit status.

    Without the paper's solver its chain is left out, and the status is FAILED. Raise
    ReproductionError, StudyError or ScenarioError when a flight is not possible.
    """
    return fly_plan(make_plan(quick, str(find_scenario(SCENARIO))), out.absolute())


def fly_plan(plan: ReproductionPlan, out: Path) -> int:
    """Fly any plan; return the exit status."""
    missing = missing_part()
    flyable = plan if missing is None else _without_open(plan)
    with errors_of_writing(out, ReproductionError):
        out.mkdir(parents=True, exist_ok=True)
        about = begun(out)
        with stop_on_signals("stops after this flight") as stop:
            fly(flyable, out, stop, _report)
        parts = sections(plan, results_of(plan, out), about)
        for name, text in (
            ("reproduction.md", markdown(TITLE, parts)),
            ("reproduction.html", html(TITLE, parts)),
        ):
            (out / name).write_text(text, encoding="utf-8")
            _report(f"wrote {out / name}")
    if stop.is_set():
        _report("stopped; repeat the command to resume")
        return STOPPED
    if flyable != plan:
        _report(f"chaserdock: the paper's chain was not flown: {missing}")
        return FAILED
    return DONE


def begun(out: Path) -> Provenance:
    """Return where and when the first flight of this code into ``out`` began; later calls only
    resume it.
    """
    path = out / f"provenance-{code_digest()}.json"
    if not path.exists():
        path.write_bytes(msgspec.json.encode(provenance()))
    return msgspec.json.decode(path.read_bytes(), type=Provenance)


def _without_open(plan: ReproductionPlan) -> ReproductionPlan:
    return ReproductionPlan(
        plan.quick,
        plan.duration_s,
        tuple(c for c in plan.cases if not needs_open(c)),
        tuple(m for m in plan.missions if not needs_open(m)),
    )


def _report(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
