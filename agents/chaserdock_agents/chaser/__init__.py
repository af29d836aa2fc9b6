# SPDX-License-Identifier: Apache-2.0
"""The chaser process: measures the target pose with its camera and drives its actuators."""
