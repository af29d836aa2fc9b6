# SPDX-License-Identifier: Apache-2.0
"""Quantization of commands: finite steps, within limits."""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array, limited

COMMAND_STEP = np.array([2.0**-16] * 3 + [2.0**-22] * 3)
"""Resolution of commands: 15 uN and 0.24 uN m, 17 and 18 bits of the paper's actuators.

It also removes differences in the last bits between SIMD levels or BLAS versions, which images in
whole grey levels would amplify to their own noise.
"""


def in_steps(wrench: Array, limits: Array) -> Array:
    """Return the nearest wrench (6,) that a command can carry, within ``limits`` (6,)."""
    return limited(np.rint(wrench / COMMAND_STEP) * COMMAND_STEP, limits)
