# SPDX-License-Identifier: Apache-2.0
"""Ingest of one chaser: its state between ticks, and checks of its messages. No I/O."""

from __future__ import annotations

import msgspec
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Odometry, ThrusterReport
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.interfaces import (
    AppliedImpulse,
    ChaserInputs,
    ChaserObservation,
    LogEntry,
)

from .latency_compensation import CommandHistory
from .lost_chasers import LossWatch
from .odometry_validation import why_invalid


class ChaserIngest:
    """Checks the messages of one chaser. Keeps its newest thruster ``report`` and for how long it
    has been silent.
    """

    def __init__(self, scenario: FlightScenario, chaser: int) -> None:
        self.chaser = chaser
        self.loss = LossWatch(chaser)
        self.report: ThrusterReport | None = None
        self._timing, self._nominal = scenario.timing, scenario.chaser.wrench_max
        self._period_ns = round(1e9 / scenario.time.rate_hz)

    def observe(
        self, inputs: ChaserInputs, tick: int, time_ns: int, sent: CommandHistory
    ) -> tuple[ChaserObservation, LogEntry | None]:
        """Check the messages of a tick. Returns what is known of the chaser, and an event when it
        is lost or found again.

        ``sent``: commands to this chaser so far.
        """
        self.report = inputs.thrusters or self.report
        # A state extrapolated from an invalid one is invalid, too.
        source = None if inputs.odometry is None else inputs.outdated or inputs.odometry
        invalid = "" if source is None else why_invalid(source)
        odometry = None if invalid else inputs.odometry
        effective_ns = self._timing.effective_ns(tick)
        interrupted = self.loss.is_absent(time_ns)
        event = self.loss.update(odometry, time_ns)
        observation = ChaserObservation(
            chaser=self.chaser,
            input_limits=self._limits(),
            odometry=odometry,
            invalid=invalid,
            outdated=self._outdated(inputs.outdated),
            lost=self.loss.obstacle(time_ns),
            interrupted=interrupted,
            docking=inputs.docking,
            impulse=None if odometry is None else self._impulse(tick, time_ns, sent),
            last_command=sent.segments(time_ns, time_ns + 1)[-1][2] if odometry is None else None,
            ahead=() if odometry is None else self._ahead(tick, time_ns, effective_ns, sent),
            thruster_impulses=self._thruster_impulses(tick),
            isolated=() if self.report is None else self.report.isolated,
        )
        return observation, event

    def _outdated(self, odometry: Odometry | None) -> Odometry | None:
        """Return valid odometry stamped with its tick's time, since a chaser's clock may be
        wrong.
        """
        if odometry is None or why_invalid(odometry):
            return None
        time_ns = self._timing.tick_time_ns(odometry.tick)
        return msgspec.structs.replace(odometry, sim_time_ns=time_ns)

    def _limits(self) -> Array:
        """Return the largest force and torque (6,) per body axis that the chaser can produce
        now.
        """
        report = self.report
        if report is None:
            return self._nominal.copy()
        return np.minimum(self._nominal, np.abs([*report.force_max_N, *report.torque_max_N_m]))

    def _impulse(self, tick: int, time_ns: int, sent: CommandHistory) -> AppliedImpulse:
        """Return the impulse since the previous tick, as thrusters report it or else as
        commanded.
        """
        r = self.report
        if r is not None and r.tick == tick:
            return AppliedImpulse(
                np.array([*r.given_impulse_N_s, *r.given_angular_impulse_N_m_s]),
                np.array([*r.given_moment_N_s2, *r.given_angular_moment_N_m_s2]),
                np.array([*r.given_magnitude_N_s, *r.given_angular_magnitude_N_m_s]),
                measured=True,
            )
        segments = sent.segments(time_ns - self._period_ns, time_ns)
        middle_ns = time_ns - self._period_ns // 2
        impulse, moment, magnitude = np.zeros((3, 6))
        for begin_ns, end_ns, wrench in segments:
            given = wrench * ((end_ns - begin_ns) / 1e9)
            impulse += given
            moment += given * ((middle_ns - (begin_ns + end_ns) // 2) / 1e9)
            magnitude += np.abs(given)
        return AppliedImpulse(impulse, moment, magnitude)

    def _ahead(
        self, tick: int, time_ns: int, effective_ns: int, sent: CommandHistory
    ) -> tuple[tuple[float, Array], ...]:
        """Return what acts on the chaser until the tick's command does, as durations (s) and
        wrenches (6,). The impulse of pulses yet to fire is spread evenly.
        """
        r = self.report
        if r is None or r.tick != tick:
            return sent.ahead(time_ns, effective_ns)
        coming = np.array([*r.coming_impulse_N_s, *r.coming_angular_impulse_N_m_s])
        duration_s = (effective_ns - time_ns) / 1e9
        return ((duration_s, coming / duration_s),) if duration_s > 0.0 else ()

    def _thruster_impulses(self, tick: int) -> Array | None:
        """Return the impulses (n,) that the thrusters report for the time since the previous
        tick.
        """
        r = self.report
        if r is None or r.tick != tick or not r.given_thrusters_N_s:
            return None
        return np.array(r.given_thrusters_N_s)
