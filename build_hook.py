# SPDX-License-Identifier: Apache-2.0
"""Hatchling build hook: compile the C kernels whenever the package is built or installed for
editing.

The environment variable CHASERDOCK_TARGET names the machine that a wheel is for (``TARGETS`` of the
kernels' build.py); by default it is the one that builds.
"""

from __future__ import annotations

import os
import runpy
import shutil
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface  # pyright: ignore[reportMissingImports]

_BUILD = "protocol/chaserdock_models/native/build.py"


class KernelsHook(BuildHookInterface):
    _folder: Path | None = None

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        root = Path(self.root)
        build = runpy.run_path(str(root / _BUILD), run_name="chaserdock_kernels")
        name = os.environ.get("CHASERDOCK_TARGET", "")
        if name and name not in build["TARGETS"]:
            raise ValueError(
                f"CHASERDOCK_TARGET={name}: must be one of {', '.join(build['TARGETS'])}"
            )
        target = build["TARGETS"][name] if name else build["this_machine"]()
        if version == "editable":
            build["compile_all"](root)
        else:
            # Not into the source tree: its libraries may be in use, and be for another machine.
            self._folder = Path(tempfile.mkdtemp(prefix="chaserdock-wheel-"))
            for file, place in build["compile_into"](self._folder, root, target).items():
                build_data["force_include"][str(file)] = place
        # Machine code, but none that depends on Python or on a C library.
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{target.tag}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        if self._folder is not None:
            shutil.rmtree(self._folder)
