# SPDX-License-Identifier: Apache-2.0
"""Motions of bodies, and logs without ground truth, for tests of what judges flights."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol import codec, topics
from chaserdock_protocol import messages as m
from chaserdock_protocol.recording.log import (
    FLIGHT_SCENARIO,
    SCENARIO_KIND,
    LogWriter,
    read_log,
    read_scenario,
)
from chaserdock_protocol.scenario import flight_scenario_json, parse_scenario
from msgspec import structs

from chaserdock.analysis.columns import Columns
from chaserdock.analysis.motion import KnownMotion, Track, motion_columns

SYSTEM = "optitrack"
REFERENCE_NS = 10_000_000
"""Interval of the reference measurements: 100 Hz."""
AFTER_TICK_NS = 3_700_000
"""Time of the first one: those of no measurement are those of a tick."""
SIGMA_M, SIGMA_RAD = 2e-4, 1e-3


def track(time_s: np.ndarray, **known: Any) -> Track:
    """A true motion at rest in the origin, but for what is known."""
    n = len(time_s)
    zeros, ones = np.zeros((n, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    values = {
        "position_m": zeros,
        "velocity_m_s": zeros,
        "q_wxyz": ones,
        "omega_rad_s": zeros,
        "sigma_m": np.zeros(n),
        "sigma_rad": np.zeros(n),
    }
    return Track(time_s, **(values | known))


def table_of(motion: Track) -> Columns:
    """A motion as a table."""
    columns = motion_columns()
    for k in range(len(motion.time_s)):
        row = motion.rows(slice(k, k + 1))
        columns.add(np.concatenate([np.ravel(v) for v in vars(row).values()]).tolist())
    return columns


def true_motion(tracks: Mapping[str, Track]) -> KnownMotion:
    """The motions as ground truth."""
    return KnownMotion({n: table_of(t) for n, t in tracks.items()}, {}, (), np.zeros(0))


def measured_motion(tracks: Mapping[str, Track], tick_s: np.ndarray) -> KnownMotion:
    """The motions as reference measurements."""
    return KnownMotion({}, {n: table_of(t) for n, t in tracks.items()}, (SYSTEM,), tick_s)


def rewritten(
    source: Path, path: Path, change: Any = lambda record: record.message, **run_data: str
) -> Path:
    """A copy of a log, each message as ``change(record)`` has it; None leaves it out."""
    writer = LogWriter(path)
    scenario, run = read_scenario(source)
    writer.describe(scenario, {k: v for k, v in run.items() if k in ("run_id", "mode")} | run_data)
    for record in read_log(source):
        message = change(record)
        if message is not None:
            writer.write(
                record.key, m.encoding_of(type(message)), codec.encode(message), record.sent_ns
            )
    writer.close()
    return path


def without_truth(
    log: Path, out: Path, bodies: Iterable[str] = (), *, rates: bool = True, flight: bool = False
) -> Path:
    """A copy of a log as a laboratory records it: without ground truth; instead a motion capture
    has measured these bodies at 100 Hz and at times of its own, with noise.

    ``rates``: with velocities. ``flight``: with the flight scenario alone.
    """
    scenario, run = read_scenario(log)
    run = {k: v for k, v in run.items() if k in ("run_id", "mode")}
    if flight:
        full = parse_scenario(json.loads(scenario), "the log's scenario")
        scenario, run = flight_scenario_json(full), run | {SCENARIO_KIND: FLIGHT_SCENARIO}
    writer = LogWriter(out)
    writer.describe(scenario, run)
    noise, sent_ns, last = np.random.default_rng(7), 0, dict[str, m.BodyTruth]()
    numbers = dict.fromkeys(bodies, 0)
    for record in read_log(log):
        message, sent_ns = record.message, record.sent_ns
        if isinstance(message, m.Farewell):
            sent = {k: n for k, n in message.published.items() if not k.startswith("truth/")}
            message = structs.replace(message, published=sent)
        if not record.key.startswith("truth/"):
            payload = codec.encode(message)
            writer.write(record.key, m.encoding_of(type(message)), payload, sent_ns)
        if not isinstance(message, m.BodyTruth) or message.body not in numbers:
            continue
        before, last[message.body] = last.get(message.body, message), message
        for measured in _between(before, message, noise, rates):
            seq = numbers[message.body]
            numbers[message.body] += 1
            key = topics.BODY_REFERENCE.key_of(message.body)
            payload = codec.encode(m.BodyReference(**measured, seq=seq))
            writer.write(key, m.encoding_of(m.BodyReference), payload, sent_ns)
    writer.close()
    return out


def _between(
    before: m.BodyTruth, after: m.BodyTruth, noise: np.random.Generator, rates: bool
) -> Iterable[dict[str, Any]]:
    """Measurements between two true states, exact but for the noise: the motion in between is that
    of constant velocities."""
    first = -(-(before.sim_time_ns - AFTER_TICK_NS) // REFERENCE_NS)
    last = -(-(after.sim_time_ns - AFTER_TICK_NS) // REFERENCE_NS)
    span_s = (after.sim_time_ns - before.sim_time_ns) / 1e9
    apart = rotations.log(rotations.multiply(rotations.conjugate(before.q_wxyz), after.q_wxyz))
    for k in range(first, last):
        time_ns = AFTER_TICK_NS + k * REFERENCE_NS
        share = (time_ns - before.sim_time_ns) / 1e9 / span_s
        at = np.add(before.position_m, share * np.subtract(after.position_m, before.position_m))
        q = rotations.multiply(before.q_wxyz, rotations.exp(share * apart))
        q = rotations.multiply(q, rotations.exp(SIGMA_RAD * noise.standard_normal(3)))
        yield {
            "tick": before.tick,
            "sim_time_ns": time_ns,
            "body": before.body,
            "source": SYSTEM,
            "position_m": tuple((at + SIGMA_M * noise.standard_normal(3)).tolist()),
            "q_wxyz": tuple(rotations.normalize(q).tolist()),
            "sigma_m": SIGMA_M,
            "sigma_rad": SIGMA_RAD,
            "velocity_m_s": before.velocity_m_s if rates else None,
            "omega_rad_s": before.omega_rad_s if rates else None,
        }


def cropped(log: Path, out: Path, from_s: float, to_s: float) -> Path:
    """A copy of the messages between two times, as other tools make it: the scenario remains."""
    scenario, run = read_scenario(log)
    writer = LogWriter(out)
    writer.describe(scenario, {k: v for k, v in run.items() if k in ("run_id", "mode")})
    for record in read_log(log):
        time_ns = getattr(record.message, "sim_time_ns", 0)
        if from_s <= time_ns / 1e9 <= to_s and record.topic is not topics.PRESENCE:
            payload = codec.encode(record.message)
            writer.write(record.key, m.encoding_of(type(record.message)), payload, record.sent_ns)
    writer.close()
    return out
