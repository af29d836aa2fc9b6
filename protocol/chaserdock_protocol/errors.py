# SPDX-License-Identifier: Apache-2.0
"""Base class of errors for users: one line of text per fault, printed without a traceback."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path


class ChaserdockError(Exception):
    """A request cannot be carried out. The text states what failed, where, and what is valid."""


class ScenarioError(ChaserdockError):
    """A scenario that is not valid; the text has one line per error."""


class MissingPackageError(ChaserdockError, ImportError):
    """A package that this part of chaserdock needs is not installed. The text states how to install
    it.
    """


def how_to_install(extra: str) -> str:
    """Return how to install an extra of chaserdock. No package index has chaserdock yet."""
    return f"in a clone of chaserdock, pip install -e '.[{extra}]'"


def require_extra(package: str, extra: str) -> None:
    """Raise MissingPackageError unless ``package``, which chaserdock[extra] installs, can be
    imported.
    """
    if find_spec(package) is None:
        raise MissingPackageError(
            f"{package}, of the extra chaserdock[{extra}], is not installed; "
            f"{how_to_install(extra)}",
            name=package,
        )


class WriteError(ChaserdockError, OSError):
    """A file cannot be written. The text names it and the reason."""

    def __init__(self, path: Path | str, reason: OSError) -> None:
        super().__init__(reason.errno or 0, reason.strerror or str(reason), str(path))

    def __str__(self) -> str:
        return f"{self.filename}: cannot be written: {self.strerror}"


@contextmanager
def errors_of_writing(
    path: Path | str, kind: type[ChaserdockError] = ChaserdockError
) -> Iterator[None]:
    """Raise an OSError as an error of this ``kind``, which names the file, or else the path, and
    the reason.
    """
    try:
        yield
    except WriteError as error:
        raise kind(str(error)) from None
    except OSError as error:
        raise kind(str(WriteError(path, error))) from None
