"""All that a controller knows after a tick, as bytes for one that comes late; and such bytes taken over.

Of the filter's buffer only the newest exposure goes along: a sighting that is older reaches who took over in vain. What
estimators and solvers of installed packages know is left out: these begin anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec
from chaserdock_models.docking_geometry import PortView
from chaserdock_protocol.messages import Odometry, OperatorCommand, ThrusterReport

from chaserdock_controller.core import ControllerCore
from chaserdock_controller.estimation import Mekf
from chaserdock_controller.estimation.baseline import PaperEstimator, PaperParameters
from chaserdock_controller.estimation.filter_update import FilterState
from chaserdock_controller.estimation.hypothesis import Branch
from chaserdock_controller.estimation.mekf import Exposure
from chaserdock_controller.estimation.parameters import MekfParameters
from chaserdock_controller.estimation.rigid_target import TargetBody
from chaserdock_controller.estimation.types import (
    CameraPose,
    EstimatorEvent,
    Measurement,
    PoseHypothesis,
    Shock,
)
from chaserdock_controller.guidance.docking import Senses
from chaserdock_controller.guidance.phases import ChaserGuidance
from chaserdock_controller.guidance.trajectories import Glide, Move, Part
from chaserdock_controller.ingest.odometry_validation import Known, OdometryValidation
from chaserdock_controller.ingest.sensor_consistency import SensorConsistency

from . import serialization as plain

CLASSES: tuple[type, ...] = (
    Branch,
    ChaserGuidance,
    EstimatorEvent,
    Exposure,
    CameraPose,
    FilterState,
    Glide,
    ThrusterReport,
    Known,
    Measurement,
    MekfParameters,
    Move,
    Odometry,
    OperatorCommand,
    PaperParameters,
    Part,
    PortView,
    PoseHypothesis,
    Senses,
    Shock,
    TargetBody,
)
"""What may be in a controller's state, beside numbers, texts and containers."""

_GUIDANCE = ("chasers", "_leaving", "_sensed", "_places", "_done", "_due", "_seen_s", "_blind")
_THRUSTERS = ("_reports", "_isolated", "_trusted", "_done")
_CAPTURES = ("body", "latched", "_changed")
_FLIGHT = ("_odometry", "_last_solve_ns", "_troubled")


class CheckpointError(ValueError):
    """Bytes that are no controller's state, or not of this mission; the text says why."""


@dataclass(frozen=True)
class _Drawer:
    """Some attributes of one object."""

    owner: Callable[[], Any]
    names: tuple[str, ...]


class Checkpoint:
    """What is told and taken over of one controller."""

    def __init__(
        self, flight: ControllerCore, watch: OdometryValidation, agreement: SensorConsistency
    ) -> None:
        self._flight = flight
        # The flight's parts are looked up when they are needed: a replay of fusion alone has none.
        parts: dict[str, Any] = {
            "flight": (lambda: flight, _FLIGHT),
            "guidance": (lambda: flight.guidance, _GUIDANCE),
            "thrusters": (lambda: vars(flight)["_thrusters"], _THRUSTERS),
            "captures": (lambda: vars(flight)["_captures"], _CAPTURES),
            "history": (lambda: vars(flight)["_history"], ("_sent",)),
            "searches": (lambda: vars(flight)["_searches"], ("_from",)),
            "absent": (lambda: flight.absent, ("known", "told")),
            "watch": (lambda: watch, ("_known",)),
            "agreement": (lambda: agreement, ("disagreeing", "_since_s")),
        }
        self._drawers = {name: _Drawer(*part) for name, part in parts.items()}

    def told(self) -> bytes:
        """The state now. Raises CheckpointError when something in it cannot be told."""
        values: dict[str, Any] = {
            name: {attribute: vars(drawer.owner())[attribute] for attribute in drawer.names}
            for name, drawer in self._drawers.items()
        }
        values["guidance"]["_due"] = len(values["guidance"]["_due"])
        values["estimator"] = _of_estimator(self._flight.estimator)
        frame = _frame_of(self._flight)
        values["plans"] = dict(frame.plans) if frame is not None else {}
        try:
            return msgspec.msgpack.encode(plain.told(values, CLASSES))
        except plain.NotPlain as error:
            raise CheckpointError(f"not to be told: {error}") from None

    def recall(self, state: bytes) -> None:
        """Takes a state over, whole or not at all. Raises CheckpointError."""
        try:
            values = plain.understood(msgspec.msgpack.decode(state), CLASSES)
            for name, drawer in self._drawers.items():
                if set(values[name]) != set(drawer.names):
                    raise CheckpointError(f"{name}: {', '.join(map(str, values[name]))}")
            chasers = values["guidance"]["chasers"]
            due, there = int(values["guidance"]["_due"]), self._flight.scenario.timeline
            plans, estimator = dict(values["plans"]), dict(values["estimator"])
        except (msgspec.DecodeError, plain.NotPlain, LookupError, TypeError, ValueError) as error:
            raise CheckpointError(str(error)) from None
        if len(chasers) != len(self._flight.scenario.chasers) or not 0 <= due <= len(there):
            raise CheckpointError("it is of another mission")
        values["guidance"]["_due"] = sorted(there, key=lambda entry: entry.at_s)[len(there) - due :]
        for name, drawer in self._drawers.items():
            _put(drawer.owner(), values[name])
        if type(self._flight.estimator).__name__ == estimator.pop("kind", ""):
            _put(self._flight.estimator, estimator)
        frame = _frame_of(self._flight)
        if frame is not None:
            frame.plans = plans


def _put(owner: Any, values: dict[str, Any]) -> None:
    for name, value in values.items():
        there = vars(owner).get(name)
        if isinstance(there, dict):  # in place: it may be one with a default
            there.clear()
            there.update(value)
        else:
            setattr(owner, name, value)


def _of_estimator(estimator: Any) -> dict[str, Any]:
    """What one of our own estimators knows, with its ``kind``; nothing of others'."""
    if not isinstance(estimator, Mekf | PaperEstimator):
        return {}
    values = dict(vars(estimator))
    if isinstance(estimator, Mekf) and len(values["_buffer"]) > 1:
        newest, before = values["_buffer"][-1], values["_buffer"][-2]
        values |= {"_buffer": [newest], "_base": before.state}
        values["_drained"] = {event for event in values["_drained"] if event in newest.events}
    return {"kind": type(estimator).__name__, **values}


def _frame_of(flight: ControllerCore) -> Any:
    """Where the solver keeps its warm starts, if it is one of ours."""
    return vars(vars(flight)["_solver"]).get("_frame")
