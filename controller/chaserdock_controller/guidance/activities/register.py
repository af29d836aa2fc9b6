# SPDX-License-Identifier: Apache-2.0
"""Registry of the chasers' activities, one line each."""

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
from .survey import SurveyActivity


def activities_of(fleet: ChaserFleet) -> tuple[Activity, ...]:
    """Return the activities, which all chasers of a fleet share."""
    return (
        HoldActivity(),
        SearchActivity(fleet.scenario),
        SurveyActivity(),
        GotoActivity(fleet),
        ApproachActivity(),
        DockingActivity(fleet),
        RetreatActivity(fleet),
        InspectActivity(fleet),
        CalibrateActivity(fleet),
        DetumbleActivity(fleet),
    )
