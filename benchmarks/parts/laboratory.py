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

import numpy as np
import pytest
from common import Figures, Group, KeptResults, Options, seeds_of

TRACKED_M = 0.01
"""Largest error, m, in the last five seconds of a flight that still tracks."""
SECONDS = 40.0


@dataclass(frozen=True)
class LabFlight:
    """How a flight ended. ``reason``: why the robots were stopped, empty if they were not.
    ``error_m``: largest error of tracking in the last five seconds; ``speed_m_s``: of the fastest
    robot at the end.
    """

    faults: tuple[str, ...]
    reason: str
    error_m: float
    rms_m: float
    speed_m_s: float
    clearance_m: float
    latency_p99_s: float
    crash: str = ""

    @property
    def ending(self) -> str:
        """Return ``tracks``, ``stopped``, or what is wrong."""
        if self.crash:
            return "crash"
        if self.clearance_m <= 0.0:
            return "contact"
        if self.reason:
            return "stopped" if self.speed_m_s < 0.02 else "moves although stopped"
        return "tracks" if self.error_m < TRACKED_M else "lost without a reason"

    def line(self) -> str:
        """Return the flight as a line of text."""
        return f"{', '.join(self.faults) or 'no fault'}: {self.ending} {self.reason or self.crash}"


def fly_laboratory(with_faults: bool, seed: int) -> LabFlight:
    """Fly two free flyers by the gateway; ``seed`` draws noise, clocks and up to two faults."""
    import virtual_lab as virtual

    rng, faults = np.random.default_rng([seed, 7]), []
    for _ in range(int(rng.integers(1, 3)) if with_faults else 0):
        kind = str(rng.choice(virtual.emulated.FAULTS))
        at_s = float(rng.uniform(2.0, 25.0))
        until_s = at_s + float(rng.exponential(4.0))
        faults.append(virtual.Fault(kind, at_s, until_s, int(rng.integers(2))))
    text, lab = virtual.flight_of("tracking", seed, faults)
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        scenario = Path(folder) / "lab.toml"
        scenario.write_text(text)
        flight = virtual.fly(scenario, Path(folder) / "run", lab, patch)
    reasons = re.findall(r"disarmed: (.*)", flight.output)
    end_s = (lab.history[-1][0] - (lab.begun_ns or 0)) / 1e9
    errors = virtual.tracking_errors_m(lab, end_s - 5.0)
    late = np.concatenate(list(errors.values()))
    steady = np.concatenate(list(virtual.tracking_errors_m(lab, 28.0).values()))
    return LabFlight(
        tuple(f"{f.kind} {f.chaser} {f.at_s:.1f}-{f.until_s:.1f} s" for f in faults),
        reasons[0] if reasons else "",
        float(late.max(initial=0.0)),
        float(np.sqrt(np.mean(steady**2))) if len(steady) else math.nan,
        max(float(np.linalg.norm(b.velocity)) for b in lab.chasers.values()),
        lab.clearance_m,
        float(np.quantile(virtual.LATENCIES_S, 0.99)) if virtual.LATENCIES_S else math.nan,
        "; ".join(flight.crashes),
    )


def laboratory(options: Options) -> Figures:
    """Fly the gateway on the emulated laboratory: three flights without faults, 100 (``--quick``:
    2) with up to two faults each. Each must end tracking, or at rest with a named reason.
    """
    clean_results = KeptResults(options.results, {"faults": False}, LabFlight)
    clean = clean_results.of(
        range(3), partial(fly_laboratory, False), LabFlight.line, jobs=options.jobs
    )
    results = KeptResults(options.results, {"faults": True}, LabFlight)
    faulty = results.of(
        seeds_of(options, 100, 2), partial(fly_laboratory, True), LabFlight.line, jobs=options.jobs
    )
    endings = Counter(flight.ending for flight in faulty)
    return {
        "clean_flights": len(clean),
        "clean_tracking": sum(f.ending == "tracks" and not f.reason for f in clean),
        "clean_rms_m": float(np.mean([f.rms_m for f in clean])),
        "added_latency_p99_s": max(f.latency_p99_s for f in clean),
        "flights_with_faults": len(faulty),
        **{f"ending_{k.replace(' ', '_')}": n for k, n in sorted(endings.items())},
    }


GROUP = Group({"laboratory": laboratory}, ("flights", "first", "results", "jobs"))
