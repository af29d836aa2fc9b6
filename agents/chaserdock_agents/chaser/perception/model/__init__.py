# SPDX-License-Identifier: Apache-2.0
"""Estimate the pose of the target from its shape alone, by analysis by synthesis with a tracker
mesh (docs/markerless.md).
"""
