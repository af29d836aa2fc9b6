"""The numerical kernels of perception and control, in C: compiled when the package is built, loaded here.

The sources beside this file say what each function does. The one shared library holds a copy of every function for
each instruction set (on x86-64: SSE4, and AVX2 with FMA); the processor decides which one runs, and all give the same bits.
Callers hand over addresses of C-contiguous float64 arrays, int64 where said; shapes are theirs to check.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chaserdock_protocol.native.build import LIBRARY, source_digest

_INSTALL = "install chaserdock again (in a clone: pip install --no-deps -e .), which compiles it"


@cache
def load(path: Path = LIBRARY) -> ctypes.CDLL:
    """The library. Raises ImportError where it is missing, does not load here, or was made from other sources."""
    if not path.exists():
        raise ImportError(f"{path}: the compiled kernels are missing; {_INSTALL}")
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise ImportError(f"{path}: not for this kind of machine ({error}); {_INSTALL}") from None
    library.source_digest.restype = ctypes.c_char_p
    if library.source_digest().decode() != source_digest(path.parent):
        raise ImportError(f"{path}: compiled from other sources than those beside it; {_INSTALL}")
    return library


def level() -> int:
    """The instruction set chosen: 3 and 2 as in x86-64-v3 and v2, 0 on other processors."""
    return int(load().level())


@cache
def function(name: str, result: Any = None, at_level: int | None = None) -> Any:
    """The kernel ``name``, in the copy for this processor or that of ``at_level``; ``result``: its ctypes type."""
    found = load()[f"v{level() if at_level is None else at_level}_{name}"]
    found.restype = result
    return found


def address(array: NDArray[Any]) -> ctypes.c_void_p:
    """Where a writable C-contiguous array lies. It must be kept alive while the address is used."""
    # By the buffer protocol, which refuses other arrays and takes a sixth of the time of `array.ctypes`.
    buffer: Any = array
    return ctypes.c_void_p(ctypes.addressof(ctypes.c_char.from_buffer(buffer)) if array.size else 0)


def memory(doubles: int) -> NDArray[np.float64]:
    """Working memory, which a kernel need not find in any state."""
    return np.empty(doubles)
