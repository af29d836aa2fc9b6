# SPDX-License-Identifier: Apache-2.0
"""State of a mission at one time: the latest message of each kind, and derived quantities."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.messages import (
    ActuatorCommand,
    AssuranceStatus,
    BodyReference,
    BodyTruth,
    DockingStatus,
    DrawnBody,
    DrawnTruth,
    Image,
    LandmarkMap,
    MissionEnd,
    Odometry,
    PassiveSafety,
    Plan,
    Reference,
    Sighting,
    SolverStatus,
    StackEstimate,
    TargetEstimate,
    ThrusterReport,
    Tick,
    WrenchCommand,
)
from chaserdock_protocol.topics import Topic

TARGET = "target"
OF_CHASERS = (
    topics.IMAGE,
    topics.ODOMETRY,
    topics.DOCKING,
    topics.SIGHTING,
    topics.WRENCH,
    topics.ACTUATORS,
    topics.THRUSTERS,
    topics.REFERENCE,
    topics.PLAN,
    topics.SAFETY,
    topics.ASSURANCE,
)
EVENT_TOPICS = (topics.COMMAND, topics.EVENT, topics.HEALTH, topics.END)
"""Topics of the list of events, and of its counts."""
OF_ALL = (topics.TICK, topics.TARGET, topics.MAP, topics.STACK, topics.SOLVER, topics.END)
"""Topics of the state: of each chaser (OF_CHASERS), of the mission (OF_ALL). Within a tick their
order is causal.
"""

_KEPT = 64
"""Messages kept to be matched with later ones: 6 s at 10 Hz. Larger: more memory; smaller: late
matches are missed.
"""
_IMAGES_KEPT = 4
"""Images of a chaser that are kept, to show all cameras at one moment. Larger: more memory;
smaller: late cameras are missed.
"""
_RECENT_NS = 2_000_000_000
"""Age (ns) after which a chaser's images count as stopped. Larger: the others wait longer for
it.
"""
OLD_S = 1.0
"""Age (s) above which an image is shown as old, and up to which exposures are compared to show all
cameras at one moment. Larger: old images pass for present ones.
"""
_FIELDS = {
    Odometry: "odometry",
    Reference: "reference",
    Plan: "plan",
    PassiveSafety: "safety",
    AssuranceStatus: "assurance",
    DockingStatus: "docking",
    Image: "image",
    Sighting: "sighting",
    WrenchCommand: "wrench",
    ActuatorCommand: "actuators",
    ThrusterReport: "thrusters",
}
"""Fields of ``ChaserState`` by the type of the message that they hold."""


@dataclass(frozen=True)
class Pose:
    """Position (3,) WRF, attitude (4,) body to WRF."""

    position_m: Array
    q_wxyz: Array


def pose_of(
    message: Odometry | BodyTruth | BodyReference | TargetEstimate | Reference,
) -> Pose:
    """Return the pose in a message."""
    return Pose(np.array(message.position_m), np.array(message.q_wxyz))


@dataclass
class ChaserState:
    """Latest messages of one chaser; None before the first one."""

    odometry: Odometry | None = None
    reference: Reference | None = None
    plan: Plan | None = None
    safety: PassiveSafety | None = None
    assurance: AssuranceStatus | None = None
    docking: DockingStatus | None = None
    image: Image | None = None
    sighting: Sighting | None = None
    wrench: WrenchCommand | None = None
    actuators: ActuatorCommand | None = None
    thrusters: ThrusterReport | None = None
    _odometries: OrderedDict[int, Odometry] = field(default_factory=OrderedDict)
    _sightings: OrderedDict[int, Sighting] = field(default_factory=OrderedDict)
    images: OrderedDict[int, Image] = field(default_factory=OrderedDict)
    """The last images by time of exposure, ns."""

    def update(self, message: Any) -> None:
        """Store a message of this chaser."""
        setattr(self, _FIELDS[type(message)], message)
        if isinstance(message, Odometry):
            keep_newest(self._odometries, message.tick, message)
        elif isinstance(message, Sighting):
            keep_newest(self._sightings, message.sim_time_ns, message)
        elif isinstance(message, Image):
            keep_newest(self.images, message.sim_time_ns, message, _IMAGES_KEPT)

    def error(self) -> tuple[float, float] | None:
        """Return distance (m) and angle (rad) from the reference, by odometry; None if unknown."""
        reference = self.reference
        odometry = self._odometries.get(reference.tick) if reference is not None else None
        if reference is None or odometry is None:
            return None
        distance_m = float(np.linalg.norm(np.subtract(odometry.position_m, reference.position_m)))
        return distance_m, float(rotations.angle_between(reference.q_wxyz, odometry.q_wxyz))

    def latest_seen(self, now_ns: int) -> Image | None:
        """Return the latest image whose sighting has been received, not older than ``OLD_S``."""
        seen = [t for t in self.images if t in self._sightings and t >= now_ns - OLD_S * 1e9]
        return self.images[max(seen)] if seen else None

    def sighting_in(self, image: Image) -> Sighting | None:
        """Return the sighting of that image, if received."""
        return self._sightings.get(image.sim_time_ns)


def keep_newest(store: OrderedDict[int, Any], key: int, message: Any, kept: int = _KEPT) -> None:
    """Store a message and drop the oldest beyond ``kept``."""
    store[key] = message
    while len(store) > kept:
        store.popitem(last=False)


@dataclass
class MissionState:
    """Latest messages of the mission.

    ``truth``: true states by body (``target``, ``chaser/0``), or measured ones where there are only
    references; empty without access to either.
    ``true_body``: true mass properties of the target, likewise.
    """

    chasers: list[ChaserState]
    tick: Tick | None = None
    target: TargetEstimate | None = None
    stack: StackEstimate | None = None
    solver: SolverStatus | None = None
    map: LandmarkMap | None = None
    ended: MissionEnd | None = None
    truth: dict[str, BodyTruth | BodyReference] = field(default_factory=dict)
    true_body: DrawnBody | None = None

    @classmethod
    def empty(cls, chasers: int) -> MissionState:
        """Return the state before the first message."""
        return cls([ChaserState() for _ in range(chasers)])

    def update(self, topic: Topic, message: Any) -> None:
        """Store a message; ignore chasers that are not part of the mission."""
        match message:
            case Tick():
                self.tick = message
            case TargetEstimate():
                self.target = message
            case StackEstimate():
                self.stack = message
            case SolverStatus():
                self.solver = message
            case LandmarkMap():
                self.map = message
            case MissionEnd():
                self.ended = message
            case BodyTruth():
                self.truth[message.body] = message
            case BodyReference() if not isinstance(self.truth.get(message.body), BodyTruth):
                self.truth[message.body] = message
            case DrawnTruth():
                self.true_body = next((b for b in message.bodies if b.body == TARGET), None)
            case _ if topic in OF_CHASERS and message.chaser < len(self.chasers):
                self.chasers[message.chaser].update(message)

    def images_of_one_moment(self) -> list[Image | None]:
        """Return an image of each chaser from the same exposure: the newest of which all images
        and, if possible, all sightings have arrived.

        Without such an exposure within ``OLD_S``, and for a chaser whose images have stopped, it
        is the latest image; if possible, the latest with a sighting.
        """
        images = [c.image for c in self.chasers]
        newest_ns = max((image.sim_time_ns for image in images if image is not None), default=0)
        present = [
            c
            for c in self.chasers
            if c.image is not None and c.image.sim_time_ns >= newest_ns - _RECENT_NS
        ]
        common = set[int].intersection(*(set(c.images) for c in present)) if present else set[int]()
        common = {t for t in common if t >= newest_ns - OLD_S * 1e9}
        seen = {t for t in common if all(c.sighting_in(c.images[t]) is not None for c in present)}
        if not common:
            return [c.latest_seen(newest_ns) or c.image for c in self.chasers]
        moment_ns = max(seen or common)
        return [c.images.get(moment_ns, c.image) for c in self.chasers]

    def time_s(self) -> float:
        """Return the simulated time of the latest tick."""
        return self.tick.sim_time_ns / 1e9 if self.tick is not None else 0.0

    def estimate(self) -> Pose | None:
        """Return the estimated pose of the target."""
        return (
            pose_of(self.target)
            if self.target is not None and self.target.status != "none"
            else None
        )

    def true_target(self) -> Pose | None:
        """Return the true (or measured) pose of the target; None without access to it."""
        return pose_of(self.truth[TARGET]) if TARGET in self.truth else None

    def chaser(self, i: int) -> Pose | None:
        """Return the pose of a chaser: true or measured if available, or else odometry."""
        body, odometry = self.truth.get(f"chaser/{i}"), self.chasers[i].odometry
        known = body if body is not None else odometry
        return pose_of(known) if known is not None else None

    def distance_m(self, i: int) -> float | None:
        """Return the distance (m) between the centres of a chaser and the estimated target."""
        target, odometry = self.estimate(), self.chasers[i].odometry
        if target is None or odometry is None:
            return None
        return float(np.linalg.norm(np.subtract(odometry.position_m, target.position_m)))

    def keep_out_m(self, default: float) -> float:
        """Return the largest distance from the target that any chaser has to keep now, ``default``
        if unknown.
        """
        limits = [
            c.reference.min_distance_target_m for c in self.chasers if c.reference is not None
        ]
        return max(limits, default=default)
