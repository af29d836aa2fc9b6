# SPDX-License-Identifier: Apache-2.0
"""Serializes and restores controller state for a standby that joins late.

Of the filter's buffer only the newest exposure is included; older sightings cannot be used after a
restore. The state of installed estimators and solvers is not included; they restart.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, TypeVar

from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import (
    ChosenPort,
    Odometry,
    OperatorCommand,
    SightedMap,
    ThrusterReport,
)
from msgspec import Struct

from chaserdock_controller.bodies.mass_properties import MassProperties
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.estimation.identification.stage import IdentificationState
from chaserdock_controller.estimation.joint import JointEstimator
from chaserdock_controller.estimation.joint.parameters import TargetParameters
from chaserdock_controller.estimation.joint.replay import ReplayBuffer
from chaserdock_controller.estimation.paper import PaperEstimator, PaperParameters, SightedTarget
from chaserdock_controller.estimation.target_shape import ShapeFilter
from chaserdock_controller.guidance.activities.detumble import detumbling_of
from chaserdock_controller.guidance.chaser_state import ChaserGuidance
from chaserdock_controller.guidance.detumble.planner import ActivePlan, PlanSearch
from chaserdock_controller.guidance.docking import DockingObservation
from chaserdock_controller.ingest.odometry_validation import Known, OdometryValidation
from chaserdock_controller.interfaces import ChaserPlan, PlanningFailure

from .serialization import decode, encode
from .shapes import ArrayShape, MisfitError, check_fit

PartT = TypeVar("PartT", bound=Struct)


class CheckpointError(ValueError):
    """The bytes are not a controller state of this mission. The text states why."""


# Each part has fields named like the attributes of the object that it is copied from.


class CoreState(Struct, forbid_unknown_fields=True):
    inspecting: frozenset[int]


class PlanningState(Struct, forbid_unknown_fields=True):
    _last_solve_ns: int | None


class OutputState(Struct, forbid_unknown_fields=True):
    _without_plan: set[int]


class FleetState(Struct, forbid_unknown_fields=True):
    _seen_s: float | None
    left: list[int]


class WaitingState(Struct, forbid_unknown_fields=True):
    waits: bool


class StackControlState(Struct, forbid_unknown_fields=True):
    _pulse: tuple[int, int | None]
    _mean_rates: Array | None


class StackPlanState(Struct, forbid_unknown_fields=True):
    active: ActivePlan | None
    search: PlanSearch | None


class SequencerState(Struct, forbid_unknown_fields=True):
    _pending_N_s: Array
    _thrusts_N: Array


class CompositeState(Struct, forbid_unknown_fields=True):
    _target_alone: MassProperties
    body: TargetBody
    latched: frozenset[int]
    _changed: bool


class ShapeState(Struct, forbid_unknown_fields=True):
    filter: ShapeFilter


# -- of one chaser ---------------------------------------------------------------------------------


class IngestState(Struct, forbid_unknown_fields=True):
    report: ThrusterReport | None


class LossState(Struct, forbid_unknown_fields=True):
    last: Odometry | None
    reported: bool


class OdometryState(Struct, forbid_unknown_fields=True):
    known: Known | None


class ConsistencyState(Struct, forbid_unknown_fields=True):
    inconsistent: bool
    confirmed: bool
    interrupted_s: float
    agrees: bool
    since_s: float


class MachineState(Struct, forbid_unknown_fields=True):
    state: ChaserGuidance
    position_m: Array | None
    seen: DockingObservation | None
    failure: PlanningFailure | None
    interrupted: bool
    abort_margin: float | None
    led_s: float | None
    unseen: str
    sighted: SightedMap | None
    port: ChosenPort | None
    _last_command: tuple[float, OperatorCommand] | None


class ThrusterCommandState(Struct, forbid_unknown_fields=True):
    isolated: set[int]
    trusted: set[int]
    _last_commands: dict[int, tuple[float, OperatorCommand]]


class PlanMonitorState(Struct, forbid_unknown_fields=True):
    _last: ChaserPlan | None
    _failed_since_ns: int | None
    _degraded_since_ns: int | None
    _degraded: bool
    _time_ns: int


class SentState(Struct, forbid_unknown_fields=True):
    _sent: list[tuple[int, Array]]


class ChaserCheckpoint(Struct, forbid_unknown_fields=True):
    """State of one chaser."""

    ingest: IngestState
    loss: LossState
    odometry: OdometryState
    consistency: ConsistencyState
    machine: MachineState
    thrusters: ThrusterCommandState
    plan_monitor: PlanMonitorState
    sent: SentState


# -- of the estimator ------------------------------------------------------------------------------


class JointEstimatorState(Struct, forbid_unknown_fields=True, tag=True):
    target: TargetParameters
    _buffer: ReplayBuffer
    _was_lost: bool


class PaperEstimatorState(Struct, forbid_unknown_fields=True, tag=True):
    parameters: PaperParameters
    _odometry: dict[tuple[int, int], Odometry]
    _latest: dict[int, SightedTarget]
    _poses: list[tuple[Array, Array]]
    _rates: list[tuple[Array, Array]]
    _mean: tuple[int, Array, Array] | None
    _newest_ns: int | None
    _removed_in_a_row: int
    _reinitialisations: int
    _seen: int
    _rejected: tuple[int, ...]
    _was_lost: bool


_ESTIMATORS: dict[type, type[JointEstimatorState | PaperEstimatorState]] = {
    JointEstimator: JointEstimatorState,
    PaperEstimator: PaperEstimatorState,
}
"""State that is copied, by type of estimator. Nothing is copied of installed ones."""


class ControllerCheckpoint(Struct, forbid_unknown_fields=True):
    """State of a controller after a tick.

    ``identification``: None if the scenario does not identify. ``plans``: warm starts of the NMPC
    solver, inputs by chaser.
    """

    core: CoreState
    planning: PlanningState
    output: OutputState
    chasers: list[ChaserCheckpoint]
    fleet: FleetState
    stack: WaitingState
    stack_control: StackControlState
    stack_plan: StackPlanState
    sequencer: SequencerState
    composite: CompositeState
    identification: IdentificationState | None
    shape: ShapeState | None
    estimator: JointEstimatorState | PaperEstimatorState | None
    plans: dict[int, Array]


OWN_ARRAYS: dict[type, dict[str, tuple[ArrayShape, ...]]] = {
    MachineState: {"position_m": ((3,),)},
    SentState: {"_sent": ((6,),)},
    StackControlState: {"_mean_rates": ((6,),)},
    SequencerState: {"_pending_N_s": (("waiting",),), "_thrusts_N": (("waiting",),)},
    PaperEstimatorState: {
        "_poses": ((3,), (4,)),
        "_rates": ((3,), (3,)),
        "_mean": ((3,), (4,)),
    },
    ControllerCheckpoint: {"plans": (("stages", 6),)},
}
"""Shapes of the arrays in the parts above."""


class Checkpoint:
    """Saves and restores the state of one controller. ``odometry``: odometry validation of each
    chaser.
    """

    def __init__(self, core: ControllerCore, odometry: Sequence[OdometryValidation]) -> None:
        self._core, self._odometry = core, odometry

    def _chaser_parts(self, i: int) -> dict[str, tuple[Any, type[Struct]]]:
        """Return the objects of one chaser whose attributes are copied, by field of its
        checkpoint.
        """
        core, machine = self._core, self._core.guidance.chasers[i]
        return {
            "ingest": (core.ingest.chasers[i], IngestState),
            "loss": (core.ingest.chasers[i].loss, LossState),
            "odometry": (self._odometry[i], OdometryState),
            "consistency": (core.estimation.consistency[i], ConsistencyState),
            "machine": (machine, MachineState),
            "thrusters": (machine.thrusters, ThrusterCommandState),
            "plan_monitor": (core.planning.monitors[i], PlanMonitorState),
            "sent": (core.output.sent[i], SentState),
        }

    def _parts(self) -> dict[str, tuple[Any, type[Struct]]]:
        """Return the objects whose attributes are copied and the types of their copies, by field of
        the checkpoint.
        """
        core = self._core
        detumble = detumbling_of(core.guidance.activities)
        parts: dict[str, tuple[Any, type[Struct]]] = {
            "core": (core, CoreState),
            "planning": (core.planning, PlanningState),
            "output": (core.output, OutputState),
            "fleet": (core.guidance.fleet, FleetState),
            "stack": (detumble, WaitingState),
            "stack_control": (detumble.control, StackControlState),
            "stack_plan": (detumble.control.planner, StackPlanState),
            "sequencer": (detumble.control.sequencer, SequencerState),
            "composite": (core.estimation.composite, CompositeState),
        }
        if core.estimation.shape is not None:
            parts["shape"] = (core.estimation.shape, ShapeState)
        return parts

    def save(self) -> bytes:
        """Return the present state as bytes. Raises CheckpointError if it contains something other
        than data.
        """
        parts: dict[str, Any] = {"shape": None, **_read_all(self._parts())}
        frame, identification = self._warm_starts(), self._core.estimation.identification
        estimator, kind = self._core.estimator, _ESTIMATORS.get(type(self._core.estimator))
        try:
            return encode(
                ControllerCheckpoint(
                    **parts,
                    chasers=[
                        ChaserCheckpoint(**_read_all(self._chaser_parts(c.number)))
                        for c in self._core.guidance.chasers
                    ],
                    identification=None if identification is None else identification.save(),
                    estimator=None if kind is None else _read(estimator, kind),
                    plans=dict(frame.plans) if frame is not None else {},
                )
            )
        except TypeError as error:
            raise CheckpointError(str(error)) from None

    def restore(self, data: bytes) -> None:
        """Replace the state by a saved one, completely or not at all. Raises CheckpointError if it
        does not fit.
        """
        try:
            state = decode(data, ControllerCheckpoint)
        except (ValueError, RecursionError) as error:
            raise CheckpointError(str(error)) from None
        try:
            check_fit(state, self._core.scenario, OWN_ARRAYS)
        except MisfitError as error:
            raise CheckpointError(str(error)) from None
        commands = range(len(self._core.scenario.timeline))
        chasers = len(self._core.scenario.chasers)
        if len(state.chasers) != chasers or not set(state.fleet.left) <= set(commands):
            raise CheckpointError("the state is of another mission")
        count = (
            None
            if self._core.estimation.shape is None
            else len(self._core.estimation.shape.parameters)
        )
        if count != (None if state.shape is None else len(state.shape.filter.vector)):
            raise CheckpointError("the state is of another mission")
        self._restore_identification(state.identification)
        _write_all(self._parts(), state)
        for i, chaser in enumerate(state.chasers):
            _write_all(self._chaser_parts(i), chaser)
            machine = self._core.guidance.chasers[i]
            machine.use_port(machine.port)
        kind = _ESTIMATORS.get(type(self._core.estimator))
        if state.estimator is not None and type(state.estimator) is kind:
            _write(self._core.estimator, state.estimator)
        frame = self._warm_starts()
        if frame is not None:
            frame.plans = state.plans

    def _restore_identification(self, state: IdentificationState | None) -> None:
        identification = self._core.estimation.identification
        if (identification is None) != (state is None):
            raise CheckpointError("the state is of another mission")
        if identification is not None and state is not None:
            try:
                identification.load(state)
            except ValueError as error:
                raise CheckpointError(f"identification: {error}") from None

    def _warm_starts(self) -> Any:
        """Return the object that holds the solver's warm starts; None for an installed solver."""
        return vars(self._core.planning.solver).get("_frame")


def _read_all(parts: dict[str, tuple[Any, type[Struct]]]) -> dict[str, Any]:
    return {name: _read(*part) for name, part in parts.items()}


def _write_all(parts: dict[str, tuple[Any, type[Struct]]], state: Struct) -> None:
    for name, (owner, _) in parts.items():
        _write(owner, getattr(state, name))


def _read(owner: Any, kind: type[PartT]) -> PartT:
    values = vars(owner)
    return kind(**{name: _data(values[name]) for name in kind.__struct_fields__})


def _data(value: Any) -> Any:
    match value:
        case deque():
            return list(value)
        case ReplayBuffer():
            return value.with_newest_only()
    return value


def _write(owner: Any, state: Struct) -> None:
    for name in state.__struct_fields__:
        value, current = getattr(state, name), vars(owner).get(name)
        if isinstance(current, dict):  # in place, as it may have a default factory
            current.clear()
            current.update(value)
        elif isinstance(current, deque):
            setattr(owner, name, deque(value, current.maxlen))
        else:
            setattr(owner, name, value)
