# SPDX-License-Identifier: Apache-2.0
"""Joint error-state filter of the target, the chasers, their sensor errors and disturbances."""

from .estimator import JointEstimator
from .parameters import JointParameters, parameters_of

__all__ = ["JointEstimator", "JointParameters", "parameters_of"]
