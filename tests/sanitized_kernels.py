# SPDX-License-Identifier: Apache-2.0
"""pytest plug-in: load the kernels that `sanitizers.run_tests` compiled into SANITIZED_KERNELS/0, 1, ..."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path

from chaserdock_models.native.build import LIBRARY_NAME, NATIVE_FOLDERS

for number, folder in enumerate(NATIVE_FOLDERS):
    module = import_module(folder.partition("/")[2].replace("/", "."))
    module.LIBRARY.path = Path(os.environ["SANITIZED_KERNELS"]) / str(number) / LIBRARY_NAME
