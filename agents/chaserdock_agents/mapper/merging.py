# SPDX-License-Identifier: Apache-2.0
"""Merge tracks of one point: of different chasers, and of times between which it was out of view.

Landmarks are one where the map puts them together, their descriptions are alike, and no image shows
both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array, IntArray
from numpy.typing import NDArray
from scipy.spatial import KDTree

from .adjustment import Adjusted
from .types import Observations

Descriptions = dict[int, list[tuple[float, Array]]]
"""Times, and descriptions (128,) of unit length, of tracks by key."""


@dataclass(frozen=True)
class MergingTuning:
    """Numbers of merging, with units and reasons."""

    distance_m: float = 0.012
    """Largest distance of landmarks that may be one. Wrong merges turn the axis of rotation, fewer
    ones leave the scale less certain (docs/evidence/unknown.md)."""
    unlike: float = 0.5
    """Largest distance of unit descriptions: one in fifty pairs of different points is as alike."""
    kept: int = 6
    apart_s: float = 5.0
    """Descriptions kept of a track, the latest, and the time between them, 16 degrees of turn: a
    point looks different from other sides."""
    residual_px: float = 0.6
    """Median residual of a part of a merged landmark above which the merge is undone: three times
    that of a single track; 1.4 mm at 2 m."""


class Merges:
    """Which tracks are one landmark: the one with the smallest key stands for all."""

    def __init__(self, tuning: MergingTuning) -> None:
        self.tuning = tuning
        self._parent: dict[int, int] = {}
        self._refused: set[tuple[int, int]] = set()
        self._descriptions: Descriptions = {}

    @property
    def count(self) -> int:
        """Number of tracks that another one stands for."""
        return len(self._parent)

    def add(self, time_s: float, keys: IntArray, values: NDArray[np.uint8]) -> None:
        """Take descriptions (n, 128) of tracks at a time."""
        unit = np.asarray(values, dtype=np.float32)
        unit = unit / np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1.0)
        for key, value in zip(np.asarray(keys).tolist(), unit, strict=True):
            before = self._descriptions.get(key, [])
            if not before or time_s - before[-1][0] > self.tuning.apart_s:
                self._descriptions[key] = [*before, (time_s, value)][-self.tuning.kept :]

    def join(self, root: int, key: int) -> None:
        """Let one track stand for another one."""
        self._parent[key] = root

    def roots(self, keys: IntArray) -> IntArray:
        """Return the keys (n,) of the landmarks of tracks (n,)."""
        if not self._parent:
            return keys
        merged = np.array(sorted(self._parent), dtype=np.int64)
        to = np.array([self._parent[k] for k in merged.tolist()], dtype=np.int64)
        at = np.minimum(np.searchsorted(merged, keys), len(merged) - 1)
        return np.where(merged[at] == keys, to[at], keys)

    def find(self, seen: Observations, found: Adjusted, keys: IntArray) -> int:
        """Merge landmarks of an adjustment to ``seen``; return the number of merges."""
        landmarks = found.estimate.landmarks_m
        if len(landmarks) < 2:
            return 0
        members: dict[int, list[int]] = {}
        for key, root in self._parent.items():
            members.setdefault(root, []).append(key)
        described = {
            root: [
                d for k in (root, *members.get(root, [])) for _, d in self._descriptions.get(k, [])
            ]
            for root in keys.tolist()
        }
        pairs = KDTree(landmarks).query_pairs(self.tuning.distance_m, output_type="ndarray")
        scored = []
        for i, j in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].tolist():
            a, b = int(keys[i]), int(keys[j])
            unlike = _unlike(described[a], described[b])
            if unlike < self.tuning.unlike and (min(a, b), max(a, b)) not in self._refused:
                scored.append((unlike, min(a, b), max(a, b), i, j))
        views = _views_of(seen, len(keys))
        made, used = 0, set[int]()
        for _, a, b, i, j in sorted(scored):
            if a in used or b in used or views[i] & views[j]:
                continue
            used |= {a, b}
            for key in (b, *members.get(b, [])):
                self.join(a, key)
            made += 1
        return made

    def check(self, seen: Observations, residual_px: Array, keys: IntArray) -> None:
        """Undo merges of tracks that do not fit, and of landmarks that no longer do.

        ``residual_px`` (k,): of the observations.
        """
        tracks, group = np.unique(seen.track, return_inverse=True)
        median = medians(residual_px, group, len(tracks))
        bad = set(tracks[median > self.tuning.residual_px].tolist())
        fitting, present = set(np.asarray(keys).tolist()), set(tracks.tolist())
        for key, root in sorted(self._parent.items()):
            if root not in fitting or key in bad or (root in bad and root in present):
                del self._parent[key]
                self._refused.add((root, key))

    def forget(self, alive: IntArray) -> None:
        """Drop what is known of tracks that are not among the ``alive`` (n,)."""
        known = set(np.asarray(alive).tolist())
        self._parent = {k: r for k, r in self._parent.items() if k in known}
        self._descriptions = {k: d for k, d in self._descriptions.items() if k in known}
        self._refused = {pair for pair in self._refused if known.issuperset(pair)}


def _unlike(a: Sequence[Array], b: Sequence[Array]) -> float:
    """Return the least distance of two sets of descriptions."""
    if not a or not b:
        return float("inf")
    return float(np.sqrt(np.maximum(2.0 - 2.0 * np.max(np.array(a) @ np.array(b).T), 0.0)))


def _views_of(seen: Observations, count: int) -> list[set[int]]:
    """Return the views that show each of ``count`` landmarks."""
    out: list[set[int]] = [set() for _ in range(count)]
    for view, landmark in zip(seen.view.tolist(), seen.landmark.tolist(), strict=True):
        out[landmark].add(view)
    return out


def medians(values: Array, group: IntArray, count: int) -> Array:
    """Return the median (n,) of the values of each group; infinite without any."""
    order = np.lexsort((values, group))
    sizes = np.bincount(group, minlength=count)
    ends = np.cumsum(sizes)
    out = np.full(count, np.inf)
    some = sizes > 0
    out[some] = values[order][(ends - sizes + sizes // 2)[some]]
    return out
