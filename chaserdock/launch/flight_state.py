# SPDX-License-Identifier: Apache-2.0
"""State of a running mission, derived from its messages: notices for the operator, and progress. No
I/O; wall time is an argument.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.messages import (
    CommandReply,
    Event,
    Health,
    MissionEnd,
    Odometry,
    Presence,
    Reference,
    SolverStatus,
    TargetEstimate,
    Tick,
)
from chaserdock_protocol.scenario import Scenario

from .json_events import ChaserProgress, CommandNotice, EventNotice, Progress

_SPEED_WINDOW_S = 5.0
"""Wall time, s, over which the present speed is averaged."""
_KEPT_TICKS = 50
"""Ticks for which odometry waits for an estimate of the same tick: 5 s at 10 Hz. Larger: more
memory; smaller: no errors are shown if estimates are late.
"""
_SOLVED = ("solved", "iteration_limit")


@dataclass
class FlightState:
    """Tracks a mission by its messages, in order of arrival."""

    scenario: Scenario
    flying: bool = False
    tick: int = -1
    time_ns: int = 0
    target: TargetEstimate | None = None
    references: dict[int, Reference] = field(default_factory=dict[int, Reference])
    present: set[str] = field(default_factory=set[str])
    _odometry: dict[tuple[int, int], Odometry] = field(
        default_factory=dict[tuple[int, int], Odometry]
    )
    _first_tick_s: float = 0.0
    _tick_times: deque[tuple[float, int]] = field(default_factory=deque[tuple[float, int]])
    _rejected: dict[str, int] = field(default_factory=dict[str, int])
    _missing: dict[str, int] = field(default_factory=dict[str, int])
    _unsolved: set[int] = field(default_factory=set[int])

    def update(self, message: object, now_s: float) -> list[EventNotice | CommandNotice]:
        """Apply a message received at ``now_s`` (wall time); return notices for the operator."""
        match message:
            case Tick():
                if not self.flying:
                    self.flying, self._first_tick_s = True, now_s
                self.tick, self.time_ns = message.tick, message.sim_time_ns
                self._tick_times.append((now_s, message.sim_time_ns))
                while (
                    now_s - self._tick_times[0][0] > _SPEED_WINDOW_S and len(self._tick_times) > 2
                ):
                    self._tick_times.popleft()
            case MissionEnd():
                # The last tick begins one period before the end.
                self.time_ns = max(self.time_ns, message.sim_time_ns)
            case Odometry():
                self._odometry[message.chaser, message.tick] = message
                self._odometry.pop((message.chaser, message.tick - _KEPT_TICKS), None)
            case Reference():
                self.references[message.chaser] = message
            case TargetEstimate():
                self.target = message
            case Presence():
                self.present.add(message.process)
            case Event() | CommandReply():
                return [_notice_of(message)]
            case Health():
                return self._health(message)
            case SolverStatus():
                return self._solver(message)
            case _:
                pass
        return []

    def waiting_for(self) -> list[str]:
        """Return the scenario's processes whose presence has not been received."""
        names = [
            "world",
            "controller",
            *(["standby"] if self.scenario.controller.standby else []),
            *(f"chaser/{i}" for i in range(len(self.scenario.chasers))),
            *(["mapper"] if self.scenario.maps_target else []),
            "recorder",
        ]
        return [name for name in names if name not in self.present]

    def errors(self, chaser: int) -> tuple[float, float] | None:
        """Return position (m) and orientation (rad) error of a chaser relative to its reference, by
        its odometry; None if unknown.
        """
        reference = self.references.get(chaser)
        odometry = self._odometry.get((chaser, reference.tick)) if reference is not None else None
        if odometry is None or reference is None:
            return None
        position = float(np.linalg.norm(np.subtract(odometry.position_m, reference.position_m)))
        return position, float(rotations.angle_between(reference.q_wxyz, odometry.q_wxyz))

    def progress(self, now_s: float) -> Progress:
        """Return the progress at ``now_s`` (wall time)."""
        wall_s = max(1e-9, now_s - self._first_tick_s) if self.flying else 0.0
        speed = self.time_ns / 1e9 / wall_s if self.flying else 0.0
        return Progress(
            sim_time_s=self.time_ns / 1e9,
            tick=self.tick,
            wall_time_s=wall_s,
            speed=speed,
            speed_now=self._speed_now(now_s, speed),
            target=self.target.status if self.target is not None else "none",
            chasers=tuple(
                self._chaser(i) for i in sorted(self.references) if self.errors(i) is not None
            ),
        )

    def remaining_s(self, progress: Progress) -> float | None:
        """Return the wall time to the end at the present speed; None if unknown."""
        simulated_s = self.scenario.duration_s - progress.sim_time_s
        return (
            simulated_s / progress.speed_now if self.flying and progress.speed_now > 1e-6 else None
        )

    def _speed_now(self, now_s: float, speed: float) -> float:
        if not self._tick_times or now_s - self._tick_times[0][0] < 1.0:
            return speed
        first_s, first_ns = self._tick_times[0]
        return (self.time_ns - first_ns) / 1e9 / (now_s - first_s)

    def _chaser(self, number: int) -> ChaserProgress:
        reference, errors = self.references[number], self.errors(number)
        assert errors is not None
        return ChaserProgress(
            chaser=number,
            phase=reference.phase,
            phase_time_s=reference.phase_time_s,
            position_error_m=errors[0],
            orientation_error_rad=errors[1],
            reference_distance_m=math.hypot(*reference.offset_m),
        )

    def _warning(self, process: str, what: str, detail: str) -> EventNotice:
        return EventNotice(
            sim_time_s=self.time_ns / 1e9,
            process=process,
            level="warning",
            what=what,
            detail=detail,
        )

    def _health(self, health: Health) -> list[EventNotice | CommandNotice]:
        """Report rejected or missed messages of a process when their count grows."""
        notices: list[EventNotice | CommandNotice] = []
        rejected = sum(health.rejected.values())
        if rejected > self._rejected.get(health.process, 0):
            reasons = ", ".join(
                f"{reason}: {count}" for reason, count in sorted(health.rejected.items())
            )
            notices.append(self._warning(health.process, f"{rejected} messages rejected", reasons))
        if health.lost > self._missing.get(health.process, 0):
            notices.append(
                self._warning(health.process, f"{health.lost} messages missing", "gaps in seq")
            )
        # A restarted process counts from zero again.
        self._rejected[health.process], self._missing[health.process] = rejected, health.lost
        return notices

    def _solver(self, status: SolverStatus) -> list[EventNotice | CommandNotice]:
        """Report chasers when they begin to have no plan, or a plan that enters a keep-out zone."""
        failed = {
            c: s for c, s in zip(status.chasers, status.status, strict=False) if s not in _SOLVED
        }
        notices: list[EventNotice | CommandNotice] = [
            self._warning("controller", f"chaser {c}: plan {s}", status.solver)
            for c, s in sorted(failed.items())
            if c not in self._unsolved
        ]
        self._unsolved = set(failed)
        return notices


def _notice_of(message: Event | CommandReply) -> EventNotice | CommandNotice:
    if isinstance(message, Event):
        return EventNotice(
            sim_time_s=message.sim_time_ns / 1e9,
            process=message.process,
            level=message.level,
            what=message.what,
            detail=message.detail,
        )
    return CommandNotice(
        sim_time_s=message.sim_time_ns / 1e9,
        command=message.command,
        chaser=message.chaser,
        accepted=message.accepted,
        reason=message.reason,
        operator=message.operator,
    )
