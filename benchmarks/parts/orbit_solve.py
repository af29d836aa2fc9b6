# SPDX-License-Identifier: Apache-2.0
"""Time of a solve with ``[orbit]`` over that without: two missions in one process, equal but for
``[orbit]``, with statistical perception, tick by tick in turn.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser
from collections.abc import Callable
from statistics import median
from typing import ParamSpec, TypeVar

from chaserdock_protocol.scenario import Scenario
from common import Figures, Group, Options
from flights import load_shipped

from chaserdock.experiments.in_process import InProcessMission
from chaserdock.experiments.perception import RenderedImages

P = ParamSpec("P")
T = TypeVar("T")


class TimedFlight:
    """A mission whose controller is timed. ``solve_s``, ``tick_s``: processor time of each tick's
    solve and of its controller.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.mission = InProcessMission(scenario, RenderedImages(scenario))
        self.solve_s: list[float] = []
        self.tick_s: list[float] = []
        controller = self.mission.controller
        solve, step = controller.planning.solver.solve, controller.step
        controller.planning.solver.solve = timed(solve, self.solve_s)
        controller.step = timed(step, self.tick_s)


def timed(function: Callable[P, T], durations_s: list[float]) -> Callable[P, T]:
    """Return a function that appends its processor time to ``durations_s`` at each call."""

    def measured(*args: P.args, **options: P.kwargs) -> T:
        start_s = time.process_time()
        result = function(*args, **options)
        durations_s.append(time.process_time() - start_s)
        return result

    return measured


def orbit(options: Options) -> Figures:
    """Time solver and controller with ``[orbit]`` and without, 600 ticks (``--quick``: 60)."""
    overrides = ("perception.name='statistical'", "timeline=[]", "duration_s=1000.0")
    in_orbit = load_shipped(
        options.scenario, *overrides, f"limits.passive_safety='{options.safety}'"
    )
    free = load_shipped(options.scenario, *overrides, "limits.passive_safety='off'")
    pair = [TimedFlight(in_orbit), TimedFlight(free.model_copy(update={"orbit": None}))]
    for _ in range(60 if options.quick else options.orbit_ticks):
        for flight in pair:
            flight.mission.step()
    figures: Figures = {"ticks": len(pair[0].tick_s)}
    for name, orbit_s, free_s in (
        ("solve", median(pair[0].solve_s), median(pair[1].solve_s)),
        ("tick", median(pair[0].tick_s), median(pair[1].tick_s)),
    ):
        figures |= {
            f"orbit_{name}_s": orbit_s,
            f"free_{name}_s": free_s,
            f"ratio_{name}": orbit_s / free_s,
        }
    return figures


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument("--scenario", default="low-orbit", help="of orbit: one with [orbit]")
    parser.add_argument("--orbit-ticks", type=int, default=600, metavar="N")
    parser.add_argument(
        "--safety",
        default="off",
        choices=("off", "monitor", "enforce"),
        help="of orbit: passive safety",
    )


GROUP = Group({"orbit": orbit}, add_options=add_options)
