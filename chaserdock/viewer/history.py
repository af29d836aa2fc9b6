"""The mission up to now: measurements over simulated time, and what happened. Bounded in memory. No I/O."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections import OrderedDict, defaultdict, deque
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.messages import (
    BodyTruth,
    CommandReply,
    Event,
    Health,
    Level,
    MissionEnd,
    Odometry,
    Reference,
    SolverStatus,
    TargetEstimate,
)
from chaserdock_protocol.topics import Topic

from .snapshot import TARGET

MOST_POINTS = 40_000
_MOST_LINES = 500
_KEPT = 64

Quantity = Literal[
    "position_error_mm",
    "orientation_error_deg",
    "distance_m",
    "latency_ms",
    "solve_ms",
    "estimate_error_mm",
    "estimate_error_deg",
]


class Series:
    """Values over time, in the order of time; once there are too many, every second one goes."""

    def __init__(self, most: int = MOST_POINTS) -> None:
        self._most = most
        self._times, self._values = array("d"), array("d")

    def __len__(self) -> int:
        return len(self._times)

    def add(self, time_s: float, value: float) -> None:
        """One more; a time that is not later than the last one is left out (a message that came twice or late)."""
        if self._times and time_s <= self._times[-1]:
            return
        self._times.append(time_s)
        self._values.append(value)
        if len(self._times) > self._most:
            self._times, self._values = self._times[::2], self._values[::2]

    def until(self, time_s: float) -> tuple[Array, Array]:
        """Times and values up to ``time_s``, each (K,)."""
        end = bisect_right(self._times, time_s)
        return np.array(self._times[:end]), np.array(self._values[:end])

    def last(self, time_s: float, within_s: float) -> float | None:
        """The latest value up to ``time_s``, if it is no older than that."""
        end = bisect_right(self._times, time_s)
        if end == 0 or self._times[end - 1] < time_s - within_s:
            return None
        return self._values[end - 1]


@dataclass(frozen=True)
class Line:
    """Something that happened, at a simulated time."""

    time_s: float
    level: Level
    text: str


@dataclass
class Trail:
    """Where a chaser has been as seen from the target: TRF, a point each quarter of a second."""

    times: array[float] = field(default_factory=lambda: array("d"))
    points: array[float] = field(default_factory=lambda: array("d"))

    def add(self, time_s: float, offset_m: Array) -> None:
        if self.times and time_s < self.times[-1] + 0.25:
            return
        self.times.append(time_s)
        self.points.extend(offset_m.tolist())
        if len(self.times) > _MOST_LINES * 8:
            del self.times[: _MOST_LINES * 4]
            del self.points[: _MOST_LINES * 12]

    def between(self, begin_s: float, end_s: float) -> Array:
        """Points (K, 3) of that time."""
        first, last = bisect_right(self.times, begin_s), bisect_right(self.times, end_s)
        return np.array(self.points[3 * first : 3 * last]).reshape(-1, 3)


class History:
    """Series by quantity and chaser (None: of the mission), trails by chaser, and lines of what happened."""

    def __init__(self, chasers: int) -> None:
        self.series: dict[tuple[Quantity, int | None], Series] = defaultdict(Series)
        self.trails = [Trail() for _ in range(chasers)]
        self.lines: deque[Line] = deque(maxlen=_MOST_LINES)
        self.refused: dict[str, int] = {}
        self._odometry: dict[int, OrderedDict[int, Odometry]] = defaultdict(OrderedDict)
        self._exposed: dict[int, OrderedDict[int, int]] = defaultdict(OrderedDict)
        self._truth: OrderedDict[int, BodyTruth] = OrderedDict()
        self._target: TargetEstimate | None = None

    def exposed(self, chaser: int, tick: int, sent_ns: int) -> None:
        """An image was sent at a wall clock's ``sent_ns``."""
        _keep(self._exposed[chaser], tick, sent_ns)

    def take(self, topic: Topic, message: Any, sent_ns: int) -> None:
        """Notes a message and when (the sender's wall clock) it was sent."""
        time_s = message.sim_time_ns / 1e9
        match message:
            case Odometry():
                _keep(self._odometry[message.chaser], message.tick, message)
                self._see(message)
            case Reference():
                self._err(message)
            case TargetEstimate() if message.status != "none":
                self._target = message
                self._compare(message)
            case BodyTruth() if message.body == TARGET:
                _keep(self._truth, message.sim_time_ns, message)
            case SolverStatus():
                self.series["solve_ms", None].add(time_s, message.wall_solve_s * 1e3)
            case Event():
                self.tell(
                    time_s, message.level, f"{message.process}: {message.what} {message.detail}".strip()
                )
            case CommandReply():
                self.tell(time_s, "info" if message.accepted else "warning", answer_text(message))
            case MissionEnd():
                self.tell(
                    time_s,
                    "info" if message.complete else "error",
                    f"the mission has ended: {message.reason}",
                )
            case Health():
                self.refused[message.process] = sum(message.rejected.values()) + message.lost
            case _ if topic is topics.IMAGE:
                self.exposed(message.chaser, message.tick, sent_ns)
            case _ if topic is topics.ACTUATORS:
                begun = self._exposed[message.chaser].pop(message.tick, None)
                if begun is not None:
                    self.series["latency_ms", message.chaser].add(time_s, (sent_ns - begun) / 1e6)

    def tell(self, time_s: float, level: Level, text: str) -> None:
        """One line of what happened; the same as the last one is told once."""
        line = Line(time_s, level, text)
        if not self.lines or self.lines[-1] != line:
            self.lines.append(line)

    def lines_until(self, time_s: float, most: int) -> list[Line]:
        """The latest lines up to ``time_s``, the newest first."""
        return sorted((x for x in reversed(self.lines) if x.time_s <= time_s), key=lambda x: -x.time_s)[:most]

    def _see(self, odometry: Odometry) -> None:
        target = self._target
        if target is None or odometry.chaser >= len(self.trails):
            return
        # The estimate is a tick or so older than the odometry: it is carried on to the same time.
        later_s = (odometry.sim_time_ns - target.sim_time_ns) / 1e9
        position = np.add(target.position_m, np.multiply(target.velocity_m_s, later_s))
        attitude = rotations.integrate(target.q_wxyz, target.omega_rad_s, later_s)
        offset = rotations.rotate_inverse(attitude, np.subtract(odometry.position_m, position))
        time_s = odometry.sim_time_ns / 1e9
        self.series["distance_m", odometry.chaser].add(time_s, float(np.linalg.norm(offset)))
        self.trails[odometry.chaser].add(time_s, offset)

    def _err(self, reference: Reference) -> None:
        here = self._odometry[reference.chaser].get(reference.tick)
        if here is None:
            return
        time_s = reference.sim_time_ns / 1e9
        away_m = float(np.linalg.norm(np.subtract(here.position_m, reference.position_m)))
        turned = float(rotations.angle_between(reference.q_wxyz, here.q_wxyz))
        self.series["position_error_mm", reference.chaser].add(time_s, away_m * 1e3)
        self.series["orientation_error_deg", reference.chaser].add(time_s, float(np.degrees(turned)))

    def _compare(self, estimate: TargetEstimate) -> None:
        true = self._truth.get(estimate.sim_time_ns)
        if true is None:
            return
        time_s = estimate.sim_time_ns / 1e9
        away_m = float(np.linalg.norm(np.subtract(true.position_m, estimate.position_m)))
        turned = float(rotations.angle_between(true.q_wxyz, estimate.q_wxyz))
        self.series["estimate_error_mm", None].add(time_s, away_m * 1e3)
        self.series["estimate_error_deg", None].add(time_s, float(np.degrees(turned)))


def answer_text(reply: CommandReply) -> str:
    """The controller's answer as a person reads it."""
    who = f" (by {reply.operator})" if reply.operator else ""
    said = "accepted" if reply.accepted else "refused"
    return f"{reply.command} chaser {reply.chaser}{who}: {said}, {reply.reason}"


def _keep(store: OrderedDict[int, Any], key: int, value: Any) -> None:
    store[key] = value
    while len(store) > _KEPT:
        store.popitem(last=False)
