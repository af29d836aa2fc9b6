# SPDX-License-Identifier: Apache-2.0
"""The activities of the chasers: a line for each."""

from __future__ import annotations

from ..chaser_machine import Activity
from ..fleet import ChaserFleet
from .approach import ApproachActivity
from .calibrate import CalibrateActivity
from .detumble import DetumbleActivity
from .docking import DockingActivity
from .goto import GotoActivity
from .hold import HoldActivity
from .inspect import InspectActivity
from .retreat import RetreatActivity
from .search import SearchActivity


def activities_of(fleet: ChaserFleet) -> tuple[Activity, ...]:
    """Return the activities that the chasers of a fleet have in common."""
    return (
        HoldActivity(),
        SearchActivity(fleet.scenario),
        GotoActivity(fleet),
        ApproachActivity(),
        DockingActivity(fleet),
        RetreatActivity(fleet),
        InspectActivity(fleet),
        CalibrateActivity(fleet),
        DetumbleActivity(fleet),
    )
