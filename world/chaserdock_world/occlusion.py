"""Which of several boxes hides which, as seen from one point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_protocol.rotations import Array


@dataclass(frozen=True)
class PlacedBox:
    """A box seen from the origin: ``centre_m`` (3,), ``rotation`` (3, 3) from its axes, ``half_m`` (3,) its
    half edges; ``low_px`` and ``high_px`` (2,) bound its picture."""

    centre_m: Array
    rotation: Array
    half_m: Array
    low_px: Array
    high_px: Array


_YZX, _ZXY = np.array([1, 2, 0]), np.array([2, 0, 1])


def hides(a: PlacedBox, b: PlacedBox) -> int:
    """1 when ``a`` is in front of ``b`` as seen from the origin, -1 when behind, 0 when neither can hide
    the other.

    Of the 15 axes that can separate two boxes (S. Gottschalk, M. C. Lin, D. Manocha, "OBBTree", 1996), those
    with a gap are looked at: a plane that has the origin and ``a`` on one side and ``b`` on the other proves
    that ``b`` cannot hide ``a``. For boxes that touch or overlap a little, the axis of largest gap decides.
    """
    axes_a, axes_b = a.rotation.T, b.rotation.T
    cross = axes_a[:, None, _YZX] * axes_b[:, _ZXY]
    cross -= axes_a[:, None, _ZXY] * axes_b[:, _YZX]
    cross = cross.reshape(9, 3)
    lengths = np.sqrt((cross * cross).sum(axis=1))
    skew = lengths > 1e-6
    axes = np.concatenate([axes_a, axes_b, cross[skew] / lengths[skew, None]])
    at_a, at_b = axes @ a.centre_m, axes @ b.centre_m
    reach_a, reach_b = np.abs(axes @ a.rotation) @ a.half_m, np.abs(axes @ b.rotation) @ b.half_m
    swap = at_a > at_b  # turn every axis so that it points from a to b
    sign = np.where(swap, -1.0, 1.0)
    at_a, at_b = sign * at_a, sign * at_b
    end_a, start_b = at_a + reach_a, at_b - reach_b
    gap = start_b - end_a
    separating = gap > 0.0
    if not separating.any():
        separating = gap >= gap.max()
    # The origin projects to 0 on every axis, and any plane from end_a to start_b separates the boxes: one of
    # them has the origin on b's side when a ends before 0, and one on a's side when b starts after 0.
    a_may_hide = not (separating & (end_a <= 0.0)).any()
    b_may_hide = not (separating & (start_b >= 0.0)).any()
    if a_may_hide == b_may_hide:
        if not a_may_hide:
            return 0
        return 1 if np.linalg.norm(a.centre_m) < np.linalg.norm(b.centre_m) else -1
    return 1 if a_may_hide else -1


def _apart(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    """Whether rectangles (left, top, right, bottom) are more than a pixel apart."""
    return a[0] > b[2] + 1.0 or a[1] > b[3] + 1.0 or b[0] > a[2] + 1.0 or b[1] > a[3] + 1.0


def paint_order(boxes: Sequence[PlacedBox]) -> list[int]:
    """Indices of ``boxes`` in the order in which to paint them: nothing before what it hides.

    Boxes that hide one another in a circle (long thin ones can) leave no such order; of those the farthest
    is painted first.
    """
    n = len(boxes)
    bounds = [(*box.low_px.tolist(), *box.high_px.tolist()) for box in boxes]
    waiting_for: list[set[int]] = [set() for _ in range(n)]  # boxes that i hides, to be painted before it
    for i in range(n):
        for j in range(i + 1, n):
            order = 0 if _apart(bounds[i], bounds[j]) else hides(boxes[i], boxes[j])
            if order > 0:
                waiting_for[i].add(j)
            elif order < 0:
                waiting_for[j].add(i)
    distance = [float(np.linalg.norm(box.centre_m)) for box in boxes]
    left = sorted(range(n), key=lambda i: -distance[i])
    done: list[int] = []
    while left:
        free = next((i for i in left if not waiting_for[i].intersection(left)), left[0])
        left.remove(free)
        done.append(free)
    return done
