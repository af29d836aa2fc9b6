# SPDX-License-Identifier: Apache-2.0
"""Growing tables of 8-byte numbers. Large tables are stored in a temporary file."""

from __future__ import annotations

import mmap
import tempfile
from array import array
from collections.abc import Iterable
from typing import IO

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.errors import ChaserdockError
from numpy.typing import NDArray

# Numbers held in memory: 1 MB, twice the motion of one body over two minutes.
_MAX_IN_MEMORY = 1 << 17


class Columns:
    """A table that grows row by row, of ``width`` numbers each. Beyond 1 MB it moves to a
    temporary file (in ``TMPDIR``).

    Methods raise ChaserdockError when that file cannot be written.
    """

    def __init__(self, width: int) -> None:
        self.width = width
        self._data = array("d")
        self._file: IO[bytes] | None = None

    def add(self, *groups: Iterable[float]) -> None:
        """Add a row, given as groups of numbers."""
        for group in groups:
            self._data.extend(group)
        if len(self._data) >= _MAX_IN_MEMORY:
            self._spill()

    def _spill(self) -> None:
        try:
            if self._file is None:
                # Unbuffered: the memory map must see all data.
                self._file = tempfile.TemporaryFile(  # noqa: SIM115
                    prefix="chaserdock-", buffering=0
                )
            rest = memoryview(self._data).cast("B")
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise ChaserdockError(
                f"{tempfile.gettempdir()}: cannot store the tables of the flight: "
                f"{error.strerror or error}; "
                "TMPDIR selects another folder"
            ) from None
        self._data = array("d")

    def table(self) -> Array:
        """Return all rows (K, width), read-only; no row may be added afterwards. Raise ValueError
        for an incomplete row.

        A large table is mapped from its file and occupies memory while it, or a part of it, is
        referenced.
        """
        if self._file is None:
            return np.frombuffer(self._data, dtype=float).reshape(-1, self.width)
        if self._data:
            self._spill()
        mapped = mmap.mmap(self._file.fileno(), 0, prot=mmap.PROT_READ)
        return np.frombuffer(mapped, dtype=float).reshape(-1, self.width)


def nanoseconds(time_s: Array) -> NDArray[np.int64]:
    """Convert seconds to integer nanoseconds, exact up to 104 days."""
    return np.rint(time_s * 1e9).astype(np.int64)


def rows_since(time_ns: NDArray[np.int64], at_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return for each of ``at_ns`` the last row of the ascending ``time_ns`` that is not later, or
    -1.
    """
    return np.searchsorted(time_ns, at_ns, side="right") - 1


def rows_at_equal_times(time_s: Array, other_s: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows (K,) in the first and in the second array of ascending times (s) that hold
    equal times.
    """
    at_ns, other_ns = nanoseconds(time_s), nanoseconds(other_s)
    if not len(other_ns):
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    row = rows_since(other_ns, at_ns)
    both = np.flatnonzero((row >= 0) & (other_ns[row] == at_ns))
    return both, row[both]
