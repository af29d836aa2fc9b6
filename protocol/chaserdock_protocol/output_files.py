# SPDX-License-Identifier: Apache-2.0
"""Write the files that a user gets: completely, or not at all.

A file is written beside its place and moved there at the end. On a full disk, or when the process
ends meanwhile, the place keeps what it had.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import WriteError


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield a path for a new file, which takes the place of ``path`` when the block ends.

    It has the same ending. An exception removes it, and ``path`` keeps what it had. Raises
    WriteError.
    """
    try:
        place = path.resolve()  # a link stays a link
        if place.exists() and not place.is_file():  # such as /dev/stdout
            yield place
            return
        new = place.with_name(f".{place.stem}.{os.getpid()}{place.suffix}")
        try:
            yield new
            with new.open("rb") as file:
                os.fsync(file.fileno())
            if place.exists():
                shutil.copymode(place, new)
            new.replace(place)
        finally:
            with suppress(OSError):
                new.unlink(missing_ok=True)
    except WriteError:
        raise
    except OSError as error:
        raise WriteError(path, error) from None


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file, text as UTF-8, in place of the one at ``path`` if any. Raises WriteError."""
    with replaced(path) as new:
        new.write_bytes(content.encode() if isinstance(content, str) else content)
