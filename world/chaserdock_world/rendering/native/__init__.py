# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels of this package; chaserdock_models.native states the conventions."""

from __future__ import annotations

from pathlib import Path

from chaserdock_models.native import KernelLibrary

LIBRARY = KernelLibrary(Path(__file__).parent)
function = LIBRARY.function
