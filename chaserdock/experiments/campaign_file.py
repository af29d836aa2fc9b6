# SPDX-License-Identifier: Apache-2.0
"""Campaign file, and the plan that it defines.

A campaign is a scenario, overrides shared by all runs, and varied parameters: a grid (every
combination of ``values``) or a random sample (each parameter drawn from its distribution).
"""

from __future__ import annotations

import itertools
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from chaserdock_protocol.scenario.errors import ScenarioError, invalid
from chaserdock_protocol.scenario.fields import Name, Number, Positive, Section
from chaserdock_protocol.shipped_scenarios import ScenarioNotFound, find_scenario
from pydantic import Field, ValidationError, model_validator

from chaserdock.toml_text import toml_value

from .plan import Alone, ExperimentPlan, PlannedFlight, plan_flight

MAX_RUNS = 100_000
"""Largest number of runs of a campaign. All are checked before the first one flies, 10 ms each."""
Seed = Annotated[int, Field(ge=0, lt=2**32)]


class Variation(Section):
    """Variation of one parameter: ``values``, or in a sample ``uniform`` [low, high] or ``normal``
    [mean, sigma].
    """

    values: tuple[Any, ...] | None = None
    uniform: tuple[Number, Number] | None = None
    normal: tuple[Number, Positive] | None = None

    @model_validator(mode="after")
    def _check_one_kind(self) -> Variation:
        kinds = [n for n in ("values", "uniform", "normal") if getattr(self, n) is not None]
        if len(kinds) != 1:
            raise ValueError("needs exactly one of values, uniform, normal")
        if self.values is not None and not self.values:
            raise ValueError("values must not be empty")
        if self.uniform is not None and not self.uniform[0] < self.uniform[1]:
            raise ValueError(
                f"uniform must be [low, high] with low < high, not {list(self.uniform)}"
            )
        return self


class AloneSection(Section):
    """Section ``[alone]``: fly the controller alone. See ``Alone``."""

    delay_s: Annotated[float, Field(ge=0.0, le=3600.0)] | None = None
    floor: bool = False


class CampaignFile(Section):
    """Content of a campaign file.

    ``seeds``: number of seeds (0, 1, ...), or list of seeds, of every combination. ``alone``: fly
    the controller alone, in one process, with perfect knowledge of the target.
    """

    name: Name
    scenario: str
    method: Literal["grid", "random"] = "grid"
    samples: Annotated[int, Field(ge=1, le=MAX_RUNS)] | None = None
    sample_seed: Seed = 0
    seeds: Annotated[int, Field(ge=1, le=MAX_RUNS)] | tuple[Seed, ...] = 1
    set: dict[str, Any] = Field(default_factory=dict)
    vary: dict[str, Variation] = Field(default_factory=dict)
    alone: AloneSection | None = None

    @model_validator(mode="after")
    def _check_method(self) -> CampaignFile:
        if (self.method == "random") != (self.samples is not None):
            raise ValueError('samples and method = "random" require each other')
        if isinstance(self.seeds, tuple) and not 0 < len(self.seeds) == len(set(self.seeds)):
            raise ValueError("seeds must be one or more different numbers")
        for name, v in self.vary.items():
            if self.method == "grid" and v.values is None:
                raise ValueError(
                    f'vary.{name}: a grid needs values; a distribution needs method = "random"'
                )
        if "seed" in self.vary or "seed" in self.set:
            raise ValueError("seed: use seeds instead")
        return self


def load_campaign(path: Path) -> ExperimentPlan:
    """Read a campaign file and validate every run's scenario; raise ScenarioError with one line per
    fault.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
        file = CampaignFile.model_validate(values)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ScenarioError(f"{path}: not TOML: {error}") from None
    except ValidationError as error:
        raise invalid(error, CampaignFile, path) from None
    local = path.absolute().parent / file.scenario  # also where workers of a cluster run
    try:
        scenario = local if local.is_file() else find_scenario(file.scenario)
    except ScenarioNotFound as error:
        raise ScenarioError(f"{path}: scenario: {error}") from None
    return ExperimentPlan(file.name, _flights(file, scenario, path), tuple(file.vary))


def _combinations(file: CampaignFile) -> list[dict[str, Any]]:
    if file.method == "grid":
        axes = [v.values or () for v in file.vary.values()]
        return [dict(zip(file.vary, point, strict=True)) for point in itertools.product(*axes)]
    rng = np.random.default_rng(file.sample_seed)
    return [
        {name: _draw(v, rng) for name, v in file.vary.items()} for _ in range(file.samples or 0)
    ]


def _draw(v: Variation, rng: np.random.Generator) -> Any:
    if v.uniform is not None:
        return float(rng.uniform(*v.uniform))
    if v.normal is not None:
        return float(rng.normal(*v.normal))
    values = v.values or ()
    return values[int(rng.integers(len(values)))]


def _flights(file: CampaignFile, scenario: Path, path: Path) -> tuple[PlannedFlight, ...]:
    seeds = tuple(range(file.seeds)) if isinstance(file.seeds, int) else file.seeds
    combinations = _combinations(file)
    if len(combinations) * len(seeds) > MAX_RUNS:
        raise ScenarioError(
            f"{path}: {len(combinations)} combinations times {len(seeds)} seeds exceed {MAX_RUNS} "
            "runs"
        )
    alone = None if file.alone is None else Alone(file.alone.delay_s, file.alone.floor)
    shared = _overrides(file.set)
    flights: list[PlannedFlight] = []
    for varied in combinations:
        own = _overrides(varied)
        for seed in seeds:
            label = f"run {len(flights)}"
            sets = (*shared, *own, f"seed={seed}")
            try:
                flight = plan_flight(label, scenario, sets, varied=varied, alone=alone)
            except ScenarioError as error:
                what = ", ".join(own) or "nothing varied"
                raise ScenarioError(f"{path}: {label} ({what}): {error}") from None
            flights.append(flight)
    _reject_duplicates(flights, path)
    return tuple(flights)


def _overrides(values: dict[str, Any]) -> tuple[str, ...]:
    return tuple(f"{key}={toml_value(value)}" for key, value in values.items())


def _reject_duplicates(flights: list[PlannedFlight], path: Path) -> None:
    seen: dict[str, str] = {}
    for flight in flights:
        if flight.name in seen:
            raise ScenarioError(
                f"{path}: {seen[flight.name]} and {flight.label} are the same scenario; a value is "
                "repeated or has no effect"
            )
        seen[flight.name] = flight.label
