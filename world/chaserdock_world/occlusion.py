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


def hides(boxes: Sequence[PlacedBox], pairs: Sequence[tuple[int, int]]) -> list[int]:
    """For each pair of ``boxes``: 1 when the first is in front of the second as seen from the origin, -1 when behind, 0
    when neither can hide the other.

    Of the 15 axes that can separate two boxes (S. Gottschalk, M. C. Lin, D. Manocha, "OBBTree", 1996), those
    with a gap are looked at: a plane that has the origin and ``a`` on one side and ``b`` on the other proves
    that ``b`` cannot hide ``a``. For boxes that touch or overlap a little, the axis of largest gap decides.
    """
    if not pairs:
        return []
    a, b = np.array(pairs).T
    centres = np.array([box.centre_m for box in boxes])
    rotation = np.array([box.rotation for box in boxes])
    half = np.array([box.half_m for box in boxes])
    axes_a, axes_b = rotation[a].swapaxes(1, 2), rotation[b].swapaxes(1, 2)
    cross = axes_a[:, :, None, _YZX] * axes_b[:, None, :, _ZXY]
    cross -= axes_a[:, :, None, _ZXY] * axes_b[:, None, :, _YZX]
    cross = cross.reshape(-1, 9, 3)
    lengths = np.sqrt((cross * cross).sum(axis=-1, keepdims=True))
    skew = lengths > 1e-6
    axes = np.concatenate([axes_a, axes_b, cross / np.where(skew, lengths, 1.0)], axis=1)  # (pairs, 15, 3)
    usable = np.concatenate([np.ones((len(a), 6), dtype=bool), skew[..., 0]], axis=1)
    at_a, at_b = (axes @ centres[a][..., None])[..., 0], (axes @ centres[b][..., None])[..., 0]
    reach_a = (np.abs(axes @ rotation[a]) @ half[a][..., None])[..., 0]
    reach_b = (np.abs(axes @ rotation[b]) @ half[b][..., None])[..., 0]
    sign = np.where(at_a > at_b, -1.0, 1.0)  # turn every axis so that it points from a to b
    end_a, start_b = sign * at_a + reach_a, sign * at_b - reach_b
    gap = np.where(usable, start_b - end_a, -np.inf)
    separating = gap > 0.0
    touching = ~separating.any(axis=1)
    separating[touching] = gap[touching] >= gap[touching].max(axis=1, keepdims=True)
    # The origin projects to 0 on every axis, and any plane from end_a to start_b separates the boxes: one of
    # them has the origin on b's side when a ends before 0, and one on a's side when b starts after 0.
    a_may_hide = ~(separating & (end_a <= 0.0)).any(axis=1)
    b_may_hide = ~(separating & (start_b >= 0.0)).any(axis=1)
    distance = np.sqrt((centres * centres).sum(axis=1))
    nearer = np.where(distance[a] < distance[b], 1, -1)
    found = np.where(a_may_hide, 1, -1)
    found = np.where(a_may_hide & b_may_hide, nearer, found)
    return np.where(a_may_hide | b_may_hide, found, 0).tolist()


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
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n) if not _apart(bounds[i], bounds[j])]
    for (i, j), order in zip(pairs, hides(boxes, pairs), strict=True):
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
