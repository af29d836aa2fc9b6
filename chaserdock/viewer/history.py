# SPDX-License-Identifier: Apache-2.0
"""History of a mission, bounded in memory: series over simulated time, trails, event lines."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections import OrderedDict, defaultdict, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.messages import (
    ActuatorCommand,
    BodyReference,
    BodyTruth,
    CommandReply,
    Event,
    Health,
    Level,
    MissionEnd,
    Odometry,
    PortLoad,
    Reference,
    SolverStatus,
    StackEstimate,
    TargetEstimate,
)
from chaserdock_protocol.topics import Topic

from chaserdock.analysis.mass_properties import values_of
from chaserdock.analysis.motion import MotionCollector

from .snapshot import TARGET, keep_newest

MOST_POINTS = 40_000
"""Most points of a curve: an hour at 10 Hz; longer ones are thinned. Larger: more memory."""
_MOST_LINES = 500
"""Most lines of the event list. Larger: more memory. A trail has at most eight times as many
points.
"""

ChartQuantity = Literal[
    "position_error_mm",
    "orientation_error_deg",
    "distance_m",
    "latency_ms",
    "solve_ms",
    "estimate_error_mm",
    "estimate_error_deg",
    "port_load_N",
    "mass_sigma_percent",
    "centre_sigma_mm",
    "inertia_sigma_percent",
]


class Series:
    """Values in order of time. Beyond the largest length every second one is dropped."""

    def __init__(self, most: int = MOST_POINTS) -> None:
        self._most = most
        self._times, self._values = array("d"), array("d")

    def __len__(self) -> int:
        return len(self._times)

    def add(self, time_s: float, value: float) -> None:
        """Add a value; ignore one that is not later than the last (a repeated or late message)."""
        if self._times and time_s <= self._times[-1]:
            return
        self._times.append(time_s)
        self._values.append(value)
        if len(self._times) > self._most:
            self._times, self._values = self._times[::2], self._values[::2]

    def until(self, time_s: float) -> tuple[Array, Array]:
        """Return times and values up to ``time_s``, each (K,)."""
        end = bisect_right(self._times, time_s)
        return np.array(self._times[:end]), np.array(self._values[:end])

    def last(self, time_s: float, within_s: float) -> float | None:
        """Return the latest value up to ``time_s`` if it is at most ``within_s`` old."""
        end = bisect_right(self._times, time_s)
        if end == 0 or self._times[end - 1] < time_s - within_s:
            return None
        return self._values[end - 1]


@dataclass(frozen=True)
class Line:
    """An event at a simulated time."""

    time_s: float
    level: Level
    text: str


@dataclass
class Trail:
    """Path of a chaser relative to the target: TRF, four points per second."""

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
        """Return the points (K, 3) of an interval."""
        first, last = bisect_right(self.times, begin_s), bisect_right(self.times, end_s)
        return np.array(self.points[3 * first : 3 * last]).reshape(-1, 3)


class History:
    """Past of a mission as the page shows it: ``series`` by quantity and chaser (None: of the
    mission), ``trails`` by chaser, ``lines`` of events, known from ``begins_s`` on.
    """

    def __init__(self, chasers: int) -> None:
        self.series: dict[tuple[ChartQuantity, int | None], Series] = defaultdict(Series)
        self.trails = [Trail() for _ in range(chasers)]
        self.lines: deque[Line] = deque(maxlen=_MOST_LINES)
        self.begins_s = 0.0
        self.rejected: dict[str, int] = {}
        self._odometry: dict[int, OrderedDict[int, Odometry]] = defaultdict(OrderedDict)
        self._exposed: dict[int, OrderedDict[int, int]] = defaultdict(OrderedDict)
        self._truth: OrderedDict[int, BodyTruth | BodyReference] = OrderedDict()
        self._uncompared: deque[TargetEstimate] = deque(maxlen=_MOST_LINES)
        self._target: TargetEstimate | None = None

    def add_exposure(self, chaser: int, tick: int, sent_ns: int) -> None:
        """Record the wall-clock time at which an image was sent."""
        keep_newest(self._exposed[chaser], tick, sent_ns)

    def update(self, topic: Topic, message: Any, sent_ns: int) -> None:
        """Add a message. ``sent_ns``: the sender's wall-clock time."""
        if topic is topics.IMAGE:
            self.add_exposure(message.chaser, message.tick, sent_ns)
        elif topic is topics.ACTUATORS:
            self._add_latency(message, sent_ns)
        elif isinstance(message, Event | CommandReply | MissionEnd):
            self._add_event(message)
        else:
            self._add_measurement(message)

    def _add_measurement(self, message: Any) -> None:
        match message:
            case Odometry():
                keep_newest(self._odometry[message.chaser], message.tick, message)
                self._add_position(message)
            case Reference():
                self._add_tracking_error(message)
            case TargetEstimate() if message.status != "none":
                self._target = message
                self._uncompared.append(message)
                self._compare_estimates()
            case BodyTruth() | BodyReference() if message.body == TARGET:
                keep_newest(self._truth, message.sim_time_ns, message)
                self._compare_estimates()
            case PortLoad():
                self.series["port_load_N", message.chaser].add(
                    message.sim_time_ns / 1e9, message.peak_force_N
                )
            case StackEstimate():
                self._add_identification(message)
            case SolverStatus():
                self.series["solve_ms", None].add(
                    message.sim_time_ns / 1e9, message.wall_solve_s * 1e3
                )
            case Health():
                self.rejected[message.process] = sum(message.rejected.values()) + message.lost

    def _add_identification(self, message: StackEstimate) -> None:
        """Add standard deviations of the target: of its mass; of its centre of mass, worst axis; of
        its inertia, worst element as a share of the largest moment.
        """
        time_s, (values, sigmas) = message.sim_time_ns / 1e9, values_of(message.target)
        self.series["mass_sigma_percent", None].add(time_s, 100.0 * float(sigmas[0] / values[0]))
        self.series["centre_sigma_mm", None].add(time_s, 1e3 * float(sigmas[1:4].max()))
        self.series["inertia_sigma_percent", None].add(
            time_s, 100.0 * float(sigmas[4:].max() / np.abs(values[4:7]).max())
        )

    def _add_event(self, message: Event | CommandReply | MissionEnd) -> None:
        time_s = message.sim_time_ns / 1e9
        match message:
            case Event():
                text = f"{message.process}: {message.what} {message.detail}".strip()
                self.add_line(time_s, message.level, text)
            case CommandReply():
                self.add_line(
                    time_s, "info" if message.accepted else "warning", reply_text(message)
                )
            case MissionEnd():
                level = "info" if message.complete else "error"
                self.add_line(time_s, level, f"the mission has ended: {message.reason}")

    def _add_latency(self, message: ActuatorCommand, sent_ns: int) -> None:
        exposed_ns = self._exposed[message.chaser].pop(message.tick, None)
        if exposed_ns is not None:
            latency_ms = (sent_ns - exposed_ns) / 1e6
            self.series["latency_ms", message.chaser].add(message.sim_time_ns / 1e9, latency_ms)

    def add_line(self, time_s: float, level: Level, text: str) -> None:
        """Add an event line; an immediate repetition is ignored."""
        line = Line(time_s, level, text)
        if not self.lines or self.lines[-1] != line:
            self.lines.append(line)

    def add_past(self, lines: Iterable[Line]) -> None:
        """Add event lines of before this history began; of those known already, nothing."""
        known = set(self.lines)
        both = [*(line for line in lines if line not in known), *self.lines]
        self.lines = deque(sorted(both, key=lambda line: line.time_s), maxlen=_MOST_LINES)
        self.begins_s = 0.0

    def lines_until(self, time_s: float, most: int) -> list[Line]:
        """Return the latest lines up to ``time_s``, newest first."""
        return sorted(
            (x for x in reversed(self.lines) if x.time_s <= time_s), key=lambda x: -x.time_s
        )[:most]

    def _add_position(self, odometry: Odometry) -> None:
        target = self._target
        if target is None or odometry.chaser >= len(self.trails):
            return
        # The estimate is about one tick older than the odometry, so it is extrapolated to the same
        # time.
        later_s = (odometry.sim_time_ns - target.sim_time_ns) / 1e9
        position = np.add(target.position_m, np.multiply(target.velocity_m_s, later_s))
        attitude = rotations.integrate(target.q_wxyz, target.omega_rad_s, later_s)
        offset = rotations.rotate_inverse(attitude, np.subtract(odometry.position_m, position))
        time_s = odometry.sim_time_ns / 1e9
        self.series["distance_m", odometry.chaser].add(time_s, float(np.linalg.norm(offset)))
        self.trails[odometry.chaser].add(time_s, offset)

    def _add_tracking_error(self, reference: Reference) -> None:
        odometry = self._odometry[reference.chaser].get(reference.tick)
        if odometry is None:
            return
        time_s = reference.sim_time_ns / 1e9
        away_m = float(np.linalg.norm(np.subtract(odometry.position_m, reference.position_m)))
        turned = float(rotations.angle_between(reference.q_wxyz, odometry.q_wxyz))
        self.series["position_error_mm", reference.chaser].add(time_s, away_m * 1e3)
        self.series["orientation_error_deg", reference.chaser].add(
            time_s, float(np.degrees(turned))
        )

    def _compare_estimates(self) -> None:
        """Compare the estimates up to the newest known state of the target with its states: those
        of a reference have times of their own.
        """
        newest_ns = max(self._truth, default=-1)
        while self._uncompared and self._uncompared[0].sim_time_ns <= newest_ns:
            self._add_estimation_error(self._uncompared.popleft(), sorted(self._truth))

    def _add_estimation_error(self, estimate: TargetEstimate, times: list[int]) -> None:
        """Add the error of an estimate. ``times``: of the known states, ns."""
        after = bisect_right(times, estimate.sim_time_ns)
        around, time_s = MotionCollector(), estimate.sim_time_ns / 1e9
        for time_ns in times[max(0, after - 2) : after + 1]:
            around.add(self._truth[time_ns])
        motion = around.finish(np.array([time_s]))
        rows, true = motion.at(TARGET, np.array([time_s])) if TARGET in motion else ((), None)
        if true is None or not len(rows):
            return
        away_m = float(np.linalg.norm(true.position_m[0] - estimate.position_m))
        turned = float(rotations.angle_between(true.q_wxyz[0], estimate.q_wxyz))
        self.series["estimate_error_mm", None].add(time_s, away_m * 1e3)
        self.series["estimate_error_deg", None].add(time_s, float(np.degrees(turned)))


def reply_text(reply: CommandReply) -> str:
    """Format the controller's reply to a command."""
    operator = f" (by {reply.operator})" if reply.operator else ""
    outcome = "accepted" if reply.accepted else "refused"
    return f"{reply.command} chaser {reply.chaser}{operator}: {outcome}, {reply.reason}"
