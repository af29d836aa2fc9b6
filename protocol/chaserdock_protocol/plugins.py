# SPDX-License-Identifier: Apache-2.0
"""Plugins: entry points of installed packages, by name.

A scenario names a plugin. Only packages installed on the machine of the process are loaded, so that
a scenario received over the network cannot load other code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from .errors import ChaserdockError

Kind = Literal["perception", "estimator", "solver"]
_GROUPS: dict[Kind, str] = {
    "perception": "chaserdock.perceptions",
    "estimator": "chaserdock.estimators",
    "solver": "chaserdock.solvers",
}

_MEMBERS: dict[Kind, tuple[str, ...]] = {
    "perception": ("estimate",),
    "estimator": (
        "update",
        "estimate_at",
        "shape",
        "reinitialisations",
        "without_drift",
        "disturb",
        "change_body",
    ),
    "solver": ("solve",),
}
"""Methods and properties that are used in a flight."""


class PluginError(ChaserdockError):
    """A plugin is not installed or cannot be loaded. The text lists the installed ones."""


def installed(kind: Kind) -> dict[str, EntryPoint]:
    """Return the plugins of a kind that installed packages provide, by name."""
    return {
        e.name: e
        for e in sorted(entry_points(group=_GROUPS[kind]), key=lambda e: (e.name, e.value))
    }


def require(kind: Kind, name: str, own: tuple[str, ...]) -> None:
    """Raise PluginError unless ``name`` is built in (``own``) or installed."""
    if name in own:
        return
    if name not in (known := installed(kind)):
        raise PluginError(
            f"{kind} {name!r} is unknown; built in: {', '.join(own)}; installed (entry points of "
            f"{_GROUPS[kind]!r}): {', '.join(known) or 'none'}"
        )


def make(kind: Kind, name: str, own: tuple[str, ...], *arguments: Any) -> Any:
    """Return what the installed part ``name`` makes of its arguments. Raises PluginError, also if
    it raises an error.
    """
    factory = load(kind, name, own)
    with _starting(kind, name):
        part = factory(*arguments)
        missing = [name for name in _MEMBERS[kind] if not hasattr(part, name)]
    if missing:
        raise PluginError(f"{kind} {name!r} has no member {missing[0]}, which it must have")
    return part


def prepare(kind: Kind, name: str, part: Any, *arguments: Any) -> None:
    """Call ``part.prepare(*arguments)``, if the part has it. Raises PluginError if that raises
    another error than a ChaserdockError.
    """
    if hasattr(part, "prepare"):
        with _starting(kind, name):
            part.prepare(*arguments)


@contextmanager
def _starting(kind: Kind, name: str) -> Iterator[None]:
    """Turn what a plugin raises within, but a ChaserdockError, into a PluginError."""
    try:
        yield
    except ChaserdockError:
        raise
    except Exception as error:  # a plugin may raise anything
        raise PluginError(
            f"{kind} {name!r} does not start: {type(error).__name__}: {error}"
        ) from error


def load(kind: Kind, name: str, own: tuple[str, ...]) -> Callable[..., Any]:
    """Return the factory that an installed package provides as ``name``. Raises PluginError, also
    if its import fails.
    """
    require(kind, name, own)
    try:
        factory = installed(kind)[name].load()
    except Exception as error:  # a plugin's import may raise anything
        raise PluginError(
            f"{kind} {name!r} cannot be loaded: {type(error).__name__}: {error}"
        ) from error
    if not callable(factory):
        raise PluginError(f"{kind} {name!r} is a {type(factory).__name__}, not a function or class")
    return factory
