# SPDX-License-Identifier: Apache-2.0
"""Pose of the target from its shape alone: analysis by synthesis with a tracker mesh
(docs/markerless.md).
"""
