# SPDX-License-Identifier: Apache-2.0
"""Speed of simulated missions: ``python benchmarks/simulate.py [--only PART ...]``.

All processes of a mission in one, on one core, with logs in memory; seconds are those of the
processor.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from chaserdock_protocol.shipped_scenarios import find_scenario
from common import Figures, Group, Options, main
from parts import cluster, laboratory

from chaserdock.simulation.flight import memory_folder
from chaserdock.simulation.mission import simulate
from chaserdock.simulation.seeds import SeedOptions, fly_seed

SCENARIO = "fault-drill"
STATISTICAL = 'perception.name="statistical"'


def nominal(options: Options) -> Figures:
    """Fly ``fault-drill`` without faults, in lock-step and in real time, with statistical
    perception and with images: the shortest time of three flights (``--quick``: one) each.
    """
    flights = 1 if options.quick else 3
    figures: Figures = {}
    for perception, overrides in (("statistical", (STATISTICAL,)), ("images", ())):
        for mode in ("lockstep", "realtime"):
            seconds = []
            for _ in range(flights):
                with tempfile.TemporaryDirectory(dir=memory_folder()) as folder:
                    begin_s = time.process_time()
                    conditions = (*overrides, f'simulation.mode="{mode}"')
                    simulate(find_scenario(SCENARIO), Path(folder) / "run", conditions)
                    seconds.append(time.process_time() - begin_s)
            figures[f"{perception}_{mode}_s"] = min(seconds)
    return figures


def swarm(options: Options) -> Figures:
    """Fly 50 random seeds (``--quick``: 3)."""
    seeds = 3 if options.quick else 50
    begin_s, outcomes, simulated_s = time.process_time(), Counter(), 0.0
    for seed in range(1, seeds + 1):
        result = fly_seed(SeedOptions(SCENARIO), seed)
        outcomes[result.outcome] += 1
        simulated_s += result.sim_time_s
    elapsed_s = time.process_time() - begin_s
    return {
        "seeds": seeds,
        "seeds_per_core_s": seeds / elapsed_s,
        "simulated_over_processor_time": simulated_s / elapsed_s,
        **{
            f"outcome_{name.replace(' ', '_')}": number for name, number in sorted(outcomes.items())
        },
    }


_TICKS, _SHORT_TICKS = 40, 20
"""Ticks that are counted, and ticks before them."""
_FLIGHTS = """
import sys, tempfile
from pathlib import Path
from chaserdock_models.native import KernelLibrary
from chaserdock_protocol.shipped_scenarios import find_scenario
from chaserdock.simulation.mission import simulate
from chaserdock.simulation.flight import memory_folder
# valgrind does not know all instructions of the other kernels
KernelLibrary.level = property(lambda self: 2)
statistical = 'perception.name="statistical"'
short = ("timeline=[]", "settling_s=0.0", "steady_until_s=1.0", "success.docked=[]", statistical)
for duration in sys.argv[2:]:
    with tempfile.TemporaryDirectory() as folder:
        overrides = (*short, f"duration_s={duration}")
        simulate(find_scenario(sys.argv[1]), Path(folder) / "run", overrides)
"""


def instructions(_: Options) -> Figures:
    """Count the instructions of a tick in lock-step with statistical perception, by valgrind.

    Those by which a second flight of 6 s exceeds one of 2 s, so that neither start nor imports
    count; they do not depend on the load of the machine. Takes minutes, also with ``--quick``.
    Raises SystemExit without valgrind.
    """
    if shutil.which("valgrind") is None:
        raise SystemExit("instructions needs valgrind (Debian: apt-get install valgrind)")
    short, long = (str(ticks / 10.0) for ticks in (_SHORT_TICKS, _SHORT_TICKS + _TICKS))
    return {"instructions_per_tick": (_count(short, long) - _count(short, short)) / _TICKS}


def _count(*durations_s: str) -> int:
    """Return the instructions of a process that flies for these durations."""
    valgrind = [
        "valgrind",
        "--tool=cachegrind",
        "--cache-sim=no",
        "--cachegrind-out-file=/dev/null",
    ]
    command = [*valgrind, sys.executable, "-c", _FLIGHTS, SCENARIO, *durations_s]
    environment = {**os.environ, "PYTHONHASHSEED": "0"}
    output = subprocess.run(
        command, check=True, capture_output=True, text=True, env=environment
    ).stderr
    found = re.search(r"I\s+refs:\s+([0-9,]+)", output)
    if found is None:
        raise RuntimeError(f"valgrind counts no instructions:\n{output}")
    return int(found[1].replace(",", ""))


GROUPS = (
    Group(
        {"nominal": nominal, "swarm": swarm, "instructions": instructions},
        on_request=("instructions",),
    ),
    laboratory.GROUP,
    cluster.GROUP,
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
