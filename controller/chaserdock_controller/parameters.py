# SPDX-License-Identifier: Apache-2.0
"""Parameters of the NMPC from the scenario."""

from __future__ import annotations

from typing import Any

from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.schema import Controller, Limits

from .nmpc import NmpcParameters
from .nmpc.coast_rows import COASTS


def nmpc_parameters(scenario: FlightScenario) -> NmpcParameters:
    """Return the NMPC's parameters, which the scenario has validated."""
    body = scenario.chaser
    ix, iy, iz = body.inertia
    return NmpcParameters(
        mass_kg=body.mass_kg,
        inertia_kg_m2=((ix, 0.0, 0.0), (0.0, iy, 0.0), (0.0, 0.0, iz)),
        force_max_N=body.force_max_N,
        torque_max_N_m=body.torque_max_N_m,
        boxes=len(scenario.target_model().boxes) if scenario.limits.min_distance_shape_m else 0,
        coasts=COASTS if scenario.limits.passive_safety == "enforce" else 0,
        **nmpc_settings(scenario.controller, scenario.limits),
    )


def nmpc_settings(controller: Controller, limits: Limits) -> dict[str, Any]:
    """Return the parameters of the NMPC that do not depend on the body."""
    names = ("horizon_s", "dt_s", "falloff", "integrator", "weight_position", "weight_orientation", "weight_force",
             "weight_torque", "weight_final_position", "weight_final_orientation")  # fmt: skip
    settings = {name: getattr(controller, name) for name in names}
    return {**settings, "max_reference_distance_m": limits.max_reference_distance_m}
