# SPDX-License-Identifier: Apache-2.0
"""Free tumbles seen by chasers that keep their places: what vision alone tells of the target's mass
properties. Fast.

The chasers move with the target as if they were fixed to it, and the filter gets the impulses that
this takes, so that no controller is involved. Sightings are those of rendered images, or with
statistical perception drawn ones, to which ``ViewErrors`` adds what images have and drawn ones
lack: errors that persist with the view, as the filter expects them of images.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from chaserdock_controller.bodies.mass_properties import (
    inertia_ratios,
    properties_of,
    with_shape,
)
from chaserdock_controller.estimation.composite_body import stated_properties
from chaserdock_controller.estimation.joint import JointEstimator, JointParameters, parameters_of
from chaserdock_controller.estimation.types import EstimatorInputs, MeasuredChaser
from chaserdock_controller.interfaces import AppliedImpulse
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState, free_rotation
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Sighting
from chaserdock_protocol.scenario import FlightScenario, Scenario, flight_scenario
from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.plant import target_plant
from chaserdock_world.sensors.errors import OdometrySensor
from chaserdock_world.sensors.publish import odometry_of

from chaserdock.analysis.pose_errors import normalized_square, pose_error, relative_pose
from chaserdock.experiments.perception import RenderedImages

from .detumble_flights import stack_scenario
from .latched_stack import body_of_plant, moving_with
from .rigid_control import wrong_knowledge


class ViewErrors:
    """Errors of the sightings of one chaser that persist with the view: a Gauss-Markov process with
    the figures of the filter.
    """

    def __init__(self, parameters: JointParameters, seed: int, chaser: int) -> None:
        self._parameters = parameters
        self._rng = np.random.default_rng([seed, 0x71E, chaser])
        self._view = self._rng.standard_normal(6)

    def added_to(self, sighting: Sighting, step_s: float) -> Sighting:
        """Return the sighting with errors, ``step_s`` after the one before."""
        noise = self._parameters.sighting_noise(len(sighting.marker_ids))
        fade = math.exp(-step_s / noise.view_time_s)
        self._view = fade * self._view + math.sqrt(1.0 - fade**2) * self._rng.standard_normal(6)
        more = math.sqrt(max(0.0, noise.white_ratio**2 - 1.0)) * self._rng.standard_normal(6)
        solutions = []
        for s in sighting.solutions:
            error = np.linalg.cholesky(np.reshape(s.covariance, (6, 6))) @ (
                more + noise.view_ratio * self._view
            )
            q = rotations.multiply(np.array(s.q_wxyz), rotations.exp(error[3:]))
            position = np.array(s.position_m) + error[:3]
            solutions.append(
                msgspec.structs.replace(s, position_m=vector(position), q_wxyz=vector(q))
            )
        return msgspec.structs.replace(sighting, solutions=tuple(solutions))


@dataclass(frozen=True)
class TumbleOutcome:
    """One tumble. ``ratio_error``: largest error of an element of the inertia over its trace, as a
    share of the largest moment over the trace; ``stated_error``: that of the stated inertia.
    ``centre_m``: error of the centre of mass. ``ratio_nees`` and ``centre_nees``: normalized
    squared errors (5 and 3 degrees of freedom). ``nees``: mean of those of the relative poses (6)
    after the first 10 s."""

    seed: int
    rate_deg_s: float
    ratio_error: float
    stated_error: float
    centre_m: float
    ratio_nees: float
    centre_nees: float
    nees: float


def tumble_scenario(
    seed: int, chasers: Sequence[int], rate_deg_s: float, changes: Sequence[str] = ()
) -> Scenario:
    """Return ``stack_scenario`` with a tumble of this rate, of which mass, inertia and centre are
    stated wrong.
    """
    scenario = stack_scenario(seed, chasers, [*wrong_knowledge(seed), *changes])
    omega = np.array(scenario.target.omega_rad_s)
    omega *= math.radians(rate_deg_s) / float(np.linalg.norm(omega))
    target = scenario.target.model_copy(update={"omega_rad_s": tuple(omega.tolist())})
    return scenario.model_copy(update={"target": target})


def watch_tumble(scenario: Scenario, duration_s: float) -> TumbleOutcome:
    """Let the chasers of a scenario watch its free target for ``duration_s`` from their nominal
    places in TRF.
    """
    flight, timing = flight_scenario(scenario), scenario.timing
    body = body_of_plant(target_plant(scenario))
    start = scenario.target
    q0, omega0 = np.array(start.q_wxyz), np.array(start.omega_rad_s)
    period_s, ticks = 1.0 / scenario.time.rate_hz, round(duration_s * scenario.time.rate_hz)
    qs, omegas, _ = free_rotation(q0, omega0, body.inertia_kg_m2, period_s, ticks)
    centre = np.array(start.position_m) + rotations.rotate(q0, body.centre_trf_m)
    velocity = np.array(start.velocity_m_s) + rotations.rotate(
        q0, np.cross(omega0, body.centre_trf_m)
    )
    camera = RenderedImages(scenario)
    sensor = OdometrySensor(scenario)
    drawn = scenario.perception.name == "statistical"
    estimator = JointEstimator(_parameters(flight, images=drawn), len(flight.chasers))
    chasers, before, nees = range(len(scenario.chasers)), None, []
    views = [ViewErrors(estimator.parameters, scenario.seed, i) for i in chasers]
    for tick in range(ticks):
        now_ns, q, omega = timing.tick_time_ns(tick), qs[tick], omegas[tick]
        arm = rotations.rotate(q, body.centre_trf_m)
        moving = velocity - np.cross(rotations.rotate(q, omega), arm)
        target = BodyState(centre + tick * period_s * velocity - arm, moving, q, omega)
        states = {TARGET: target} | {
            f"chaser/{i}": moving_with(target, np.array(c.position_m), np.array(c.q_wxyz))
            for i, c in enumerate(scenario.chasers)
        }
        own = [states[f"chaser/{i}"] for i in chasers]
        sightings: tuple[Sighting, ...] = ()
        if timing.has_images(tick):
            sightings = tuple(camera(i, tick, now_ns, states) for i in chasers)
        if drawn:
            image_s = period_s * timing.ticks_per_image
            sightings = tuple(views[s.chaser].added_to(s, image_s) for s in sightings)
        measured = tuple(
            MeasuredChaser(
                i,
                AppliedImpulse.steady(_impulse(scenario, (before or own)[i], own[i])),
                odometry_of(sensor, i, own[i], tick, now_ns),
            )
            for i in chasers
        )
        estimator.update(EstimatorInputs(now_ns, period_s, measured, sightings))
        before = own
        if tick * period_s >= 10.0:
            nees += [
                _nees(r.position_m, r.q_wxyz, r.covariance, target, own[i])
                for i, r in estimator.relative_poses().items()
            ]
    shape = estimator.shape
    if shape is None:
        raise ValueError('needs target.motion = "torque_free"')
    stated = stated_properties(flight)
    found, true = with_shape(stated, *shape), properties_of(body)[4:]
    ratios, covariance = inertia_ratios(found)
    largest = float(np.linalg.eigvalsh(body.inertia_kg_m2)[-1] / np.trace(body.inertia_kg_m2))
    off, begin = (r - true / true[:3].sum() for r in (ratios, inertia_ratios(stated)[0]))
    away = found.body.centre_trf_m - body.centre_trf_m
    return TumbleOutcome(
        seed=scenario.seed,
        rate_deg_s=math.degrees(float(np.linalg.norm(omega0))),
        ratio_error=float(np.abs(off).max()) / largest,
        stated_error=float(np.abs(begin).max()) / largest,
        centre_m=float(np.linalg.norm(away)),
        # The trace of the ratios is 1: their covariance has rank 5.
        ratio_nees=float(off @ np.linalg.pinv(covariance, rcond=1e-9, hermitian=True) @ off),
        centre_nees=float(away @ np.linalg.solve(found.covariance[1:4, 1:4], away)),
        nees=float(np.mean(nees)) if nees else math.nan,
    )


def _parameters(flight: FlightScenario, images: bool) -> JointParameters:
    """Return the filter's parameters for a flight, or for the same one with images of markers."""
    if not images:
        return parameters_of(flight)
    perception = flight.perception.model_copy(update={"name": "default"})
    return parameters_of(flight.model_copy(update={"perception": perception}))


def _impulse(scenario: Scenario, before: BodyState, after: BodyState) -> Array:
    """Return the impulse (6,), body axes, that changes the rates of a chaser of the nominal mass
    properties so.
    """
    body = scenario.chaser
    push = rotations.rotate_inverse(before.q_wxyz, after.velocity_m_s - before.velocity_m_s)
    spin = [
        rotations.rotate(s.q_wxyz, np.array(body.inertia) * s.omega_rad_s) for s in (before, after)
    ]
    return np.concatenate(
        [body.mass_kg * push, rotations.rotate_inverse(before.q_wxyz, spin[1] - spin[0])]
    )


def _nees(
    position_m: Array, q_wxyz: Array, covariance: Array, target: BodyState, own: BodyState
) -> float:
    """Return the normalized squared error of a chaser's estimated pose relative to the target."""
    true = relative_pose(own.position_m, own.q_wxyz, target.position_m, target.q_wxyz)
    return float(normalized_square(pose_error(*true, position_m, q_wxyz), covariance))
