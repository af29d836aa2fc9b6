# SPDX-License-Identifier: Apache-2.0
"""Recorded logs: open, check, repair, export, play."""

from .reader import Log, open_log

__all__ = ["Log", "open_log"]
