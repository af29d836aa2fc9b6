# SPDX-License-Identifier: Apache-2.0
"""Functions of the Python API, exported by ``import chaserdock``. Heavy imports wait until a
function needs them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

from chaserdock_protocol.errors import ScenarioError
from chaserdock_protocol.stall import DEFAULT_STALL_S

from .toml_text import toml_value

if TYPE_CHECKING:
    from chaserdock_protocol.scenario import Scenario

    from .launch.json_events import JsonLine
    from .logs.reader import Log
    from .summary import Summary

StrPath = str | Path


@dataclass(frozen=True)
class RunResult:
    """A flown mission. ``summary``: its evaluation; ``summary.success`` is the verdict. ``dir``:
    folder with its files.
    """

    summary: Summary
    dir: Path

    def __repr__(self) -> str:
        return f"{self.summary!r}\n  files: {self.dir}"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the verdict with all that qualifies it."""
        shown = self.summary._repr_html_()  # pyright: ignore[reportPrivateUsage] (IPython's name)
        return f"{shown}<p>files: <code>{escape(str(self.dir))}</code></p>"

    @cached_property
    def log(self) -> Log:
        """Return the recorded log, open."""
        return open_log(self.dir)


def run(
    scenario: StrPath,
    *,
    out: StrPath | None = None,
    mode: Literal["lockstep", "realtime"] = "lockstep",
    seed: int | None = None,
    keys: StrPath | None = None,
    stall_s: float = DEFAULT_STALL_S,
    overrides: Mapping[str, object] | None = None,
    on_event: Callable[[JsonLine], None] | None = None,
    **changes: object,
) -> RunResult:
    """Fly a scenario on this machine and judge it, as ``chaserdock run`` does.

    Args:
        scenario: a scenario file, or the name of a shipped scenario.
        out: folder for the files of the run; a new folder in ``runs/`` by default.
        mode: ``lockstep`` (reproducible) or ``realtime`` (simulated time follows the wall clock).
        seed: seed of all random numbers.
        keys: folder of a mission's keys: connect through a router, over TLS, with access rights.
        stall_s: time (s) without progress after which a lock-step mission ends, with the reason.
        overrides: scenario values by dotted key, such as ``{"camera.width_px": 640}``.
        on_event: called in this thread with the objects that ``chaserdock run --json`` prints.
        **changes: scenario values; tables are merged: ``duration_s=20, camera={"width_px": 640}``.

    A mission that fails is a result with ``summary.success == False``. Raises ScenarioError for an
    invalid scenario or override, MissingPackageError for one that needs a package that is not
    installed, RunError when the mission cannot start or leaves no log. A mission that cannot start
    leaves no folder. An exception, such as KeyboardInterrupt, ends all processes of the mission.
    """
    from chaserdock_protocol.transport import TransportError

    from .launch.launcher import RunError, fly_mission
    from .launch.progress import Show, print_json_line
    from .summary import Summary

    try:
        outcome = fly_mission(
            scenario,
            None if out is None else Path(out),
            mode,
            override_texts(overrides, changes),
            seed=seed,
            show=Show.none if on_event is None else Show.json,
            keys=None if keys is None else Path(keys),
            emit=on_event or print_json_line,
            stall_s=stall_s,
            option="",
        )
    except TransportError as error:
        raise RunError(str(error)) from error
    if outcome.summary is None:
        raise RunError(outcome.failure or f"{outcome.folder}: no readable log")
    return RunResult(Summary.from_dict(outcome.summary), outcome.folder)


def open_log(source: StrPath | Sequence[StrPath]) -> Log:
    """Open a log: the folder of a run, a file, or the files of a rotated log. Raises LogError, and
    ScenarioError if the log's scenario is not valid.
    """
    from .logs.reader import open_log as open_source

    return open_source(source)


def load_scenario(
    scenario: StrPath, *, overrides: Mapping[str, object] | None = None, **changes: object
) -> Scenario:
    """Load a scenario file, or a shipped scenario by name, with overrides as in ``run``. Raises
    ScenarioError.
    """
    from chaserdock_protocol.scenario import load_scenario as load
    from chaserdock_protocol.shipped_scenarios import find_scenario

    return load(find_scenario(str(scenario)), override_texts(overrides, changes), option="")


def list_scenarios() -> list[str]:
    """Return the names of the shipped scenarios, sorted."""
    from chaserdock_protocol.shipped_scenarios import shipped_names

    return shipped_names()


def override_texts(
    overrides: Mapping[str, object] | None, changes: Mapping[str, object]
) -> tuple[str, ...]:
    """Return overrides as ``key.path=VALUE`` in TOML's notation, nested tables flattened. Raises
    ScenarioError for a value that TOML cannot express.
    """
    texts: list[str] = []
    for key, value in [*_flatten("", changes), *_flatten("", overrides or {})]:
        try:
            texts.append(f"{key}={toml_value(value)}")
        except TypeError as error:
            raise ScenarioError(f"{key}: {error}") from None
    return tuple(texts)


def _flatten(prefix: str, table: Mapping[str, object]) -> Iterator[tuple[str, object]]:
    for key, value in table.items():
        if isinstance(value, Mapping) and value:
            yield from _flatten(f"{prefix}{key}.", cast("Mapping[str, object]", value))
        else:
            yield f"{prefix}{key}", value
