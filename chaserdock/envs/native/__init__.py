# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels of this package; chaserdock_models.native states the conventions."""

from chaserdock_models.native import KernelLibrary

LIBRARY = KernelLibrary(__file__)
function = LIBRARY.function
