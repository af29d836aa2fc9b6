# SPDX-License-Identifier: Apache-2.0
"""Load scenarios from files with variants and overrides, and from the JSON of world and logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from chaserdock_protocol import plugins
from chaserdock_protocol.shipped_scenarios import ScenarioNotFound, shipped_scenario

from .camera import REPLACED_BY_INTRINSICS
from .errors import ScenarioError, explain, invalid, value_text
from .files import read_toml, resolve_files
from .migrations import drop_removed_keys, old_format, old_keys
from .mission import Scenario
from .overrides import Values, merge, with_override
from .schema import ESTIMATORS, PERCEPTIONS, SOLVERS

Step = tuple[str, Callable[[Values], Values]]
"""One step of loading: its source (a file or an override), and the function that applies the
source's values to those of the steps before.
"""


SET_OPTION = "--set "
"""Precedes an override in the errors of a command."""


def load_scenario(path: Path, overrides: Sequence[str] = (), option: str = SET_OPTION) -> Scenario:
    """Load a scenario file with ``key.path=value`` overrides (values in TOML's notation). Raises
    ScenarioError.

    ``option``: precedes an override in errors; empty for overrides that no command line stated.
    Paths in a file are relative to it, those in an override to the working directory. The plugins
    that the scenario names must be installed; this is not required of a scenario from the world or
    a log.
    """
    steps = [(str(file), _merging(values, str(file))) for file, values in _read_with_parents(path)]
    scenario = _validated([*steps, *_override_steps(overrides, option)], str(path))
    _require_plugins(scenario, str(path))
    return scenario


def parse_scenario(values: dict[str, Any], source: str, overrides: Sequence[str] = ()) -> Scenario:
    """Return the scenario of nested tables with overrides. Raises ScenarioError with one line per
    error.
    """
    _check_format(values, source)
    return _validated([(source, lambda _: values), *_override_steps(overrides, SET_OPTION)], source)


def scenario_from_json(text: str, source: str) -> Scenario:
    """Return a resolved scenario from JSON. Raises ScenarioError."""
    try:
        return Scenario.model_validate_json(text)
    except ValidationError as error:
        raise invalid(error, Scenario, source) from None


def _read_with_parents(path: Path) -> list[tuple[Path, Values]]:
    """Read a file and those that it extends, the base first."""
    files: list[tuple[Path, Values]] = []
    following: Path | None = path
    while following is not None:
        seen = [file.resolve() for file, _ in files]
        if following.resolve() in seen:
            cycle = " -> ".join(str(file) for file in (*(f for f, _ in files), following))
            raise ScenarioError(f"{path}: extends: cycle: {cycle}")
        values = read_toml(following)
        _check_format(values, str(following))
        resolve_files(values, following.parent)
        files.append((following, values))
        following = _parent(values.pop("extends", None), following)
    return files[::-1]


def _parent(name: Any, file: Path) -> Path | None:
    if name is None:
        return None
    if not isinstance(name, str):
        raise ScenarioError(
            f"{file}: extends: must be the name of a shipped scenario or the path of a .toml file "
            f"(got {value_text(name)})"
        )
    if name.endswith(".toml"):
        path = file.parent / name
        if not path.is_file():
            raise ScenarioError(f"{file}: extends: {path}: no such file")
        return path
    try:
        return shipped_scenario(name)
    except ScenarioNotFound as error:
        raise ScenarioError(f"{file}: extends: {error}") from None


def _merging(values: Values, source: str) -> Callable[[Values], Values]:
    def step(base: Values) -> Values:
        merged = merge(base, values)
        _check_camera(base, merged, source)
        return merged

    return step


def _override_steps(overrides: Sequence[str], option: str) -> list[Step]:
    return [(f"{option}{text}", _overriding(text, option)) for text in overrides]


def _overriding(text: str, option: str) -> Callable[[Values], Values]:
    source = f"{option}{text}"

    def step(before: Values) -> Values:
        try:
            values = with_override(
                before, text, lambda v: Scenario.model_validate(v).model_dump(mode="json")
            )
        except ScenarioError as error:
            raise ScenarioError(f"{option}{error}") from None
        _check_format(values, source)
        try:
            resolve_files(values, Path())
        except ScenarioError as error:
            raise ScenarioError(
                "\n".join(f"{source}: {line}" for line in str(error).splitlines())
            ) from None
        _check_camera(before, values, source)
        return values

    return step


def _check_camera(before: Values, after: Values, source: str) -> None:
    """Drop, in place, the values that ``camera.intrinsics`` replaces.

    Raises ScenarioError where the source itself states one of them.
    """
    was, now = (v["camera"] if isinstance(v.get("camera"), dict) else {} for v in (before, after))
    for key in REPLACED_BY_INTRINSICS if now.get("intrinsics") else ():
        if now.get(key) != was.get(key):
            raise ScenarioError(
                f"{source}: camera.{key}: not used with camera.intrinsics; change "
                "camera.intrinsics instead"
            )
        now.pop(key, None)


def _check_format(values: Values, source: str) -> None:
    """Raise ScenarioError for keys of older formats; drop those that have no effect any more."""
    drop_removed_keys(values)
    if lines := old_format(values) or old_keys(values):
        raise ScenarioError("\n".join(f"{source}: {line}" for line in lines))


def _validated(steps: Sequence[Step], source: str) -> Scenario:
    """Apply all steps and validate the result. Raises ScenarioError, each line with the step that
    caused it.
    """
    try:
        values: Values = {}
        for _, step in steps:
            values = step(values)
        return Scenario.model_validate(values)
    except ValidationError as error:
        raise ScenarioError(
            "\n".join(_with_sources(steps, explain(error, Scenario), source))
        ) from None
    except RecursionError:
        raise ScenarioError(f"{source}: nested too deeply") from None


def _with_sources(steps: Sequence[Step], lines: list[str], source: str) -> list[str]:
    """Prefix each line with the source of the first step after which it appears.

    A missing key belongs to ``source``, whatever the step.
    """
    first: dict[str, str] = {}
    values: Values = {}
    for label, step in steps:
        try:
            values = step(values)
            Scenario.model_validate(values)
        except ValidationError as error:
            for line in explain(error, Scenario):
                first.setdefault(line, source if ": is missing" in line else label)
    return [f"{first.get(line, source)}: {line}" for line in lines]


def _require_plugins(scenario: Scenario, source: str) -> None:
    parts: tuple[tuple[plugins.Kind, str, str, tuple[str, ...]], ...] = (
        ("perception", "perception.name", scenario.perception.name, PERCEPTIONS),
        ("estimator", "estimator.name", scenario.estimator.name, ESTIMATORS),
        ("solver", "controller.solver", scenario.controller.solver, SOLVERS),
    )
    for kind, path, name, own in parts:
        try:
            plugins.require(kind, name, own)
        except plugins.PluginError as error:
            raise ScenarioError(f"{source}: {path}: {error}") from None
