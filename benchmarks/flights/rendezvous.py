# SPDX-License-Identifier: Apache-2.0
"""A whole rendezvous in one process, from far range to the verified latch: hold points, hand-over
to the markers, contact.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import RelativeEstimate
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.rendering.cameras import States

from chaserdock.analysis.pose_errors import pose_error, relative_pose
from chaserdock.experiments.in_process import InProcessMission, TickRecord
from chaserdock.experiments.perception import PerceptionModel

HOLD_S = 20.0
"""Time before the next command over which tracking at a hold point is measured."""
_AFTER_CAPTURE_S, _AFTER_COMMAND_S = 1.0, 1.0
"""A flight ends so long after the verified latch, a leg after the next command."""


@dataclass(frozen=True)
class HoldPoint:
    """How well a chaser waited at a hold point, over the last `HOLD_S` before ``until_s``.

    ``range_m``: distance from the target. ``position_rms_m``, ``angle_max_deg``: from the reference
    pose on the true target. ``estimate_rms_m``: error of the estimated relative position.
    """

    until_s: float
    range_m: float
    position_rms_m: float
    angle_max_deg: float
    estimate_rms_m: float


@dataclass(frozen=True)
class HandOver:
    """How the estimate changed when the first markers were seen, at ``range_m``.

    ``step_m``, ``step_deg``: change of the estimate's error by the tick that uses them.
    ``step_sigmas``: its largest component over the estimate's standard deviation before.
    ``error_sigmas``: the same of the error before.
    """

    time_s: float
    range_m: float
    step_m: float
    step_deg: float
    step_sigmas: float
    error_sigmas: float


@dataclass
class RendezvousOutcome:
    """One rendezvous of chaser 0.

    ``verified_s``: when the latch was verified, or None. ``delta_v_m_s``: impulse, summed over
    axes, over mass. ``keep_out_margin_m``: least distance from the target outside the port's
    corridor, less ``limits.min_distance_target_m``.
    """

    verified_s: float | None = None
    phase: str = ""
    delta_v_m_s: float = 0.0
    propellant_kg: float = 0.0
    keep_out_margin_m: float = math.inf
    max_closing_m_s: float = 0.0
    holds: list[HoldPoint] = field(default_factory=list)
    hand_over: HandOver | None = None
    contact_lateral_m: float = math.nan
    contact_angle_deg: float = math.nan
    contact_closing_m_s: float = math.nan
    events: list[tuple[float, str, str]] = field(default_factory=list)
    contacts: set[tuple[str, str]] = field(default_factory=set)


def estimate_error(estimate: RelativeEstimate, states: States) -> Array:
    """Return the error (6,) of an estimated relative pose: position in TRF axes (m), rotation
    vector in CRF axes (rad).
    """
    own, target = states[f"chaser/{estimate.chaser}"], states[TARGET]
    truth = relative_pose(own.position_m, own.q_wxyz, target.position_m, target.q_wxyz)
    return pose_error(*truth, np.array(estimate.position_m), np.array(estimate.q_wxyz))


class _Recorder:
    """Collects the outcome of chaser 0's flight, tick by tick."""

    def __init__(self, scenario: Scenario) -> None:
        self.outcome = RendezvousOutcome()
        self._scenario = scenario
        self._ends_s = [entry.at_s for entry in scenario.timeline]
        self._window: list[tuple[float, float, float, float]] = []
        self._before: tuple[Array, Array] | None = None
        self._range_m: float | None = None

    def note(self, record: TickRecord, phase: str, in_corridor: bool) -> None:
        """Take the record of a tick."""
        out, states = self.outcome, record.states
        range_m = float(np.linalg.norm(states["chaser/0"].position_m - states[TARGET].position_m))
        out.phase = phase
        out.delta_v_m_s += record.delivered[0].absolute_impulse_N_s / self._scenario.chaser.mass_kg
        if not in_corridor:
            margin_m = range_m - self._scenario.limits.min_distance_target_m
            out.keep_out_margin_m = min(out.keep_out_margin_m, margin_m)
        if self._range_m is not None:
            closing_m_s = (self._range_m - range_m) * self._scenario.time.rate_hz
            out.max_closing_m_s = max(out.max_closing_m_s, closing_m_s)
        self._range_m = range_m
        estimate = self._relative(record)
        error = None if estimate is None else estimate_error(estimate, states)
        self._note_hand_over(record, range_m, estimate, error)
        self._note_hold(record, range_m, error)

    @staticmethod
    def _relative(record: TickRecord) -> RelativeEstimate | None:
        relative = () if record.outputs is None else record.outputs.target.relative
        return next((r for r in relative if r.chaser == 0), None)

    def _note_hand_over(
        self,
        record: TickRecord,
        range_m: float,
        estimate: RelativeEstimate | None,
        error: Array | None,
    ) -> None:
        seen = any(s.marker_ids for s in record.sightings)
        if (
            self.outcome.hand_over is None
            and seen
            and self._before is not None
            and error is not None
        ):
            before, sigmas = self._before
            step = error - before
            self.outcome.hand_over = HandOver(
                record.time_s,
                range_m,
                float(np.linalg.norm(step[:3])),
                math.degrees(float(np.linalg.norm(step[3:]))),
                float(np.max(np.abs(step) / sigmas)),
                float(np.max(np.abs(before) / sigmas)),
            )
        if estimate is not None and error is not None:
            covariance = np.array(estimate.covariance).reshape(6, 6)
            self._before = error, np.sqrt(np.diag(covariance))

    def _note_hold(self, record: TickRecord, range_m: float, error: Array | None) -> None:
        if not self._ends_s:
            return
        end_s = self._ends_s[0]
        if end_s - HOLD_S <= record.time_s < end_s:
            estimate_m = math.nan if error is None else float(np.linalg.norm(error[:3]))
            self._window.append((range_m, *record.tracking_errors[0], estimate_m))
        elif record.time_s >= end_s:
            self._ends_s.pop(0)
            if self._window:
                rows = np.array(self._window)
                rms = np.sqrt(np.mean(rows**2, axis=0))
                angle_deg = math.degrees(float(rows[:, 2].max()))
                self.outcome.holds.append(
                    HoldPoint(end_s, float(rows[-1, 0]), float(rms[1]), angle_deg, float(rms[3]))
                )
            self._window = []


def rendezvous(
    scenario: Scenario,
    perception: PerceptionModel,
    report: Callable[[TickRecord, InProcessMission], None] = lambda record, flight: None,
) -> RendezvousOutcome:
    """Fly chaser 0 of a scenario until its latch is verified, or to the end; ``report`` is called
    after each tick.
    """
    recorder = _Recorder(scenario)
    out = recorder.outcome
    with InProcessMission(scenario, perception) as flight:
        while flight.tick < scenario.ticks:
            record = flight.step()
            chaser = flight.controller.guidance.chasers[0]
            recorder.note(record, chaser.phase, chaser.in_corridor())
            report(record, flight)
            if out.phase == "verified" and out.verified_s is None:
                out.verified_s = record.time_s
            if out.verified_s is not None and record.time_s >= out.verified_s + _AFTER_CAPTURE_S:
                break
        closed = next((t for t in flight.touches if t.latched), None)
        out.events, out.contacts, out.propellant_kg = (
            flight.events,
            flight.contacts,
            flight.propellant_kg,
        )
    if closed is not None:
        out.contact_lateral_m, out.contact_closing_m_s = closed.lateral_m, closed.closing_m_s
        out.contact_angle_deg = math.degrees(closed.angle_rad)
    return out


def leg(scenario: Scenario, index: int, wait_s: float = 30.0) -> Scenario:
    """Return the part of a scenario that begins with command ``index`` of its timeline and ends
    before the next command but one.

    It starts at rest at the place before, and waits there for ``wait_s``: longer than `HOLD_S`, as
    the estimate is off at first.
    """
    timeline = sorted(scenario.timeline, key=lambda entry: entry.at_s)
    begin_s, following = timeline[index].at_s - wait_s, timeline[index : index + 2]
    start_m = scenario.chasers[0].position_m if index == 0 else timeline[index - 1].offset_m
    assert start_m is not None
    end_s = following[1].at_s + _AFTER_COMMAND_S if len(following) > 1 else scenario.duration_s
    return scenario.model_copy(
        update={
            "chasers": (
                scenario.chasers[0].model_copy(update={"position_m": start_m}),
                *scenario.chasers[1:],
            ),
            "timeline": tuple(e.model_copy(update={"at_s": e.at_s - begin_s}) for e in following),
            "duration_s": end_s - begin_s,
        }
    )


def last_leg(scenario: Scenario) -> Scenario:
    """Return the scenario from its last hold point on."""
    return leg(scenario, len(scenario.timeline) - 1)
