# SPDX-License-Identifier: Apache-2.0
"""Environments of train.py on the workers of a Dask cluster.

Each worker keeps its environments in its own memory (a Dask actor). A batch costs a message with
the weights to each worker and one with what it flew back: 16 MB in all for 2048 environments.
"""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
from distributed import Client
from train import ENVIRONMENTS, Flights

from chaserdock.envs import loaded
from chaserdock.version import difference, version

FOLDER = Path(__file__).parent
MODULES = ("policy_file.py", "proportional.py", "train.py", "fleet.py")


def started(scenario, seed, environments, middle, scale):
    """Return flights with the scale of another's observations."""
    flights = Flights(loaded(scenario), seed, environments)
    flights.middle, flights.scale = middle, scale
    return flights


class Fleet:
    """The flights of all workers, as one. ``like``: flights whose scale of observations they take.

    The workers need the packages of this process, and the scenario at the same path. Raises
    SystemExit for one with other sources.
    """

    def __init__(self, address, scenario, seed, like):
        self._client, here = Client(address), version()
        for worker, found in self._client.run(version).items():
            if why := difference(found, here):
                raise SystemExit(f"{worker}: {why}")
        for name in MODULES:
            self._client.upload_file(str(FOLDER / name))
        workers = sorted(self._client.scheduler_info(n_workers=-1)["workers"])
        shares = [len(part) for part in np.array_split(np.arange(ENVIRONMENTS), len(workers))]
        given, scale = Path(scenario).absolute(), (like.middle, like.scale)
        begun = [
            self._client.submit(
                started, given, seed + (k << 32), share, *scale, workers=[worker], actor=True
            )
            for k, (worker, share) in enumerate(zip(workers, shares, strict=True))
        ]
        self._flights = self._client.gather(begun)

    def spread_out(self, policy):
        """Do so on all workers; see ``Flights``."""
        self._all("spread_out", [(policy,)] * len(self._flights))

    def collect(self, trained, ticks, trace, key):
        """Return the columns of all workers; see ``Flights``."""
        draws = jax.random.split(key, len(self._flights))
        given = [(trained, ticks, trace, draw) for draw in draws]
        return tuple(map(np.concatenate, zip(*self._all("collect", given), strict=True)))

    def episodes_ended(self):
        """Return those of all workers; see ``Flights``."""
        return np.concatenate(self._all("episodes_ended", [()] * len(self._flights)))

    def _all(self, name, arguments):
        """Call a method of each worker's flights at once; return the results."""
        calls = zip(self._flights, arguments, strict=True)
        return [f.result() for f in [getattr(flights, name)(*given) for flights, given in calls]]
