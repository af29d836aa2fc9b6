# SPDX-License-Identifier: Apache-2.0
"""Estimate the target's state from the sightings of all chasers. Mathematics and parameters:
docs/estimation.md.
"""
