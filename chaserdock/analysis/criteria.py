# SPDX-License-Identifier: Apache-2.0
"""Success criteria of a recorded flight, evaluated on the motion of its bodies: which can be
judged; docking and goals.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Vector3
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.mission import Success

from .flight import LoadHistory, RecordedFlight, SensedDocking
from .motion import TARGET

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


def overloads(result: dict[str, Any], s: Scenario) -> list[str]:
    """Return a message for each load limit that was exceeded, or cannot be judged."""
    out = []
    for i, c in result["chasers"].items() if result["collisions"] is not None else ():
        for quantity, limit, unit in _load_limits(s, int(i)):
            load, what = c["capture"]["port_load"], quantity.split("_")[1]
            if load is None:
                out.append(
                    f"chaser {i}: largest {what} on its port: unknown, at most {limit:g} {unit} "
                    "allowed"
                )
            elif load[quantity] > limit:
                out.append(
                    f"chaser {i}: largest {what} on its port: {load[quantity]:.4g} {unit}, at most "
                    f"{limit:g} {unit} allowed; "
                    f"exceeded from {load['limit_exceeded_s']:.2f} s on"
                )
    return out


def nearest_allowed_m(s: Scenario, chaser: int) -> float:
    """Return the smallest allowed distance of a chaser from the target's centre. With a port it is
    smaller.
    """
    port, limit = s.docking.port_of(chaser), s.limits.min_distance_target_m
    if port is None:
        return limit
    latched_m = float(np.linalg.norm(centre_offset(port, s.chaser.probe_reach_m, 0.0)))
    return min(limit, latched_m - _CONTACT_SLACK_M)


def capture_failures(result: dict[str, Any], s: Scenario) -> list[str]:
    """Return a message for each chaser that should be latched and verified but is not."""
    out = []
    for i in s.success.latched:
        capture = result["chasers"].get(str(i), {}).get("capture")
        if capture is None or not capture["latched"]:
            refused = capture["refused"] if capture else []
            out.append(
                f"chaser {i} is not latched"
                + (f"; last rejected touch: {refused[-1]}" if refused else "")
            )
        elif not capture["verified"]:
            out.append(f"chaser {i} is latched but not verified by a pull test")
    return out


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
        f"{np.degrees(capture['contact_angle_rad']):.2f} deg off, closing at "
        f"{capture['contact_closing_m_s'] * 1e3:.1f} mm/s"
    )


def stack_rest(flight: RecordedFlight) -> dict[str, float | None] | None:
    """Return the final rates of the target with the chasers latched then; None if the scenario does
    not judge them.

    ``since_s``: simulated time since which both were within ``success.detumbled``; None if they are
    not at the end.
    """
    names = ["target", *(f"chaser/{i}" for i in flight.latched)]
    limits = flight.scenario.success.detumbled
    if limits is None or any(name not in flight.motion for name in names):
        return None
    if not flight.motion.has_rates():
        return None
    tracks = {name: flight.motion[name] for name in names}
    n = min(len(track.time_s) for track in tracks.values())
    momentum, mass = np.zeros((n, 3)), 0.0
    for name, track in tracks.items():
        mass_kg, centre_m = _mass_and_centre(flight, name)
        turning = np.cross(track.omega_rad_s[:n], centre_m)
        momentum += mass_kg * (track.velocity_m_s[:n] + rotations.rotate(track.q_wxyz[:n], turning))
        mass += mass_kg
    speed = np.linalg.norm(momentum, axis=1) / mass
    rate = np.linalg.norm(tracks["target"].omega_rad_s[:n], axis=1)
    outside = np.flatnonzero((speed > limits.speed_m_s) | (rate > np.radians(limits.rate_deg_s)))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return {
        "speed_m_s": float(speed[-1]),
        "rate_rad_s": float(rate[-1]),
        "since_s": float(tracks["target"].time_s[first]) if first < n else None,
    }


def _mass_and_centre(flight: RecordedFlight, name: str) -> tuple[float, Vector3]:
    """Return mass, kg, and centre of mass, m, of a body: the true ones, or else those stated."""
    for drawn in flight.drawn:
        if drawn.body == name:
            return drawn.mass_kg, drawn.centre_of_mass_m
    if name == TARGET:
        return flight.scenario.target.mass_kg, flight.scenario.target.centre_of_mass_m
    return flight.scenario.chaser.mass_kg, (0.0, 0.0, 0.0)


def rest_failures(result: dict[str, Any], s: Scenario) -> list[str]:
    """Return the violations of ``success.detumbled``."""
    limits, stack = s.success.detumbled, result.get("stack")
    if limits is None or (stack is not None and stack["since_s"] is not None):
        return []
    if stack is None:
        return ["success.detumbled: the motion of the stack is not in the log"]
    return [
        f"the stack moves at {stack['speed_m_s'] * 1e3:.2f} mm/s and "
        f"{np.degrees(stack['rate_rad_s']):.3f} degrees/s; at most "
        f"{limits.speed_m_s * 1e3:g} mm/s and {limits.rate_deg_s:g} degrees/s allowed"
    ]


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
    goal_m = target.position_m + rotations.rotate(target.q_wxyz, np.array(offset_m))
    away = np.linalg.norm(own.position_m - goal_m, axis=1) > success.reached_position_m
    outside = np.flatnonzero(away | (target.time_s < start_s))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return float(target.time_s[first]) if first < len(away) else None


def not_reached(scenario: Scenario, chaser: int, time_s: float | None) -> list[str]:
    """Return the violations of ``success.reached``. ``time_s``: time since which the chaser stayed
    at its goal, or None.
    """
    success, goal = scenario.success, scenario.goal_of(chaser)
    if chaser not in success.reached or goal is None:
        return []
    if time_s is None:
        return [f"chaser {chaser} is not within {success.reached_position_m:g} m of its goal"]
    took_s = time_s - goal[0]
    if success.reached_within_s is not None and took_s > success.reached_within_s:
        return [
            f"chaser {chaser} reached its goal after {took_s:.1f} s, at most "
            f"{success.reached_within_s:g} s allowed"
        ]
    return []


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
