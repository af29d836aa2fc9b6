# SPDX-License-Identifier: Apache-2.0
"""The physics engines against each other: ``python benchmarks/engines.py [--only PART ...] [--quick] [--json FILE]``.

Parts: ``free``, ``thrusters``, ``capture`` and ``stack`` (open loop, 30 s, ``--quick`` 5 s; the cases of
``chaserdock.evaluation.engine_comparison``) print the largest differences of any body and port, the change of momentum on each
engine where no load acts, and the time per physics step. ``missions`` flies ``four-chaser-docking`` (30 s), ``docking-contact`` and
``four-chaser-capture`` in ``chaserdock simulate`` on each engine with the perception ``statistical``, and prints their success.
``--seeds N``: number of seeds of each mission.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

from chaserdock_protocol.shipped_scenarios import shipped_scenario
from common import Figures, make_parser, run_parts

from chaserdock.analysis.summary import summarize
from chaserdock.evaluation.engine_comparison import CASES, ENGINES, difference, fly_case
from chaserdock.simulation.mission import simulate

MISSIONS = {
    "four-chaser-docking": ("duration_s=30.0",),
    "docking-contact": (),
    "four-chaser-capture": (),
}
WITHOUT_LOADS = ("free", "capture")


def case(name: str, duration_s: float) -> Figures:
    """Return the differences of both engines in one case."""
    flights = {engine: fly_case(CASES[name](0), engine, duration_s) for engine in ENGINES}
    apart = difference(*flights.values())
    figures = {
        f"{name}_position_m": apart.position_m,
        f"{name}_attitude_deg": math.degrees(apart.angle_rad),
        f"{name}_port_force_N": apart.force_N,
        f"{name}_port_torque_N_m": apart.torque_N_m,
    }
    for engine, flight in flights.items():
        figures[f"{name}_{engine}_step_s"] = flight.step_s
        if name in WITHOUT_LOADS:
            figures[f"{name}_{engine}_momentum_share"] = flight.momentum_error
            figures[f"{name}_{engine}_angular_momentum_share"] = flight.angular_momentum_error
    return figures


def missions(seeds: int) -> Figures:
    """Return how many missions of each scenario succeed on each engine."""
    figures: Figures = {}
    for name, overrides in MISSIONS.items():
        for engine in ENGINES:
            successes = 0
            for seed in range(seeds):
                failures = failures_of(name, engine, seed, overrides)
                successes += not failures
                print(f"  {name}, {engine}, seed {seed}: {'; '.join(failures) or 'success'}", flush=True)
            figures[f"{name}_{engine}_success_share"] = successes / seeds
    return figures


def failures_of(name: str, engine: str, seed: int, overrides: tuple[str, ...]) -> list[str]:
    """Fly a mission in this process; return why it is no success."""
    settings = (*overrides, f"seed={seed}", f"world.engine={engine}", "perception.name=statistical")
    with tempfile.TemporaryDirectory() as folder:
        flight = simulate(shipped_scenario(name), Path(folder), settings)
        if flight.crashes or flight.stalled:
            return [*flight.crashes.values(), *flight.stalled]
        return summarize(Path(folder) / "mission.mcap")["failures"]


def main() -> None:
    """Run the parts."""
    parser = make_parser(__doc__, (*CASES, "missions"))
    parser.add_argument("--seeds", type=int, default=1, help="seeds of each mission")
    options = parser.parse_args()
    duration_s = 5.0 if options.quick else 30.0
    parts = {name: lambda name=name: case(name, duration_s) for name in CASES}
    run_parts(options, {**parts, "missions": lambda: missions(options.seeds)})


if __name__ == "__main__":
    main()
