# SPDX-License-Identifier: Apache-2.0
"""Aborts at random moments of a rendezvous, without the flight: the guidance of the controller on a
profile that is tracked up to the errors of navigation, then two orbits of nonlinear relative motion
with J2 after the abort's burn, under the disturbances that the scenario states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import cast

import numpy as np
from chaserdock_controller.estimation.joint.parameters import parameters_of
from chaserdock_controller.guidance.chaser_state import ChaserTick, TrackingErrors
from chaserdock_controller.guidance.escape import EscapePlanner, RelativeState
from chaserdock_controller.guidance.phases import Phase, Trigger
from chaserdock_controller.guidance.stage import GuidanceStage
from chaserdock_controller.interfaces import TargetState
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.orbit import HillFrame, hill_frame, propagate, state_of
from chaserdock_models.passive_safety import CoastNoise, disturbed
from chaserdock_models.relative_motion import relative_acceleration
from chaserdock_protocol.scenario import Scenario, flight_scenario

STEP_S = 10.0
"""Step of RK4 of a coast of two orbits (some 5,500 s each)."""
_POSITION_SHARE, _POSITION_M = 8e-4, 2e-3
_VELOCITY_SHARE, _VELOCITY_M_S = 3e-6, 4e-4
"""Errors by distance: those of the joint filter in `v-bar` after 30 s are 0.16 m and 0.7 to 1.6
mm/s at 200 m, 0.08 m and 0.6 to 0.9 mm/s at 100 m, and shrink further."""
_BURN_ERROR = 0.03
"""Error of a burn, share, one sigma."""


def navigation_covariance(distance_m: float) -> Array:
    """Return the covariance (6, 6) of the estimated relative position and velocity at a distance
    from the target.
    """
    position_m = math.hypot(_POSITION_M, _POSITION_SHARE * distance_m)
    velocity_m_s = math.hypot(_VELOCITY_M_S, _VELOCITY_SHARE * distance_m)
    return np.diag([position_m**2] * 3 + [velocity_m_s**2] * 3)


def known_at(state: Array, scenario: Scenario) -> RelativeState:
    """Return what guidance knows in a relative state (6,): it cannot tell the force that lasts in a
    coast from errors of thrust, and knows its size only.
    """
    parameters = parameters_of(flight_scenario(scenario))
    covariance = navigation_covariance(float(np.linalg.norm(state[:3])))
    sigma_m_s2 = parameters.lasting_force_N / parameters.body.mass_kg
    return RelativeState(state, disturbed(covariance, sigma_m_s2), still_target(scenario))


def still_target(scenario: Scenario) -> TargetState:
    """Return the target of a scenario as guidance sees one that does not turn."""
    values = SimpleNamespace(q_wxyz=np.asarray(scenario.target.q_wxyz), omega_rad_s=np.zeros(3))
    return cast(TargetState, values)


def profile(scenario: Scenario) -> tuple[EscapePlanner, Array, Array]:
    """Return the guidance's planner of aborts, and the profile of chaser 0: times (K,), states (K,
    6) relative to the target, WRF.

    It ends where the chaser waits at the entry of its corridor. Raises ValueError for a refused
    command.
    """
    fleet = GuidanceStage(flight_scenario(scenario)).fleet
    chaser, planner, still = fleet.chasers[0], fleet.moves.escapes, still_target(scenario)
    chaser.fire(Trigger.TARGET_ACQUIRED, 0.0)
    times, states = [], []
    if planner is None:
        raise ValueError('the study needs limits.passive_safety = "enforce"')
    last = max((entry.at_s for entry in scenario.timeline), default=0.0)
    for now_s in np.arange(0.0, scenario.duration_s, 1.0).tolist():
        offsets, velocities, _ = chaser.state.move.at(np.array([now_s]))
        state = rotations.rotate(still.q_wxyz, np.stack([offsets[0], velocities[0]])).ravel()
        chaser.position_m = offsets[0]
        chaser.relative = known_at(state, scenario)
        commands = fleet.due_commands(now_s)
        for command, result in zip(commands, fleet.apply(commands, now_s), strict=True):
            if not result.accepted:
                raise ValueError(f"{command.command} at {now_s:g} s: {result.reason}")
        times.append(now_s)
        states.append(state)
        if chaser.phase is not Phase.ALIGN:  # there it would look at its port
            here = ChaserTick(now_s, own=None, target=still, offset_m=offsets[0])
            chaser.step(here, TrackingErrors(0.0, 0.0))
        if now_s > last and chaser.state.move.over_at(now_s):
            break
    return planner, np.array(times), np.array(states)


@dataclass(frozen=True)
class AbortOutcome:
    """Of the aborts: ``certified``, those with the required margin; ``entered``, those whose true
    coast entered the keep-out. ``nearest_m``: smallest distance of all; ``delta_v_m_s``: mean and
    largest burn."""

    aborts: int
    certified: int
    entered: int
    nearest_m: float
    mean_delta_v_m_s: float
    max_delta_v_m_s: float
    profile_s: float


def study(scenario: Scenario, aborts: int, seed: int) -> AbortOutcome:
    """Abort at random moments of a scenario's rendezvous, with random errors of navigation and
    burn, and random disturbances.

    The true state differs from the one that guidance aborts from by an error of the covariance that
    guidance receives, and the burn by 3 % in size. Two forces act on the coast, each with the
    standard deviation of ``limits.passive_safety_force_N`` along every axis of the Hill frame: a
    constant one and a Gauss-Markov process that begins at zero.
    """
    if scenario.orbit is None:
        raise ValueError("the study needs an orbit")
    planner, times, states = profile(scenario)
    frames = _frames(scenario, planner.duration_s)
    rng = np.random.default_rng([seed, 0xAB07])
    keep_out_m = scenario.limits.min_distance_target_m
    noise = parameters_of(flight_scenario(scenario)).coast_noise
    certified, entered, nearest, impulses = 0, 0, math.inf, []
    for row in rng.integers(0, len(times), aborts):
        state = states[row]
        known = known_at(state, scenario)
        escape, margin = planner.escape(known, float(times[row]))
        certified += margin >= planner.sigmas
        impulses.append(escape.impulse_m_s)
        error = np.linalg.cholesky(known.disturbed.covariance[:6, :6]) @ rng.standard_normal(6)
        burn = escape.acceleration_m_s2 * (1.0 + _BURN_ERROR * rng.standard_normal())
        pushes = _disturbances(noise, (len(frames) - 1) // 2 + 1, rng)
        nearest_m = _fly(state + error, burn, escape.burn_s, pushes, frames)
        entered += nearest_m < keep_out_m
        nearest = min(nearest, nearest_m)
    return AbortOutcome(
        aborts,
        certified,
        entered,
        nearest,
        float(np.mean(impulses)),
        max(impulses),
        float(times[-1]),
    )


def _frames(scenario: Scenario, duration_s: float) -> list[HillFrame]:
    """Return the Hill frames of the target's orbit at every half step."""
    assert scenario.orbit is not None
    j2 = scenario.orbit.zonal_coefficient
    state = state_of(scenario.orbit.elements)
    frames = []
    for _ in range(2 * math.ceil(duration_s / STEP_S) + 1):
        frames.append(hill_frame(state, j2))
        state = propagate(state, 0.5 * STEP_S, j2)
    return frames


def _disturbances(noise: CoastNoise, steps: int, rng: np.random.Generator) -> Array:
    """Return the accelerations (steps, 3) by disturbances, constant within a step."""
    kept = math.exp(-STEP_S / noise.varying_s)
    constant, varying, found = noise.varying_m_s2 * rng.standard_normal(3), np.zeros(3), []
    for _ in range(steps):
        found.append(constant + varying)
        fresh = noise.varying_m_s2 * math.sqrt(1.0 - kept * kept) * rng.standard_normal(3)
        varying = kept * varying + fresh
    return np.array(found)


def _fly(
    state: Array, burn_m_s2: Array, burn_s: float, pushes: Array, frames: Sequence[HillFrame]
) -> float:
    """Return the smallest distance from the target after a burn, in steps of RK4 of which the first
    ends with the burn. ``pushes`` (K, 3): accelerations by disturbances in the K steps.
    """
    y, nearest = state, math.inf
    # The burn takes seconds: one step in the first frame, and the coast begins there.
    for k, push in enumerate(pushes):
        first = max(0, 2 * (k - 1))
        h, inside = STEP_S, frames[first : first + 3]
        if k == 0:
            h, inside, push = burn_s, [frames[0]] * 3, push + burn_m_s2
        a = _derivative(inside[0], y, push)
        b = _derivative(inside[1], y + 0.5 * h * a, push)
        c = _derivative(inside[1], y + 0.5 * h * b, push)
        d = _derivative(inside[2], y + h * c, push)
        moved = y + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        nearest = min(nearest, _nearest_on(y[:3], moved[:3]))
        y = moved
    return nearest


def _derivative(frame: HillFrame, y: Array, push_m_s2: Array) -> Array:
    x, z, w, u, v, s = y.tolist()
    return np.concatenate(
        [y[3:], np.add(relative_acceleration(frame, (x, z, w), (u, v, s)), push_m_s2)]
    )


def _nearest_on(begin: Array, end: Array) -> float:
    """Return the smallest distance of a segment from the origin."""
    step = end - begin
    share = min(1.0, max(0.0, -float(begin @ step) / max(float(step @ step), 1e-30)))
    return float(np.linalg.norm(begin + share * step))
