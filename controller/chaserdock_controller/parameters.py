# SPDX-License-Identifier: Apache-2.0
"""Derives the parameters of the NMPC from the scenario."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.schema import Controller, ControllerOptions, Limits

from .nmpc import NmpcParameters
from .nmpc.problem import terms_of


def nmpc_parameters(scenario: FlightScenario) -> NmpcParameters:
    """Return the NMPC's parameters. The scenario has validated them."""
    body = scenario.chaser
    ix, iy, iz = body.inertia
    return NmpcParameters(
        mass_kg=body.mass_kg,
        inertia_kg_m2=((ix, 0.0, 0.0), (0.0, iy, 0.0), (0.0, 0.0, iz)),
        force_max_N=body.force_max_N,
        torque_max_N_m=body.torque_max_N_m,
        **nmpc_settings(scenario.controller, scenario.limits),
    )


def nmpc_settings(controller: Controller, limits: Limits) -> dict[str, Any]:
    """Return the NMPC's parameters that do not depend on the body: every key of ``controller`` that
    is not among `ControllerOptions`.

    Raises ValueError for a key that nothing reads.
    """
    keys = type(controller).model_fields.keys() - ControllerOptions.model_fields.keys()
    own = keys & {f.name for f in fields(NmpcParameters)}
    settings = {name: getattr(controller, name) for name in keys - own}
    settings["max_reference_distance_m"] = limits.max_reference_distance_m
    return {name: getattr(controller, name) for name in own} | {"terms": terms_of(settings)}
