"""A mission as an operator hears it: what is worth telling at once, and how it stands. No I/O; wall time is given."""

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
    Odometry,
    Presence,
    Reference,
    SolverStatus,
    TargetEstimate,
    Tick,
)
from chaserdock_protocol.scenario import Scenario

from .json_events import ChaserLine, Commanded, Progress, Told

_NOW_S = 5.0
"""Wall time over which the present speed is taken."""
_KEPT_TICKS = 50
_SOLVED = ("solved", "iteration_limit")


@dataclass
class FlightState:
    """Takes messages in the order they come and says how the mission stands."""

    scenario: Scenario
    flying: bool = False
    tick: int = -1
    time_ns: int = 0
    target: TargetEstimate | None = None
    references: dict[int, Reference] = field(default_factory=dict)
    present: set[str] = field(default_factory=set)
    _odometry: dict[tuple[int, int], Odometry] = field(default_factory=dict)
    _begun_s: float = 0.0
    _heard: deque[tuple[float, int]] = field(default_factory=deque)
    _refused: dict[str, int] = field(default_factory=dict)
    _lost: dict[str, int] = field(default_factory=dict)
    _unsolved: set[int] = field(default_factory=set)

    def take(self, message: object, now_s: float) -> list[Told | Commanded]:
        """Notes a message that came at ``now_s`` (wall time); what it says that people should know."""
        match message:
            case Tick():
                if not self.flying:
                    self.flying, self._begun_s = True, now_s
                self.tick, self.time_ns = message.tick, message.sim_time_ns
                self._heard.append((now_s, message.sim_time_ns))
                while now_s - self._heard[0][0] > _NOW_S and len(self._heard) > 2:
                    self._heard.popleft()
            case Odometry():
                self._odometry[message.chaser, message.tick] = message
                self._odometry.pop((message.chaser, message.tick - _KEPT_TICKS), None)
            case Reference():
                self.references[message.chaser] = message
            case TargetEstimate():
                self.target = message
            case Presence():
                self.present.add(message.process)
            case Event():
                return [
                    Told(
                        sim_time_s=message.sim_time_ns / 1e9,
                        process=message.process,
                        level=message.level,
                        what=message.what,
                        detail=message.detail,
                    )
                ]
            case CommandReply():
                return [
                    Commanded(
                        sim_time_s=message.sim_time_ns / 1e9,
                        command=message.command,
                        chaser=message.chaser,
                        accepted=message.accepted,
                        reason=message.reason,
                        operator=message.operator,
                    )
                ]
            case Health():
                return self._health(message)
            case SolverStatus():
                return self._solver(message)
        return []

    def waiting_for(self) -> list[str]:
        """Processes of the scenario whose presence has not been heard."""
        names = [
            "world",
            "controller",
            *(["standby"] if self.scenario.controller.standby else []),
            *(f"chaser/{i}" for i in range(len(self.scenario.chasers))),
            "recorder",
        ]
        return [name for name in names if name not in self.present]

    def errors(self, chaser: int) -> tuple[float, float] | None:
        """Position (m) and orientation (rad) error of a chaser from its reference, as the controller sees it."""
        there = self.references.get(chaser)
        here = self._odometry.get((chaser, there.tick)) if there is not None else None
        if here is None or there is None:
            return None
        position = float(np.linalg.norm(np.subtract(here.position_m, there.position_m)))
        return position, float(rotations.angle_between(there.q_wxyz, here.q_wxyz))

    def progress(self, now_s: float) -> Progress:
        """How the mission stands at ``now_s`` (wall time)."""
        wall_s = max(1e-9, now_s - self._begun_s) if self.flying else 0.0
        speed = self.time_ns / 1e9 / wall_s if self.flying else 0.0
        return Progress(
            sim_time_s=self.time_ns / 1e9,
            tick=self.tick,
            wall_time_s=wall_s,
            speed=speed,
            speed_now=self._speed_now(now_s, speed),
            target=self.target.status if self.target is not None else "none",
            chasers=tuple(self._chaser(i) for i in sorted(self.references) if self.errors(i) is not None),
        )

    def left_s(self, progress: Progress) -> float | None:
        """Wall time to the end at the present speed; None when nobody can say."""
        left_s = self.scenario.duration_s - progress.sim_time_s
        return left_s / progress.speed_now if self.flying and progress.speed_now > 1e-6 else None

    def _speed_now(self, now_s: float, speed: float) -> float:
        if not self._heard or now_s - self._heard[0][0] < 1.0:
            return speed
        first_s, first_ns = self._heard[0]
        return (self.time_ns - first_ns) / 1e9 / (now_s - first_s)

    def _chaser(self, number: int) -> ChaserLine:
        reference, errors = self.references[number], self.errors(number)
        assert errors is not None
        return ChaserLine(
            chaser=number,
            phase=reference.phase,
            phase_time_s=reference.phase_time_s,
            position_error_m=errors[0],
            orientation_error_rad=errors[1],
            reference_distance_m=math.hypot(*reference.offset_m),
        )

    def _warning(self, process: str, what: str, detail: str) -> Told:
        return Told(sim_time_s=self.time_ns / 1e9, process=process, level="warning", what=what, detail=detail)

    def _health(self, health: Health) -> list[Told | Commanded]:
        """Messages that a process has refused or missed, told when there are more than were told before."""
        told: list[Told | Commanded] = []
        refused = sum(health.rejected.values())
        if refused > self._refused.get(health.process, 0):
            reasons = ", ".join(f"{reason}: {count}" for reason, count in sorted(health.rejected.items()))
            told.append(self._warning(health.process, f"{refused} messages refused", reasons))
        if health.lost > self._lost.get(health.process, 0):
            told.append(self._warning(health.process, f"{health.lost} messages missing", "gaps in seq"))
        # A process that was started again counts from zero.
        self._refused[health.process], self._lost[health.process] = refused, health.lost
        return told

    def _solver(self, status: SolverStatus) -> list[Told | Commanded]:
        """Chasers whose plan is none, or enters a keep-out zone: told when it begins."""
        bad = {c: s for c, s in zip(status.chasers, status.status, strict=False) if s not in _SOLVED}
        told: list[Told | Commanded] = [
            self._warning("controller", f"chaser {c}: plan {s}", status.solver)
            for c, s in sorted(bad.items())
            if c not in self._unsolved
        ]
        self._unsolved = set(bad)
        return told
