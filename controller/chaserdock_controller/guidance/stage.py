# SPDX-License-Identifier: Apache-2.0
"""Third stage of a tick: apply commands, advance the phases, and compute the references."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, length
from chaserdock_models.docking_geometry import view_of
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.messages import CommandReply, DockingStatus, Odometry, OperatorCommand
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.estimation.composite_body import centre_in_target, pose_in_target
from chaserdock_controller.estimation.identification.stage import body_state
from chaserdock_controller.interfaces import (
    ChaserEstimate,
    GuidanceResult,
    HorizonReference,
    Observation,
    PlanningHistory,
    ReferencePose,
    TargetEstimation,
    TargetState,
)

from .activities.register import activities_of
from .activities.search import is_settled
from .chaser_machine import ChaserMachine
from .chaser_state import ChaserTick, TrackingErrors
from .docking import DockingObservation
from .escape import RelativeState
from .fleet import ChaserFleet
from .horizon import ReferenceBuilder
from .pauses import lead_from_here, resume_after_pause
from .phases import Phase

_UNLED = (Phase.SEARCHING, Phase.SURVEY)
"""Phases of chasers that do not fly relative to the target, by commands of their own."""


class GuidanceStage:
    """Runs the state machines of the chasers and their activities."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario = scenario
        self.fleet = ChaserFleet(scenario)
        self.activities = activities_of(self.fleet)
        for chaser in self.fleet.chasers:
            chaser.take_up(self.activities)
        self.references = ReferenceBuilder(scenario)

    @property
    def chasers(self) -> tuple[ChaserMachine, ...]:
        """Return the state machines of the chasers, by number."""
        return self.fleet.chasers

    def run(
        self,
        observation: Observation,
        estimation: TargetEstimation,
        history: PlanningHistory,
    ) -> GuidanceResult:
        """Return what every chaser is to do in this tick. ``history``: results of planning in
        earlier ticks.
        """
        now_s, fleet, target = observation.time_s, self.fleet, estimation.target
        known = self._known(observation, estimation, history)
        ticks = tuple(zip(fleet.chasers, known, strict=True))
        for chaser, tick in ticks:
            if estimation.known and tick.own is not None:
                resume_after_pause(chaser, tick, fleet.moves, self.references)
        if estimation.known:
            fleet.follow_target(now_s, known, target.status == "tracking", is_settled(target))
        else:
            fleet.miss_target(now_s, target.status == "lost")
        for chaser, tick in ticks:
            chaser.follow_planning(tick)

        for sighting in observation.sightings:
            fleet.chasers[sighting.chaser].unseen = sighting.detail
            if sighting.map is not None:
                fleet.chasers[sighting.chaser].sight_map(sighting.map, now_s)
        commands = (*fleet.due_commands(now_s), *observation.commands)
        for activity in self.activities:
            activity.observe(commands, observation, estimation)
        replies = self._reply(commands, observation)

        references: dict[int, ReferencePose] = {}
        for chaser, tick in ticks:
            if estimation.known and tick.own is not None:
                references[chaser.number] = self._step(chaser, tick, tick.own)
        for chaser, tick in ticks:
            chaser.follow_safety(tick)
        for activity in self.activities:
            activity.conclude(observation)

        horizon = self._horizon(known, estimation)
        directives = tuple(c.directive(tick, references.get(c.number)) for c, tick in ticks)
        return GuidanceResult(directives, horizon, replies, fleet.drain_events())

    def _known(
        self, observation: Observation, estimation: TargetEstimation, history: PlanningHistory
    ) -> tuple[ChaserTick, ...]:
        """Return what is known of each chaser in this tick, by number."""
        stack, time_ns = estimation.stack, observation.time_ns
        return tuple(
            ChaserTick(
                now_s=observation.time_s,
                own=None if estimate.own is None else estimate.own.state,
                target=estimation.target,
                offset_m=_offset_m(estimate, estimation),
                port=self._port(chaser, seen.docking, estimate, estimation),
                relative=self._relative(estimate, estimation.target),
                failure=history.failure(chaser.number, time_ns),
                camera=estimate.camera,
                acquiring=next(
                    (s.acquiring for s in observation.sightings if s.chaser == chaser.number), None
                ),
                stuck_thrusters=() if stack is None else stack.failed_of(chaser.number),
                invalid=bool(seen.invalid),
                latched=estimate.latched and estimate.own is not None,
                doubtful=estimate.doubtful,
                unsafe=history.unsafe(chaser.number, time_ns),
            )
            for chaser, seen, estimate in zip(
                self.chasers, observation.chasers, estimation.chasers, strict=True
            )
        )

    def _port(
        self,
        chaser: ChaserMachine,
        status: DockingStatus | None,
        estimate: ChaserEstimate,
        estimation: TargetEstimation,
    ) -> DockingObservation | None:
        """Return the state of a chaser at its port; None without a port, or if its pose relative to
        the target is unknown.
        """
        dock, target = chaser.dock, estimation.target
        if dock is None or estimate.own is None or not estimation.known:
            return None
        own = estimate.own.state
        moving = BodyState(
            target.position_m, target.velocity_m_s, target.q_wxyz, target.omega_rad_s
        )
        q_off = np.asarray(self._scenario.chasers[chaser.number].q_wxyz)
        view = view_of(dock.port, dock.reach_m, q_off, body_state(own), moving)
        contact = status is not None and status.contact
        pose = pose_in_target(target, own)
        changes = None if estimate.relative is None else estimate.relative.random_covariance
        return DockingObservation(
            view,
            contact,
            estimate.latched,
            *pose,
            sensed=status is not None,
            covariance=np.zeros((6, 6)) if changes is None else changes,
        )

    def _relative(self, estimate: ChaserEstimate, target: TargetState) -> RelativeState | None:
        """Return a chaser's state relative to the target; None unless passive safety is
        enforced.
        """
        disturbed, enforced = estimate.disturbed, self._scenario.limits.passive_safety
        if disturbed is None or estimate.own is None or enforced != "enforce":
            return None
        own = estimate.own.state
        state = np.concatenate(
            [own.position_m - target.position_m, own.velocity_m_s - target.velocity_m_s]
        )
        return RelativeState(state, disturbed, target)

    def _reply(
        self, commands: Sequence[OperatorCommand], observation: Observation
    ) -> tuple[CommandReply, ...]:
        """Execute or refuse the commands. Returns the replies."""
        results = self.fleet.apply(commands, observation.time_s)
        return tuple(
            CommandReply(
                tick=observation.tick,
                sim_time_ns=observation.time_ns,
                command=command.command,
                chaser=command.chaser,
                accepted=result.accepted,
                reason=result.reason,
                operator=command.operator,
            )
            for command, result in zip(commands, results, strict=True)
        )

    def _step(self, chaser: ChaserMachine, known: ChaserTick, own: Odometry) -> ReferencePose:
        """Advance a chaser's phase by its tracking errors and its docking sensor. Returns its
        reference at the start of the tick.
        """
        if chaser.phase is Phase.SURVEY:
            lead_from_here(chaser, known, self.fleet.moves, self.references)
        pose = self.references.pose(chaser, known.target, known.now_s)
        error_m = length(pose[0] - own.position_m)
        error_rad = float(rotations.angle_between(pose[1], own.q_wxyz))
        chaser.step(known, TrackingErrors(error_m, error_rad))
        return ReferencePose(*pose, chaser.min_distance_target_m())

    def _horizon(
        self, known: Sequence[ChaserTick], estimation: TargetEstimation
    ) -> HorizonReference | None:
        """Return the references of the chasers that are planned for; None if there are none."""
        present = [(c, tick) for c, tick in zip(self.chasers, known, strict=True) if tick.own]
        planned = [c for c, _ in present if c.phase not in _UNLED]
        attached = frozenset(c.number for c, tick in present if c.is_attached(tick))
        # Latched chasers are planned for only while others have to fly around them.
        if estimation.at_effect is None or not planned or len(attached) == len(present):
            return None
        relative = [estimation.chasers[c.number].relative for c in planned]
        return self.references.horizon(
            planned, estimation.at_effect, estimation.body, attached, relative
        )


def _offset_m(estimate: ChaserEstimate, estimation: TargetEstimation) -> Array | None:
    """Return a chaser's estimated centre (3,), TRF; None if unknown."""
    if estimate.own is None or not estimation.known:
        return None
    return centre_in_target(estimation.target, estimate.own.state)
