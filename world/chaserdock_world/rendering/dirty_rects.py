"""Which parts of an image have to be painted: rectangles of pixels that do not overlap."""

from __future__ import annotations

from collections.abc import Sequence

Rectangle = tuple[int, int, int, int]
"""x0, y0, x1, y1: pixels x0 <= x < x1 and y0 <= y < y1."""


def patches(covered: Sequence[Rectangle]) -> list[tuple[Rectangle, frozenset[int]]]:
    """Rectangles, none overlapping another, that hold the ``covered`` ones, and which of these each holds.

    Bodies far apart in the image are thus painted each on its own: one rectangle around all of them would be mostly
    sky, and leave fewer samples to a pixel.
    """
    found: list[tuple[Rectangle, frozenset[int]]] = []
    for index, rectangle in enumerate(covered):
        members = frozenset([index])
        # What it joins makes it larger, so that it may reach others.
        while touched := [known for known in found if _overlap(known[0], rectangle)]:
            found = [known for known in found if known not in touched]
            members = members.union(*(others for _, others in touched))
            x0, y0, x1, y1 = zip(rectangle, *(other for other, _ in touched), strict=True)
            rectangle = (min(x0), min(y0), max(x1), max(y1))
        found.append((rectangle, members))
    return found


def _overlap(a: Rectangle, b: Rectangle) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
