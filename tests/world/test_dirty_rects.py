# SPDX-License-Identifier: Apache-2.0
"""Merging of overlapping rectangles: disjoint, covering, and merged only where necessary."""

from __future__ import annotations

from itertools import combinations

from chaserdock_world.rendering.dirty_rects import Rectangle, merge_overlapping
from hypothesis import given
from hypothesis import strategies as st

corners = st.integers(0, 60)
extents = st.integers(1, 25)
rectangles = st.builds(lambda x, y, w, h: (x, y, x + w, y + h), corners, corners, extents, extents)


def pixels(r: Rectangle) -> set[tuple[int, int]]:
    return {(x, y) for x in range(r[0], r[2]) for y in range(r[1], r[3])}


@given(st.lists(rectangles, max_size=8))
def test_patches_cover_each_rectangle_once_and_are_disjoint(covered: list[Rectangle]) -> None:
    found = merge_overlapping(covered)
    assert sorted(i for _, members in found for i in members) == list(range(len(covered)))
    for patch, members in found:
        assert all(pixels(covered[i]) <= pixels(patch) for i in members)
        held = set().union(*(pixels(covered[i]) for i in members))
        assert {min(p) for p in zip(*held, strict=True)} == {
            patch[0],
            patch[1],
        }  # no larger than needed
    for (a, _), (b, _) in combinations(found, 2):
        assert not pixels(a) & pixels(b)


def test_distant_rectangles_stay_separate_until_a_third_joins_them() -> None:
    left, right = (0, 0, 10, 10), (50, 0, 60, 10)
    assert merge_overlapping([left, right]) == [(left, frozenset([0])), (right, frozenset([1]))]
    assert merge_overlapping([left, right, (5, 5, 55, 8)]) == [
        ((0, 0, 60, 10), frozenset([0, 1, 2]))
    ]
