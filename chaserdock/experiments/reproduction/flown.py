# SPDX-License-Identifier: Apache-2.0
"""Which flights of the page were flown when, and at which commit."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping

from chaserdock.experiments.page import PageSection, Table
from chaserdock.experiments.plan import ExperimentPlan, PlannedFlight
from chaserdock.experiments.provenance import Provenance
from chaserdock.experiments.worker import FlightOutcome

from .paper import BASELINE, ROWS
from .plan import COLUMNS
from .tables import NONE

ALONE = "controller alone"
FREE, MISSIONS = "free starts", "missions"

Provenances = Mapping[str, Provenance | None]
"""Where and when flights were flown, by their label; None: not known."""


def flown_by_label(plan: ExperimentPlan, outcomes: Mapping[str, FlightOutcome]) -> Provenances:
    """Return the provenance of the flights that have a result."""
    ended = ((f.label, outcomes[f.name]) for f in plan.flights if f.name in outcomes)
    return {label: outcome.flown for label, outcome in ended if outcome.summary is not None}


def place_of(flight: PlannedFlight) -> tuple[str, str]:
    """Return row and column of a flight in the table of flights."""
    if "mission" in flight.varied:
        return MISSIONS, flight.varied["chain"]
    kind, *rest = flight.label.split("/")
    labels = {row.name: row.label for row in ROWS}
    if kind == "table":
        return labels[rest[1]], rest[0]
    if kind == "free":
        return FREE, ALONE
    return labels.get(rest[0], BASELINE.label), ALONE


def flights_section(plan: ExperimentPlan, flown: Provenances) -> PageSection:
    """Return the section on where and when the flights of every row were flown."""
    planned = Counter(map(place_of, plan.flights))
    known: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for flight in plan.flights:
        if flight.label in flown:
            known[place_of(flight)][_when(flown[flight.label])] += 1

    def cell(place: tuple[str, str]) -> str:
        found = "; ".join(f"{n} on {when}" for when, n in sorted(known[place].items()))
        return f"{found} (of {planned[place]})" if found else NONE

    columns = (*COLUMNS, ALONE)
    names = (*(row.label for row in ROWS), FREE, MISSIONS)
    rows = [(name, *(cell((name, column)) for column in columns)) for name in names]
    machines = sorted({about.machine for about in flown.values() if about is not None})
    where = f" Machine: {'; '.join(machines)}." if machines else ""
    whens = {(about.date, about.commit) for about in flown.values() if about is not None}
    if len(whens) == 1:
        where = " All of them were flown on {}, commit {}.".format(*whens.pop()) + where
    text = (
        "Number, date and commit of the flights whose results stand here without a mark; in "
        f"parentheses how many are planned; {NONE}: none.{where}"
    )
    return PageSection("Flights", (text, Table(("row", *columns), tuple(rows), text=True)))


def _when(about: Provenance | None) -> str:
    return "an unknown date" if about is None else f"{about.date} at {about.commit}"
