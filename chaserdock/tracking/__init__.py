# SPDX-License-Identifier: Apache-2.0
"""Poses of a target in images from anywhere, by the perception that chasers fly."""
