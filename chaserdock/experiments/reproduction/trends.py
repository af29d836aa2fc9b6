# SPDX-License-Identifier: Apache-2.0
"""Trends of the paper: changes of a row from the baseline row, beside ours, with measurements that
explain the differences.
"""

from __future__ import annotations

from .paper import BASELINE, ROWS, PaperRow
from .plan import CODE, DEFAULT, DELAYS_S, STAGE_WEIGHTS
from .tables import (
    NONE,
    QUANTITIES,
    Quantity,
    Summaries,
    cell,
    changes,
    comes_out,
    errors_by_label,
    errors_of,
    paper_change,
    spread,
)


def trend_rows(results: Summaries) -> list[tuple[str, ...]]:
    """Return a row for every row of the paper's table but the baseline: paper, chains, controller
    alone, explanation.
    """
    out = []
    for row in ROWS[1:]:
        paper = "; ".join(change_text(paper_change(row, q)) for q in QUANTITIES)
        chains = [_chain_text(results, column, row) for column in (CODE, DEFAULT)]
        alone = [_alone_change(results, f"alone/{row.name}", q) for q in QUANTITIES]
        alone_text = (
            NONE if None in alone else "; ".join(change_text(x) for x in alone if x is not None)
        )
        why = explanation(results, row)
        same = next((label for label, *_, known in out if known == why != NONE), None)
        out.append(
            (row.label, paper, *chains, alone_text, why if same is None else f"As for {same}.")
        )
    return out


def change_text(change: float) -> str:
    """Format a change in percent; beyond doubling as a factor."""
    return f"{100 * change:+.1f} %" if abs(change) < 1.0 else f"x {1 + change:.3g}"


def _chain_text(results: Summaries, column: str, row: PaperRow) -> str:
    texts = []
    for q in QUANTITIES:
        values = changes(results, column, row, q)
        if not values:
            return NONE
        answer = "yes" if comes_out(values, paper_change(row, q)) else "no"
        texts.append(f"{change_text(spread(values).median)} {answer}")
    return "; ".join(texts)


def _alone_change(results: Summaries, name: str, quantity: Quantity) -> float | None:
    """Return the change of a flight with perfect knowledge from the baseline; None without
    results.
    """
    one, base = (errors_by_label(results, n) for n in (name, f"alone/{BASELINE.name}"))
    return None if one is None or base is None else one.of(quantity) / base.of(quantity) - 1.0


def explanation(results: Summaries, row: PaperRow) -> str:
    """Return what was measured about a trend that does not appear in both errors of the paper's
    chain; NONE if a measurement is missing.
    """
    values = [changes(results, CODE, row, q) for q in QUANTITIES]
    if all(
        v and comes_out(v, paper_change(row, q)) for v, q in zip(values, QUANTITIES, strict=True)
    ):
        return "It comes out."
    texts = []
    if row.name in DELAYS_S:
        texts.append(_by_delay(results, row))
    if row.name in STAGE_WEIGHTS:
        texts.append(_by_stage_weights(results, row))
    if row.falloff:
        texts.append(_by_spread(results, row))
    return " ".join(texts) if all(texts) else NONE


def _by_delay(results: Summaries, row: PaperRow) -> str:
    """Find the command delay that brings the position error of the controller alone to the
    paper's.
    """
    solved = results.get(f"alone/{row.name}")
    flown = [(d, errors_by_label(results, f"delay/{row.name}/{d:g}")) for d in DELAYS_S[row.name]]
    known = [(d, e.position) for d, e in flown if e is not None]
    if solved is None or not known:
        return ""
    paper = row.position_mse_m2
    reached = next((k for k, (_, value) in enumerate(known) if value >= paper), None)
    shown = known[-1:] if reached is None else known[max(reached - 1, 0) : reached + 1]
    delayed = ", ".join(f"{_error_text(value)} if {d:g} s late" for d, value in shown)
    found = "Unexplained" if reached is None else "A late command gives as much"
    solve_ms = solved["solver"]["solve_s"]["p50"] * 1e3
    return (
        f"{found}: the controller alone has {errors_of(solved).position:.3g} m^2, {delayed}, the "
        f"paper {paper:.3g}. The median solve of OpEn took {solve_ms:.1f} ms here."
    )


def _error_text(position_mse_m2: float) -> str:
    return f"{position_mse_m2:.3g}" if position_mse_m2 < 10.0 else "divergence"


def _by_stage_weights(results: Summaries, row: PaperRow) -> str:
    """Compare with the same dt at stage weights that keep the sum of the stage costs."""
    before = _alone_change(results, f"alone/{row.name}", "position")
    after = _alone_change(results, f"weights/{row.name}", "position")
    if before is None or after is None:
        return ""
    text = (
        f"position {change_text(before)} alone, {change_text(after)} with stage weights times "
        f"{STAGE_WEIGHTS[row.name]:.2g}"
    )
    if abs(after) >= 0.5 * abs(before):
        return f"Unexplained: {text}."
    return (
        f"Eq. 6 counts the final cost once for any dt, which explains ours: {text}. The paper's "
        "is unexplained."
    )


def _by_spread(results: Summaries, row: PaperRow) -> str:
    """Compare the paper's changes with the spread of the baseline over the dispersed starts."""
    runs = list(cell(results, CODE, BASELINE).values())
    if len(runs) < 2:
        return ""
    texts = []
    for q in QUANTITIES:
        s = spread([e.of(q) for e in runs])
        width = (s.greatest - s.least) / s.median
        found = (
            "unexplained by the start"
            if width < abs(paper_change(row, q))
            else "not separable from the start"
        )
        texts.append(f"{q} {found}, which changes the baseline by {100 * width:.0f} %")
    return f"{'; '.join(texts).capitalize()}. The paper states no spread."
