"""Parts that users bring along: entry points of installed packages, by name.

A scenario names a part; only what is installed on the machine of the process that needs it is ever loaded, so a
scenario that comes over the network can name nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from .errors import ChaserdockError

Kind = Literal["perception", "estimator", "solver"]
_GROUPS: dict[Kind, str] = {
    "perception": "chaserdock.perceptions",
    "estimator": "chaserdock.estimators",
    "solver": "chaserdock.solvers",
}


class PluginError(ChaserdockError):
    """A part that is not installed, or cannot be used; the text says which ones there are."""


def installed(kind: Kind) -> dict[str, EntryPoint]:
    """Parts of that kind that installed packages bring along, by name."""
    return {e.name: e for e in sorted(entry_points(group=_GROUPS[kind]), key=lambda e: (e.name, e.value))}


def require(kind: Kind, name: str, own: tuple[str, ...]) -> None:
    """Raises PluginError unless ``name`` is one of chaserdock's ``own`` or installed."""
    known = installed(kind)
    if name not in own and name not in known:
        raise PluginError(
            f"{kind} {name!r} is unknown here; chaserdock's own: {', '.join(own)}; installed (entry points of "
            f"{_GROUPS[kind]!r}): {', '.join(known) or 'none'}"
        )


def load(kind: Kind, name: str, own: tuple[str, ...]) -> Callable[..., Any]:
    """The factory that an installed package gives under ``name``. Raises PluginError, also when importing it fails."""
    require(kind, name, own)
    try:
        factory = installed(kind)[name].load()
    except Exception as error:  # a stranger's module may raise anything
        raise PluginError(f"{kind} {name!r} cannot be loaded: {type(error).__name__}: {error}") from error
    if not callable(factory):
        raise PluginError(
            f"{kind} {name!r} is a {type(factory).__name__}, not a function or class to be called"
        )
    return factory
