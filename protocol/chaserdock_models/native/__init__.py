# SPDX-License-Identifier: Apache-2.0
"""Load the numerical kernels: C code that is compiled when the package is built.

Each package with kernels has a folder ``native`` with its C sources, ``kernels.c`` which includes
them, and one shared library ``kernels.so``. This module loads such libraries and provides the
kernels of ``chaserdock_models``.

A library contains every function once per instruction set (on x86-64: SSE4, and AVX2 with FMA). The
copy is chosen at run time; all copies give the same bits. Arguments are C-contiguous float64 arrays
(int64 or uint8 where stated), passed by ``address``; callers check shapes. Kernels keep nothing
between calls and have no static memory: threads may call the same kernel at once, each with its own
arrays.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .build import LIBRARY_NAME, source_digest

S = TypeVar("S", bound=type[ctypes.Structure])

_INSTALL = "reinstall chaserdock (in a clone: pip install --no-deps -e .), which compiles it"


class _Member(ctypes.Structure):
    """Mirror ``Member`` of base.h: one line of the table that C exports of a structure.

    No table describes this structure itself.
    """

    _fields_ = [("name", ctypes.c_char_p), ("size", ctypes.c_int64), ("offset", ctypes.c_int64)]


class KernelLibrary:
    """Load the compiled kernels of one package on first use.

    ``file``: the package's ``native/__init__.py``, beside which the library stands.
    """

    def __init__(self, file: str) -> None:
        self.path = Path(file).with_name(LIBRARY_NAME)
        self._functions: dict[str, Any] = {}
        self._structures: dict[str, type[ctypes.Structure]] = {}

    def structure(self, name: str) -> Callable[[S], S]:
        """Return a class decorator for the ctypes counterpart of the C structure ``name``.

        C lists the structure's members by LAYOUT (base.h). Names, sizes and offsets are compared
        when the library is loaded, or at once if it is: otherwise C would read other values than
        Python wrote. Raises ImportError for the first difference.
        """

        def register(structure: S) -> S:
            self._structures[name] = structure
            if "library" in vars(self):
                self._check(self.library, name, structure)
            return structure

        return register

    def _check(self, library: ctypes.CDLL, name: str, own: type[ctypes.Structure]) -> None:
        try:
            layout = library[f"v{int(library.level())}_layout_{name}"]
        except AttributeError:
            raise ImportError(
                f"{self.path}: no LAYOUT({name}, ...) stands in its sources"
            ) from None
        layout.restype = ctypes.POINTER(_Member)
        table = layout()
        theirs = []
        while table[len(theirs)].name is not None:
            member = table[len(theirs)]
            theirs.append((member.name.decode(), member.size, member.offset))
        ours = [(name, ctypes.sizeof(own), 0)]
        for field in own._fields_:
            descriptor = getattr(own, field[0])
            ours.append((field[0], descriptor.size, descriptor.offset))
        for c, python in itertools.zip_longest(theirs, ours):
            if c != python:
                raise ImportError(
                    f"{self.path}: structure {name} of C and {own.__name__} of Python differ: "
                    f"{_describe(c)} in C, {_describe(python)} in Python"
                )

    @cached_property
    def library(self) -> ctypes.CDLL:
        """The shared library. Raises ImportError if it is missing, does not load, or was compiled
        from other sources.
        """
        if not self.path.exists():
            raise ImportError(f"{self.path}: the compiled kernels are missing; {_INSTALL}")
        try:
            library = ctypes.CDLL(str(self.path))
        except OSError as error:
            raise ImportError(
                f"{self.path}: compiled for another kind of machine ({error}); {_INSTALL}"
            ) from None
        library.source_digest.restype = ctypes.c_char_p
        if library.source_digest().decode() != source_digest(self.path.parent):
            raise ImportError(
                f"{self.path}: compiled from other sources than those beside it; {_INSTALL}"
            )
        for name, structure in self._structures.items():
            self._check(library, name, structure)
        return library

    @cached_property
    def level(self) -> int:
        """The instruction set in use: 3 or 2 for x86-64-v3 or -v2, 0 on other processors."""
        return int(self.library.level())

    def function(self, name: str, result: Any = None, at_level: int | None = None) -> Any:
        """Return kernel ``name`` for this processor, or its copy for ``at_level``; ``result`` is
        its ctypes type.
        """
        kernel = self._functions.get(name) if at_level is None else None
        if kernel is None:
            kernel = self.library[f"v{self.level if at_level is None else at_level}_{name}"]
            kernel.restype = result  # before another thread can find it
            if at_level is None:
                self._functions[name] = kernel
        return kernel


def _describe(member: tuple[str, int, int] | None) -> str:
    if member is None:
        return "nothing more"
    return f"{member[0]} of {member[1]} bytes at byte {member[2]}"


address: Callable[[Any], ctypes.Array[ctypes.c_char]] = (ctypes.c_char * 0).from_buffer
"""Pass a writable C-contiguous array to a kernel: return its address, which keeps the array alive.

Rejects arrays that are not contiguous, as the type has no size. Takes a fifteenth of the time of
``array.ctypes``.
"""


def location(array: NDArray[Any]) -> int:
    """Return the address of a writable C-contiguous array for a field of a structure. Keep the
    array alive meanwhile.
    """
    return ctypes.addressof(address(array))


def scratch(doubles: int) -> NDArray[np.float64]:
    """Allocate uninitialized working memory for a kernel."""
    return np.empty(doubles)


LIBRARY = KernelLibrary(__file__)
function = LIBRARY.function
