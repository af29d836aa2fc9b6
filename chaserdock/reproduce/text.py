"""The page's prose: how things are measured, and what explains the differences."""

from __future__ import annotations

from .page import Section, Table
from .paper import PAPER_S
from .plan import Plan
from .runner import Results


def how_measured(plan: Plan, results: Results) -> Section:
    """What was flown, every definition, and what is still missing."""
    how = "chaserdock reproduce --quick" if plan.quick else "chaserdock reproduce"
    missing = sum(m.name not in results.missions for m in plan.missions)
    missing_studies = sum(c.name not in results.studies for c in plan.studies)
    parts: list[str | Table] = [
        f"Written by `{how}` (its reproduction.md). The paper is Fourlas, Viswanathan, Satpute and Nikolakopoulos, "
        "Vision Based Docking of Multiple Satellites with an Uncooperative Target (IFAC 2023).",
        "Errors. Position: mean over the run of the square of the distance between the chaser's centre and its "
        "reference pose on the true target, m^2. Orientation: the same of the angle between their attitudes, rad^2. Both "
        "are taken on ground truth at every tick, from the first. Steady: the same from "
        "20 s on. The paper says MSE and no more.",
        f"Length. The paper's runs took {PAPER_S:g} s, and so do ours here."
        if not plan.quick
        else f"Length. The paper's runs took {PAPER_S:g} s, the single-chaser runs here {plan.duration_s:g} s: what follows "
        "counts as their steady state (20 s to the end). One seed each.",
        "Start. The paper does not give it. Inferred from its figures: 0.85 m straight back from the reference pose, turned "
        "by 33 degrees (0.575 rad), at rest in the world frame. That leaves two things open. Which way: the target flies "
        "away from a chaser that waits behind it (receding: reference pose of the paper's chaser 0) and towards one that "
        "waits in front of it (closing: its chaser 3). And about which axis the chaser is turned. The inferred start is in "
        "front of the target, rolled and yawed together (rotation vector 0.42, 0, -0.3927 rad; the target is still in the "
        "image), because there both figures of the baseline come out: these two are fitted, the other rows are not. "
        "Beside it stand two starts that are rolled alone (0.575 rad about the body's X), closing and receding; further "
        "ones are in the table on the start.",
        "With images: a world process renders 1280 x 720 images, a chaser process sees the markers, a controller "
        "process estimates and plans (`chaserdock run`). Perfect knowledge: the same flight code in one process with "
        "the target's true state in place of the estimate (`chaserdock study`).",
        "Paper's settings: 30 Hz control and images, forward Euler in the prediction, u_ref = 0, no latency; weights, "
        "body, target and camera as everywhere. Our default: RK4, feed-forward, 15 Hz, 1/30 s from exposure to "
        "actuation.",
        "Least possible: the smallest position MSE of any controller under 2 N along each body axis for a chaser of 30 kg "
        "that turns as ours turned (a convex quadratic programme over the first 15 s, with zero error from then on).",
        "A run counts as failed if it does not reach its end, touches or comes nearer than d_min to anything, or has a "
        "solve without an answer (perfect knowledge). The paper does not say what it counts.",
    ]
    if missing or missing_studies:
        parts.append(
            f"NOT COMPLETE: {missing} of {len(plan.missions)} runs with images and {missing_studies} of "
            f"{len(plan.studies)} on perfect knowledge are not flown yet. The same command goes on with them."
        )
    return Section("What was flown, and how it is measured", tuple(parts))


def explained() -> Section:
    """Why rows differ from the paper's."""
    return Section(
        "What explains the differences",
        (
            "Baseline and falloff rows: the start. The mean is made in the first ten seconds, and how long these take "
            "depends on where and how fast the target flies meanwhile, and on how the chaser is turned, as its limits are "
            "those of its own axes (next table). Integration, feed-forward, latency and rate move the position figure "
            "little; weights move it more, but those the paper gives (the table after that).",
            "dt: eq. 6 sums the stage costs but counts the final cost once. A smaller dt at equal weights means more "
            "stages, so less weight on the end of the horizon, and a slower approach; with the stage weights divided alike "
            "the figure comes back (ingredients: dt = 1/30 s). The paper reports the opposite trend. Its smaller dt would "
            "need a start, or a solver, other than what it tells: from none of the three starts is its figure below "
            "the baseline's.",
            "T = 0.5: the horizon is shorter than braking takes, so the chaser oscillates about its reference and does not "
            "settle. No run fails by our count; the steady column shows what it is.",
            "T = 10: flies like the others as long as the plan is there in time; the table on real time shows from which "
            "delay on it does not, and which solvers keep up.",
            "Steady state: with u_ref = 0 the input cost pulls against the constant force that following a tumbling "
            "reference takes; the feed-forward removes that.",
        ),
    )
