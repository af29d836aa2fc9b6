"""Plan, flights, tables, page: what the verb ``reproduce`` does."""

from __future__ import annotations

import sys
from pathlib import Path

from .plan import SCENARIO, make_plan
from .runner import Runner, scenario_path


def reproduce(quick: bool, out: Path, jobs: int, keep_logs: bool) -> int:
    """Flies what is not flown yet and writes ``reproduction.md`` and ``.html`` into ``out``; 0.

    Raises ReproduceError or ScenarioError when something could not be flown at all.
    """
    plan = make_plan(quick, str(scenario_path(SCENARIO)))
    Runner(out, jobs, keep_logs, lambda text: print(text, file=sys.stderr, flush=True)).fly(plan)
    return 0
