# SPDX-License-Identifier: Apache-2.0
"""Random flights: each seed draws a subset of the fault kinds, then its faults, network and
operator commands.

Leaving out most kinds in each flight finds more than always mixing all (A. Groce et al., "Swarm
testing", 2012). A flight is a ``Case``: the keys of a scenario file that extends a shipped
scenario.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Any, get_args

from chaserdock_models.plane import flattened
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.faults import LATCH_FAULTS, FaultKind
from chaserdock_protocol.scenario.planar import height_m, up_in_target

from .checks.docking import settling_s

KINDS: tuple[str, ...] = tuple(kind for kind in get_args(FaultKind) if kind not in LATCH_FAULTS)
LATCH_KINDS: tuple[str, ...] = tuple(sorted(LATCH_FAULTS))
"""Kinds of faults of any scenario, and those that need a port."""
RECEIVED = {
    "world": ["actuators"],
    "controller": ["odometry", "sighting"],
    "chaser": ["image", "odometry", "wrench"],
}
MESSAGE_KINDS = ("drop", "delay", "duplicate", "reorder", "corrupt")
"""Kinds of faults of received messages."""
PUBLISHED = {
    "world": ["image", "odometry"],
    "controller": ["wrench"],
    "chaser": ["sighting", "actuators"],
}

LONG_EVERY, RECOVERY_S = 4, 10.0
"""One seed in LONG_EVERY flies on until docking can be judged: RECOVERY_S (s) after the last
disturbance plus the time of an approach.
"""

Case = dict[str, Any]
"""Keys and values of a scenario file, as JSON has them: lists, no tuples."""


def draw_fault(
    kind: str, draw: random.Random, chasers: int, latest_s: float = 20.0, ports: Sequence[int] = ()
) -> dict[str, Any]:
    """Return a random fault of a kind, as in a scenario file, that begins before ``latest_s``.

    ``ports``: chasers with a port; latch faults need one.
    """
    names = [f"chaser/{i}" for i in range(chasers)]
    fault: dict[str, Any] = {"kind": kind, "at_s": round(draw.uniform(0.5, latest_s), 2)}
    duration_s = round(draw.choice([0.3, 1.0, 3.0, 8.0]) * draw.uniform(0.5, 1.5), 2)
    if kind != "kill":
        fault["duration_s"] = min(duration_s, 3.0) if kind == "freeze" else duration_s
    processes = ["world", "controller", *names]
    if kind == "kill":
        fault["process"] = draw.choice(["controller", "recorder", *names])
    elif kind == "freeze":
        fault["process"] = draw.choice([*processes, "recorder"])
    elif kind == "cut":
        fault["process"] = draw.choice(names)
        if draw.random() < 0.5:
            fault["peer"] = "controller"
    elif kind in LATCH_FAULTS:
        fault["process"] = f"chaser/{draw.choice(ports)}"
    elif kind in ("camera_off", "lying_sensor", "odometry_lie"):
        fault["process"] = draw.choice(names)
    elif kind == "clock_jump":
        fault["process"] = draw.choice(["controller", *names])
        fault["offset_s"] = round(draw.choice([-1, 1]) * 10 ** draw.uniform(-2, 2), 3)
    else:
        fault["process"] = draw.choice(processes)
        topics = PUBLISHED if kind == "flood" else RECEIVED
        fault["topic"] = draw.choice(topics[fault["process"].partition("/")[0]])
    fault |= _draw_severity(kind, draw)
    return fault


def _draw_severity(kind: str, draw: random.Random) -> dict[str, Any]:
    if kind in ("drop", "duplicate", "reorder", "corrupt"):
        return {"share": draw.choice([0.1, 0.5, 1.0])}
    if kind == "delay":
        return {"delay_s": round(draw.uniform(0.1, 1.0), 2)}
    if kind == "latch_slip":
        return {"force_N": draw.choice([0.05, 0.3]), "torque_N_m": draw.choice([0.01, 0.1])}
    if kind == "flood":
        return {"copies": draw.choice([5, 50, 200])}
    if kind in ("lying_sensor", "odometry_lie"):
        return {
            "offset_m": [round(draw.gauss(0.0, 0.1), 3) for _ in range(3)],
            "rotation_deg": [round(draw.gauss(0.0, 5.0), 2) for _ in range(3)],
        }
    return {}


def draw_case(
    name: str, seed: int, scenario: Scenario, *, images: bool = False, mode: str | None = None
) -> Case:
    """Return the flight of a seed: a variant of scenario ``name``, of which ``scenario`` is the
    loaded form.
    """
    draw, chasers, end_s = (
        random.Random(f"swarm {seed}"),
        len(scenario.chasers),
        scenario.duration_s,
    )

    case: Case = {"extends": name, "name": f"seed-{seed}", "seed": seed % 2**32}
    if not images:
        case["perception"] = {"name": "statistical"}
    standby = scenario.controller.standby or draw.random() < 0.5
    case["controller"] = {"standby": standby}

    kinds = [kind for kind in KINDS if draw.random() < 0.25]
    ports = [i for i in range(chasers) if scenario.docking.port_of(i) is not None]
    kinds += [kind for kind in LATCH_KINDS if ports and draw.random() < 0.25]
    faults = [
        draw_fault(draw.choice(kinds), draw, chasers, 0.8 * end_s, ports)
        for _ in range(draw.choice([0, 1, 1, 2, 3, 4]) if kinds else 0)
    ]
    for fault in faults:
        if standby and fault["process"] == "controller" and draw.random() < 0.3:
            fault["process"] = "standby"
    case["fault"] = faults

    case["simulation"] = _draw_network(draw, chasers, end_s, standby)
    if mode is not None:
        case["simulation"]["mode"] = mode
    if truth := _draw_truth(draw):
        case["truth"] = truth
    if commands := _draw_commands(draw, scenario):
        case["timeline"] = commands

    devices = random.Random(f"devices {seed}")
    faults += _draw_device_faults(devices, scenario)
    if failures := _draw_thruster_failures(devices, scenario):
        case["thruster_failure"] = failures

    # A stream of its own, so that other seeds fly as they did before this fault existed.
    faults += _draw_other_faults(random.Random(f"others {seed}"), scenario, standby)

    if seed % LONG_EVERY == 0:
        case["duration_s"] = _long_enough_s(case, scenario)
    return case


def _long_enough_s(case: Case, scenario: Scenario) -> float:
    """Return the duration (s) that leaves the chasers time to dock after the last disturbance."""
    rows = (
        [e.model_dump() for e in scenario.timeline] if "timeline" not in case else case["timeline"]
    )
    network = case["simulation"]
    rows = [*rows, *case["fault"], *case.get("thruster_failure", [])]
    rows += [*network.get("partition", []), *network.get("slow", [])]
    last_s = max((row["at_s"] + row.get("duration_s", 0.0) for row in rows), default=0.0)
    needed_s = (
        last_s + RECOVERY_S + max(settling_s(scenario, i) for i in range(len(scenario.chasers)))
    )
    return max(scenario.duration_s, float(math.ceil(needed_s)))


def _draw_device_faults(draw: random.Random, scenario: Scenario) -> list[dict[str, Any]]:
    """Return at most one fault of thruster or docking sensor messages, if the scenario has these
    devices.
    """
    readers = [("controller", "thrusters")] if scenario.chaser.actuation == "thrusters" else []
    if scenario.docking.kind == "capture":
        readers.append(("controller", "docking"))
        readers += [(f"chaser/{p.chaser}", "docking") for p in scenario.docking.ports]
    if not readers or draw.random() > 0.3:
        return []
    return [_draw_message_fault(draw.choice(MESSAGE_KINDS), draw, scenario, readers)]


def _draw_other_faults(
    draw: random.Random, scenario: Scenario, standby: bool
) -> list[dict[str, Any]]:
    """Return at most one fault: of the leases that a controller receives, a controller that is cut
    off, or a flood of leases or of a device's messages.
    """
    if draw.random() > 0.15:
        return []
    controllers = ["controller", *(["standby"] if standby else [])]
    names = [f"chaser/{i}" for i in range(len(scenario.chasers))]
    what = draw.choice(["lease", "lease", "lease", "cut", "flood"])
    if what == "lease":
        readers = [(name, "lease") for name in controllers]
        return [_draw_message_fault(draw.choice(MESSAGE_KINDS), draw, scenario, readers)]
    if what == "cut":
        fault = draw_fault("cut", draw, len(names), 0.8 * scenario.duration_s)
        fault["process"] = draw.choice(controllers)
        if "peer" in fault:
            fault["peer"] = draw.choice(names)
        return [fault]
    publishers = [(name, "lease") for name in names]
    if scenario.chaser.actuation == "thrusters":
        publishers += [(name, "thrusters") for name in names]
    if scenario.docking.kind == "capture":
        publishers.append(("world", "docking"))
    return [_draw_message_fault("flood", draw, scenario, publishers)]


def _draw_message_fault(
    kind: str, draw: random.Random, scenario: Scenario, choices: Sequence[tuple[str, str]]
) -> dict[str, Any]:
    """Return a fault for one of the ``choices`` of process and topic."""
    fault = draw_fault(kind, draw, len(scenario.chasers), 0.8 * scenario.duration_s)
    fault["process"], fault["topic"] = draw.choice(choices)
    return fault


def _draw_thruster_failures(draw: random.Random, scenario: Scenario) -> list[dict[str, Any]]:
    """Return the scenario's thruster failures, sometimes with one more; usually, and without
    thrusters, none.
    """
    if scenario.chaser.actuation != "thrusters" or draw.random() > 0.3:
        return []
    failures = [f.model_dump(exclude_none=True) for f in scenario.thruster_failure]
    failed = {(f["chaser"], f["thruster"]) for f in failures}
    healthy = [
        (i, j)
        for i in range(len(scenario.chasers))
        for j in range(len(scenario.chaser.thrusters))
        if (i, j) not in failed
    ]
    chaser, thruster = draw.choice(healthy)
    failure: dict[str, Any] = {"chaser": chaser, "thruster": thruster}
    failure["at_s"] = round(draw.uniform(0.5, 0.8 * scenario.duration_s), 2)
    failure["kind"] = draw.choice(["stuck_off", "stuck_on", "weak"])
    if failure["kind"] == "weak":
        failure["factor"] = draw.choice([0.2, 0.5, 0.8])
    failure["reported"] = draw.random() < 0.3
    return [*failures, failure]


def _draw_network(draw: random.Random, chasers: int, end_s: float, standby: bool) -> dict[str, Any]:
    """Return a section ``[simulation]``."""
    names = [
        "world",
        "controller",
        *(["standby"] if standby else []),
        *(f"chaser/{i}" for i in range(chasers)),
    ]

    def window() -> dict[str, float]:
        duration_s = draw.choice([0.2, 1.0, 4.0]) * draw.uniform(0.5, 1.5)
        return {
            "at_s": round(draw.uniform(0.5, 0.8 * end_s), 2),
            "duration_s": round(duration_s, 2),
        }

    section: dict[str, Any] = {"mode": draw.choice(["lockstep", "realtime", "realtime"])}
    section["latency_s"] = draw.choice([0.0, 0.0005, 0.002, 0.01])

    for key, values in (
        ("jitter_s", [0.0005, 0.002, 0.01]),
        ("loss", [0.001, 0.01, 0.05]),
        ("duplicate", [0.001, 0.02, 0.1]),
        ("reorder", [0.001, 0.02, 0.1]),
    ):
        if draw.random() < 0.3:
            section[key] = draw.choice(values)

    if draw.random() < 0.3:
        section["partition"] = [
            # All others are on the world's side.
            {**window(), "processes": sorted(draw.sample(names[1:], draw.choice([1, 1, 2])))}
            for _ in range(draw.choice([1, 1, 2]))
        ]

    if draw.random() < 0.25:
        reader = draw.choice([*names, "recorder"])
        section["slow"] = [
            {**window(), "process": reader, "each_s": draw.choice([0.001, 0.005, 0.02])}
        ]

    if draw.random() < 0.3:
        wrong = draw.sample(names, draw.choice([1, 2]))
        section["clock"] = [
            {
                "process": p,
                "offset_s": round(draw.uniform(-1e3, 1e3), 1),
                "drift": round(draw.gauss(0, 0.005), 4),
            }
            for p in sorted(wrong)
        ]
        for clock in section["clock"]:
            clock["drift"] = max(-0.05, min(0.05, clock["drift"]))

    return section


def _draw_truth(draw: random.Random) -> dict[str, Any]:
    """Return a section ``[truth]``, usually empty."""
    if draw.random() > 0.3:
        return {}
    chaser = {
        "mass_share": draw.choice([0.05, 0.1]),
        "thrust_share": 0.05,
        "force_N": 0.005,
        "torque_N_m": 0.0005,
        "delay_s": 0.01,
        "clock_offset_s": 0.005,
    }
    return {"chaser": {key: value for key, value in chaser.items() if draw.random() < 0.5}}


def _draw_commands(draw: random.Random, scenario: Scenario) -> list[dict[str, Any]]:
    """Return a timeline: the scenario's, with random operator commands; may be empty."""
    if draw.random() > 0.3:
        return []
    timeline = [e.model_dump(mode="json", exclude_none=True) for e in scenario.timeline]
    for _ in range(draw.choice([1, 2, 3])):
        chaser = draw.randrange(len(scenario.chasers))
        command = draw.choice(["hold", "retreat", "abort", "approach", "goto"])
        entry = {"at_s": round(draw.uniform(1.0, 0.9 * scenario.duration_s), 2), "command": command}
        entry["chasers"] = [chaser]
        if command == "goto":
            position_m = scenario.chasers[chaser].position_m
            # The farthest allowed reference, less 0.1 % for rounding.
            farthest_m = 0.999 * scenario.limits.max_reference_distance_m
            share = min(1.3, farthest_m / (math.hypot(*position_m) or 1.0))
            offset_m = [round(share * x, 3) for x in position_m]
            if (up := up_in_target(scenario)) is not None:
                offset_m = flattened(offset_m, up, height_m(scenario, chaser, up)).tolist()
            entry["offset_m"] = offset_m
        timeline.append(entry)
    return sorted(timeline, key=lambda e: e["at_s"])
