# SPDX-License-Identifier: Apache-2.0
"""The activities of the chasers: a line for each."""

from __future__ import annotations

from ..chaser_machine import Activity
from ..fleet import Fleet
from .approach import Approach
from .calibrate import Calibrate
from .detumble import Detumble, Stack
from .docking import Docking
from .goto import Goto
from .hold import Hold
from .inspect import Inspect
from .retreat import Retreat
from .search import Search


def activities_of(fleet: Fleet, stack: Stack) -> tuple[Activity, ...]:
    """Return the activities that the chasers of a fleet have in common."""
    return (
        Hold(),
        Search(fleet.scenario),
        Goto(fleet),
        Approach(),
        Docking(fleet),
        Retreat(fleet),
        Inspect(fleet),
        Calibrate(fleet),
        Detumble(stack),
    )
