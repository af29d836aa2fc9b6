"""Growing tables of numbers, eight bytes each; a long flight's lie in a temporary file, and not in memory."""

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

# A megabyte; two minutes of a body's motion are half of it.
_HELD = 1 << 17


class Columns:
    """Rows of ``width`` numbers. What goes beyond a megabyte is put into a temporary file (in ``TMPDIR``).

    Raises ChaserdockError where that file cannot be written.
    """

    def __init__(self, width: int) -> None:
        self.width = width
        self._data = array("d")
        self._file: IO[bytes] | None = None

    def add(self, *groups: Iterable[float]) -> None:
        """Adds a row, its numbers in groups."""
        for group in groups:
            self._data.extend(group)
        if len(self._data) >= _HELD:
            self._put_away()

    def _put_away(self) -> None:
        try:
            if self._file is None:
                # Unbuffered: what is mapped must have reached the file.
                self._file = tempfile.TemporaryFile(prefix="chaserdock-", buffering=0)  # noqa: SIM115
            rest = memoryview(self._data).cast("B")
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise ChaserdockError(
                f"{tempfile.gettempdir()}: cannot hold the flight's tables: {error.strerror or error}; "
                "TMPDIR can name another folder"
            ) from None
        self._data = array("d")

    def table(self) -> Array:
        """All rows (K, width), not to be written to; nothing may be added afterwards. Raises ValueError for a torn row.

        A long table is read from its file as it is used, and takes memory for as long as it, or a part of it, is held.
        """
        if self._file is None:
            return np.frombuffer(self._data, dtype=float).reshape(-1, self.width)
        if self._data:
            self._put_away()
        mapped = mmap.mmap(self._file.fileno(), 0, prot=mmap.PROT_READ)
        return np.frombuffer(mapped, dtype=float).reshape(-1, self.width)


def nanoseconds(time_s: Array) -> NDArray[np.int64]:
    """Times in whole nanoseconds; exact for what was whole nanoseconds and is below 104 days."""
    return np.rint(time_s * 1e9).astype(np.int64)


def rows_since(time_ns: NDArray[np.int64], at_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """For each of ``at_ns`` the last row of the rising ``time_ns`` that is not later; -1 where there is none."""
    return np.searchsorted(time_ns, at_ns, side="right") - 1
