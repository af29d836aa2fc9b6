# SPDX-License-Identifier: Apache-2.0
"""Speed of simulated missions: ``python benchmarks/simulate.py [--quick] [--json FILE] [--only nominal swarm]``.

``nominal``: ``fault-drill`` without faults, in lock-step and in real time, with statistical perception and with images;
``swarm``: random seeds. All on one core; seconds are those of the processor.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from pathlib import Path

from chaserdock_protocol.shipped_scenarios import find_scenario
from common import Figures, make_parser, run_parts

from chaserdock.simulation.campaign import Swarm, fly_seeds
from chaserdock.simulation.mission import simulate

SCENARIO = "fault-drill"
STATISTICAL = 'perception.name="statistical"'


def nominal(flights: int) -> Figures:
    """Fly without faults; the shortest time of several flights each."""
    figures: Figures = {}
    for perception, overrides in (("statistical", (STATISTICAL,)), ("images", ())):
        for mode in ("lockstep", "realtime"):
            seconds = []
            for _ in range(flights):
                with tempfile.TemporaryDirectory() as folder:
                    begin_s = time.process_time()
                    conditions = (*overrides, f'simulation.mode="{mode}"')
                    simulate(find_scenario(SCENARIO), Path(folder) / "run", conditions)
                    seconds.append(time.process_time() - begin_s)
            figures[f"{perception}_{mode}_s"] = min(seconds)
    return figures


def swarm(seeds: int) -> Figures:
    """Fly random seeds."""
    begin_s, outcomes, simulated_s = time.process_time(), Counter(), 0.0
    for result in fly_seeds(Swarm(SCENARIO), range(1, seeds + 1)):
        outcomes[result.outcome] += 1
        simulated_s += result.sim_time_s
    elapsed_s = time.process_time() - begin_s
    return {
        "seeds": seeds,
        "seeds_per_core_s": seeds / elapsed_s,
        "simulated_over_processor_time": simulated_s / elapsed_s,
        **{f"outcome_{name.replace(' ', '_')}": number for name, number in sorted(outcomes.items())},
    }


def main() -> None:
    options = make_parser(__doc__, ("nominal", "swarm")).parse_args()
    parts = {
        "nominal": lambda: nominal(1 if options.quick else 3),
        "swarm": lambda: swarm(3 if options.quick else 50),
    }
    run_parts(options, parts)


if __name__ == "__main__":
    main()
