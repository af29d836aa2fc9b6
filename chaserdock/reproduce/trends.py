# SPDX-License-Identifier: Apache-2.0
"""The paper's trends: changes of a row from the baseline row, beside ours, with what a measurement says about the difference.

An explanation quotes the measurement that supports it; without one it is "unexplained".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.scenario.bodies import Target

from .paper import PAPER_S, ROWS, PaperRow
from .plan import CHAIN, DELAYS_S, DRAWS, INFERRED, TRACKING, ReproductionPlan, table_group
from .runner import ReproductionResults
from .tables import (
    TREND_BAND,
    Errors,
    Spread,
    spread,
    study_errors,
    verdict,
    with_images,
    with_perfect_knowledge,
)

UNEXPLAINED = "unexplained"
SPIKE = 5.0
"""An error angle counts as a spike above this multiple of its RMS; of 3000 Gaussian ones the greatest is at 2.5."""
PaperQuantity = Literal["position", "orientation"]


@dataclass(frozen=True)
class Trend:
    """A change from the baseline as a share of it: the paper's, and ours over the starts by column, with verdicts."""

    name: str
    paper: float
    ours: dict[str, tuple[Spread, str]]
    explanation: str


def paper_change(row: PaperRow, quantity: PaperQuantity) -> float:
    """Return the paper's change of a row from its baseline."""
    a, b = row, ROWS[0]
    if quantity == "position":
        return a.position_mse_m2 / b.position_mse_m2 - 1.0
    return a.orientation_mse_rad2 / b.orientation_mse_rad2 - 1.0


def changes(
    plan: ReproductionPlan, results: ReproductionResults, column: str, row: PaperRow, quantity: PaperQuantity
) -> list[float]:
    """Return the changes from the baseline of the same start: with images if all were flown so, else perfect knowledge."""
    groups = [table_group(column, name) for name in (row.name, ROWS[0].name)]
    pair = [with_images(plan, results, group) for group in groups]
    if any(len(runs) < len(DRAWS) for runs in pair):
        pair = [with_perfect_knowledge(results, group) for group in groups]
    if not all(pair):
        return []
    return [_value(a, quantity) / _value(b, quantity) - 1.0 for a, b in zip(*pair, strict=True)]


def trends(plan: ReproductionPlan, results: ReproductionResults) -> list[Trend]:
    """Return the trends of all rows in both errors, as far as results exist."""
    out = []
    for row in ROWS[1:]:
        for quantity in ("position", "orientation"):
            ours: dict[str, tuple[Spread, str]] = {}
            paper = paper_change(row, quantity)
            for column in (CHAIN, "paper"):
                values = changes(plan, results, column, row, quantity)
                if values:
                    ours[column] = spread(values), trend_verdict(values, paper)
            if not ours:
                continue
            met = all(text == "met" for _, text in ours.values())
            why = "-" if met else explain(results, row, quantity)
            out.append(Trend(f"{row.label}, {quantity}", paper, ours, why))
    return out


def trend_verdict(values: list[float], paper: float) -> str:
    """Judge changes over the starts by their median; state whether their sign depends on the start."""
    text = verdict(spread(values).median / paper, TREND_BAND)
    return text if min(values) * max(values) > 0.0 else f"{text}; sign depends on the start"


def explain(results: ReproductionResults, row: PaperRow, quantity: PaperQuantity) -> str:
    """Return what was measured about a trend that differs from the paper's."""
    if row.failed:
        return _explain_by_delay(results, row, quantity)
    texts = []
    if row.dt_s != ROWS[0].dt_s:
        texts.append(_explain_by_weights(results, row, quantity))
    if row.falloff:
        texts.append(_explain_by_spread(results, row, quantity))
    return " ".join(texts)


def _value(errors: Errors, quantity: PaperQuantity) -> float:
    return errors.position if quantity == "position" else errors.orientation


def _explain_by_weights(results: ReproductionResults, row: PaperRow, quantity: PaperQuantity) -> str:
    """Compare with the same dt at stage weights that keep the sum of the stage costs."""
    text = "times 2" if row.dt_s > ROWS[0].dt_s else "by 3"
    step = "1/5 s" if row.dt_s > ROWS[0].dt_s else "1/30 s"
    base = study_errors(results, f"start/{INFERRED}")
    plain = study_errors(results, f"ingredient/dt = {step}")
    scaled = study_errors(results, f"ingredient/dt = {step}, stage weights {text}")
    if base is None or plain is None or scaled is None:
        return UNEXPLAINED
    before, after = (100 * (_value(e, quantity) / _value(base, quantity) - 1.0) for e in (plain, scaled))
    measured = (
        f"dt = {step} alone changes the error by {before:+.1f} %, with stage weights {text} by {after:+.1f} %"
    )
    if abs(after) >= 0.5 * abs(before):
        return f"Unexplained: {measured}."
    return f"Ours is the number of stages, hence the share of the final cost: {measured}. The paper's is unexplained."


def _explain_by_spread(results: ReproductionResults, row: PaperRow, quantity: PaperQuantity) -> str:
    """Compare the paper's change with the spread of the baseline over the dispersed starts."""
    runs = with_perfect_knowledge(results, table_group("paper", ROWS[0].name))
    if not runs:
        return UNEXPLAINED
    s = spread([_value(e, quantity) for e in runs])
    width, paper = 100 * (s.greatest - s.least) / s.median, 100 * paper_change(row, quantity)
    measured = f"the baseline varies by {width:.1f} % over our starts, the paper's change is {paper:+.1f} %"
    if width < abs(paper):
        return f"Unexplained: {measured}."
    return f"Not separable from the start, if the paper's runs varied as ours: {measured}."


def _explain_by_delay(results: ReproductionResults, row: PaperRow, quantity: PaperQuantity) -> str:
    """Find the delay of the command that brings our error to the paper's."""
    paper = row.position_mse_m2 if quantity == "position" else row.orientation_mse_rad2
    delayed = [(d, study_errors(results, f"delay/{row.horizon_s:g}/{d:g}")) for d in DELAYS_S]
    known = [(d, _value(e, quantity)) for d, e in delayed if e is not None]
    if not known:
        return UNEXPLAINED
    unit = "m^2" if quantity == "position" else "rad^2"
    reached = next(((d, v) for d, v in known if not v < paper), None)
    if reached is None:
        d, most = max(known, key=lambda item: item[1])
        return f"Unexplained: delays of the command up to {known[-1][0]:g} s give at most {most:.3g} {unit} ({d:g} s)."
    before = [f"{v:.3g} {unit} at {d:g} s" for d, v in known if d < reached[0]][-1:]
    text = ", ".join([*before, f"{reached[1]:.3g} {unit} at {reached[0]:g} s"])
    return (
        f"A command delayed by the solve gives as much or more: {text} (paper: {paper:.3g}). Whether the paper's solver "
        "was that late is not known."
    )


@dataclass(frozen=True)
class Spike:
    """Largest attitude error of the target estimate after settling over its RMS, in the two-chaser mission."""

    largest_rad: float
    rms_rad: float

    @property
    def ratio(self) -> float:
        """The largest error over the RMS."""
        return self.largest_rad / self.rms_rad

    @property
    def text(self) -> str:
        """The measured values."""
        return f"largest {math.degrees(self.largest_rad):.3f} deg, {self.ratio:.1f} times the RMS"

    @property
    def verdict(self) -> str:
        """Whether there is a spike, as in the paper."""
        return "met" if self.ratio > SPIKE else "no spike, unlike the paper"


def spike_of(summary: dict[str, Any]) -> Spike | None:
    """Return the spike measure of a summary, None without an estimate or if the run ended before the paper's."""
    e = summary["target_estimate"]
    largest, rms = e["max_orientation_error_rad"], e["orientation_rms_rad"]
    whole = summary["sim_time_s"] >= PAPER_S - 1e-6
    return Spike(float(largest), float(rms)) if whole and largest and rms else None


def spikes(results: ReproductionResults) -> dict[str, Spike]:
    """Return the spike measure of the two-chaser missions by column."""
    out = {}
    for column in (CHAIN, "paper", "default"):
        summary = results.missions.get(f"mission/{column}/{TRACKING}/0")
        spike = None if summary is None else spike_of(summary)
        if spike is not None:
            out[column] = spike
    return out


def pitch_rad(time_s: float) -> float:
    """Return the pitch (Z-Y-X Euler angles in WRF) of the paper's target, which begins unrotated."""
    attitude = rotations.exp(np.multiply(Target().omega_rad_s, time_s))
    return -math.asin(float(rotations.to_matrix(attitude)[2, 0]))


def explain_spike() -> str:
    """Return how near the target's attitude comes to the Euler singularity that the paper blames."""
    times = np.arange(0.0, PAPER_S + 0.5, 0.5)
    pitch = np.abs([pitch_rad(t) for t in times])
    k = int(np.argmax(pitch))
    return (
        "The paper blames an Euler angle singularity of PnP. Unexplained: the paper's chain here uses no Euler angles "
        "(the authors' public code averages them), and from an unrotated start the target's pitch is "
        f"{math.degrees(pitch[times == 100.0][0]):.0f} deg at 100 s and at most {math.degrees(pitch[k]):.0f} deg (at "
        f"{times[k]:.0f} s), which is not singular. The paper does not state the attitude at the start."
    )
