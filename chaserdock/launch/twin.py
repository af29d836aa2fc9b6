# SPDX-License-Identifier: Apache-2.0
"""Make the simulation twin of a recorded flight: a scenario with the same start and commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.codec import vector
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.recording.log import LogSource, read_log
from chaserdock_protocol.scenario import Scenario, scenario_from_json

from chaserdock.analysis.flight import RecordedFlight, load_flight
from chaserdock.analysis.motion import TARGET, Track

_FIT_S = 1.0
"""Time, s, of the motion that gives velocities and rates at the start: long against the noise of
motion capture, short against a turn of the target.
"""
_LEAST_POSES = 3
"""Fewest poses in these lines."""
ARMED = "arm accepted"
"""Event of a gateway from which robots move: a twin starts then."""


class TwinError(ChaserdockError):
    """A log does not tell where its bodies started."""


def twin_of(log: LogSource) -> Scenario:
    """Return the scenario of a recorded flight, in simulation: with the poses and velocities of its
    start and the operator's commands, both from when its robots were armed, and without `[lab]`.

    Raises TwinError for a log with neither ground truth nor a reference of every body, LogError.
    """
    flight = load_flight(Path(log) if isinstance(log, str | Path) else log)
    missing = [
        name
        for name in (TARGET, *(f"chaser/{i}" for i in range(len(flight.scenario.chasers))))
        if name not in flight.motion
    ]
    if missing:
        raise TwinError(
            f"{log}: no ground truth and no reference of {', '.join(missing)}: its start is unknown"
        )
    armed = [e.sim_time_ns / 1e9 for e in flight.events if e.what == ARMED]
    start_s = armed[0] if armed else 0.0
    values = flight.scenario.model_dump(mode="json", exclude_none=True)
    values.pop("lab", None)
    place, velocity, q, omega = _start_of(flight.motion[TARGET], start_s)
    values["name"] = f"{values['name'][:58]}-twin"
    values["duration_s"] = max(1.0 / flight.scenario.time.rate_hz, flight.flown_s - start_s)
    values["target"] |= {
        "position_m": vector(place),
        "velocity_m_s": vector(velocity),
        "q_wxyz": vector(q),
        "omega_rad_s": vector(omega),
    }
    for i, chaser in enumerate(values["chasers"]):
        chaser |= _chaser_start(flight, i, start_s, (place, q))
    values["timeline"] = _commands(log, flight.scenario, start_s)
    return scenario_from_json(json.dumps(values), f"the twin of {log}")


def _start_of(track: Track, start_s: float) -> tuple[Array, Array, Array, Array]:
    """Return position (3,) and velocity (3,) in WRF, attitude (4,) and rate (3,) in body axes at a
    time.

    Of measured motion: by straight lines through what comes before, when robots did not act, or
    where the log begins there by parabolas through what comes after.
    """
    time_s, degree = track.time_s, 1
    if not track.sigma_m.any():  # ground truth
        k = min(int(np.searchsorted(time_s, start_s)), len(time_s) - 1)
        exact = track.position_m[k], track.velocity_m_s[k], track.q_wxyz[k], track.omega_rad_s[k]
        return exact
    rows = np.flatnonzero((time_s >= start_s - _FIT_S) & (time_s <= start_s))
    if len(rows) < _LEAST_POSES:
        rows = np.flatnonzero((time_s >= start_s) & (time_s <= start_s + _FIT_S))
        degree = 2
    if len(rows) < _LEAST_POSES:
        raise TwinError(f"the log knows fewer than {_LEAST_POSES} poses at its start")
    since_s, q0 = time_s[rows] - start_s, track.q_wxyz[rows[0]]
    turns = rotations.log(rotations.multiply(rotations.conjugate(q0), track.q_wxyz[rows]))
    values = np.hstack([track.position_m[rows], turns])
    lines: Array = np.asarray(np.polynomial.polynomial.polyfit(since_s, values, degree), float)
    q = rotations.multiply(q0, rotations.exp(lines[0, 3:]))
    return lines[0, :3], lines[1, :3], rotations.normalize(q), lines[1, 3:]


def _chaser_start(
    flight: RecordedFlight, chaser: int, start_s: float, target: tuple[Array, Array]
) -> dict[str, Any]:
    """Return the keys of a chaser's start relative to its reference pose."""
    place, velocity, q, _ = _start_of(flight.motion[f"chaser/{chaser}"], start_s)
    own, (target_m, q_target) = flight.scenario.chasers[chaser], target
    offset = rotations.rotate_inverse(q_target, place - target_m) - np.array(own.position_m)
    reference = rotations.multiply(q_target, np.array(own.q_wxyz))
    turn = rotations.log(rotations.multiply(rotations.conjugate(reference), q))
    return {
        "start_offset_m": vector(offset),
        "start_rotation_rad": vector(turn),
        "start_velocity_m_s": vector(velocity),
    }


def _commands(log: LogSource, scenario: Scenario, start_s: float) -> list[dict[str, Any]]:
    """Return the timeline of the scenario and of the operator, from the start on."""
    found = [
        {**entry.model_dump(mode="json", exclude_none=True), "at_s": entry.at_s - start_s}
        for entry in scenario.timeline
    ]
    for record in read_log(log, keys=(topics.OPERATED.key_of(),)):
        command = record.message
        if isinstance(command, OperatorCommand):
            entry: dict[str, Any] = {
                "at_s": command.sim_time_ns / 1e9 - start_s,
                "command": command.command,
                "chasers": [command.chaser],
            }
            if command.offset_m is not None:
                entry["offset_m"] = list(command.offset_m)
            if command.thruster is not None:
                entry["thruster"] = command.thruster
            found.append(entry)
    return sorted((e for e in found if e["at_s"] >= 0.0), key=lambda e: e["at_s"])
