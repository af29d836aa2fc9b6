# SPDX-License-Identifier: Apache-2.0
"""Joint error-state filter of the target, the chasers, their sensors and the disturbances that act
on them.
"""

from .estimator import JointEstimator
from .parameters import JointParameters, parameters_of

__all__ = ["JointEstimator", "JointParameters", "parameters_of"]
