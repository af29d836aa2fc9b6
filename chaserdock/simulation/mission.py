# SPDX-License-Identifier: Apache-2.0
"""Flies one scenario in this process: all processes of the mission, unchanged, over a simulated
network.
"""

from __future__ import annotations

import contextlib
import gc
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from chaserdock_agents.chaser import process as chaser
from chaserdock_agents.mapper import process as mapper
from chaserdock_agents.recorder import process as recorder
from chaserdock_controller import process as controller
from chaserdock_protocol.process import ProcessOptions
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.transport import Link, RawSample
from chaserdock_world import process as world
from chaserdock_world.requirements import require_packages

from .links import Traffic
from .network import SimulatedNetwork
from .scheduler import Scheduler, Task

Tap = Callable[[str, RawSample], None]
ProcessMain = Callable[[ProcessOptions], int]

_START_S, _END_S = 30.0, 60.0
"""Longest virtual time (s) from the start of the processes to the first tick, and from the end of
the mission to the end of all processes.
"""


@dataclass(frozen=True)
class SimulatedFlight:
    """A simulated flight. ``statuses``: exit status by process; None for one that was killed.

    ``crashes``: traceback by process. ``stalled``: processes that had not ended when time was up.
    ``output``: text that the processes printed. ``time_s``: virtual time at the end.
    """

    folder: Path
    statuses: dict[str, int | None]
    crashes: dict[str, str]
    stalled: tuple[str, ...]
    output: str
    time_s: float
    traffic: Traffic = field(repr=False)


def simulate(
    path: Path,
    folder: Path,
    overrides: tuple[str, ...] = (),
    tap: Tap | None = None,
    over: Callable[[], bool] | None = None,
    others: Mapping[str, ProcessMain] | None = None,
) -> SimulatedFlight:
    """Fly a scenario file under the conditions of its section ``[simulation]``; the recorder writes
    to ``folder``.

    ``tap``: called with sender and sample of every message when it is published. ``over``: the
    flight is broken off once it returns True. ``others``: processes by name, which are added or
    take the place of those of their names. Raises ScenarioError and MissingPackageError.
    """
    scenario = load_scenario(path, overrides)
    require_packages(scenario)
    scheduler = Scheduler(scenario.seed)
    conditions = scenario.simulation
    lockstep = conditions.mode == "lockstep"
    network = SimulatedNetwork(scheduler, conditions, scenario.seed, lockstep, tap)

    options = ProcessOptions(
        link=Link(network=network),
        scenario=path,
        overrides=overrides,
        mode=conditions.mode,
        out=folder,
        viewer_layer=False,
        compressed_log=False,  # it is read once, if at all
        signals=False,
    )

    printed = io.StringIO()
    collecting = gc.isenabled()
    gc.disable()
    try:
        with contextlib.redirect_stderr(printed):
            tasks = _spawn(scheduler, scenario, options, others or {})
            limit_s = _START_S + 3.0 * scenario.duration_s + _END_S
            scheduler.run(limit_s, over)
            stalled = tuple(t.name for t in tasks if not t.done)
            scheduler.end()
    finally:
        if collecting:
            gc.enable()

    return SimulatedFlight(
        folder=folder,
        statuses={t.name: None if t.killed else t.result for t in tasks if t.name not in stalled},
        crashes={t.name: t.error for t in tasks if t.error},
        stalled=stalled,
        output=printed.getvalue(),
        time_s=scheduler.now_s,
        traffic=network.traffic,
    )


def _spawn(
    scheduler: Scheduler,
    scenario: Scenario,
    options: ProcessOptions,
    others: Mapping[str, ProcessMain],
) -> list[Task]:
    """Start world, controllers, chasers, mapper, recorder, and ``others``, some in place of
    these.
    """
    left = dict(others)

    def start(name: str, main: ProcessMain, **changes: object) -> Task:
        own = left.pop(name, main)
        return scheduler.spawn(name, lambda: own(replace(options, **changes)))

    tasks = [start("world", world.main), start("controller", controller.main)]
    if scenario.controller.standby:
        tasks.append(start("standby", controller.main, standby=True))
    tasks += [start(f"chaser/{i}", chaser.main, chaser=i) for i in range(len(scenario.chasers))]
    if scenario.maps_target:
        tasks.append(start("mapper", mapper.main))
    tasks.append(start("recorder", recorder.main))
    return [*tasks, *(start(name, left[name]) for name in tuple(left))]
