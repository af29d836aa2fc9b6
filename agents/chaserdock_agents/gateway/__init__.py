# SPDX-License-Identifier: Apache-2.0
"""Fly a mission in a laboratory: cameras, robots and motion capture in place of the world."""
