# SPDX-License-Identifier: Apache-2.0
"""Parameters of estimator and NMPC from the scenario."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

from chaserdock_protocol import plugins
from chaserdock_protocol.scenario import ESTIMATORS, FlightScenario
from chaserdock_protocol.scenario.schema import (
    Controller,
    ControllerOptions,
    EstimatorSection,
    Limits,
)

from chaserdock_controller.estimation.parameters import MekfParameters
from chaserdock_controller.estimation.types import Estimator

from .estimation import make_estimator
from .estimation.composite_body import rows_of, stated_properties
from .estimation.joint import JointEstimator, JointParameters
from .estimation.joint.parameters import BEARING, RANGING, SHAPE, TARGET_NOISE, SightingNoise
from .nmpc import NmpcParameters
from .nmpc.problem import terms_of


def nmpc_parameters(scenario: FlightScenario) -> NmpcParameters:
    """Return the NMPC's parameters, which the scenario has validated."""
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
    """Return the parameters of the NMPC that do not depend on the body: every key of ``controller``
    that is not among `ControllerOptions`. Raises ValueError for one that nothing reads.
    """
    keys = type(controller).model_fields.keys() - ControllerOptions.model_fields.keys()
    own = keys & {f.name for f in fields(NmpcParameters)}
    settings = {name: getattr(controller, name) for name in keys - own}
    settings["max_reference_distance_m"] = limits.max_reference_distance_m
    return {name: getattr(controller, name) for name in own} | {"terms": terms_of(settings)}


def target_noise(estimator: EstimatorSection) -> dict[str, tuple[float, float]]:
    """Return the process noise of the target for each motion model: the default, or what the
    scenario states.
    """
    stated = (estimator.target_acceleration_noise, estimator.target_angular_noise)
    return {
        model: (stated[0] or default[0], stated[1] or default[1])
        for model, default in TARGET_NOISE.items()
    }


def _far_noise(scenario: FlightScenario) -> SightingNoise:
    """Return the errors of sightings without markers."""
    if scenario.ranging is None:
        return SHAPE
    return RANGING if scenario.perception.name == "statistical" else BEARING


def estimator_of(scenario: FlightScenario) -> Estimator | JointEstimator:
    """Return the estimator that the scenario names: a built-in one, or an installed
    ``chaserdock.estimators`` entry point, called with the scenario. Raises PluginError if there is
    none of that name."""
    name = scenario.estimator.name
    if name not in ESTIMATORS:
        return plugins.load("estimator", name, ESTIMATORS)(scenario)
    if name == "paper":
        return make_estimator(name)
    target, errors = scenario.target, scenario.navigation.errors()
    xx, xy, xz, _, yy, yz, _, _, zz = target.inertia_tensor.reshape(-1).tolist()
    parameters = MekfParameters(
        motion_model="torque_free" if target.motion == "torque_free" else "constant_rates",
        inertia_ratios=((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)),
        centre_of_mass_trf_m=target.centre_of_mass_m,
        body_covariance=rows_of(stated_properties(scenario).covariance[1:, 1:]),
        bias_position_m=errors.camera_shift_m,
        bias_attitude_rad=errors.camera_turn_rad,
        bias_focal_share=errors.camera_focal_share,
    )
    if name == "mekf":
        return make_estimator(name, parameters)
    body = scenario.chaser
    joint = JointParameters(
        target=parameters,
        body=body,
        camera=scenario.camera_model(),
        navigation=errors,
        force_max_N=body.force_max_N,
        torque_max_N_m=body.torque_max_N_m,
        unexpected_velocity_m_s=body.force_max_N
        / body.mass_kg
        / scenario.time.rate_hz
        / math.sqrt(3.0),
        unexpected_omega_rad_s=math.sqrt(3.0)
        * body.torque_max_N_m
        / min(body.inertia)
        / scenario.time.rate_hz,
        mean_motion_rad_s=0.0
        if scenario.orbit is None
        else scenario.orbit.elements.mean_motion_rad_s,
        target_noise=target_noise(scenario.estimator),
        shape=_far_noise(scenario),
    )
    return JointEstimator(joint, len(scenario.chasers))
