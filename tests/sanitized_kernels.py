# SPDX-License-Identifier: Apache-2.0
"""pytest plug-in: load the kernels that `sanitizers.run_tests` compiled into SANITIZED_KERNELS/0,
1, ...
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from chaserdock_agents.chaser.perception import native as perception
from chaserdock_controller.estimation.joint import native as joint
from chaserdock_controller.nmpc import native as nmpc
from chaserdock_models import native as models
from chaserdock_models.native.build import LIBRARY_NAME, NATIVE_FOLDERS
from chaserdock_world.physics import native as physics
from chaserdock_world.rendering import native as rendering
from sanitizers import kernels_in
from source_tree import ROOT

from chaserdock.envs import native as envs

_LIBRARIES = {
    str(one.LIBRARY.path.parent.relative_to(ROOT)): one.LIBRARY
    for one in (models, perception, rendering, nmpc, joint, physics, envs)
}

for number, folder in enumerate(NATIVE_FOLDERS):
    _LIBRARIES[folder].path = Path(os.environ["SANITIZED_KERNELS"]) / str(number) / LIBRARY_NAME


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--all-kernels", action="store_true", help="fail unless the tests call all kernels"
    )


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    uncalled = {
        name
        for folder, library in _LIBRARIES.items()
        for name in kernels_in(folder) - library._functions.keys()  # pyright: ignore[reportPrivateUsage]
    }
    if session.config.getoption("all_kernels") and uncalled:
        print(f"\nnot called by any test: {', '.join(sorted(uncalled))}")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
