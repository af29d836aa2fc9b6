# SPDX-License-Identifier: Apache-2.0
"""Identification of a robot from a recorded run: mass properties, thrusts, delay and lag."""
