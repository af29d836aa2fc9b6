# SPDX-License-Identifier: Apache-2.0
"""Thruster performance. Missions fly in one process with a measurement model in place of images."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from chaserdock_agents.chaser.thrusters.allocation import allocator_of
from chaserdock_agents.chaser.thrusters.modulation import Modulator
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.thruster_model import Valves
from chaserdock_protocol.scenario import Scenario, parse_scenario
from chaserdock_protocol.scenario.thrusters import thrusts_max
from common import Figures, Group, Options
from flights.measured_poses import measurement_model

from chaserdock.experiments.flight_record import FlightRecord, record_flight

FAILED_AT_S = 30.01  # just after a tick: the longest time until two whole ticks are observed
PAPER_RATES = {"velocity_m_s": (0.015, 0.0075, 0.03), "omega_rad_s": (0.015, 0.045, 0.03)}
"""Rates of the paper's target."""


VARIANTS: dict[str, dict[str, Any]] = {
    "untested": {"thruster_test_s": 0.0},
    "carrier_15_hz": {"modulation": {"carrier_hz": 15}},
}
"""At 15 Hz: without test burns; one carrier period per tick."""


def scenario(
    duration_s: float, body: str = "tetra12", rate_hz: int = 15, **changes: Any
) -> Scenario:
    """Return a scenario with one chaser a metre from the target, with thrusters by default."""
    chaser = {"body": body, "actuation": "thrusters", **changes.pop("chaser", {})}
    start = {
        "start_offset_m": [-0.1, 0.02, 0.0],
        "start_rotation_rad": [0.05, 0.0, 0.0],
        **changes.pop("start", {}),
    }
    values: dict[str, Any] = {
        "name": "thrusters",
        "duration_s": duration_s,
        "time": {"rate_hz": rate_hz, "image_hz": rate_hz},
        "chaser": chaser,
        "navigation": {"grade": "exact"},
        "chasers": [{"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0], **start}],
    }
    return parse_scenario(values | changes, "benchmark")


def fly(s: Scenario) -> FlightRecord:
    """Fly a scenario with measurements without noise."""
    return record_flight(s, measurement_model(s, 0))


def allocation(options: Options) -> Figures:
    """Measure accuracy and time of the allocation of random wrenches, up to full thrust."""
    out: Figures = {}
    for body in ("tetra12", "slider"):
        rng = np.random.default_rng(1)
        b = scenario(1.0, body).chaser
        allocator, full = allocator_of(b), thrusts_max(b.thrusters)
        worst, over, inexact, took = 0.0, 0.0, 0, []
        for _ in range(1000 if options.quick else 10_000):
            wrench = allocator.matrix @ (full * rng.uniform(0.0, 1.0, len(full)))
            begin = time.perf_counter()
            got = allocator.allocate(wrench, full)
            took.append(time.perf_counter() - begin)
            error = np.abs((allocator.matrix @ got.thrusts_N - wrench) / b.wrench_max).max()
            worst = max(worst, error / np.abs(wrench / b.wrench_max).max())
            over = max(over, float((got.thrusts_N - full).max()), float(-got.thrusts_N.min()))
            inexact += not got.exact
        out |= {
            f"allocation_{body}_worst_relative_error": worst,
            f"allocation_{body}_inexact": float(inexact),
            f"allocation_{body}_beyond_limits_N": over,
            f"allocation_{body}_wall_median_s": float(np.median(took)),
        }
    return out


def pulses(options: Options) -> Figures:
    """Measure the largest difference of delivered and commanded impulse over a second of random
    thrusts, in minimum pulses.

    ``less_late``: without what was commanded within a carrier period after its pulse had been sent,
    which is zero where every tick begins a period.
    """
    out: Figures = {}
    for rate_hz, carrier_hz in ((10, 10), (15, 10), (30, 10), (15, 15)):
        s = scenario(1.0, rate_hz=rate_hz, chaser={"modulation": {"carrier_hz": carrier_hz}})
        b, timing, rng = s.chaser, s.timing, np.random.default_rng(2)
        full = thrusts_max(b.thrusters)
        modulator, valves = Modulator(b.thrusters, b.modulation, timing), Valves(b.thrusters)
        ticks, level = (20 if options.quick else 200) * rate_hz, full
        commanded = [np.zeros(len(full))]
        for tick in range(ticks):
            # The cube makes small thrusts frequent; steps come every second.
            if tick % rate_hz == 0:
                level = full * rng.uniform(0.0, 0.8, len(full)) ** 3
            thrusts = level * rng.uniform(0.9, 1.1, len(full))
            begin, end = timing.effective_ns(tick), timing.effective_ns(tick + 1)
            commanded.append(commanded[-1] + thrusts * (end - begin) * 1e-9)
            for p in modulator.pulses(thrusts, full, begin, end):
                valves.pulse(p.thruster, p.open_ns, p.close_ns)
        # Every second tick-aligned: whole seconds hold whole periods.
        edges = np.array(
            [timing.effective_ns(k * rate_hz) for k in range(1, ticks // rate_hz)], dtype=float
        )
        total = CommandedImpulse(
            np.array([timing.effective_ns(k) for k in range(ticks + 1)], dtype=float),
            np.array(commanded),
        )
        off = valves.impulses(edges) - np.diff(total.until(edges), axis=0)
        late = np.diff(total.late(edges, 1e9 / carrier_hz), axis=0)
        least = full * [t.min_on_s for t in b.thrusters]
        name = f"pulses_{rate_hz}_hz" + (f"_carrier_{carrier_hz}_hz" if carrier_hz != 10 else "")
        out[f"{name}_worst_second_min_pulses"] = float(np.abs(off / least).max())
        out[f"{name}_less_late_min_pulses"] = float(np.abs((off + late) / least).max())
    return out


@dataclass(frozen=True)
class CommandedImpulse:
    """Commanded impulse (K, n) N s up to times (K,) ns, linear in between."""

    times_ns: Array
    total_N_s: Array

    def until(self, times_ns: Array) -> Array:
        """Return the impulse up to times (M,) ns: (M, n) N s."""
        return np.array(
            [np.interp(times_ns, self.times_ns, column) for column in self.total_N_s.T]
        ).T

    def late(self, ends_ns: Array, period_ns: float) -> Array:
        """Return, per period that ends at times (M,), the impulse less that of the thrust at its
        begin, (M, n).
        """
        begins = ends_ns - period_ns
        first = self.until(begins + 1e-3 * period_ns) - self.until(begins)
        return self.until(ends_ns) - self.until(begins) - 1e3 * first


def tracking(options: Options) -> Figures:
    """Measure steady errors and impulse with thrusters, beside ideal actuation."""
    out: Figures = {}
    duration_s = 40.0 if options.quick else 120.0
    for body in ("tetra12", "slider"):
        ideal = fly(scenario(duration_s, body, chaser={"actuation": "ideal"}))
        out[f"tracking_{body}_ideal_position_rms_m"] = ideal.rms(20.0)[0]
        out[f"tracking_{body}_ideal_absolute_impulse_N_s"] = float(ideal.absolute_impulse_N_s[0])
        rates: list[tuple[str, int, dict[str, Any]]] = [(f"{hz}_hz", hz, {}) for hz in (15, 10, 30)]
        rates += [(name, 15, chaser) for name, chaser in VARIANTS.items()]
        for variant, rate_hz, chaser in rates[:1] if options.quick else rates:
            record = fly(scenario(duration_s, body, rate_hz, chaser=chaser))
            position, angle = record.rms(20.0)
            name = f"tracking_{body}_{variant}"
            out |= {
                f"{name}_position_rms_m": position,
                f"{name}_orientation_rms_rad": angle,
                f"{name}_thruster_impulse_N_s": float(record.thruster_impulse_N_s[0]),
                f"{name}_propellant_kg": float(record.propellant_kg[0]),
            }
    return out


def _isolated_s(record: FlightRecord, thruster: int) -> float:
    """Return the time from a thruster's failure to the closing of its shut-off valve; infinite if
    never.
    """
    times = [
        c.effective_time_ns / 1e9 - FAILED_AT_S
        for c in record.commands_of(0)
        if thruster in c.isolated
    ]
    return times[0] if times else math.inf


def stuck_on(options: Options) -> Figures:
    """Let every thruster stick open at 30 s, not reported: time to isolation, wrongly isolated
    thrusters, errors afterwards.
    """
    return _failures(options, "stuck_on", 60.0)


def stuck_off(options: Options) -> Figures:
    """Let every thruster be lost at 30 s, not reported: the same."""
    return _failures(options, "stuck_off", 80.0)


def _failures(options: Options, kind: str, duration_s: float) -> Figures:
    delays, wrong, peaks, final = [], 0, [], []
    for thruster in (0, 5) if options.quick else range(12):
        failure = {"chaser": 0, "thruster": thruster, "at_s": FAILED_AT_S, "kind": kind}
        record = fly(scenario(duration_s, thruster_failure=[failure]))
        delays.append(_isolated_s(record, thruster))
        wrong += len({j for c in record.commands_of(0) for j in c.isolated} - {thruster})
        late = record.time_s >= FAILED_AT_S
        errors = record.position_error_m[late, 0], record.orientation_error_rad[late, 0]
        peaks.append((float(errors[0].max()), float(errors[1].max())))
        final.append(record.rms(record.time_s[-1] - 10.0)[0])
        print(
            f"  {kind} thruster {thruster}: isolated after {delays[-1]:.3f} s, "
            f"peak {peaks[-1][0] * 1e3:.1f} mm, "
            f"{math.degrees(peaks[-1][1]):.2f} deg; {record.thruster_events}",
            file=sys.stderr,
        )
    return {
        f"failures_{kind}_flights": float(len(delays)),
        f"failures_{kind}_isolated": float(np.isfinite(delays).sum()),
        f"failures_{kind}_wrong_thrusters": float(wrong),
        f"failures_{kind}_time_to_isolation_median_s": float(np.median(delays)),
        f"failures_{kind}_time_to_isolation_max_s": float(max(delays)),
        f"failures_{kind}_peak_position_error_max_m": float(max(p for p, _ in peaks)),
        f"failures_{kind}_peak_orientation_error_max_rad": max(a for _, a in peaks),
        f"failures_{kind}_final_position_rms_max_m": float(max(final)),
    }


def healthy(options: Options) -> Figures:
    """Count false alarms without failures: random starts, up to three times the paper's rates,
    noisy measurements, both bodies.
    """
    alarms, flights = 0, 4 if options.quick else 20
    for seed in range(flights):
        rng = np.random.default_rng(100 + seed)
        times = rng.uniform(0.0, 3.0)
        start = {
            "start_offset_m": rng.uniform(-0.15, 0.15, 3).tolist(),
            "start_rotation_rad": rng.uniform(-0.2, 0.2, 3).tolist(),
            "start_velocity_m_s": rng.uniform(-0.02, 0.02, 3).tolist(),
        }
        target = {
            key: _randomly_rotated(rng, np.array(v) * times) for key, v in PAPER_RATES.items()
        }
        s = scenario(
            40.0 if options.quick else 60.0,
            ("tetra12", "slider")[seed % 2],
            (15, 10, 30)[seed % 3],
            start=start,
            target=target,
        )
        record = record_flight(s, measurement_model(s, seed, 0.002, math.radians(0.1)))
        alarms += len(record.thruster_events)
        for event in record.thruster_events:
            print(f"  healthy flight {seed}: {event}", file=sys.stderr)
    return {"healthy_flights": float(flights), "healthy_false_alarms": float(alarms)}


def _randomly_rotated(rng: np.random.Generator, vector: Array) -> list[float]:
    return rotations.rotate(rotations.normalize(rng.normal(size=4)), vector).tolist()


GROUP = Group(
    {
        "thrusters-allocation": allocation,
        "thrusters-pulses": pulses,
        "thrusters-tracking": tracking,
        "thrusters-stuck-on": stuck_on,
        "thrusters-stuck-off": stuck_off,
        "thrusters-healthy": healthy,
    }
)
