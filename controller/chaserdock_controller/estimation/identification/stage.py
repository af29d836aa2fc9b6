# SPDX-License-Identifier: Apache-2.0
"""Identification during a mission: runs the filter of the stack, with fault detection, while
chasers are latched.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from chaserdock_models.arrays import BoolArray
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.mounting import nominal_mounting, plume_free_thrusters
from chaserdock_protocol.scenario.thrusters import thrusts_max

from chaserdock_controller.bodies.mass_properties import MassProperties, attach, inertia_ratios
from chaserdock_controller.estimation.composite_body import pose_in_target, stated_properties
from chaserdock_controller.interfaces import (
    IdentifiedStack,
    LogEntry,
    Observation,
    TargetEstimation,
)

from .composite import CompositeIdentification, IdentificationParameters
from .fault_recovery import FaultTolerantIdentification, RecoveryState
from .faults import StackFault

_SHOCK = (0.01, 0.02)
"""One sigma of the change of the stack's rates by a touch (m/s, rad/s)."""
_SILENT_S, _SILENT_SHARE = 1.0, 0.02
"""A chaser stops reporting its thrusters: for the first time (s) their impulses are unknown up to
full thrust, later up to the second number, a share of full thrust.
"""
_REFINE_S, _KNOWN_RATIO, _KNOWN_M = 2.0, 0.05, 0.02
"""The estimator adopts the target's mass properties at this interval (s), once the standard
deviations of the inertia ratios and of the centre of mass (m) are below the other two. Larger:
sooner, with less reliable properties; smaller: the estimator's prior is kept for longer.
"""
_PULSE_S = 0.3
"""Length, s, of an identifying pulse (`guidance/detumble/control.py` fires them)."""
_WATCH_S = 1.0
"""Time, s, over which the effect of a pulse is assumed to be measured when pulses are compared."""
_GOOD = (0.02, 0.005, 0.05)
"""Accuracies of mass (share), centre of mass (m) and inertia (share of the largest moment) that
count as equally valuable.
"""


def parameters_of(scenario: FlightScenario) -> IdentificationParameters:
    """Return the filter's parameters for a scenario."""
    s = scenario.detumble.identification
    return IdentificationParameters(
        thrust_share=s.thrust_share,
        scatter_share=s.pulse_scatter_share,
    )


@dataclass(frozen=True, eq=False)
class IdentificationState:
    """State for a standby controller. ``composite``: the latched chasers in the filter's order, and
    the filter's state; None while nothing is latched.
    """

    target: MassProperties
    failed: set[tuple[int, int]]
    reporting: set[int]
    silent_ticks: list[int]
    composite: tuple[list[int], RecoveryState] | None


class StackIdentification:
    """Identifies the stack that is latched now.

    ``target``: mass properties of the target alone, kept when chasers latch and leave. ``failed``:
    thrusters found stuck, as (chaser, number).
    """

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario, self._parameters = scenario, parameters_of(scenario)
        self._period_s = 1.0 / scenario.time.rate_hz
        self._full_N = thrusts_max(scenario.chaser.thrusters)
        self.target = stated_properties(scenario)
        self.failed: set[tuple[int, int]] = set()
        self._composite: FaultTolerantIdentification | None = None
        self._reporting: set[int] = set()
        self._silent_ticks = [0] * len(scenario.chasers)
        self._events: list[LogEntry] = []

    def run(self, observation: Observation, estimation: TargetEstimation) -> IdentifiedStack | None:
        """Process a tick's odometry and pulses. Returns the identified stack, or None while the
        target is unknown.

        While nothing is latched, the properties that the estimator finds in the free tumble become
        the prior of the next stack.
        """
        latched = {c.chaser for c in estimation.chasers if c.latched}
        present = {c.chaser for c in estimation.chasers if c.own is not None}

        if not latched:
            self._composite = None
            if estimation.stack is not None:
                self.target = estimation.stack.target
            return estimation.stack
        if not estimation.known or not latched & present:
            self._composite = None
            return None

        states = {
            c.chaser: body_state(c.measured)
            for c in observation.chasers
            if c.measured is not None and c.chaser in latched
        }
        composite = self._composite
        if composite is None or set(composite.filter.chasers) != latched:
            if not states:
                return None
            composite = self._composite = self._begin(estimation, states)
        else:
            self._predict(composite, observation)

        fault = composite.update(states, self._suspects(composite.filter))
        if fault is not None:
            self._add_fault(fault)

        found = composite.filter
        self.target = found.target(self._scenario.chaser)
        return IdentifiedStack(
            stack=found.stack,
            target=self.target,
            chasers=found.members,
            motion=found.motion,
            failed=frozenset(self.failed),
            informative=partial(self._by_information, found),
        )

    def _suspects(self, found: CompositeIdentification) -> BoolArray:
        """Return which thrusters (u,) are tested for failures: those not yet found failed, of
        chasers that report their pulses.
        """
        return np.array(
            [
                (i, thruster) not in self.failed and self._silent_ticks[i] == 0
                for i, thruster in found.usable
            ],
            dtype=bool,
        )

    def identified(
        self, observation: Observation, estimation: TargetEstimation
    ) -> TargetEstimation:
        """Return the estimation completed by the identified stack and its events."""
        stack = self.run(observation, estimation)
        events, self._events = self._events, []
        return replace(estimation, stack=stack, events=(*estimation.events, *events))

    def refined_target(self, observation: Observation) -> MassProperties | None:
        """Return the target's mass properties for the estimator, at intervals and once they are
        accurate enough; otherwise None.
        """
        if self._composite is None or observation.tick % max(1, round(_REFINE_S / self._period_s)):
            return None
        ratios = math.sqrt(float(np.trace(inertia_ratios(self.target)[1])))
        centre_m = math.sqrt(float(np.trace(self.target.covariance[1:4, 1:4])))
        return self.target if ratios < _KNOWN_RATIO and centre_m < _KNOWN_M else None

    def save(self) -> IdentificationState:
        """Return the state for a standby controller. The result of a free tumble is part of the
        target's mass properties.
        """
        composite = None
        if self._composite is not None:
            composite = list(self._composite.filter.chasers), self._composite.save()
        return IdentificationState(
            self.target,
            set(self.failed),
            set(self._reporting),
            list(self._silent_ticks),
            composite,
        )

    def load(self, state: IdentificationState) -> None:
        """Replace the state by a saved one. Raises ValueError, and changes nothing, if that belongs
        to another scenario.
        """
        composite, known = None, range(len(self._scenario.chasers))
        if len(state.silent_ticks) != len(known) or not state.reporting <= set(known):
            raise ValueError("the state is of other chasers")
        if state.composite is not None:
            chasers, saved = state.composite
            if not chasers or len(set(chasers)) != len(chasers) or not set(chasers) <= set(known):
                raise ValueError("the state is of other chasers")
            estimate = saved.composite.estimate
            places = zip(chasers, estimate.mounts_m, estimate.mounts_wxyz, strict=True)
            still = BodyState(estimate.position_m, np.zeros(3), estimate.q_wxyz, np.zeros(3))
            composite = self._filter_of(
                {i: MountedChaser(place, q) for i, place, q in places},
                dict.fromkeys(chasers, still),
                1,
            )
            composite.load(saved)
        self.target, self.failed = state.target, set(state.failed)
        self._reporting, self._silent_ticks = set(state.reporting), list(state.silent_ticks)
        self._composite = composite

    def _begin(
        self, estimation: TargetEstimation, states: Mapping[int, BodyState]
    ) -> FaultTolerantIdentification:
        s, chasers = self._scenario, {}
        for c in estimation.chasers:
            if c.latched:
                chasers[c.chaser] = (
                    nominal_mounting(s, c.chaser)
                    if c.own is None
                    else MountedChaser(*pose_in_target(estimation.target, c.own.state))
                )
        # Measured chasers come first, because the filter starts from them.
        chasers = {i: chasers[i] for i in sorted(chasers, key=lambda i: (i not in states, i))}
        return self._filter_of(chasers, states, len(states))

    def _filter_of(
        self, chasers: Mapping[int, MountedChaser], states: Mapping[int, BodyState], measured: int
    ) -> FaultTolerantIdentification:
        s = self._scenario
        found = CompositeIdentification(
            attach(self.target, tuple(chasers.values()), s.chaser),
            chasers,
            states,
            s.chaser.thrusters,
            plume_free_thrusters(s, chasers.keys()),
            s.navigation.errors(),
            self._parameters,
            measured,
        )
        return FaultTolerantIdentification(found, self._full_N)

    def _predict(self, composite: FaultTolerantIdentification, observation: Observation) -> None:
        chasers = composite.filter.chasers
        given = {
            c.chaser: c.thruster_impulses
            for c in observation.chasers
            if c.thruster_impulses is not None and c.chaser in chasers
        }
        if given.keys() != self._reporting:
            composite.restart_detection()
        self._reporting = set(given)
        unknown = {}
        for i in chasers:
            self._silent_ticks[i] = 0 if i in given else self._silent_ticks[i] + 1
            # A silent chaser may still execute earlier commands, or fire without the controller.
            if i not in given:
                early = self._silent_ticks[i] * self._period_s <= _SILENT_S
                unknown[i] = self._full_N * (
                    self._period_s if early else _SILENT_SHARE * self._period_s
                )
        touched = any(c.touches for c in observation.chasers)
        composite.predict(given, self._period_s, unknown, _SHOCK if touched else None)

    def _add_fault(self, fault: StackFault) -> None:
        self.failed.add((fault.chaser, fault.thruster))
        kind = fault.kind.replace("_", " ")
        text = (
            f"chaser {fault.chaser}: thruster {fault.thruster} {kind}, seen in the motion of the "
            "stack, isolated"
        )
        self._events.append(("warning", text))

    def _by_information(self, found: CompositeIdentification) -> tuple[tuple[int, int], ...]:
        """Return the thrusters in the order of the information that a pulse gives on the mass
        properties, the most informative first.
        """
        errors, stack = self._scenario.navigation.errors(), found.stack
        count = len(found.chasers) * _WATCH_S / self._period_s
        noise = (
            np.repeat([errors.velocity_noise_m_s, errors.omega_noise_rad_s], 3)
            * math.sqrt(2.0 / count)
            + 1e-7
        )
        largest = float(np.linalg.eigvalsh(stack.body.inertia_kg_m2)[-1])
        scale = np.array(
            [_GOOD[0] * stack.body.mass_kg, *[_GOOD[1]] * 3, *[_GOOD[2] * largest] * 6]
        )
        gains = found.pulse_gains(float(self._full_N.max()) * _PULSE_S, noise, scale)
        usable = found.usable
        order = np.argsort(-gains, kind="stable")
        return tuple(usable[k] for k in order if usable[k] not in self.failed)


def body_state(o: Odometry) -> BodyState:
    """Return the state in an odometry message."""
    return BodyState(
        np.array(o.position_m),
        np.array(o.velocity_m_s),
        np.array(o.q_wxyz),
        np.array(o.omega_rad_s),
    )
