# SPDX-License-Identifier: Apache-2.0
"""Calls that other processes import, for tests of spreading."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from chaserdock.simulation.flight import SimulationResult
    from chaserdock.simulation.seeds import SeedOptions

REAL_SEEDS = (1, 2)
"""Seeds that ``fly`` really flies."""


def fly(options: SeedOptions, digest: str, seed: int) -> SimulationResult:
    """Fly a seed, most of them in 50 ms of wall time and to a result that tells nothing else."""
    from chaserdock.simulation.flight import SimulationResult
    from chaserdock.simulation.seeds import fly_seed

    if seed in REAL_SEEDS:
        return fly_seed(options, seed)
    time.sleep(0.05)
    return SimulationResult(seed, {"extends": options.scenario}, (), "docked", digest, {}, 1.0)


def die_once(marks: Path, item: int) -> int:
    """Return an item; at the first call with it, end the process by the status that it states."""
    mark = marks / str(item)
    if item and not mark.exists():
        mark.touch()
        os._exit(item)
    return item
