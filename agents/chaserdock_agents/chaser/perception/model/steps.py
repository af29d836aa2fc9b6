# SPDX-License-Identifier: Apache-2.0
"""Spread work over several images: generators state the expected CPU time of each step
before it.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")

Steps = Generator[float, None, T]
"""Work in steps: yields the expected CPU time of the next step, ms, and returns a result. The time
decides only how work is spread over images.
"""

LIGHT_MS = 5.0
"""CPU time to estimate the light by points, ms."""
LIKELY_MS, VIEWS_MS = 6.0, 12.0
"""CPU times, ms, to find likely lights, and to compare them by synthetic views."""
SUNS_MS = 10.0
"""CPU time to compare all directions of a sun behind the target, ms."""
_LEVEL_MS, _MS_PER_PX = 3.0, 5.5e-5
"""CPU time to render and align a level, ms, and per pixel of its window. Measured, as all here, on
one core of the development machine; they decide only how work is spread over images.
"""
_COMPARED_MS, _COMPARED_MS_PER_PX = 0.9, 1.4e-5
"""CPU time to render a view and compare it with the image, ms, and per pixel of its window."""


def result_of(steps: Steps[T]) -> T:
    """Take all steps at once and return their result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value


def level_ms(area_px: float) -> float:
    """Return the CPU time, ms, to render a level on ``area_px`` pixels and align its control
    points.
    """
    return _LEVEL_MS + _MS_PER_PX * area_px


def compared_ms(area_px: float) -> float:
    """Return the CPU time, ms, to render a view on ``area_px`` pixels and compare it with the
    image.
    """
    return _COMPARED_MS + _COMPARED_MS_PER_PX * area_px
