"""Thrusters measured: ``python benchmarks/thrusters.py [--quick] [--json FILE] [--only PART ...]``.

Parts: ``allocation`` (random wrenches), ``pulses`` (given against asked for), ``tracking`` (perfect state, the paper's
rates), ``failures`` (every thruster of tetra12 stuck on, and stuck off, untold, at 30 s), ``healthy`` (false alarms).
Flights are those of ``closed_loop``: everything that flies, without images. ``--quick``: fewer and shorter.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_agents.chaser.thrusters.allocation import allocator_of
from chaserdock_agents.chaser.thrusters.modulation import Modulator
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.thruster_model import Valves
from chaserdock_protocol.scenario import Scenario, parse_scenario
from chaserdock_protocol.scenario.thrusters import thrusts_max
from closed_loop import Record, fly
from results import options_of, write_json

ROOT = Path(__file__).resolve().parents[1]
FAILED_AT_S = 30.01  # just after a tick: the longest until two whole ticks are seen
PAPER_RATES = {"velocity_m_s": (0.015, 0.0075, 0.03), "omega_rad_s": (0.015, 0.045, 0.03)}


VARIANTS: dict[str, dict[str, Any]] = {
    "untested": {"thruster_test_s": 0.0},
    "carrier_15_hz": {"modulation": {"carrier_hz": 15}},
    "schmitt": {"modulation": {"modulator": "schmitt"}},
}
"""Of the chasers, at 15 Hz: without test burns, with a period a tick, with a Schmitt trigger instead of pulse widths."""


def scenario(duration_s: float, body: str = "tetra12", rate_hz: int = 15, **changes: Any) -> Scenario:
    """One chaser a metre from the target, with thrusters unless said otherwise."""
    chaser = {"body": body, "actuation": "thrusters", **changes.pop("chaser", {})}
    start = {
        "start_offset_m": [-0.1, 0.02, 0.0],
        "start_rotation_rad": [0.05, 0.0, 0.0],
        **changes.pop("start", {}),
    }
    values: dict[str, Any] = {
        "name": "bench",
        "duration_s": duration_s,
        "time": {"rate_hz": rate_hz, "image_hz": rate_hz},
        "chaser": chaser,
        "chasers": [{"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0], **start}],
    }
    return parse_scenario(values | changes, "benchmark")


def allocation(quick: bool) -> dict[str, float]:
    """Wrenches that thrusters can give, up to full thrust of all, reproduced; and how long that takes."""
    out: dict[str, float] = {}
    for body in ("tetra12", "slider"):
        rng = np.random.default_rng(1)
        b = scenario(1.0, body).chaser
        allocator, full = allocator_of(b), thrusts_max(b.thrusters)
        box = np.array([b.force_max_N] * 3 + [b.torque_max_N_m] * 3)
        worst, over, inexact, took = 0.0, 0.0, 0, []
        for _ in range(1000 if quick else 10_000):
            wrench = allocator.matrix @ (full * rng.uniform(0.0, 1.0, len(full)))
            begun = time.perf_counter()
            got = allocator.allocate(wrench, full)
            took.append(time.perf_counter() - begun)
            error = np.abs((allocator.matrix @ got.thrusts_N - wrench) / box).max()
            worst = max(worst, error / np.abs(wrench / box).max())
            over = max(over, float((got.thrusts_N - full).max()), float(-got.thrusts_N.min()))
            inexact += not got.exact
        out |= {
            f"allocation_{body}_worst_relative_error": worst,
            f"allocation_{body}_inexact": float(inexact),
            f"allocation_{body}_beyond_limits_N": over,
            f"allocation_{body}_median_s": float(np.median(took)),
        }
    return out


def pulses(quick: bool) -> dict[str, float]:
    """Thrusts asked for at random, new every tick: greatest difference of impulse given and asked for, over any whole
    number of carrier periods that makes a second, in minimum pulses of the thruster.

    ``less_late``: without what was asked for within a period after its pulse had been sent. Where every tick begins a
    period there is none.
    """
    out: dict[str, float] = {}
    for rate_hz, carrier_hz in ((10, 10), (15, 10), (30, 10), (15, 15)):
        s = scenario(1.0, rate_hz=rate_hz, chaser={"modulation": {"carrier_hz": carrier_hz}})
        b, timing, rng = s.chaser, s.timing, np.random.default_rng(2)
        full = thrusts_max(b.thrusters)
        modulator, valves = Modulator(b.thrusters, b.modulation, timing), Valves(b.thrusters)
        ticks, level = (20 if quick else 200) * rate_hz, full
        asked = [np.zeros(len(full))]
        for tick in range(ticks):
            # Held for a second at most a third, so that small and large thrusts, and steps between, all come.
            if tick % rate_hz == 0:
                level = full * rng.uniform(0.0, 0.8, len(full)) ** 3
            thrusts = level * rng.uniform(0.9, 1.1, len(full))
            begin, end = timing.effective_ns(tick), timing.effective_ns(tick + 1)
            asked.append(asked[-1] + thrusts * (end - begin) * 1e-9)
            for p in modulator.pulses(thrusts, full, begin, end):
                valves.pulse(p.thruster, p.open_ns, p.close_ns)
        # Where periods and ticks begin together, every whole second of the carrier is one of the ticks, too.
        edges = np.array([timing.effective_ns(k * rate_hz) for k in range(1, ticks // rate_hz)], dtype=float)
        total = Asked(
            np.array([timing.effective_ns(k) for k in range(ticks + 1)], dtype=float), np.array(asked)
        )
        off = valves.impulses(edges) - np.diff(total.until(edges), axis=0)
        late = np.diff(total.late(edges, 1e9 / carrier_hz), axis=0)
        least = full * [t.min_on_s for t in b.thrusters]
        name = f"pulses_{rate_hz}_hz" + (f"_carrier_{carrier_hz}_hz" if carrier_hz != 10 else "")
        out[f"{name}_worst_second_min_pulses"] = float(np.abs(off / least).max())
        out[f"{name}_less_late_min_pulses"] = float(np.abs((off + late) / least).max())
    return out


@dataclass(frozen=True)
class Asked:
    """Impulse asked for up to times (K,) ns: (K, n) N s, growing evenly in between."""

    times_ns: Array
    total_N_s: Array

    def until(self, times_ns: Array) -> Array:
        """Asked for up to times (M,) ns: (M, n) N s."""
        return np.array([np.interp(times_ns, self.times_ns, column) for column in self.total_N_s.T]).T

    def late(self, ends_ns: Array, period_ns: float) -> Array:
        """Of the periods that end at times (M,): asked for less what the thrust at their begin would make, (M, n)."""
        begins = ends_ns - period_ns
        first = self.until(begins + 1e-3 * period_ns) - self.until(begins)
        return self.until(ends_ns) - self.until(begins) - 1e3 * first


def tracking(quick: bool) -> dict[str, float]:
    """Steady errors with thrusters, perfect state, and what that costs beside ideal actuation."""
    out: dict[str, float] = {}
    duration_s = 40.0 if quick else 120.0
    for body in ("tetra12", "slider"):
        ideal = fly(scenario(duration_s, body, chaser={"actuation": "ideal"}))[0]
        out[f"tracking_{body}_ideal_position_rms_m"] = ideal.rms(20.0)[0]
        out[f"tracking_{body}_ideal_absolute_impulse_N_s"] = ideal.absolute_impulse_N_s
        rates: list[tuple[str, int, dict[str, Any]]] = [(f"{hz}_hz", hz, {}) for hz in (15, 10, 30)]
        rates += [(name, 15, chaser) for name, chaser in VARIANTS.items()]
        for variant, rate_hz, chaser in rates[:1] if quick else rates:
            record = fly(scenario(duration_s, body, rate_hz, chaser=chaser))[0]
            position, angle = record.rms(20.0)
            name = f"tracking_{body}_{variant}"
            out |= {
                f"{name}_position_rms_m": position,
                f"{name}_orientation_rms_deg": math.degrees(angle),
                f"{name}_thruster_impulse_N_s": record.thruster_impulse_N_s(),
                f"{name}_propellant_kg": record.propellant_kg,
            }
    return out


def _isolated_s(record: Record, thruster: int) -> float:
    """When a thruster's shut-off valve was closed after its failure, s from then; infinite if never."""
    times = [c.effective_time_ns / 1e9 - FAILED_AT_S for c in record.commands if thruster in c.isolated]
    return times[0] if times else math.inf


def failures(quick: bool) -> dict[str, float]:
    """Every thruster fails untold at 30 s: when the right one is shut off, how many wrong ones are, the errors after."""
    out: dict[str, float] = {}
    thrusters = (0, 5, 10) if quick else range(12)
    for kind in ("stuck_on", "stuck_off"):
        delays, wrong, peaks, final = [], 0, [], []
        for thruster in thrusters:
            failure = {"chaser": 0, "thruster": thruster, "at_s": FAILED_AT_S, "kind": kind}
            record = fly(scenario(80.0 if kind == "stuck_off" else 60.0, thruster_failure=[failure]))[0]
            delays.append(_isolated_s(record, thruster))
            wrong += len({j for c in record.commands for j in c.isolated} - {thruster})
            late = np.array(record.time_s) >= FAILED_AT_S
            peaks.append((max(np.array(record.position_m)[late]), max(np.array(record.angle_rad)[late])))
            final.append(record.rms(record.time_s[-1] - 10.0)[0])
            print(f"  {kind} thruster {thruster}: isolated after {delays[-1]:.3f} s, peak {peaks[-1][0] * 1e3:.1f} mm, "
                  f"{math.degrees(peaks[-1][1]):.2f} deg; {record.events}", file=sys.stderr)  # fmt: skip
        out |= {
            f"failures_{kind}_flights": float(len(delays)),
            f"failures_{kind}_isolated": float(np.isfinite(delays).sum()),
            f"failures_{kind}_wrong_thrusters": float(wrong),
            f"failures_{kind}_median_time_to_isolation_s": float(np.median(delays)),
            f"failures_{kind}_max_time_to_isolation_s": float(max(delays)),
            f"failures_{kind}_max_peak_position_m": float(max(p for p, _ in peaks)),
            f"failures_{kind}_max_peak_orientation_deg": math.degrees(max(a for _, a in peaks)),
            f"failures_{kind}_max_final_position_rms_m": float(max(final)),
        }
    return out


def healthy(quick: bool) -> dict[str, float]:
    """Flights with nothing wrong: random starts, tumbles up to three times the paper's, noisy sightings, both bodies."""
    alarms, flights = 0, 4 if quick else 20
    for seed in range(flights):
        rng = np.random.default_rng(100 + seed)
        times = rng.uniform(0.0, 3.0)
        start = {
            "start_offset_m": rng.uniform(-0.15, 0.15, 3).tolist(),
            "start_rotation_rad": rng.uniform(-0.2, 0.2, 3).tolist(),
            "start_velocity_m_s": rng.uniform(-0.02, 0.02, 3).tolist(),
        }
        target = {key: _turned(rng, np.array(v) * times) for key, v in PAPER_RATES.items()}
        s = scenario(40.0 if quick else 60.0, ("tetra12", "slider")[seed % 2], (15, 10, 30)[seed % 3], start=start,
                     target=target)  # fmt: skip
        record = fly(s, seed, noise_m=0.002, noise_rad=math.radians(0.1))[0]
        alarms += len(record.events)
        for event in record.events:
            print(f"  healthy flight {seed}: {event}", file=sys.stderr)
    return {"healthy_flights": float(flights), "healthy_false_alarms": float(alarms)}


def _turned(rng: np.random.Generator, vector: Array) -> list[float]:
    return rotations.rotate(rotations.normalize(rng.normal(size=4)), vector).tolist()


PARTS: dict[str, Callable[[bool], dict[str, float]]] = {
    "allocation": allocation,
    "pulses": pulses,
    "tracking": tracking,
    "failures": failures,
    "healthy": healthy,
}


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    options = parser.parse_args()
    result: dict[str, float] = {}
    for part in options.only:
        figures = PARTS[part](options.quick)
        width = max(map(len, figures))
        for name, value in figures.items():
            print(f"{name:{width}}  {value:.5g}", flush=True)
        result |= figures
    write_json(options.json, result)


if __name__ == "__main__":
    main()
