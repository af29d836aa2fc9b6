# SPDX-License-Identifier: Apache-2.0
"""pytest plug-in: load the kernels that `sanitizers.run_tests` compiled into SANITIZED_KERNELS/0, 1, ..."""

from __future__ import annotations

import os
from pathlib import Path

from chaserdock_agents.chaser.perception import native as perception
from chaserdock_controller.estimation.joint import native as joint
from chaserdock_controller.nmpc import native as nmpc
from chaserdock_models import native as models
from chaserdock_models.native.build import LIBRARY_NAME, NATIVE_FOLDERS
from chaserdock_world.rendering import native as rendering
from source_tree import ROOT

LIBRARIES = (models.LIBRARY, perception.LIBRARY, rendering.LIBRARY, nmpc.LIBRARY, joint.LIBRARY)

for number, folder in enumerate(NATIVE_FOLDERS):
    (library,) = (one for one in LIBRARIES if one.path.parent == ROOT / folder)
    library.path = Path(os.environ["SANITIZED_KERNELS"]) / str(number) / LIBRARY_NAME
