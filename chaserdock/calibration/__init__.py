# SPDX-License-Identifier: Apache-2.0
"""Calibration of a camera from images of a board."""
