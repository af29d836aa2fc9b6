# SPDX-License-Identifier: Apache-2.0
"""Checks a decoded controller state against the scenario, before any of it is used.

Types state that a field is an array, not of which shape. Here every array that a checkpoint may
contain has its shape, and every tuple or list whose length other values depend on has its length.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from chaserdock_protocol import codec
from chaserdock_protocol.messages import Message, ThrusterReport
from chaserdock_protocol.scenario import FlightScenario
from msgspec import Struct

from chaserdock_controller.bodies.body_shape import SHAPE, BodyShape
from chaserdock_controller.bodies.mass_properties import MassProperties
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.estimation.identification.composite import (
    CompositeEstimate,
    CompositeFilterState,
)
from chaserdock_controller.estimation.identification.faults import DetectorState
from chaserdock_controller.estimation.joint.hypotheses import FilterState
from chaserdock_controller.estimation.joint.parameters import TargetParameters
from chaserdock_controller.estimation.joint.replay import FilterTick
from chaserdock_controller.estimation.joint.star import ChasersGivenTarget
from chaserdock_controller.estimation.joint.state import (
    CHANNELS,
    CHASER,
    EXTRA,
    TARGET,
    JointState,
)
from chaserdock_controller.estimation.paper import SightedTarget
from chaserdock_controller.estimation.target_shape import ShapeFilter
from chaserdock_controller.estimation.types import MeasuredChaser, Shock
from chaserdock_controller.guidance.detumble.planner import ActivePlan, PlanSearch
from chaserdock_controller.guidance.detumble.planning import StackPlan, StackProblem
from chaserdock_controller.guidance.docking import DockingObservation
from chaserdock_controller.guidance.pointing import SearchProgress, SurveyPlace
from chaserdock_controller.guidance.trajectories import Circuit, Escape, Glide, Move, Part, Slew
from chaserdock_controller.ingest.odometry_validation import Known
from chaserdock_controller.interfaces import AppliedImpulse, ChaserPlan, RelativePose
from chaserdock_controller.parameters import nmpc_parameters

Size = int | str
"""A length: a number, or a name of one; "NAME+1" is one more.

``chasers``, ``thrusters`` (of a chaser), ``stages`` and ``stages+1`` are the scenario's. Another
name stands for any length, the same everywhere in an object and the objects within; only those in
``MAY_BE_ZERO`` may be zero.
"""
ArrayShape = tuple[Size, ...]

_3, _4, _6 = (3,), (4,), (6,)
"""Shapes of a vector, a quaternion, and a wrench or two vectors: without unit, by definition."""
_EACH: ArrayShape = ("chasers",)

ARRAYS: dict[type, dict[str, tuple[ArrayShape, ...]]] = {
    Known: {"correction": (_3, _4)},
    Part: {"coefficients": ((6, 3),)},
    Glide: {"from_m": (_3,), "along": (_3,)},
    Escape: {"state": (_6,), "acceleration_m_s2": (_3,)},
    Circuit: {"from_m": (_3,), "axis": (_3,)},
    SearchProgress: {"q_start_wxyz": (_4,)},
    SurveyPlace: {"position_m": (_3,), "q_wxyz": (_4,)},
    Slew: {"turn_rad": (_3,)},
    DockingObservation: {"offset_m": (_3,), "q_wxyz": (_4,), "covariance": ((6, 6),)},
    RelativePose: {
        "position_m": (_3,),
        "q_wxyz": (_4,),
        "covariance": ((6, 6),),
        "random_covariance": ((6, 6),),
    },
    ChaserPlan: {"states": (("stages+1", 13),), "inputs": (("stages", 6),)},
    StackPlan: {"thrusts_N": (("steps", "stack"),), "remaining": (_6,)},
    ActivePlan: {"limits_N": (("stack",),)},
    StackProblem: {
        "momentum": (_6,),
        "q_wxyz": (_4,),
        "inertia_kg_m2": ((3, 3),),
        "wrenches": ((6, "stack"),),
        "limits_N": (("stack",),),
        "groups": (("stack",),),
    },
    TargetBody: {"inertia_kg_m2": ((3, 3),), "centre_trf_m": (_3,)},
    MassProperties: {"covariance": ((10, 10),)},
    CompositeEstimate: {
        "position_m": (_3,),
        "velocity_m_s": (_3,),
        "q_wxyz": (_4,),
        "omega_rad_s": (_3,),
        "mounts_m": (("latched", 3),),
        "mounts_wxyz": (("latched", 4),),
        "thrusts": (("stack",),),
        "biases": (("latched", 3),),
    },
    CompositeFilterState: {"covariance": (("errors", "errors"),)},
    DetectorState: {
        "signatures": (("errors", "tests"),),
        "gains": (("tests",),),
        "ticks": (("tests",),),
    },
    ShapeFilter: {
        "information": (("parameters", "parameters"),),
        "vector": (("parameters",),),
        "baselines": (("parameters+1", "parameters+1"),),
        "lengths": (("parameters+1",),),
    },
    AppliedImpulse: {"impulse": (_6,), "moment": (_6,), "magnitude": (_6,)},
    MeasuredChaser: {"last_command": (_6,)},
    Shock: {"velocity_m_s": (_3,), "omega_rad_s": (_3,)},
    BodyShape: {"inertia": ((3, 3),), "centre_m": (_3,)},
    JointState: {
        "position_m": (_3,),
        "velocity_m_s": (_3,),
        "q_wxyz": (_4,),
        "omega_rad_s": (_3,),
        "covariance": (("errors", "errors"),),
        "positions_m": (("chasers", 3),),
        "velocities_m_s": (("chasers", 3),),
        "attitudes_wxyz": (("chasers", 4),),
        "omegas_rad_s": (("chasers", 3),),
        "extra": (("chasers", EXTRA),),
        "alive": (_EACH,),
        "odometry_ns": (_EACH,),
        "measured_ns": (_EACH,),
        "rejections": (("chasers", len(CHANNELS)),),
        "nis": (("chasers", len(CHANNELS) - 1),),
        "markers": (_EACH,),
        "view_units": (("chasers", 6, 6),),
        "view_units_ns": (_EACH,),
        "ratio_information": ((5, 5),),
    },
    ChasersGivenTarget: {
        "gains": (("chasers", CHASER, "errors"),),
        "covariances": (("chasers", CHASER, CHASER),),
    },
    SightedTarget: {"position_m": (_3,), "q_wxyz": (_4,)},
}
"""Shapes of the arrays in each field. Those of a field with several arrays repeat in order."""

LENGTHS: dict[type, dict[str, ArrayShape]] = {
    Move: {"parts": ("parts",)},
    Glide: {"speeds_m_s": ("holds",), "holds_s": ("holds",), "ramps_s": ("holds+1",)},
    FilterState: {"hypotheses": ("hypotheses",)},
    FilterTick: {"chasers": _EACH},
    ThrusterReport: {"given_thrusters_N_s": ("thrusters",)},
    TargetParameters: {"body_covariance": (9, 9)},
}
"""Lengths of tuples and lists, and of those within. Those in ``MAY_BE_EMPTY`` may be absent."""
MAY_BE_EMPTY = {(ThrusterReport, "given_thrusters_N_s"), (TargetParameters, "body_covariance")}
MAY_BE_ZERO = {"waiting", "tests"}
"""Names of lengths that may be zero: impulses that wait to be fired, and tests for failures."""


class MisfitError(ValueError):
    """A part of a state does not fit the scenario. The text names the field and what is right."""


def check_fit(
    state: Any, scenario: FlightScenario, own: Mapping[type, dict[str, tuple[ArrayShape, ...]]]
) -> None:
    """Raise MisfitError unless all shapes, chaser numbers and messages in ``state`` fit the
    scenario.

    ``own``: shapes of the arrays in types that are declared elsewhere.
    """
    sizes = {
        "chasers": len(scenario.chasers),
        "thrusters": len(scenario.chaser.thrusters),
        "stages": nmpc_parameters(scenario).stages,
    }
    _check(state, sizes, {**ARRAYS, **own}, "state")


def _check(
    value: Any,
    sizes: dict[str, int],
    arrays: Mapping[type, dict[str, tuple[ArrayShape, ...]]],
    at: str,
) -> None:
    """Check a value that stands at ``at``, and what it contains. ``sizes``: known by name."""
    if isinstance(value, dict):
        value = [*value.keys(), *value.values()]
    if _is_collection(value):
        for item in value:
            _check(item, sizes, arrays, at)
        return
    if not (names := _names(value)):
        return
    sizes = sizes | _sizes_of(value, sizes["chasers"])
    _check_chaser(value, sizes["chasers"], at)
    for name, shape in LENGTHS.get(type(value), {}).items():
        items = getattr(value, name)
        if items or (type(value), name) not in MAY_BE_EMPTY:
            _match(_lengths(items, len(shape)), shape, sizes, f"{at}.{name}")
    if isinstance(value, Message):
        _check_message(value, at)  # without arrays
        return
    known = arrays.get(type(value), {})
    for name in names:
        for array, shape in zip(
            _arrays_in(getattr(value, name)), itertools.cycle(known.get(name, ())), strict=False
        ):
            _match(array.shape, shape, sizes, f"{at}.{name}")
            _check_numbers(array, name, f"{at}.{name}")
    for name in names:
        _check(getattr(value, name), sizes, arrays, f"{at}.{name}")


def _is_collection(value: Any) -> bool:
    """Return whether a value is a list, set or tuple without names."""
    return isinstance(value, list | tuple | set | frozenset) and not hasattr(value, "_fields")


def _sizes_of(value: Any, chasers: int) -> dict[str, int]:
    """Return the sizes that an object determines itself."""
    match value:
        case JointState():
            dense = CHASER * chasers if value.given_target is None else 0
            return {"errors": TARGET + dense + SHAPE * (value.shape is not None)}
        case PlanSearch():
            return {"stack": len(value.problem.limits_N)}
    return {}


def _check_chaser(value: Any, chasers: int, at: str) -> None:
    chaser = getattr(value, "chaser", None)
    if isinstance(chaser, int) and not 0 <= chaser < chasers:
        raise MisfitError(f"{at}: chaser {chaser} of {chasers}")


def _check_message(message: Message, at: str) -> None:
    try:
        codec.check_numbers(message)
    except codec.Rejected as error:
        raise MisfitError(f"{at}: {error}") from None


def _check_numbers(array: np.ndarray, name: str, where: str) -> None:
    """Raise MisfitError for numbers that no message may contain either."""
    if array.dtype.kind == "f" and np.abs(array).max(initial=0.0) > codec.MAX_MAGNITUDE:
        raise MisfitError(f"{where} contains numbers beyond {codec.MAX_MAGNITUDE:g}")
    if "wxyz" in name:
        lengths = np.linalg.norm(array, axis=-1)
        if np.abs(lengths - 1.0).max(initial=0.0) > codec.UNIT_QUATERNION_TOLERANCE:
            raise MisfitError(f"{where} is no unit quaternion")


def _names(value: Any) -> tuple[str, ...]:
    """Return the names of the fields of a structure, none for another value."""
    if isinstance(value, Struct):
        return value.__struct_fields__
    if is_dataclass(value):
        return tuple(f.name for f in fields(value))
    return getattr(value, "_fields", ())


def _arrays_in(value: Any) -> Iterator[np.ndarray]:
    """Yield the arrays in a field, not those of structures within."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, dict):
        yield from _arrays_in(list(value.values()))
    elif _is_collection(value):
        for item in value:
            yield from _arrays_in(item)


def _lengths(items: Any, depth: int) -> tuple[int, ...]:
    """Return the lengths of nested tuples; -1 where they differ."""
    if depth == 1:
        return (len(items),)
    inner = {_lengths(item, depth - 1) for item in items}
    return (len(items), *(inner.pop() if len(inner) == 1 else (-1,) * (depth - 1)))


def _match(found: tuple[int, ...], shape: ArrayShape, sizes: dict[str, int], where: str) -> None:
    """Raise MisfitError unless a shape is as declared. Sets the names in it that are unknown."""
    wanted: list[Size] = list(shape)
    if len(found) == len(shape):
        for k, size in enumerate(shape):
            if isinstance(size, str):
                name, _, more = size.partition("+")
                added = int(more or 0)
                least = added + (name not in MAY_BE_ZERO)
                known = sizes.setdefault(name, found[k] - added) + added
                wanted[k] = known if known >= least else f"at least {least}"
    if list(found) != wanted:
        raise MisfitError(f"{where} has the shape {found}, not ({', '.join(map(str, wanted))})")
