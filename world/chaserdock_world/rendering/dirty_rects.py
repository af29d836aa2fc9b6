# SPDX-License-Identifier: Apache-2.0
"""Merge overlapping rectangles of pixels into disjoint patches to be painted."""

from __future__ import annotations

from collections.abc import Sequence

Rectangle = tuple[int, int, int, int]
"""x0, y0, x1, y1: pixels x0 <= x < x1 and y0 <= y < y1."""


def merge_overlapping(rectangles: Sequence[Rectangle]) -> list[tuple[Rectangle, frozenset[int]]]:
    """Return disjoint rectangles that cover ``rectangles``, each with the indices of those that it
    covers.

    Bodies that are far apart in the image are painted separately: a common rectangle would be
    mostly background and allow fewer samples per pixel.
    """
    merged: list[tuple[Rectangle, frozenset[int]]] = []
    for index, rectangle in enumerate(rectangles):
        members = frozenset([index])
        # A union is larger than its parts and may overlap further rectangles.
        while overlapping := [known for known in merged if _overlap(known[0], rectangle)]:
            merged = [known for known in merged if known not in overlapping]
            members = members.union(*(others for _, others in overlapping))
            x0, y0, x1, y1 = zip(rectangle, *(other for other, _ in overlapping), strict=True)
            rectangle = (min(x0), min(y0), max(x1), max(y1))
        merged.append((rectangle, members))
    return merged


def _overlap(a: Rectangle, b: Rectangle) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
