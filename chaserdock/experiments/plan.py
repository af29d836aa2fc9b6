# SPDX-License-Identifier: Apache-2.0
"""Plan of an experiment: its flights. Equal plans give flights with equal names."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import msgspec
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.scenario import Scenario, ScenarioError, load_scenario
from msgspec import Struct

ONE_PROCESS = "chaserdock.experiments.controller_flight"
"""Module of flights without recorder and network."""


class ExperimentError(ChaserdockError):
    """An experiment cannot continue."""


class Alone(Struct, frozen=True):
    """Settings of a flight of the controller alone: in one process, with perfect knowledge of the
    target's motion.

    ``delay_s``: time from a tick to its command's effect. The controller does not know of it and
    skips the ticks meanwhile. ``floor``: also compute the least squared position error of any
    controller that turns the chaser as this one did.
    """

    delay_s: float | None = None
    floor: bool = False


class PlannedFlight(Struct, frozen=True, kw_only=True):
    """One flight: all processes of a mission, recorded and judged, or one process of ``module``.

    ``name``: digest of the scenario and of how it is flown. ``label``: its name within the
    experiment. ``scenario``: path of its file. ``varied``: values in which flights of the plan
    differ. ``module``: Python module that reads this flight as JSON and writes ``summary.json``; ""
    for a whole mission. ``alone``: settings of a flight of the controller alone. ``code``: digest
    of the flying code; a result of other code is flown again. "" accepts any.
    """

    name: str
    label: str
    scenario: str
    overrides: tuple[str, ...]
    seed: int
    varied: dict[str, Any] = {}
    alone: Alone | None = None
    module: str = ""
    code: str = ""


class ExperimentPlan(Struct, frozen=True):
    """All flights of an experiment, and the names of the varied parameters."""

    name: str
    flights: tuple[PlannedFlight, ...]
    parameters: tuple[str, ...] = ()


def plan_flight(
    label: str,
    scenario: Path,
    overrides: tuple[str, ...] = (),
    *,
    varied: dict[str, Any] | None = None,
    alone: Alone | None = None,
    module: str = "",
    code: str = "",
) -> PlannedFlight:
    """Return a flight, named by a digest of the resolved scenario, ``alone`` and ``module``. Raise
    ScenarioError.
    """
    resolved = load_scenario(scenario, overrides, option="")
    flown = module + resolved.model_dump_json()
    if alone is not None:
        _check_alone(resolved, alone)
        flown += json.dumps(msgspec.to_builtins(alone))
    return PlannedFlight(
        name=hashlib.sha256(flown.encode()).hexdigest()[:12],
        label=label,
        scenario=str(scenario),
        overrides=overrides,
        seed=resolved.seed,
        varied=varied or {},
        alone=alone,
        module=ONE_PROCESS if alone is not None and not module else module,
        code=code,
    )


def _check_alone(scenario: Scenario, alone: Alone) -> None:
    """Raise ScenarioError unless the controller can fly the scenario alone."""
    if scenario.target.motion == "torque_free":
        raise ScenarioError("target.motion: must be constant_rates or static for [alone]")
    if alone.delay_s is not None:
        if not 0.0 <= alone.delay_s < math.inf:
            raise ScenarioError("alone.delay_s: must be finite and not negative")
        if scenario.chaser.actuation != "ideal":
            raise ScenarioError('alone.delay_s: needs chaser.actuation = "ideal"')
    if scenario.settling_s > scenario.duration_s:
        raise ScenarioError(
            f"duration_s ({scenario.duration_s:g}) ends before settling_s ({scenario.settling_s:g})"
        )
