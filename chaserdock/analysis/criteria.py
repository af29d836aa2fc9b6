# SPDX-License-Identifier: Apache-2.0
"""Success criteria of a recorded flight, evaluated on the motion of its bodies: which can be
judged; docking and goals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.mission import Success
from msgspec import structs

from chaserdock.criterion import Criterion, criterion

from .flight import LoadHistory, RecordedFlight, SensedDocking
from .mapping import mapping_criteria
from .motion import TARGET
from .rendezvous import rendezvous_criteria
from .stack import stack_motion

_CONTACT_SLACK_M = 0.02
"""Distance (m) by which a chaser in contact may be closer than a latched one, because it tilts and
its probe is sprung. Larger: a wrong penetration passes; smaller: contacts fail.
"""
_VERIFIED = ("verified", "identify", "detumble", "stack_hold")
"""Phases of a chaser whose latch has passed its test."""


def capture_of(flight: RecordedFlight, chaser: int) -> dict[str, Any] | None:
    """Return the capture of a chaser as plain values for JSON; None for a chaser without a port.

    ``latched``: at the end. ``latch_time_s`` and the contact values belong to the touch that closed
    the latch.
    """
    if flight.scenario.docking.port_of(chaser) is None:
        return None
    reference, loads = flight.references.get(chaser), flight.loads.get(chaser)
    verified = reference is not None and reference.phases[-1][1] in _VERIFIED
    if not flight.world.ticks:
        return _sensed_capture(flight.sensed_docking.get(chaser, SensedDocking()), verified)
    touches = [t for t in flight.world.touches if t.chaser == chaser]
    latching = [t for t in touches if t.latched]
    last = latching[-1] if latching else None
    return {
        "latched": chaser in flight.world.latched,
        "verified": verified,
        "latch_time_s": None if last is None else last.sim_time_ns / 1e9,
        "contact_lateral_m": None if last is None else last.lateral_m,
        "contact_angle_rad": None if last is None else last.angle_rad,
        "contact_closing_m_s": None if last is None else last.closing_m_s,
        "contact_lateral_speed_m_s": None if last is None else last.lateral_speed_m_s,
        "probe_touches": len(touches),
        "refused": [t.refused for t in touches if not t.latched],
        "port_load": None if loads is None else port_load_of(loads, flight.scenario, chaser),
    }


def _sensed_capture(sensed: SensedDocking, verified: bool) -> dict[str, Any]:
    """Return the capture as the docking sensor alone shows it, which measures no offset."""
    return {
        "latched": sensed.latched,
        "verified": verified,
        "latch_time_s": sensed.latch_time_s,
        "contact_lateral_m": None,
        "contact_angle_rad": None,
        "contact_closing_m_s": None,
        "contact_lateral_speed_m_s": None,
        "probe_touches": sensed.contacts,
        "refused": [],
        "port_load": None,
    }


def port_load_of(loads: LoadHistory, s: Scenario, chaser: int) -> dict[str, float | None]:
    """Return the largest loads at a chaser's port, and when a limit was first exceeded, as plain
    values for JSON.
    """
    beyond = np.zeros(len(loads.time_s), dtype=bool)
    for quantity, limit, _ in _load_limits(s, chaser):
        beyond |= loads.of(quantity) > limit
    first = np.flatnonzero(beyond)
    return {
        **loads.peaks(),
        "limit_exceeded_s": float(loads.time_s[first[0]]) if len(first) else None,
    }


def _load_limits(s: Scenario, chaser: int) -> list[tuple[str, float, str]]:
    """Return quantity, limit and unit of the load limits of a chaser's port."""
    port = s.docking.port_of(chaser)
    if port is None:
        return []
    limits = (
        ("peak_force_N", port.force_limit_N, "N"),
        ("peak_torque_N_m", port.torque_limit_N_m, "N m"),
    )
    return [(quantity, limit, unit) for quantity, limit, unit in limits if limit is not None]


def _loads(result: dict[str, Any], s: Scenario) -> Iterator[Criterion]:
    """Yield the load limits of the ports; a load that is not in the log violates its limit."""
    for i, c in result["chasers"].items() if result["collisions"] is not None else ():
        for quantity, limit, unit in _load_limits(s, int(i)):
            load, what = c["capture"]["port_load"], quantity.split("_")[1]
            value, note = None if load is None else load[quantity], ""
            if load is not None and load[quantity] > limit:
                note = f"exceeded from {load['limit_exceeded_s']:.2f} s on"
            yield criterion(
                "loads on the ports", f"{what} on the port", value, limit, unit, int(i), note=note
            )


def nearest_allowed_m(s: Scenario, chaser: int) -> float:
    """Return the smallest allowed distance of a chaser from the target's centre. With a port it is
    smaller; with one chosen in flight, on a face turned away from the centre, that to the port.
    """
    port, limit = s.docking.port_of(chaser), s.limits.min_distance_target_m
    if s.chooses_port(chaser):
        return min(limit, s.approach.dock_distance_m - s.approach.docked_position_m)
    if port is None:
        return limit
    latched_m = float(np.linalg.norm(centre_offset(port, s.chaser.probe_reach_m, 0.0)))
    return min(limit, latched_m - _CONTACT_SLACK_M)


def _captures(result: dict[str, Any], s: Scenario) -> Iterator[Criterion]:
    """Yield ``success.latched`` for each of its chasers."""
    for i in s.success.latched:
        capture = result["chasers"].get(str(i), {}).get("capture") or {}
        latched, verified = capture.get("latched", False), capture.get("verified", False)
        note = ""
        if not latched and capture.get("refused"):
            note = f"last rejected touch: {capture['refused'][-1]}"
        elif latched and not verified:
            note = "latched, but not verified by a pull test"
        yield criterion(
            "latched",
            "latched and verified",
            capture["latch_time_s"] if latched else None,
            result["sim_time_s"],
            "s",
            i,
            note=note,
            met=latched and verified,
        )


def capture_state(capture: dict[str, Any]) -> str:
    """Return the state of a capture at the end of the flight in one or two words."""
    if capture["latch_time_s"] is None and not capture["latched"]:
        return "never latched"
    return "verified" if capture["verified"] else "latched" if capture["latched"] else "released"


def capture_text(capture: dict[str, Any]) -> str:
    """Describe a capture as part of a line."""
    if capture["latch_time_s"] is None:
        return f"; {capture_state(capture)}"
    if capture["contact_lateral_m"] is None:
        return f"; {capture_state(capture)}, latched at {capture['latch_time_s']:.1f} s"
    return (
        f"; {capture_state(capture)}, latched at {capture['latch_time_s']:.1f} s: "
        f"{capture['contact_lateral_m'] * 1e3:.2f} mm and "
        f"{np.degrees(capture['contact_angle_rad']):.2f}° off, closing at "
        f"{capture['contact_closing_m_s'] * 1e3:.1f} mm/s"
    )


def stack_rest(flight: RecordedFlight) -> dict[str, float | None] | None:
    """Return the final rates of the target with the chasers latched then; None if the scenario does
    not judge them.

    ``since_s``: simulated time since which both were within ``success.detumbled``; None if they are
    not at the end.
    """
    limits = flight.scenario.success.detumbled
    stack = None if limits is None else stack_motion(flight, dict.fromkeys(flight.latched))
    if limits is None or stack is None:
        return None
    speed, rate, n = stack.speed_m_s, stack.rate_rad_s, len(stack.time_s)
    outside = np.flatnonzero((speed > limits.speed_m_s) | (rate > np.radians(limits.rate_deg_s)))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return {
        "speed_m_s": float(speed[-1]),
        "rate_rad_s": float(rate[-1]),
        "since_s": float(stack.time_s[first]) if first < n else None,
    }


def _rest(result: dict[str, Any], s: Scenario) -> Iterator[Criterion]:
    """Yield ``success.detumbled``."""
    limits, stack = s.success.detumbled, result.get("stack")
    if limits is None:
        return
    values, note = (None, None), "the motion of the stack is not in the log"
    if stack is not None:
        values = (stack["speed_m_s"] * 1e3, math.degrees(stack["rate_rad_s"]))
        since_s = stack["since_s"]
        note = "" if since_s is None else f"both within their limits since {since_s:.2f} s"
    yield criterion(
        "detumbled", "speed of the stack", values[0], limits.speed_m_s * 1e3, "mm/s", note=note
    )
    yield criterion("detumbled", "rate of the stack", values[1], limits.rate_deg_s, "°/s")


def reached_time(flight: RecordedFlight, chaser: int) -> float | None:
    """Return the simulated time (s) since which a chaser stays at the goal of its last ``goto``;
    None if it does not.

    The goal is the scenario's, placed on the true (measured) target. A chaser without a ``goto`` in
    the timeline has none.
    """
    goal, success = flight.scenario.goal_of(chaser), flight.scenario.success
    if goal is None:
        return None
    start_s, offset_m = goal
    own, target = flight.motion.pair(chaser)
    target = flight.estimated_frame(target)
    goal_m = target.position_m + rotations.rotate(target.q_wxyz, np.array(offset_m))
    away = np.linalg.norm(own.position_m - goal_m, axis=1) > success.reached_position_m
    outside = np.flatnonzero(away | (target.time_s < start_s))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return float(target.time_s[first]) if first < len(away) else None


def _poses(result: dict[str, Any], s: Scenario) -> Iterator[Criterion]:
    """Yield the criteria on the motion of each chaser that is known."""
    success, end_s = s.success, result["sim_time_s"]
    for number, c in result["chasers"].items():
        i = int(number)
        if (distance := c["min_distance_target_m"]) is None:
            continue
        if success.keep_distances:
            limit_m = nearest_allowed_m(s, i)
            yield criterion(
                "keep_distances", "distance to target", distance, limit_m, "m", i, "at least"
            )
        if i in success.docked:
            held_s = s.approach.docked_time_s
            yield criterion(
                "docked",
                "docking pose since",
                c["dock_time_s"],
                end_s - held_s,
                "s",
                i,
                note=f"to the end; the controller reports docked after {held_s:g} s in the pose",
                met=c["docked"],
            )
        if i in success.reached and (goal := s.goal_of(i)) is not None:
            within_s = success.reached_within_s
            yield criterion(
                "reached",
                "at its goal since",
                c["reached_time_s"],
                end_s if within_s is None else goal[0] + within_s,
                "s",
                i,
                note=f"to the end, within {success.reached_position_m * 1e3:g} mm",
            )
        errors = (c["steady"][k] for k in ("position_mse_m2", "orientation_mse_rad2"))
        position, angle = (None if e is None else math.sqrt(e) for e in errors)
        yield from _pose_limits(
            "steady_{}_rms", "steady {} RMS", position, angle, success, chaser=i
        )


def _pose_limits(
    key: str,
    name: str,
    position_m: float | None,
    angle_rad: float | None,
    success: Success,
    chaser: int | None,
) -> Iterator[Criterion]:
    """Yield the limits of a pose error that the scenario states. ``key``, ``name``: with braces for
    position or orientation.
    """
    for what, key_unit, value, factor, unit in (
        ("position", "m", position_m, 1e3, "mm"),
        ("orientation", "deg", None if angle_rad is None else math.degrees(angle_rad), 1.0, "°"),
    ):
        found = f"{key.format(what)}_{key_unit}"
        if (limit := getattr(success, found)) is not None:
            measured = None if value is None else value * factor
            yield criterion(found, name.format(what), measured, limit * factor, unit, chaser)


def _estimates(result: dict[str, Any], s: Scenario) -> Iterator[Criterion]:
    """Yield the limits of the estimated poses relative to the target.

    An estimator that publishes none treats the odometry of the chasers as exact, and is judged by
    the target's pose.
    """
    relative = {
        int(i): c["relative_estimate"]
        for i, c in result["chasers"].items()
        if "relative_estimate" in c
    }
    for i, e in (relative or {None: result["target_estimate"]}).items():
        errors = e["max_position_error_m"], e["max_orientation_error_rad"]
        yield from _pose_limits("max_estimate_{}", "{} estimate", *errors, s.success, chaser=i)


def _flight(result: dict[str, Any], s: Scenario) -> Iterator[Criterion]:
    """Yield the criteria on the flight as a whole."""
    flown_s = result["sim_time_s"]
    yield criterion(
        "duration_s",
        "flown",
        flown_s,
        s.duration_s,
        "s",
        side="at least",
        note="" if flown_s >= s.duration_s else result["ended"],
        met=flown_s >= s.duration_s - 1.0 / s.time.rate_hz,
    )
    if (hits := result["collisions"]) is not None:
        yield criterion("collisions", "collisions", hits, 0, "")
    nearest = result["min_distance_chasers_m"]
    if s.success.keep_distances and nearest is not None:
        limit_m = s.limits.min_distance_chasers_m
        yield criterion("keep_distances", "between chasers", nearest, limit_m, "m", side="at least")


_PARTS = (
    _flight,
    _poses,
    _captures,
    _loads,
    _rest,
    rendezvous_criteria,
    mapping_criteria,
    _estimates,
)


def judge(result: dict[str, Any], s: Scenario, skipped: Sequence[str] = ()) -> list[Criterion]:
    """Judge a summary by the criteria of its scenario. ``skipped``: see ``criteria_of``; each is a
    row, which states its limit if the scenario has it.
    """
    parts = (line.partition(": ") for line in skipped)
    reasons = {what: why for what, _, why in parts}
    rows, used = list[Criterion](), set[str]()
    for row in (row for part in _PARTS for row in part(result, s)):
        keys = (f"success.{row.key}, chaser {row.chaser}", f"success.{row.key}", row.key)
        key = next((key for key in keys if key in reasons), None)
        if key is not None:
            used.add(key)
            row = structs.replace(row, outcome="not judged", measured=None, note=reasons[key])
            if row.unit == "s":  # the end of a flight that is too short
                row = structs.replace(row, limit=None)
        rows.append(row)
    for what, why in reasons.items():
        if what not in used:
            name, _, chaser = what.removeprefix("success.").partition(", chaser ")
            name, i = name.replace("_", " "), int(chaser) if chaser.isdigit() else None
            rows.append(Criterion(key=what, name=name, outcome="not judged", chaser=i, note=why))
    return rows


_OF_POSES = (
    "docked",
    "reached",
    "detumbled",
    "speed_limit",
    "approach_cone",
    "arrival",
    "abort_clear_m",
    "keep_distances",
    "steady_position_rms_m",
    "steady_orientation_rms_deg",
    "max_estimate_position_m",
    "max_estimate_orientation_deg",
)
_OF_RATES = ("detumbled", "speed_limit", "arrival")
_AT_THE_END = ("docked", "reached", "detumbled")
"""Criteria on poses of the bodies, those that need their velocities, too, and those on the end."""


def criteria_of(flight: RecordedFlight) -> tuple[Scenario, list[str]]:
    """Return the scenario with the success criteria that the log allows to judge, and a line for
    each other one. Such criteria are neither met nor violated.
    """
    if not flight.states_criteria:
        none = flight.scenario.model_copy(update={"success": Success(keep_distances=False)})
        return none, ["success: the log holds the flight scenario, which states no criteria"]
    scenario, skipped = judged_criteria(flight.scenario)
    motion, success, absent = flight.motion, scenario.success, {}
    if TARGET not in motion or not any(motion.has_pair(i) for i in flight.chasers):
        body = "a chaser" if TARGET in motion else "the target"
        why = f"the log has neither ground truth nor a reference of {body}"
        absent = dict.fromkeys(_OF_POSES, why)
    elif not motion.has_rates():
        absent = dict.fromkeys(_OF_RATES, "the reference does not measure velocities and rates")
    jumps = motion.reference_jumps()
    if any(jump.until_s is None for jump in jumps):
        absent |= dict.fromkeys(_AT_THE_END, "the reference jumped, and did not come back")
    absent = {name: why for name, why in absent.items() if getattr(success, name)}
    skipped += [f"success.{name}: {why}" for name, why in absent.items()]
    unknown = Success(keep_distances=False)
    success = success.model_copy(update={name: getattr(unknown, name) for name in absent})
    skipped += map(str, jumps)
    skipped += _without_truth(flight)
    return scenario.model_copy(update={"success": success}), skipped


def _without_truth(flight: RecordedFlight) -> Iterator[str]:
    """Yield a line for each criterion of every mission that needs the world's ground truth, and for
    each chaser without a motion beside others.
    """
    if not flight.world.ticks:
        yield "collisions: the log has no ground truth of contacts"
        if any(_load_limits(flight.scenario, i) for i in flight.chasers):
            yield "loads on the ports: the log has no ground truth of them"
    shown = flight.shown
    for i in flight.chasers if shown else ():
        if i not in shown:
            yield f"chaser {i}, criteria on its pose: the log has no reference of it"


def judged_criteria(scenario: Scenario) -> tuple[Scenario, list[str]]:
    """Return the scenario with the success criteria that its duration allows to judge, and a line
    for each other one.

    A scenario shortened by an override can end before the part of the flight that a criterion is
    about. That part begins at ``settling_s`` (tracking and estimation errors), or when the timeline
    commands the approach or the ``goto`` of a chaser (``docked``, ``latched``, ``reached``,
    ``arrival``) or the first ``detumble``. Such criteria are neither met nor violated.
    """
    success, changes, skipped = scenario.success, {}, []
    end_s = min(scenario.steady_until_s or scenario.duration_s, scenario.duration_s)

    for name, from_s, until_s in (
        ("steady_position_rms_m", scenario.settling_s, end_s),
        ("steady_orientation_rms_deg", scenario.settling_s, end_s),
        ("max_estimate_position_m", scenario.settling_s, scenario.duration_s),
        ("max_estimate_orientation_deg", scenario.settling_s, scenario.duration_s),
    ):
        if getattr(success, name) is not None and from_s >= until_s:
            changes[name] = None
            skipped.append(
                f"success.{name}: the flight ends at {until_s:g} s, settling_s is {from_s:g} s"
            )

    for name, command in (("docked", "approach"), ("latched", "approach"), ("reached", "goto")):
        late = {
            i: first_s
            for i in getattr(success, name)
            if (first_s := _first_command_s(scenario, command, i)) is not None
            and first_s >= scenario.duration_s
        }
        if late:
            changes[name] = tuple(i for i in getattr(success, name) if i not in late)
            skipped += [
                f"success.{name}, chaser {i}: the flight ends at {scenario.duration_s:g} s, "
                f"its {command} is at {first_s:g} s"
                for i, first_s in late.items()
            ]

    if late := _late_arrivals(scenario):
        assert success.arrival is not None
        left = tuple(i for i in success.arrival.chasers if i not in late)
        changes["arrival"] = success.arrival.model_copy(update={"chasers": left}) if left else None
        skipped += [
            f"success.arrival, chaser {i}: the flight ends at {scenario.duration_s:g} s, its goto "
            f"is at {first_s:g} s"
            for i, first_s in late.items()
        ]

    first_s = min((e.at_s for e in scenario.timeline if e.command == "detumble"), default=None)
    if success.detumbled is not None and first_s is not None and first_s >= scenario.duration_s:
        changes["detumbled"] = None
        skipped.append(
            f"success.detumbled: the flight ends at {scenario.duration_s:g} s, detumble is at "
            f"{first_s:g} s"
        )

    return scenario.model_copy(update={"success": success.model_copy(update=changes)}), skipped


def _late_arrivals(scenario: Scenario) -> dict[int, float]:
    """Return the chasers of ``success.arrival`` whose first ``goto`` comes after the end, with its
    time (s).
    """
    arrival = scenario.success.arrival
    first = {i: _first_command_s(scenario, "goto", i) for i in (arrival.chasers if arrival else ())}
    return {
        i: at_s for i, at_s in first.items() if at_s is not None and at_s >= scenario.duration_s
    }


def _first_command_s(scenario: Scenario, command: str, chaser: int) -> float | None:
    """Return the time (s) of the first such command to a chaser in the timeline, or None."""
    return min(
        (e.at_s for e in scenario.timeline if e.command == command and chaser in e.chasers),
        default=None,
    )
