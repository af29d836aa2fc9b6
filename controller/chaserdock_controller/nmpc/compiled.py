"""How the numerical kernels are compiled: by Numba, for two kinds of functions."""

from __future__ import annotations

from numba import njit

# Called from Python: compiled with what boxes and unboxes arguments, and cached on disk.
kernel = njit(cache=True, error_model="numpy")

# Called from kernels only (from Python, also by way of a kernel's `py_func`, it crashes): no wrappers, which would take as long to compile as a small function itself, and no
# cache of its own. A kernel must lie in the file of what it calls, or carry a digest of that file in its closure
# (`ipm`): Numba's cache does not see that a function called has changed.
part = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
