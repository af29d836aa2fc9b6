# SPDX-License-Identifier: Apache-2.0
"""Results of seeds in a file of JSON lines, which grows as they come and outlives its writer."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import msgspec
from chaserdock_protocol.errors import ChaserdockError, errors_of_writing

from chaserdock.version import digest_of, version

from .flight import SimulationResult
from .seeds import SeedOptions, flown_digest


class _Flown(msgspec.Struct):
    """The key of a line: a digest of scenario, options, sources, Python and packages."""

    flown: str


class SeedTable:
    """The results of seeds of one scenario with equal options, by equal code. ``results``: by
    seed.
    """

    def __init__(self, file: BinaryIO, options: SeedOptions) -> None:
        self._file, here = file, version()
        self._commit = here["commit"]
        self._flown = f"{flown_digest(options)}-{digest_of(here)}"
        self.results: dict[int, SimulationResult] = {}
        content = file.read()
        for number, line in enumerate(content.splitlines(keepends=True), 1):
            if not line.endswith(b"\n"):  # its writer was killed
                file.truncate(len(content) - len(line))
                break
            try:
                flown = msgspec.json.decode(line, type=_Flown).flown
                result = msgspec.json.decode(line, type=SimulationResult)
            except msgspec.DecodeError as error:
                raise ChaserdockError(
                    f"{file.name}: line {number} is no result of a seed ({error}); delete the "
                    "line, or name another file"
                ) from None
            if flown == self._flown:
                self.results[result.seed] = result

    def add(self, result: SimulationResult) -> None:
        """Append a result, in one piece. Raises WriteError."""
        self.results[result.seed] = result
        row = {"flown": self._flown, "commit": self._commit} | msgspec.to_builtins(result)
        line = msgspec.json.encode(row) + b"\n"
        with errors_of_writing(self._file.name):
            written = self._file.write(line)
            if written < len(line):
                self._file.write(line[written:])  # raises what stopped it


@contextmanager
def opened_table(path: Path, options: SeedOptions) -> Iterator[SeedTable]:
    """Open the table in a file, made if there is none. Rows of other flights in it are left alone.

    Raises ChaserdockError if it cannot be written, has other content, or is in use.
    """
    with errors_of_writing(path):
        file = path.open("a+b", buffering=0)
    with file:
        with errors_of_writing(path):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ChaserdockError(f"{path}: another simulation writes to it") from None
            file.seek(0)
            table = SeedTable(file, options)
        yield table
