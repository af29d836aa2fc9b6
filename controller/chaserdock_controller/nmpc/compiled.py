"""How the numerical kernels are compiled: by Numba, for two kinds of functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

_compile: Callable[..., Any] = njit

# Called from Python: compiled with what boxes and unboxes arguments, and cached on disk.
kernel = _compile(cache=True, error_model="numpy")

# Called from kernels only: without wrappers, which take as long to compile as a small function itself, and
# without a cache of its own. Called from Python, be it by way of a kernel's `py_func`, it crashes. A kernel must
# lie in the file of the parts that it calls, or carry a digest of their file in its closure (`ipm`): Numba's
# cache does not see that a function called has changed.
part = _compile(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
