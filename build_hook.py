# SPDX-License-Identifier: Apache-2.0
"""Hatchling build hook: compile the C kernels whenever the package is built or installed for editing."""

from __future__ import annotations

import runpy
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface  # pyright: ignore[reportMissingImports]

_BUILD = "protocol/chaserdock_models/native/build.py"


class KernelsHook(BuildHookInterface):
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        root = Path(self.root)
        for library in runpy.run_path(str(root / _BUILD))["compile_all"](root):
            build_data["artifacts"].append(f"/{library.relative_to(root)}")
        # Machine code, but none that depends on Python or on a C library.
        build_data["pure_python"] = False
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{platform}"
