# SPDX-License-Identifier: Apache-2.0
"""Evaluation of a flight on the motion of its bodies: ``summary.json``. SI units and radians; keys
as in docs/summary.md.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_protocol.recording.log import LogError
from numpy.typing import NDArray

from chaserdock.criterion import Criterion, text_table
from chaserdock.terminal import wrapped
from chaserdock.verdict import estimate_doubts, verdict_of

from .actuation import ImpulseTotals
from .columns import nanoseconds, rows_since
from .criteria import capture_of, capture_text, criteria_of, judge, reached_time, stack_rest
from .flight import (
    AssuranceHistory,
    InnovationHistory,
    RecordedFlight,
    SafetyHistory,
    SightingUse,
    load_flight,
)
from .mapping import mapping_of, mapping_text, ports_at
from .motion import TARGET, Track
from .pose_errors import (
    Verticals,
    chi_square_band,
    measured_covariance,
    pose_error,
    pose_nees,
    relative_measured_covariance,
    relative_pose,
    verticals_of,
)
from .rendezvous import rendezvous_of, rendezvous_text

SUMMARY_NAME = "summary.json"
"""Name of a flight's summary, beside its log."""
_POSE_ERRORS = ("position_m", "orientation_rad", "nees")
_BLOCK = 1 << 14  # rows processed at a time


def summarize(log: Path) -> dict[str, Any]:
    """Evaluate a log, or the folder of a run. Raise LogError for an unreadable log."""
    return summary_of_run(load_flight(log), log)


def summary_of_run(flight: RecordedFlight, log: Path) -> dict[str, Any]:
    """Evaluate a flight, and adopt what only its launcher knew: a ``run_failure`` in the
    summary.json beside the log. One of another flight (digest) counts as absent.
    """
    result = summary_of(flight)
    file = (log if log.is_dir() else log.parent) / SUMMARY_NAME
    try:
        written = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None
    except (OSError, ValueError) as error:
        raise LogError(
            f"{file}: not readable: {error}; delete it to judge the flight by its log alone"
        ) from None
    if isinstance(written, dict):
        known = cast("dict[str, Any]", written)
        if known.get("digest") == result["digest"] and known.get("run_failure"):
            add_run_failure(result, str(known["run_failure"]))
    return result


def add_run_failure(result: dict[str, Any], failure: str) -> None:
    """Add to a summary why its launcher holds the flight for failed."""
    row = Criterion(key="run", name="run", outcome="not met", note=failure)
    result |= {
        "criteria": [msgspec.to_builtins(row), *result.get("criteria", ())],
        "success": False,
        "failures": [failure, *result["failures"]],
        "run_failure": failure,
    }


def true_reference(
    flight: RecordedFlight, chaser: int, rows: slice, target: Track
) -> tuple[Array, Array]:
    """Return the reference positions (K, 3), WRF, and attitudes (K, 4) of a chaser at these rows of
    the target's motion.

    The commanded offset is placed on the *true* (or measured) target, so that estimation errors
    count as tracking errors. Before the first command it is the scenario's offset.
    """
    c = flight.scenario.chasers[chaser]
    offsets = commanded_offsets(flight, chaser, np.array(c.position_m), target.time_s[rows])
    positions = target.position_m[rows] + rotations.rotate(target.q_wxyz[rows], offsets)
    q_off = np.array(c.q_wxyz)
    if flight.scenario.approach.face_target:
        base = ports_at(flight.maps, _latency_s(flight), chaser, target.time_s[rows])[0]
        q_off = facing_attitudes(c.position_m, q_off, offsets - base)
    return positions, rotations.multiply(target.q_wxyz[rows], q_off)


def _latency_s(flight: RecordedFlight) -> float:
    """Return the age at which a map of an unknown target counts, s."""
    return flight.scenario.mapping.latency_s


def commanded_offsets(flight: RecordedFlight, chaser: int, before: Array, time_s: Array) -> Array:
    """Return the commanded offsets (K, 3), TRF, of a chaser at times (K,). ``before`` (3,): offset
    before the first command.
    """
    history = flight.references.get(chaser)
    if history is None:
        return np.broadcast_to(before, (len(time_s), 3))
    row = rows_since(nanoseconds(history.time_s), nanoseconds(time_s))
    return np.vstack([before, history.offset_m])[row + 1]


def blocks(number: int) -> Iterator[slice]:
    """Yield ``number`` rows in blocks, which bound the memory of intermediate arrays."""
    return (slice(k, min(k + _BLOCK, number)) for k in range(0, number, _BLOCK))


def led_pair(flight: RecordedFlight, chaser: int) -> tuple[Track, Track]:
    """Return the motions of a chaser and of the frame in which it is led, while it is led relative
    to the target: not in the survey of an unknown one.
    """
    own, target = flight.motion.pair(chaser)
    target = flight.estimated_frame(target)
    if not flight.scenario.maps_target:
        return own, target
    history = flight.references.get(chaser)
    led = np.zeros(len(target.time_s), dtype=np.bool_)
    for begin_s, phase in () if history is None else history.phases:
        led[target.time_s >= begin_s] = phase != "survey"
    rows = np.flatnonzero(led)
    return own.rows(rows), target.rows(rows)


def tracking_errors(flight: RecordedFlight, chaser: int) -> tuple[Array, Array, Array]:
    """Return times (K,) s, position errors (K,) m and orientation errors (K,) rad of a chaser
    relative to its true reference, without the survey of an unknown target.
    """
    own, target = led_pair(flight, chaser)
    n = len(target.time_s)
    position, angle = np.empty(n), np.empty(n)
    for rows in blocks(n):
        positions, attitudes = true_reference(flight, chaser, rows, target)
        position[rows] = np.linalg.norm(own.position_m[rows] - positions, axis=1)
        angle[rows] = rotations.angle_between(attitudes, own.q_wxyz[rows])
    return target.time_s, position, angle


def tracking_components(
    flight: RecordedFlight, chaser: int, step: int
) -> tuple[Array, Array, Array]:
    """Return times (K,) s, position errors (K, 3) m, TRF, and orientation errors (K, 3) rad, CRF,
    of every ``step``-th tick.

    Own pose relative to the true reference. The orientation error is a rotation vector.
    """
    own, target = led_pair(flight, chaser)
    rows = slice(0, len(target.time_s), step)
    positions, attitudes = true_reference(flight, chaser, rows, target)
    offset = rotations.rotate_inverse(target.q_wxyz[rows], own.position_m[rows] - positions)
    turn = rotations.log(rotations.multiply(rotations.conjugate(attitudes), own.q_wxyz[rows]))
    return target.time_s[rows], offset, turn


def known_estimates(flight: RecordedFlight) -> tuple[NDArray[np.intp], Track]:
    """Return the rows (K,) of the estimate in which the target is known and its motion, too; and
    that motion at the same times.
    """
    known = np.flatnonzero(flight.estimate_known)
    e = flight.estimate
    if TARGET not in flight.motion:
        return known[:0], e.rows(known[:0])
    rows, target = flight.motion.at(TARGET, e.time_s[known])
    return known[rows], flight.estimated_frame(target)


def estimate_errors(flight: RecordedFlight) -> dict[str, Array]:
    """Return errors of the fused estimate, each (K,): ``time_s``, ``position_m``,
    ``orientation_rad``, ``velocity_m_s``, ``omega_rad_s`` and ``nees`` (over position and
    attitude). The covariance of a measured motion is added to that of the estimate.
    """
    a, target = known_estimates(flight)
    e, up = flight.estimate, verticals_of(flight.scenario)
    errors = {name: np.empty(len(a)) for name in (*_POSE_ERRORS, "velocity_m_s", "omega_rad_s")}
    for rows in blocks(len(a)):
        i, true = a[rows], target.rows(rows)
        pose = pose_error(true.position_m, true.q_wxyz, e.position_m[i], e.q_wxyz[i])
        covariance = flight.pose_covariance(i) + measured_covariance(true)
        _store_pose_errors(errors, rows, pose, covariance, up and up[0])
        errors["velocity_m_s"][rows] = np.linalg.norm(true.velocity_m_s - e.velocity_m_s[i], axis=1)
        errors["omega_rad_s"][rows] = np.linalg.norm(true.omega_rad_s - e.omega_rad_s[i], axis=1)
    return {"time_s": e.time_s[a], **errors}


def relative_errors(flight: RecordedFlight, chaser: int) -> dict[str, Array]:
    """Return errors of a chaser's estimated pose relative to the target, each (K,): ``time_s``,
    ``position_m``, ``orientation_rad``, ``nees``.

    There are no rows where the motion of one of them is not known, or if the estimator does not
    publish that pose.
    """
    history = flight.relative.get(chaser)
    if history is None or not flight.motion.has_pair(chaser):
        return {name: np.zeros(0) for name in ("time_s", *_POSE_ERRORS)}
    a, target = flight.motion.at(TARGET, history.time_s)
    both, own = flight.motion.at(f"chaser/{chaser}", target.time_s)
    a, target = a[both], flight.estimated_frame(target.rows(both))
    errors, up = {name: np.empty(len(a)) for name in _POSE_ERRORS}, verticals_of(flight.scenario)
    for rows in blocks(len(a)):
        i, mine, its = a[rows], own.rows(rows), target.rows(rows)
        true = relative_pose(mine.position_m, mine.q_wxyz, its.position_m, its.q_wxyz)
        pose = pose_error(*true, history.position_m[i], history.q_wxyz[i])
        covariance = history.covariance(i) + relative_measured_covariance(mine, its)
        _store_pose_errors(errors, rows, pose, covariance, up and up[1])
    return {"time_s": history.time_s[a], **errors}


def _store_pose_errors(
    errors: dict[str, Array],
    rows: slice,
    pose: Array,
    covariance: Array,
    verticals: Verticals | None,
) -> None:
    """Store the quantities of ``_POSE_ERRORS`` in these rows, computed from pose errors (K, 6) with
    covariances (K, 6, 6). ``verticals``: see ``pose_nees``.
    """
    errors["position_m"][rows] = np.linalg.norm(pose[:, :3], axis=1)
    errors["orientation_rad"][rows] = np.linalg.norm(pose[:, 3:], axis=1)
    errors["nees"][rows] = pose_nees(pose, covariance, verticals)


def _pose_figures(errors: dict[str, Array], from_s: float) -> dict[str, float | None]:
    """Return RMS, largest value and mean NEES of pose errors since ``from_s``; None for an empty
    part.
    """
    late = errors["time_s"] >= from_s
    position, angle, nees = (errors[name][late] for name in _POSE_ERRORS)
    return {
        "position_rms_m": _rms(position),
        "orientation_rms_rad": _rms(angle),
        "max_position_error_m": _greatest(position),
        "max_orientation_error_rad": _greatest(angle),
        "nees_mean": float(np.mean(nees)) if len(nees) else None,
    }


def _rms(x: Array) -> float | None:
    """Return the RMS; None without values, or where a reference measures none."""
    return float(np.sqrt(np.mean(x * x))) if len(x) and np.isfinite(x).all() else None


def _mean_square(x: Array) -> float | None:
    return float(np.mean(x * x)) if len(x) else None


def _least(x: Array) -> float | None:
    return float(np.min(x)) if len(x) else None


def _greatest(x: Array) -> float | None:
    return float(np.max(x)) if len(x) else None


def _time_of_greatest(x: Array, time_s: Array) -> float | None:
    return float(time_s[np.argmax(x)]) if len(x) else None


def _percentiles(x: Array, names: dict[str, float]) -> dict[str, float | None]:
    out: dict[str, float | None] = {
        n: float(np.percentile(x, p)) if len(x) else None for n, p in names.items()
    }
    return out | {"max": _greatest(x)}


def dock_time(flight: RecordedFlight, chaser: int) -> float | None:
    """Return the time (s) since which a chaser stays within the docking tolerances; None if it is
    not docked.

    Docked: the reference is at the docking distance from the target's centre, or before the chosen
    port of an unknown target, and at the end the chaser has been within the
    scenario's position and angle tolerances of it for at least ``docked_time_s``.
    """
    approach = flight.scenario.approach
    time_s, position, angle = tracking_errors(flight, chaser)
    offsets = commanded_offsets(flight, chaser, np.full(3, math.inf), time_s)
    at, axis = ports_at(flight.maps, _latency_s(flight), chaser, time_s)
    if axis.any():
        docked = at + approach.dock_distance_m * axis
        missing = np.linalg.norm(offsets - docked, axis=1)
        reached = axis.any(axis=1) & (missing < approach.docked_position_m)
    else:
        away = np.linalg.norm(offsets, axis=1)
        reached = np.abs(away - approach.dock_distance_m) < 1e-6
    limit = math.radians(approach.docked_angle_deg)
    inside = reached & (position <= approach.docked_position_m) & (angle <= limit)
    if not len(inside) or not inside[-1]:
        return None
    outside = np.flatnonzero(~inside)
    since = time_s[outside[-1] + 1] if len(outside) else time_s[0]
    return float(since) if time_s[-1] - since >= approach.docked_time_s else None


def _unanswered(flight: RecordedFlight) -> int:
    """Return the number of expected commands that never arrived (0 in lock-step)."""
    return max(
        0,
        flight.expected_commands
        - sum(n for key, n in flight.counts.items() if key.endswith("/actuators")),
    )


def summary_of(flight: RecordedFlight) -> dict[str, Any]:
    """Evaluate a flight; return plain values for JSON."""
    s = flight.scenario
    chasers: dict[str, dict[str, Any]] = {}

    for i in flight.chasers:
        impulses = flight.impulses.get(i, ImpulseTotals())
        chasers[str(i)] = {
            **_of_poses(flight, i),
            "impulse_N_s": impulses.absolute_N_s,
            "thruster_impulse_N_s": impulses.thrusters_N_s,
            "propellant_kg": impulses.propellant_kg,
        }
        if flight.motion.source != "truth":
            chasers[str(i)] |= _of_estimates(flight, i)

        relative = _pose_figures(relative_errors(flight, i), s.settling_s)
        if relative["nees_mean"] is not None:
            chasers[str(i)]["relative_estimate"] = relative
        if (capture := capture_of(flight, i)) is not None:
            chasers[str(i)]["capture"] = capture
        if i in flight.shown and (found := rendezvous_of(flight, i)) is not None:
            chasers[str(i)]["rendezvous"] = found
        if i in flight.innovations:
            chasers[str(i)]["innovations"] = _innovations(flight.innovations[i], s.settling_s)
        if i in flight.safety:
            chasers[str(i)]["passive_safety"] = _passive_safety(flight.safety[i])
        if i in flight.assurance:
            chasers[str(i)]["assurance"] = _assurance(flight.assurance[i])

    motion = flight.motion
    apart = (
        motion[f"chaser/{i}"].distance_to(motion[f"chaser/{j}"])[1]
        for i, j in combinations(motion.chasers, 2)
    )
    between = [float(distance_m.min()) for distance_m in apart if len(distance_m)]

    errors = estimate_errors(flight)
    late = errors["time_s"] >= s.settling_s
    in_truth = flight.world.ticks > 0

    result: dict[str, Any] = {
        "scenario": s.name,
        "seed": s.seed,
        "mode": flight.run.get("mode", ""),
        "ticks": flight.ticks,
        "sim_time_s": flight.flown_s,
        "wall_time_s": flight.wall_time_s,
        "success": False,
        "failures": [],
        "not_judged": [],
        "doubts": [],
        "ended": _ended(flight),
        "log_lacks": flight.missing,
        "judged_against": flight.motion.describe(),
        "impulses_are": flight.impulses_are,
        "events": _events(flight),
        "chasers": chasers,
        "min_distance_chasers_m": min(between) if between else None,
        "collisions": flight.world.contacts if in_truth else None,
        "target_estimate": {
            **_pose_figures(errors, s.settling_s),
            "velocity_rms_m_s": _rms(errors["velocity_m_s"][late]),
            "omega_rms_rad_s": _rms(errors["omega_rad_s"][late]),
            "max_orientation_error_at_s": _time_of_greatest(
                errors["orientation_rad"][late], errors["time_s"][late]
            ),
        },
        "latency_s": _percentiles(flight.latency_s, {"p50": 50, "p99": 99}),
        "late_commands": flight.world.late_commands if in_truth else None,
        "unanswered": _unanswered(flight),
        "solver": {
            "name": flight.solves.name or s.controller.solver,
            "solve_s": _percentiles(flight.solves.wall_s, {"p50": 50, "p95": 95}),
            "failures": flight.solves.statuses["failed"],
            "relaxed": flight.solves.statuses["infeasible_relaxed"],
        },
        "drawn": [msgspec.to_builtins(body) for body in flight.drawn],
        "messages": _messages(flight),
        "rejected": flight.rejected,
        "digest": flight.digest,
    }

    if (mapping := mapping_of(flight.maps, motion.get(TARGET))) is not None:
        result["mapping"] = mapping
    if flight.plumes:
        result["plumes"] = {body: asdict(totals) for body, totals in sorted(flight.plumes.items())}
    if (stack := stack_rest(flight)) is not None:
        result["stack"] = stack

    judged, result["not_judged"] = criteria_of(flight)
    stated = flight.scenario if flight.states_criteria else judged
    rows = judge(result, stated, result["not_judged"])
    result["criteria"] = msgspec.to_builtins(rows)
    result["failures"] = [row.failure for row in rows if row.outcome == "not met"]
    result["success"] = not result["failures"]
    result["doubts"] = estimate_doubts(result)
    return result


def _of_poses(flight: RecordedFlight, chaser: int) -> dict[str, Any]:
    """Return what is measured on the motion of a chaser and of the target; None for each figure
    where one is not known.
    """
    s = flight.scenario
    steady_until = s.steady_until_s or s.duration_s
    if not flight.motion.has_pair(chaser):
        nothing = dict.fromkeys(("position_mse_m2", "orientation_mse_rad2"))
        others = ("docked", "dock_time_s", "reached_time_s", "min_distance_target_m")
        return {**nothing, "steady": nothing, **dict.fromkeys(others)}
    time_s, position, angle = tracking_errors(flight, chaser)
    steady = (time_s >= s.settling_s) & (time_s < steady_until)
    docked_s = dock_time(flight, chaser)
    own, target = flight.motion.pair(chaser)
    return {
        "position_mse_m2": _mean_square(position),
        "orientation_mse_rad2": _mean_square(angle),
        "steady": {
            "position_mse_m2": _mean_square(position[steady]),
            "orientation_mse_rad2": _mean_square(angle[steady]),
        },
        "docked": docked_s is not None,
        "dock_time_s": docked_s,
        "reached_time_s": reached_time(flight, chaser),
        "min_distance_target_m": _least(own.distance_to(target)[1]),
    }


def _of_estimates(flight: RecordedFlight, chaser: int) -> dict[str, Any]:
    """Return what a log without ground truth shows by the flight's own estimates: tracking errors
    of the odometry from the reference pose on the estimated target, since ``settling_s``, and how
    many sightings the estimator used and rejected.
    """
    s, use = flight.scenario, flight.sighting_use.get(chaser, SightingUse())
    errors = flight.estimated_errors.get(chaser, np.zeros((0, 3)))
    steady = errors[
        (errors[:, 0] >= s.settling_s) & (errors[:, 0] < (s.steady_until_s or s.duration_s))
    ]
    return {
        "estimated_tracking": {
            "position_rms_m": _rms(steady[:, 1]),
            "orientation_rms_rad": _rms(steady[:, 2]),
        },
        "sightings": {"used": use.used, "rejected": use.rejected},
    }


def _innovations(history: InnovationHistory, from_s: float) -> dict[str, Any]:
    """Return what the innovations of a chaser's sightings since ``from_s`` show; None for an empty
    part.
    """
    late = history.time_s >= from_s
    squared, freedoms, used = history.squared[late], history.freedoms[late], history.used[late]
    _, above = chi_square_band(freedoms)
    return {
        "used": int(used.sum()),
        "rejected": int((~used).sum()),
        "mean_per_freedom": _share(squared[used].sum(), freedoms[used].sum()),
        "rejected_mean_per_freedom": _share(squared[~used].sum(), freedoms[~used].sum()),
        "above_share": _share((squared > above).sum(), len(squared)),
    }


def _share(part: float, whole: float) -> float | None:
    return float(part / whole) if whole else None


def _ended(flight: RecordedFlight) -> str:
    """Return why the flight ended, and when."""
    if flight.end is None:
        return f"not known: the log ends before the mission does, at {flight.flown_s:.2f} s"
    early = "" if flight.end.complete else "early, "
    return f"{early}{flight.end.reason} at {flight.end.sim_time_ns / 1e9:.2f} s"


def _passive_safety(history: SafetyHistory) -> dict[str, float]:
    worst = int(np.argmin(history.margin_sigmas))
    return {
        "min_margin_sigmas": float(history.margin_sigmas[worst]),
        "min_margin_time_s": float(history.time_s[worst]),
        "distance_m": float(history.distance_m[worst]),
        "safe_share": float(np.mean(history.safe)),
    }


def _assurance(history: AssuranceHistory) -> dict[str, Any]:
    known = history.room_m[np.isfinite(history.room_m)]
    return {
        "changed": int(history.changed.sum()),
        "backup": int(history.backup.sum()),
        "hazards": dict(sorted(history.hazards.items())),
        "least_room_m": float(known.min()) if len(known) else None,
    }


def _events(flight: RecordedFlight) -> list[dict[str, Any]]:
    events = [(e.sim_time_ns, f"{e.process}: {e.what} {e.detail}".strip()) for e in flight.events]
    for r in flight.replies:
        outcome = "accepted" if r.accepted else "refused"
        events.append(
            (r.sim_time_ns, f"command {r.command} chaser {r.chaser}: {outcome}: {r.reason}")
        )
    return [{"time_s": t / 1e9, "what": what} for t, what in sorted(events)]


def _messages(flight: RecordedFlight) -> dict[str, dict[str, int]]:
    out: dict[str, dict[str, int]] = defaultdict(lambda: {"count": 0, "lost": 0})
    for key, count in flight.counts.items():
        out[key] = {"count": count, "lost": flight.lost.get(key, 0)}
    return dict(out)


def text_of(result: dict[str, Any]) -> str:
    """Format the summary as lines of text that fit a terminal: verdict, criteria, chasers."""
    verdict, wall_s = verdict_of(result), result["wall_time_s"]
    speed = (
        f" in {wall_s:.1f} s ({result['sim_time_s'] / wall_s:.2f} x real time)" if wall_s else ""
    )
    lines = [
        f"{result['scenario']}: {verdict.headline}; "
        f"{result['sim_time_s']:.1f} s flown{speed}, digest {result['digest'][:16]}"
    ]
    lines += [f"  {line}" for line in verdict.lines_beside_table()]
    if result["judged_against"] != "ground truth":
        lines.append(f"  judged against {result['judged_against']}")
    head, lines = lines, []
    for i, c in result["chasers"].items():
        lines.append(_chaser_text(i, c))
    estimate = result["target_estimate"]
    if estimate["position_rms_m"] is not None:
        lines.append(
            f"  target estimate: RMS {estimate['position_rms_m'] * 1e3:.2f} mm, "
            f"{math.degrees(estimate['orientation_rms_rad']):.3f}°; largest error "
            f"{estimate['max_position_error_m'] * 1e3:.2f} mm, "
            f"{math.degrees(estimate['max_orientation_error_rad']):.3f}°; mean NEES "
            f"{estimate['nees_mean']:.2f} of 6"
        )
    if "mapping" in result:
        lines.append(mapping_text(result["mapping"]))
    if result["mode"] == "realtime" and result["latency_s"]["p50"] is not None:
        latency = result["latency_s"]
        late = "?" if result["late_commands"] is None else result["late_commands"]
        lines.append(
            f"  exposure to command: median {latency['p50'] * 1e3:.1f} ms, p99 "
            f"{latency['p99'] * 1e3:.1f} ms; "
            f"{late} commands late, {result['unanswered']} missing"
        )
    return "\n".join([*wrapped(head), *text_table(verdict.criteria), *wrapped(lines)])


def print_summary(result: dict[str, Any]) -> None:
    """Print the summary as text, in colour on a terminal: what failed, what was not judged."""
    from rich.console import Console
    from rich.text import Text

    text = Text(text_of(result))
    text.highlight_words(["FAILED", "not met", "not met:"], "bold red")
    text.highlight_words(["not judged", "success, but"], "yellow")
    text.highlight_regex(r"(?m)^  met(?= )|: success;", "green")
    Console(soft_wrap=True, highlight=False).print(text)


def _chaser_text(i: str, c: dict[str, Any]) -> str:
    """Format what a summary says of a chaser as a line."""
    steady, line = c["steady"], f"  chaser {i}: "
    if steady["position_mse_m2"] is not None:
        line += (
            f"steady RMS {math.sqrt(steady['position_mse_m2']) * 1e3:.2f} mm, "
            f"{math.degrees(math.sqrt(steady['orientation_mse_rad2'])):.3f}°; "
        )
    if (nearest := c["min_distance_target_m"]) is not None:
        line += f"closest to the target {nearest:.3f} m"
    if "estimated_tracking" in c:
        line += _estimates_text(c)
    if c["propellant_kg"] > 0.0:
        line += f"; propellant {c['propellant_kg'] * 1e3:.1f} g"
    if c["docked"]:
        line += f"; in its docking pose since {c['dock_time_s']:.1f} s"
    if (relative := c.get("relative_estimate")) is not None:
        line += (
            f"; estimated relative to it within {relative['position_rms_m'] * 1e3:.2f} mm, "
            f"{math.degrees(relative['orientation_rms_rad']):.3f}° RMS"
        )
    line += innovations_text(c.get("innovations")) + assurance_text(c.get("assurance"))
    if "capture" in c:
        line += capture_text(c["capture"])
    if "rendezvous" in c:
        line += rendezvous_text(c["rendezvous"])
    return line


def innovations_text(found: dict[str, Any] | None) -> str:
    """Describe the innovations of a chaser's sightings as part of a line."""
    if found is None or found["above_share"] is None:
        return ""
    mean = found["mean_per_freedom"]
    used = "" if mean is None else f"mean NIS {mean:.2f} per degree of freedom, "
    return f"; {used}{100.0 * found['above_share']:.1f} % above the 95 % band"


def assurance_text(found: dict[str, Any] | None) -> str:
    """Describe what a chaser's assurance changed as part of a line."""
    if found is None or not found["changed"]:
        return ""
    hazards = ", ".join(found["hazards"])
    return f"; {found['changed']} commands changed, {found['backup']} by the backup: {hazards}"


def _estimates_text(c: dict[str, Any]) -> str:
    """Describe what a log without ground truth shows of a chaser, as part of a line."""
    e, use = c["estimated_tracking"], c["sightings"]
    text = "" if c["min_distance_target_m"] is None else "; "
    if e["position_rms_m"] is not None:
        text += (
            f"estimated steady RMS {e['position_rms_m'] * 1e3:.2f} mm, "
            f"{math.degrees(e['orientation_rms_rad']):.3f}°; "
        )
    return f"{text}{use['rejected']} of {use['used'] + use['rejected']} sightings rejected"
