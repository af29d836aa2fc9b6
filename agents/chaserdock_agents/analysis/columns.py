"""Growing tables of numbers, eight bytes each: a flight of ten hours fits where a list of messages would not."""

from __future__ import annotations

from array import array
from collections.abc import Iterable

import numpy as np
from chaserdock_protocol.rotations import Array
from numpy.typing import NDArray


class Columns:
    """Rows of ``width`` numbers."""

    def __init__(self, width: int) -> None:
        self.width = width
        self._data = array("d")

    def add(self, *groups: Iterable[float]) -> None:
        """Adds a row, its numbers in groups."""
        for group in groups:
            self._data.extend(group)

    def table(self) -> Array:
        """All rows (K, width), without a copy; nothing may be added afterwards. Raises ValueError for a torn row."""
        return np.frombuffer(self._data, dtype=float).reshape(-1, self.width)


def nanoseconds(time_s: Array) -> NDArray[np.int64]:
    """Times in whole nanoseconds; exact for what was whole nanoseconds and is below 104 days."""
    return np.rint(time_s * 1e9).astype(np.int64)


def rows_since(time_ns: NDArray[np.int64], at_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """For each of ``at_ns`` the last row of the rising ``time_ns`` that is not later; -1 where there is none."""
    return np.searchsorted(time_ns, at_ns, side="right") - 1
