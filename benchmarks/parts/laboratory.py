# SPDX-License-Identifier: Apache-2.0
"""Flights of a gateway on the emulated laboratory, with faults and without, in virtual time."""

from __future__ import annotations

import math
import re
import tempfile
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_protocol.scenario import load_scenario
from chaserdock_world.sensors.errors import camera_errors
from common import Figures, Group, KeptResults, Options, seeds_of

import chaserdock
from chaserdock.simulation.mission import simulate

TRACKED_M = 0.01
"""Largest error, m, in the last five seconds of a flight that still tracks."""
RESTARTED_S, ARMED_AGAIN_S = 3.0, 8.0
"""Times from the end of a gateway that is killed until it is started again, and until its robots
are armed again.
"""
KILLED = "gateway killed"
SECONDS = {"tracking": 25.0, "planar-docking": 40.0, "free-flyer-docking": 40.0}
"""Flights, and the time in which faults begin, s after the first command."""
ENDS_S = {"tracking": 60.0, "planar-docking": 120.0, "free-flyer-docking": 120.0}
"""Length of flights with faults, s: a robot that lost its target at the latest time has backed out
and docked again by then, and one that tracks is back at its place.
"""


@dataclass(frozen=True)
class LabFlight:
    """How a flight ended. ``reason``: why the robots were stopped since they were last armed, empty
    if they were not.
    ``held``: why a chaser that is not latched waits, by the controller. ``error_m``: largest error
    of tracking in the last five seconds; ``speed_m_s``: of the fastest robot at the end.
    """

    faults: tuple[str, ...]
    reason: str
    held: str
    latched: bool
    error_m: float | None
    rms_m: float | None
    speed_m_s: float
    clearance_m: float
    misses: int
    latency_p99_s: float | None
    crash: str = ""

    @property
    def ending(self) -> str:
        """Return ``docked``, ``tracks``, ``stopped``, ``waits``, or what is wrong."""
        if self.crash:
            return "crash"
        if self.clearance_m <= 0.0 or self.misses:
            return "contact"
        if self.reason:
            return "stopped" if self.speed_m_s < 0.02 else "moves although stopped"
        if self.latched:
            return "docked"
        if self.error_m is not None and self.error_m < TRACKED_M:
            return "tracks"
        return "waits" if self.held else "lost without a reason"

    def line(self) -> str:
        """Return the flight as a line of text."""
        why = self.crash or self.reason or self.held
        return f"{', '.join(self.faults) or 'no fault'}: {self.ending} {why}"


def drawn_faults(name: str, seed: int, robots: int) -> list[Any]:
    """Return one or two faults; one of eight flights has its gateway killed besides."""
    import virtual_lab as virtual

    rng, faults = np.random.default_rng([seed, 7]), []
    for _ in range(int(rng.integers(1, 3))):
        kind = str(rng.choice(virtual.emulated.FAULTS))
        at_s = float(rng.uniform(2.0, SECONDS[name]))
        until_s = at_s + float(rng.exponential(4.0))
        faults.append(virtual.Fault(kind, at_s, until_s, int(rng.integers(robots))))
    if rng.uniform() < 1 / 8:
        faults.append(virtual.Fault(KILLED, float(rng.uniform(2.0, SECONDS[name]))))
    return faults


def fly_laboratory(name: str, with_faults: bool, seed: int) -> LabFlight:
    """Fly by the gateway on the emulated laboratory; ``seed`` draws noise, clocks and faults."""
    import virtual_lab as virtual

    robots = 1 if name == "free-flyer-docking" else 2
    faults = drawn_faults(name, seed, robots) if with_faults else []
    # Without faults it is compared with the world, whose cameras expose at each tick.
    camera_hz = 29.4 if with_faults else CAPTURE[3]
    text, lab = virtual.flight_of(name, seed, faults, camera_hz=camera_hz)
    if not with_faults:  # cameras are mounted as in the world's flight of this seed
        path = virtual.FOLDER / name / "scenario.toml"
        scenario = load_scenario(path, (f"seed={seed}",))
        for i in lab.chasers:
            error = camera_errors(scenario, i)
            lab.mount(i, error.turn_rad, error.shift_m, error.focal_share)
    others: dict[str, Any] = {}
    if with_faults:
        others["overrides"] = (f"duration_s={ENDS_S[name]}",)
        others["watcher"] = virtual.approach_again
    killed_s = next((f.at_s for f in faults if f.kind == KILLED), None)
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        if killed_s is not None:
            others["world"] = virtual.killed_and_restarted(lab, killed_s, RESTARTED_S, patch)
            others["operator"] = partial(virtual.arm_again, after_s=killed_s + ARMED_AGAIN_S)
        path = Path(folder) / "lab.toml"
        path.write_text(text)
        flight = virtual.fly(path, Path(folder) / "run", lab, patch, **others)
        held = held_reasons(Path(folder) / "run")
    since_armed = flight.output.rpartition("arm accepted")[2]
    reasons = re.findall(r"disarmed: (.*)", since_armed)
    begun_ns = lab.history[0][0] if lab.begun_ns is None else lab.begun_ns
    end_s = (lab.history[-1][0] - begun_ns) / 1e9
    late = steady = np.zeros(0)
    if name == "tracking":
        late = np.concatenate(list(virtual.tracking_errors_m(lab, end_s - 5.0).values()))
        steady = np.concatenate(list(virtual.tracking_errors_m(lab, STEADY_S).values()))
    return LabFlight(
        tuple(f"{f.kind} {f.chaser} {f.at_s:.1f}-{f.until_s:.1f} s" for f in faults),
        reasons[0] if reasons else "",
        held,
        bool(lab.probes) and all(probe.is_latched for probe in lab.probes.values()),
        float(late.max()) if len(late) else None,
        float(np.sqrt(np.mean(steady**2))) if len(steady) else None,
        max(float(np.linalg.norm(b.velocity)) for b in lab.chasers.values()),
        lab.clearance_m,
        sum(len(probe.misses) for probe in lab.probes.values()),
        float(np.quantile(virtual.LATENCIES_S, 0.99)) if virtual.LATENCIES_S else None,
        "; ".join(flight.crashes),
    )


def held_reasons(folder: Path) -> str:
    """Return the last two events of each chaser, as the controller states them: that it holds, and
    what for.
    """
    last: dict[str, list[str]] = {}
    log = chaserdock.open_log(folder)
    for event in log.messages("controller/event"):
        if found := re.match(r"(chaser \d+): (.*)", event.what):
            last[found[1]] = [*last.get(found[1], [])[-1:], event.what]
    return "; ".join(what for name in sorted(last) for what in last[name])


STEADY_S = 28.0
"""Time, s, after which a flight that tracks is judged: both robots have settled by then."""
CAPTURE = (0.3e-3, 0.03, 100.0, 15.0)
"""Noise of the motion capture, m and degrees, its rate and that of the ticks, Hz."""


def native_overrides() -> tuple[str, ...]:
    """Return what lets the world fly as the laboratory does: motion of the target, and the noise of
    odometry that the gateway computes from the poses of a tick, by least squares.
    """
    noise_m, noise_deg, rate_hz, tick_hz = CAPTURE
    n = rate_hz / tick_hz
    mean_s = (n - 1.0) / 2.0 / rate_hz + 0.006  # before the tick, with the latency
    spread_s2 = n * (n**2 - 1.0) / 12.0 / rate_hz**2
    place, motion = math.sqrt(1.0 / n + mean_s**2 / spread_s2), 1.0 / math.sqrt(spread_s2)
    return (
        "simulation.mode='realtime'",
        "perception.name='statistical'",
        "target.velocity_m_s=[0.0, 0.0, 0.0]",
        f"target.omega_rad_s=[0.0, 0.0, {math.radians(3.0)}]",
        f"navigation.position_noise_m={noise_m * place}",
        f"navigation.velocity_noise_m_s={noise_m * motion}",
        f"navigation.attitude_noise_deg={noise_deg * place}",
        f"navigation.attitude_roll_noise_deg={noise_deg * place}",
        f"navigation.omega_noise_deg_s={noise_deg * motion}",
    )


def fly_native(seed: int) -> float:
    """Fly the tracking flight in the world; return the RMS of the position, m, of both robots."""
    import virtual_lab as virtual

    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        path = virtual.FOLDER / "tracking" / "scenario.toml"
        simulate(path, run, (*native_overrides(), f"seed={seed}"))
        bodies: dict[str, dict[int, Any]] = {"target": {}, "chaser/0": {}, "chaser/1": {}}
        for record in chaserdock.open_log(run).records("truth/body/{process}"):
            bodies[record.place or ""][record.message.tick] = record.message
    errors = []
    for tick, target in bodies["target"].items():
        if target.sim_time_ns >= STEADY_S * 1e9:
            for i, place in virtual.PLACES.items():
                wanted = target.position_m + rotations.rotate(target.q_wxyz, place)
                errors.append(bodies[f"chaser/{i}"][tick].position_m - wanted)
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1))))


def tracking(options: Options) -> Figures:
    """Fly the tracking flight of the emulated laboratory by the gateway, and in the world with
    equal errors of the sensors, 30 seeds each (``--quick``: 1).
    """
    seeds, jobs = seeds_of(options, 30, 1), options.jobs
    kept = KeptResults(options.results, {"flight": "tracking", "faults": False}, LabFlight)
    fly = partial(fly_laboratory, "tracking", False)
    flights = kept.of(seeds, fly, LabFlight.line, jobs=jobs)
    kept_native = KeptResults(options.results, {"flight": "native tracking"}, float)
    native = kept_native.of(seeds, fly_native, lambda rms: f"native: {rms * 1e3:.3f} mm", jobs=jobs)
    by_gateway = [f.rms_m or math.nan for f in flights]
    own, world = float(np.median(by_gateway)), float(np.median(native))
    paired = np.log(np.divide(by_gateway, native))
    latencies = [f.latency_p99_s for f in flights if f.latency_p99_s is not None]
    return {
        "flights": len(flights),
        "tracking": sum(f.ending == "tracks" for f in flights),
        "gateway_rms_m": own,
        "native_rms_m": world,
        "gateway_over_native": own / world,
        "paired_ratios_geometric_mean": float(np.exp(paired.mean())),
        "paired_ratios_standard_error": float(paired.std() / math.sqrt(len(paired))),
        "added_latency_p99_s": max(latencies, default=math.nan),
    }


def faults(options: Options) -> Figures:
    """Fly the gateway on the emulated laboratory with one or two faults, its own end among them,
    100 seeds (``--quick``: 3): tracking, planar docking and docking of a free flyer in turn. Each
    must end docked, tracking, or at rest with a named reason.
    """
    flights: list[LabFlight] = []
    names = tuple(SECONDS)
    for k, name in enumerate(names):
        seeds = [seed for seed in seeds_of(options, 100, 3) if seed % len(names) == k]
        kept = KeptResults(options.results, {"flight": name, "faults": True}, LabFlight)
        fly = partial(fly_laboratory, name, True)
        flights += kept.of(seeds, fly, LabFlight.line, jobs=options.jobs)
    endings = Counter(flight.ending for flight in flights)
    return {
        "flights": len(flights),
        **{f"ending_{k.replace(' ', '_')}": n for k, n in sorted(endings.items())},
    }


def docking(options: Options) -> Figures:
    """Dock with the gateway on the emulated laboratory, without faults: two robots on the floor,
    and a free flyer, 10 seeds each (``--quick``: 1).
    """
    figures: Figures = {}
    for name in ("planar-docking", "free-flyer-docking"):
        kept = KeptResults(options.results, {"flight": name, "faults": False}, LabFlight)
        fly = partial(fly_laboratory, name, False)
        flights = kept.of(seeds_of(options, 10, 1), fly, LabFlight.line, jobs=options.jobs)
        figures[f"{name.replace('-', '_')}_flights"] = len(flights)
        figures[f"{name.replace('-', '_')}_docked"] = sum(f.ending == "docked" for f in flights)
    return figures


GROUP = Group(
    {"laboratory-tracking": tracking, "laboratory-docking": docking, "laboratory-faults": faults},
    ("flights", "first", "results", "jobs"),
    on_request=("laboratory-docking", "laboratory-faults"),
)
