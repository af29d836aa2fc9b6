# SPDX-License-Identifier: Apache-2.0
"""Free tumbles seen by chasers that keep their places: estimates of its mass properties from vision alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from chaserdock_controller.estimation.composite_body import target_body
from chaserdock_controller.estimation.identification.composite import prior_of, properties_of
from chaserdock_controller.estimation.identification.free_tumble import TumbleIdentification
from chaserdock_controller.estimation.identification.stage import parameters_of
from chaserdock_controller.estimation.measurements import SightingConverter
from chaserdock_models import rotations
from chaserdock_models.rigid_body import BodyState, free_rotation
from chaserdock_protocol.scenario import Scenario, flight_scenario
from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.plant import target_plant
from chaserdock_world.sensors.errors import OdometrySensor
from chaserdock_world.sensors.publish import odometry_of

from .detumble_flights import moving_with
from .latched_stack import body_of_plant
from .perception import RenderedImages


@dataclass(frozen=True)
class TumbleOutcome:
    """One tumble. ``ratio_error``: largest error of an element of inertia over trace, as a share of the largest of them;
    ``centre_m``: of the centre of mass; ``nees`` of the ratios (5 degrees of freedom) per degree, ``nis`` per degree."""

    seed: int
    rate_deg_s: float
    ratio_error: float
    centre_m: float
    nees: float
    nis: float


def watch_tumble(scenario: Scenario, duration_s: float) -> TumbleOutcome:
    """Let the chasers of a scenario watch its free target for ``duration_s`` from their nominal places in TRF."""
    flight, timing = flight_scenario(scenario), scenario.timing
    body = body_of_plant(target_plant(scenario))
    start = scenario.target
    q0, omega0 = np.array(start.q_wxyz), np.array(start.omega_rad_s)
    period_s, ticks = 1.0 / scenario.time.rate_hz, round(duration_s * scenario.time.rate_hz)
    qs, omegas, _ = free_rotation(q0, omega0, body.inertia_kg_m2, period_s, ticks)
    centre = np.array(start.position_m) + rotations.rotate(q0, body.centre_trf_m)
    velocity = np.array(start.velocity_m_s) + rotations.rotate(q0, np.cross(omega0, body.centre_trf_m))
    camera, sensor = RenderedImages(scenario), OdometrySensor(scenario)
    converter, found = SightingConverter(flight.camera_model()), None
    nis, parameters, errors = [], parameters_of(flight), flight.navigation.errors()
    for tick in range(ticks):
        now_ns, q, omega = timing.tick_time_ns(tick), qs[tick], omegas[tick]
        arm = rotations.rotate(q, body.centre_trf_m)
        moving = velocity - np.cross(rotations.rotate(q, omega), arm)
        target = BodyState(centre + tick * period_s * velocity - arm, moving, q, omega)
        states = {TARGET: target} | {
            f"chaser/{i}": moving_with(target, np.array(c.position_m), np.array(c.q_wxyz))
            for i, c in enumerate(scenario.chasers)
        }
        chasers = range(len(scenario.chasers))
        odometry = {i: odometry_of(sensor, i, states[f"chaser/{i}"], tick, now_ns) for i in chasers}
        converter.add_odometry(odometry, now_ns)
        sightings = ()
        if timing.has_images(tick):
            sightings = tuple(camera(i, tick, now_ns, states) for i in chasers)
        first = found is None
        if found is None:
            rng = np.random.default_rng([scenario.seed, 0xF7])
            guess = BodyState(
                target.position_m,
                moving + rng.normal(0.0, 0.005, 3),
                rotations.multiply(q, rotations.exp(rng.normal(0.0, 0.005, 3))),
                omega + rng.normal(0.0, 0.003, 3),
            )
            prior = prior_of(target_body(flight), parameters)
            found = TumbleIdentification(prior, chasers, guess, errors, parameters)
        found.step(converter.measurements(sightings), period_s, first)
        nis.append(found.nis)
    assert found is not None
    ratios, covariance = found.ratios
    true = properties_of(body)[4:]
    true = true / true[:3].sum()
    error = ratios - true
    return TumbleOutcome(
        seed=scenario.seed,
        rate_deg_s=math.degrees(float(np.linalg.norm(omega0))),
        ratio_error=float(np.abs(error).max())
        / float(np.linalg.eigvalsh(body.inertia_kg_m2)[-1] / np.trace(body.inertia_kg_m2)),
        centre_m=float(np.linalg.norm(found.target.body.centre_trf_m - body.centre_trf_m)),
        nees=float(error @ np.linalg.pinv(covariance, rcond=1e-6, hermitian=True) @ error) / 5.0,
        nis=float(np.mean(nis)),
    )
