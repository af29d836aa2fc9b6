# SPDX-License-Identifier: Apache-2.0
"""Python API of chaserdock: fly missions, open their logs, load scenarios, track targets in images.

>>> import chaserdock as cd
>>> camera = {"width_px": 640, "height_px": 360}
>>> result = cd.run("single", duration_s=20, camera=camera)  # doctest: +SKIP
>>> result.summary.success, result.summary.chasers[0].steady.position_mse_m2  # doctest: +SKIP
>>> result.log.table("controller/target").to_pandas()  # doctest: +SKIP

Errors are ``ChaserdockError`` or a subclass, with the text that the command line prints. Nothing is
printed, no signal handler is installed; the functions work in notebooks and in threads.
"""

from __future__ import annotations

TYPE_CHECKING = False  # as type checkers know it; `typing` alone takes most of this import
if TYPE_CHECKING:
    from typing import Any

    from chaserdock_protocol.errors import ChaserdockError, MissingPackageError, ScenarioError
    from chaserdock_protocol.recording.scan import LogError

    from .api import RunResult, list_scenarios, load_scenario, open_log, run
    from .launch.launcher import RunError
    from .logs.reader import Log
    from .summary import ChaserSummary, Summary
    from .tracking.tracker import TrackedImage, TrackedPose, TrackedTarget, Tracker

__all__ = [
    "ChaserSummary",
    "ChaserdockError",
    "Log",
    "LogError",
    "MissingPackageError",
    "RunError",
    "RunResult",
    "ScenarioError",
    "Summary",
    "TrackedImage",
    "TrackedPose",
    "TrackedTarget",
    "Tracker",
    "list_scenarios",
    "load_scenario",
    "open_log",
    "run",
]


def __getattr__(name: str) -> Any:
    """Import what is used on first use: the program's start must be quick, and stoppable."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in ("ChaserdockError", "MissingPackageError", "ScenarioError"):
        from chaserdock_protocol import errors as home
    elif name == "LogError":
        from chaserdock_protocol.recording import scan as home
    elif name == "RunError":
        from .launch import launcher as home
    elif name == "Log":
        from .logs import reader as home
    elif name.startswith("Track"):
        from .tracking import tracker as home
    elif name in ("ChaserSummary", "Summary"):
        from . import summary as home
    else:
        from . import api as home
    found = globals()[name] = getattr(home, name)
    return found
