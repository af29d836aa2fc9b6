"""Hatchling's hook: the kernels in C are compiled whenever the package is built or installed for editing."""

from __future__ import annotations

import runpy
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface  # pyright: ignore[reportMissingImports]

_NATIVE = "protocol/chaserdock_protocol/native"


class KernelsHook(BuildHookInterface):
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        runpy.run_path(str(Path(self.root) / _NATIVE / "build.py"))["compile_kernels"]()
        build_data["artifacts"].append(f"/{_NATIVE}/kernels.so")
        # Machine code, but none that depends on Python or on a C library.
        build_data["pure_python"] = False
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{platform}"
