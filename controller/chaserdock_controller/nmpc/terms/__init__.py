# SPDX-License-Identifier: Apache-2.0
"""The terms of the problem: one a file. A file in this folder that defines ``TERM`` is a term; no
other list names it.
"""

from __future__ import annotations

import pkgutil
from importlib import import_module

from chaserdock_controller.nmpc.term import Term

TERMS: tuple[type[Term], ...] = tuple(
    import_module(f"{__name__}.{name}").TERM
    for name in sorted(module.name for module in pkgutil.iter_modules(__path__))
)
"""All terms, in the order of their files, which is that of their members in C's `Problem`."""
