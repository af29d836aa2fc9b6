"""The mission as it is at one moment: the latest message of each kind, and what follows from them. No I/O."""

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
    BodyTruth,
    DockingStatus,
    Image,
    MissionEnd,
    Odometry,
    Plan,
    Reference,
    Sighting,
    SolverStatus,
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
)
OF_ALL = (topics.TICK, topics.TARGET, topics.SOLVER, topics.END)
"""Topics of which the present shows the latest message: of each chaser, of the mission. The order is that in which
messages of one tick follow from one another."""

_KEPT = 32


@dataclass(frozen=True)
class Pose:
    """Position (3,) WRF, attitude (4,) body to WRF."""

    position_m: Array
    q_wxyz: Array


def pose_of(message: Odometry | BodyTruth | TargetEstimate | Reference) -> Pose:
    """Where the body of a message is."""
    return Pose(np.array(message.position_m), np.array(message.q_wxyz))


@dataclass
class ChaserNow:
    """The latest of one chaser; None where nothing has come yet."""

    odometry: Odometry | None = None
    reference: Reference | None = None
    plan: Plan | None = None
    docking: DockingStatus | None = None
    image: Image | None = None
    sighting: Sighting | None = None
    wrench: WrenchCommand | None = None
    actuators: ActuatorCommand | None = None
    thrusters: ThrusterReport | None = None
    _odometries: OrderedDict[int, Odometry] = field(default_factory=OrderedDict)
    _sightings: OrderedDict[int, Sighting] = field(default_factory=OrderedDict)

    def take(self, message: Any) -> None:
        """Notes a message of this chaser."""
        match message:
            case Odometry():
                self.odometry = message
                _keep(self._odometries, message.tick, message)
            case Reference():
                self.reference = message
            case Plan():
                self.plan = message
            case DockingStatus():
                self.docking = message
            case Image():
                self.image = message
            case Sighting():
                self.sighting = message
                _keep(self._sightings, message.sim_time_ns, message)
            case WrenchCommand():
                self.wrench = message
            case ActuatorCommand():
                self.actuators = message
            case ThrusterReport():
                self.thrusters = message

    def error(self) -> tuple[float, float] | None:
        """Distance (m) and angle (rad) of the chaser from its reference, by its own odometry; None while unknown."""
        there = self.reference
        here = self._odometries.get(there.tick) if there is not None else None
        if there is None or here is None:
            return None
        away_m = float(np.linalg.norm(np.subtract(here.position_m, there.position_m)))
        return away_m, float(rotations.angle_between(there.q_wxyz, here.q_wxyz))

    def sighting_in(self, image: Image) -> Sighting | None:
        """What was found in that image, if that is known."""
        return self._sightings.get(image.sim_time_ns)


def _keep(store: OrderedDict[int, Any], key: int, message: Any) -> None:
    store[key] = message
    while len(store) > _KEPT:
        store.popitem(last=False)


@dataclass
class Now:
    """The latest of everything; ``truth`` by body (``target``, ``chaser/0``), empty where it may not be read."""

    chasers: list[ChaserNow]
    tick: Tick | None = None
    target: TargetEstimate | None = None
    solver: SolverStatus | None = None
    ended: MissionEnd | None = None
    truth: dict[str, BodyTruth] = field(default_factory=dict)

    @classmethod
    def of(cls, chasers: int) -> Now:
        """Nothing known yet of so many chasers."""
        return cls([ChaserNow() for _ in range(chasers)])

    def take(self, topic: Topic, message: Any) -> None:
        """Notes a message; chasers that this mission does not have are not noted."""
        match message:
            case Tick():
                self.tick = message
            case TargetEstimate():
                self.target = message
            case SolverStatus():
                self.solver = message
            case MissionEnd():
                self.ended = message
            case BodyTruth():
                self.truth[message.body] = message
            case _ if topic in OF_CHASERS and message.chaser < len(self.chasers):
                self.chasers[message.chaser].take(message)

    def time_s(self) -> float:
        """Simulated time of the latest tick."""
        return self.tick.sim_time_ns / 1e9 if self.tick is not None else 0.0

    def estimate(self) -> Pose | None:
        """Where the target is thought to be."""
        return pose_of(self.target) if self.target is not None and self.target.status != "none" else None

    def true_target(self) -> Pose | None:
        """Where the target is, for those who may know."""
        return pose_of(self.truth[TARGET]) if TARGET in self.truth else None

    def chaser(self, i: int) -> Pose | None:
        """Where a chaser is: truly where that is known, else as it says itself."""
        body, odometry = self.truth.get(f"chaser/{i}"), self.chasers[i].odometry
        known = body if body is not None else odometry
        return pose_of(known) if known is not None else None

    def distance_m(self, i: int) -> float | None:
        """From a chaser's centre to the target's, as estimated."""
        target, odometry = self.estimate(), self.chasers[i].odometry
        if target is None or odometry is None:
            return None
        return float(np.linalg.norm(np.subtract(odometry.position_m, target.position_m)))

    def keep_out_m(self, otherwise: float) -> float:
        """How near to the target the chasers may plan to come: the largest that holds for one of them."""
        limits = [c.reference.min_distance_target_m for c in self.chasers if c.reference is not None]
        return max(limits, default=otherwise)


def in_target(pose: Pose, target: Pose) -> Array:
    """A body's position (3,) in TRF."""
    return rotations.rotate_inverse(target.q_wxyz, pose.position_m - target.position_m)
