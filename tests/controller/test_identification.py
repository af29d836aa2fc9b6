# SPDX-License-Identifier: Apache-2.0
"""Mathematics of the identification of a stack: its Jacobians, its covariances, and what detection
of failures proves.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from chaserdock_controller.bodies.mass_properties import (
    MassProperties,
    attach,
    body_of,
    covariance_by_chasers,
    detach,
    prior_of,
    properties_of,
)
from chaserdock_controller.bodies.target_body import TargetBody, attach_bodies
from chaserdock_controller.estimation.identification.composite import (
    CompositeIdentification,
    IdentificationParameters,
)
from chaserdock_controller.estimation.identification.fault_recovery import (
    FaultTolerantIdentification,
)
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState, free_rotation
from chaserdock_protocol.scenario.navigation import NavigationSection
from detumble_cases import BODY, mounted, stack_of, target_alone
from hypothesis import given, settings
from hypothesis import strategies as st

SEEDS = st.integers(0, 2**32 - 1)
ERRORS = NavigationSection(grade="lab").errors()
PARAMETERS = IdentificationParameters()
STEP_S = 1.0 / 15.0
FREE = np.array([t.direction[0] > 0.0 for t in BODY.thrusters])


class Stack:
    """A true stack that moves freely between impulses, and its chasers' odometry."""

    def __init__(self, seed: int, chasers: tuple[int, ...] = (0, 3)) -> None:
        self.rng = np.random.default_rng(seed)
        self.chasers = mounted(chasers)
        self.body = stack_of(self.chasers)
        self.position, self.velocity = self.rng.normal(size=3), self.rng.normal(0.0, 0.02, 3)
        self.q = rotations.normalize(self.rng.normal(size=4))
        omega = self.rng.normal(size=3)
        self.omega = math.radians(7.0) * omega / np.linalg.norm(omega)

    def states(self, noise: float = 1.0) -> dict[int, BodyState]:
        out, draw = {}, self.rng.normal
        for i, c in self.chasers.items():
            arm = c.position_m - self.body.centre_trf_m
            turn = rotations.exp(noise * draw(0.0, ERRORS.attitude_noise_rad, 3))
            out[i] = BodyState(
                self.position
                + rotations.rotate(self.q, arm)
                + noise * draw(0.0, ERRORS.position_noise_m, 3),
                self.velocity
                + rotations.rotate(self.q, np.cross(self.omega, arm))
                + noise * draw(0.0, ERRORS.velocity_noise_m_s, 3),
                rotations.multiply(rotations.multiply(self.q, c.q_wxyz), turn),
                rotations.rotate_inverse(c.q_wxyz, self.omega)
                + noise * draw(0.0, ERRORS.omega_noise_rad_s, 3),
            )
        return out

    def step(self, impulses: dict[int, Array]) -> None:
        wrench = np.zeros(6)
        for i, j in impulses.items():
            own = np.array(
                [(*t.direction, *np.cross(t.position_m, t.direction)) for t in BODY.thrusters]
            ).T
            wrench += self.chasers[i].wrench_to_stack(own @ j, self.body.centre_trf_m)
        kick = rotations.rotate(self.q, wrench[:3]) / self.body.mass_kg
        turn = np.linalg.solve(self.body.inertia_kg_m2, wrench[3:])
        self.position = self.position + STEP_S * (self.velocity + kick / 2.0)
        self.velocity = self.velocity + kick
        qs, omegas, _ = free_rotation(
            self.q, self.omega + turn / 2.0, self.body.inertia_kg_m2, STEP_S, 2
        )
        self.q, self.omega = qs[1], omegas[1] + turn / 2.0

    def filter(self, target: TargetBody | None = None) -> CompositeIdentification:
        prior = attach(
            prior_of(target or target_alone(), 0.3, 0.3, 0.1), tuple(self.chasers.values()), BODY
        )
        usable = dict.fromkeys(self.chasers, FREE)
        return CompositeIdentification(
            prior, self.chasers, self.states(0.0), BODY.thrusters, usable, ERRORS, PARAMETERS
        )

    def pulses(self, share: float = 0.2) -> dict[int, Array]:
        on = {i: FREE & (self.rng.random(12) < share) for i in self.chasers}
        return {i: np.where(mask, 1.5 * STEP_S, 0.0) for i, mask in on.items()}


def test_covariance_by_chasers_is_that_of_drawn_masses_and_centres() -> None:
    rng, chasers, target = np.random.default_rng(1), mounted((0, 1, 3)), target_alone()
    drawn = []
    for _ in range(3000):
        parts = []
        for c in chasers.values():
            share = 1.0 + 0.1 * rng.normal()
            place = c.position_m + rng.normal(0.0, 0.01, 3)
            parts.append((share * BODY.mass_kg, share * np.asarray(BODY.inertia), place, c.q_wxyz))
        drawn.append(properties_of(attach_bodies(target, parts)))
    found = covariance_by_chasers(target, tuple(chasers.values()), BODY, 0.1, 0.01)
    expected = np.cov(np.array(drawn).T)
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / size).max() < 0.1


@settings(deadline=None, max_examples=20)
@given(SEEDS)
def test_detaching_undoes_attaching(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(10, 10))
    root[0, 1:] = root[1:, 0] = 0.0
    root[0, 0] *= 1e-3  # what the curvature in the mass adds to the uncertainty is not undone
    target = MassProperties(target_alone(), root @ root.T * 1e-4)
    chasers = mounted((0, 1, 3))
    parts = tuple(chasers.values())
    again = detach(attach(target, parts, BODY), parts, BODY)
    assert again.values == pytest.approx(target.values, abs=1e-9)
    assert again.covariance == pytest.approx(target.covariance, rel=1e-4, abs=1e-6)
    assert properties_of(body_of(target.values)) == pytest.approx(target.values)


def test_a_stack_is_as_uncertain_as_its_nonlinear_dependence_on_the_mass() -> None:
    """Centre and ratios are known and the mass is 30 % wrong: the true stack is within its
    covariance.
    """
    true, chasers = target_alone(), mounted((0,))
    scale = np.diag([45.0**2, *[1e-6] * 3, *[1e-4] * 6])
    for share in (0.7, 1.3):
        stated = TargetBody(share * true.mass_kg, true.inertia_kg_m2, true.centre_trf_m)
        stack = attach(MassProperties(stated, share**2 * scale), tuple(chasers.values()), BODY)
        off = properties_of(stack_of(chasers)) - stack.values
        # The mass of the stack is learned as a logarithm.
        off[0] = stack.body.mass_kg * math.log1p(off[0] / stack.body.mass_kg)
        assert off @ np.linalg.solve(stack.covariance, off) < 16.0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_transition_is_the_derivative_of_the_prediction(seed: int) -> None:
    """Shift the error state before a prediction, and compare the innovations of the exact state
    with those that follow.
    """
    stack = Stack(seed)
    size = len(stack.filter().covariance)
    pulses = stack.pulses(0.4)
    reference = stack.filter()
    transition = reference.predict(pulses, STEP_S).transition
    stack.step(pulses)
    states = stack.states(0.0)
    rng = np.random.default_rng(seed)
    scale = np.array(
        [
            *[1e-4] * 3,
            *[1e-4] * 3,
            *[1e-4] * 6,
            1e-2,
            *[1e-3] * 3,
            *[0.1] * 6,
            *[1e-4] * 12,
            *[1e-2] * 12,
        ]
    )
    assert len(scale) == size
    for _ in range(6):
        shift = scale * rng.normal(size=size)
        residuals = []
        for sign in (1.0, -1.0):
            moved = Stack(seed).filter()
            moved._estimate = moved._corrected(moved._estimate, sign * shift)
            moved.predict(pulses, STEP_S)
            innovation = moved.update(states)
            assert innovation is not None
            residuals.append(innovation.residual)
        change = (residuals[1] - residuals[0]) / 2.0
        innovation = reference_innovation(seed, pulses, states)
        assert change == pytest.approx(innovation @ transition @ shift, abs=2e-7, rel=2e-3)


def reference_innovation(
    seed: int, pulses: dict[int, Array], states: dict[int, BodyState]
) -> Array:
    """Return the measurement matrix at the predicted state."""
    reference = Stack(seed).filter()
    reference.predict(pulses, STEP_S)
    innovation = reference.update(states)
    assert innovation is not None
    return innovation.matrix


def run(
    stack: Stack,
    target: TargetBody,
    seconds: float,
    failure: tuple[int, int, str] | None = None,
    at_s: float = 0.0,
):
    """Identify a stack from pulses; ``failure``: chaser, thruster and kind, from ``at_s`` on until
    it is found. Return filter, mean NIS and what was found with its time."""
    found, nis, faults = FaultTolerantIdentification(stack.filter(target), np.full(12, 1.5)), [], []
    suspects = np.ones(len(found.filter.usable), dtype=bool)
    pulses: dict[int, Array] = {}
    for k in range(round(seconds / STEP_S)):
        if k:
            found.predict(pulses, STEP_S)
        fault = found.update(stack.states(), suspects)
        nis.append(found.filter.nis)
        if fault is not None:
            faults.append((k * STEP_S, fault))
            suspects[found.filter.usable.index((fault.chaser, fault.thruster))] = False
        if k % 5 == 0:
            pulses = stack.pulses(0.1)
            for _, fault in faults:
                pulses[fault.chaser][fault.thruster] = 0.0
        given = {i: j.copy() for i, j in pulses.items()}
        if failure is not None and k * STEP_S >= at_s:
            chaser, thruster, kind = failure
            given[chaser][thruster] = 1.5 * STEP_S if kind == "stuck_on" and not faults else 0.0
        stack.step(given)
    return found.filter, float(np.mean(nis)), faults


def wrong_target() -> TargetBody:
    return TargetBody(150.0 * 1.3, 20.0 * 0.7 * np.eye(3), np.zeros(3))


@pytest.mark.parametrize("seed", [0, 1])
def test_wrong_knowledge_becomes_right_with_consistent_covariance(seed: int) -> None:
    stack = Stack(seed)
    found, nis, faults = run(stack, wrong_target(), 20.0)
    assert not faults
    assert nis == pytest.approx(1.0, abs=0.15)
    error = found.stack.values - properties_of(stack.body)
    assert error @ np.linalg.solve(found.stack.covariance, error) / 10.0 < 2.5
    alone = found.target(BODY)
    off = alone.values - properties_of(target_alone())
    assert abs(off[0]) < 0.04 * 150.0
    assert np.linalg.norm(off[1:4]) < 0.008
    assert np.abs(off[4:]).max() < 0.08 * 25.0


@pytest.mark.parametrize(
    ("seed", "kind", "at_s"), [(3, "stuck_off", 0.0), (4, "stuck_off", 5.0), (3, "stuck_on", 5.0)]
)
def test_after_a_failure_the_mass_properties_are_as_well_known_as_without(
    seed: int, kind: str, at_s: float
) -> None:
    stack = Stack(seed)
    thruster = int(np.flatnonzero(FREE)[2])
    found, _, faults = run(stack, wrong_target(), 12.0, (3, thruster, kind), at_s)
    assert [(f.chaser, f.thruster, f.kind) for _, f in faults] == [(3, thruster, kind)]
    error = found.stack.values - properties_of(stack.body)
    assert error @ np.linalg.solve(found.stack.covariance, error) / 10.0 < 2.5
    off = found.target(BODY).values - properties_of(target_alone())
    assert abs(off[0]) < 0.05 * 150.0
    assert np.linalg.norm(off[1:4]) < 0.01
    assert np.abs(off[4:]).max() < 0.1 * 25.0


def test_pulses_that_are_thought_to_tell_nothing_gain_nothing() -> None:
    found = Stack(1).filter()
    noise = np.full(6, 1e-4)
    some = found.pulse_gains(0.5, noise, np.ones(10))
    more = found.pulse_gains(1.0, noise, np.ones(10))
    assert (some > 0.0).all()
    assert (more > some).all()
    assert found.pulse_gains(0.0, noise, np.ones(10)) == pytest.approx(0.0)
