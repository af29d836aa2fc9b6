# SPDX-License-Identifier: Apache-2.0
"""Check for packages that only some scenarios need of the world, and state what to do
without them.
"""

from __future__ import annotations

import platform
import sys
from importlib.util import find_spec

from chaserdock_protocol.errors import MissingPackageError, how_to_install, require_extra
from chaserdock_protocol.scenario import Scenario


def require_packages(scenario: Scenario) -> None:
    """Raise MissingPackageError if a package that the world of a scenario needs is not
    installed.
    """
    if scenario.world.engine == "mujoco":
        require_extra("mujoco", "mujoco")
    else:
        require_pybullet()


def require_pybullet(
    what: str = "the world",
    instead: str = (
        f'elsewhere, {how_to_install("mujoco")} and set world.engine = "mujoco" '
        "(--set world.engine=mujoco)"
    ),
) -> None:
    """Raise MissingPackageError if PyBullet, which ``what`` needs, is not installed; ``instead``:
    what else helps.
    """
    if find_spec("pybullet") is None:
        here = (
            f"Python {sys.version_info.major}.{sys.version_info.minor} on {sys.platform} "
            f"{platform.machine()}"
        )
        raise MissingPackageError(
            f"{what} needs PyBullet, which is not installed; it has wheels for Python 3.11 on "
            "Linux x86_64 only (this is "
            f"{here}); {instead}",
            name="pybullet",
        )
