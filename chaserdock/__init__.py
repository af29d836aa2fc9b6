# SPDX-License-Identifier: Apache-2.0
"""Python API of chaserdock: fly missions, open their logs, load scenarios.

>>> import chaserdock as cd
>>> camera = {"width_px": 640, "height_px": 360}
>>> result = cd.run("single", duration_s=20, camera=camera)  # doctest: +SKIP
>>> result.summary.success, result.summary.chasers[0].steady.position_mse_m2  # doctest: +SKIP
>>> result.log.table("controller/target").to_pandas()  # doctest: +SKIP

Errors are ``ChaserdockError`` or a subclass, with the text that the command line prints. Nothing is
printed, no signal handler is installed; the functions work in notebooks and in threads.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from chaserdock_protocol.errors import ChaserdockError, MissingPackageError, ScenarioError

from .api import RunResult, list_scenarios, load_scenario, open_log, run

if TYPE_CHECKING:
    from chaserdock_protocol.recording.scan import LogError

    from .launch.launcher import RunError
    from .logs.reader import Log
    from .summary import ChaserSummary, Summary

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
    "list_scenarios",
    "load_scenario",
    "open_log",
    "run",
]


def __getattr__(name: str) -> Any:
    """Import the types that need heavy modules on first use."""
    if name == "Log":
        from .logs.reader import Log

        return Log
    if name == "LogError":
        from chaserdock_protocol.recording.scan import LogError

        return LogError
    if name == "RunError":
        from .launch.launcher import RunError

        return RunError
    if name in ("ChaserSummary", "Summary"):
        from . import summary

        return getattr(summary, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
