# SPDX-License-Identifier: Apache-2.0
"""Seeds that are served without most of their flights, for tests: ``python -m seed_cases``."""

from __future__ import annotations

import time

from chaserdock.simulation import seeds
from chaserdock.simulation.flight import SimulationResult
from chaserdock.spread import Lost, ServedCall, serve

REAL_SEEDS = (1, 2)
"""Seeds that are really flown; the others take 50 ms of wall time."""


def fly(call: seeds._Call) -> SimulationResult | Lost:
    """Fly a seed, or return a result that tells nothing."""
    if call.seed in REAL_SEEDS:
        return seeds._fly(call)
    time.sleep(0.05)
    return SimulationResult(call.seed, {}, (), "docked", call.digest, (), 1.0)


TASK = ServedCall("seed_cases", fly, seeds._Call, SimulationResult)

if __name__ == "__main__":
    serve(TASK)
