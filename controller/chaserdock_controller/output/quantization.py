# SPDX-License-Identifier: Apache-2.0
"""Quantizes commands to finite steps within their limits."""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array, limited

COMMAND_STEP = np.array([2.0**-16] * 3 + [2.0**-22] * 3)
"""Resolution of commands: 15 uN and 0.24 uN m, 17 and 18 bits of the range of the paper's
actuators.

It also removes differences in the last bits between SIMD levels or BLAS versions. Images in whole
grey levels would amplify these to the size of their own noise.
"""


def in_steps(wrench: Array, limits: Array) -> Array:
    """Return the wrench (6,) within ``limits`` (6,) nearest to ``wrench`` that a command can
    express.
    """
    return limited(np.rint(wrench / COMMAND_STEP) * COMMAND_STEP, limits)
