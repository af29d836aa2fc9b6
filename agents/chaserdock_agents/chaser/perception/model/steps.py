# SPDX-License-Identifier: Apache-2.0
"""Work that is spread over several images: generators that state the expected CPU time of each step
before they take it.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")

Steps = Generator[float, None, T]
"""Yields the expected CPU time of the next step, ms, and returns a result. The time decides only
how work is spread.
"""

LIGHT_MS = 5.0
"""Time to estimate the light by points."""
LIKELY_MS, VIEWS_MS = 6.0, 12.0
"""Times to find likely lights, and to compare them by synthetic views."""
SUNS_MS = 10.0
"""Time to compare all directions of a sun behind the target."""
_LEVEL_MS, _MS_PER_PX = 3.0, 5.5e-5
"""Time to render and align a level, and per pixel of its window: measured, as all here, on one core
of the development machine. They decide only how work is spread over images.
"""
_COMPARED_MS, _COMPARED_MS_PER_PX = 0.9, 1.4e-5
"""Time to render a view and compare it with the image, and per pixel of its window."""


def result_of(steps: Steps[T]) -> T:
    """Take all steps at once and return their result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value


def level_ms(area_px: float) -> float:
    """Return the time to render a level on a window of ``area_px`` pixels and to align its control
    points.
    """
    return _LEVEL_MS + _MS_PER_PX * area_px


def compared_ms(area_px: float) -> float:
    """Return the time to render a view on a window of ``area_px`` pixels and to compare it with the
    image.
    """
    return _COMPARED_MS + _COMPARED_MS_PER_PX * area_px
