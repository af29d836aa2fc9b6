# SPDX-License-Identifier: Apache-2.0
"""Runs an installed estimator so that its failures cost estimates, not the controller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.passive_safety import DisturbedMotion
from chaserdock_protocol.codec import MAX_MAGNITUDE, UNIT_QUATERNION_TOLERANCE
from chaserdock_protocol.failure_watch import FailureWatch, text_of
from chaserdock_protocol.messages import Innovation, Odometry

from chaserdock_controller.bodies.body_shape import SHAPE, BodyShape
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.interfaces import RelativePose, TargetState

from .joint.motion_models import constant_rates
from .types import (
    CameraError,
    ChaserMotion,
    Estimate,
    Estimator,
    EstimatorEvent,
    EstimatorInputs,
    Shock,
    no_estimate,
)

ResultT = TypeVar("ResultT")

FAILED = "estimator failed"
"""Name of the failure in events and counts."""
_STATUS = ("none", "tracking", "predicting", "lost")
_LEVELS = ("info", "warning", "error")
_ASYMMETRY = 1e-6
"""Largest asymmetry of a covariance, relative to its largest element; rounding leaves 1e-12."""

_3, _4, _6x6 = (3,), (4,), (6, 6)
"""Shapes of a vector, a quaternion and a covariance of a pose: without unit, by definition."""
_SHAPES: dict[type, dict[str, tuple[int, ...]]] = {
    TargetState: {
        "position_m": _3,
        "velocity_m_s": _3,
        "q_wxyz": _4,
        "omega_rad_s": _3,
        "covariance": (12, 12),
    },
    ChaserMotion: {
        "position_m": _3,
        "velocity_m_s": _3,
        "q_wxyz": _4,
        "omega_rad_s": _3,
        "disturbance": (6,),
    },
    RelativePose: {"position_m": _3, "q_wxyz": _4, "covariance": _6x6},
    CameraError: {"turn_rad": _3, "shift_m": _3, "covariance": (7, 7)},
    BodyShape: {"inertia": (3, 3), "centre_m": _3},
    DisturbedMotion: {"acceleration_m_s2": _3, "covariance": (9, 9)},
}
"""Shapes of the arrays that an estimator returns."""


class GuardedEstimator(Estimator):
    """An installed estimator ``name`` of a mission of ``chasers``, whose failures are counted.

    A failure is an exception, a result of another type, or a value that is not finite. Where
    ``update`` fails, the last estimate is continued at constant rates with its covariance, status
    "predicting", and "lost" once the failures in a row are an error; the chasers' motions are then
    their odometry.
    """

    def __init__(self, name: str, estimator: Any, chasers: int) -> None:
        self._inner, self._chasers = estimator, chasers
        self._watch = FailureWatch(name)
        self._last: TargetState | None = None
        self._detail = ""
        self._continues = self._failed = False

    @property
    def failed(self) -> bool:
        """Return whether a call has failed: an event of the newest update."""
        return self._failed

    def update(self, inputs: EstimatorInputs) -> Estimate:
        """Return the estimator's result, or the continued estimate if it fails."""

        def checked() -> Estimate:
            found = self._inner.update(inputs)
            _check_estimate(found, inputs.time_ns, self._chasers)
            return found

        found = self._guarded("update", checked, None)
        report = self._watch.update(FAILED, self._detail)
        self._failed, self._detail = bool(self._detail), ""
        self._continues = found is None
        if found is None:
            found = Estimate(self._continued(inputs.time_ns))
        else:
            self._last = found.target
        if report is None:
            return found
        event = EstimatorEvent(inputs.time_ns, report.level, f"{report.what}: {report.detail}")
        return replace(found, events=(*found.events, event))

    def estimate_at(self, time_ns: int) -> TargetState:
        """Return the estimator's prediction, or the continued estimate if it has failed."""

        def checked() -> TargetState:
            found = self._inner.estimate_at(time_ns)
            _check_target(found, time_ns, self._chasers)
            return found

        found = None if self._continues else self._guarded("estimate_at", checked, None)
        return self._continued(time_ns) if found is None else found

    @property
    def shape(self) -> tuple[BodyShape, Array] | None:
        """Return the estimator's shape; None if it fails."""

        def checked() -> tuple[BodyShape, Array] | None:
            found = self._inner.shape
            if found is not None:
                _check("shape", found[0], BodyShape)
                _check_covariance("the shape's covariance", found[1], (SHAPE, SHAPE))
            return found

        return self._guarded("shape", checked, None)

    def disturbed_motion(self, chaser: int) -> DisturbedMotion | None:
        """Return what the estimator knows of a coast; None if it fails: nothing is certified."""

        def checked() -> DisturbedMotion | None:
            found = self._inner.disturbed_motion(chaser)
            if found is not None:
                _check("disturbed_motion", found, DisturbedMotion)
            return found

        return self._guarded("disturbed_motion", checked, None)

    @property
    def reinitialisations(self) -> int:
        """Return the estimator's count; 0 if it fails."""
        return self._guarded("reinitialisations", lambda: int(self._inner.reinitialisations), 0)

    def without_drift(self, odometry: Odometry) -> Odometry:
        """Return what the estimator makes of odometry; the same if it fails."""

        def checked() -> Odometry:
            found = self._inner.without_drift(odometry)
            if not isinstance(found, Odometry):
                raise TypeError(f"without_drift() returned {type(found).__name__}, not Odometry")
            _check_values("position_m", np.array(found.position_m), _3)
            _check_values("q_wxyz", np.array(found.q_wxyz), _4)
            return found

        return self._guarded("without_drift", checked, odometry)

    def disturb(self, shock: Shock) -> None:
        """Pass on a shock."""
        self._guarded("disturb", lambda: self._inner.disturb(shock), None)

    def change_body(self, body: TargetBody, covariance: Array) -> None:
        """Pass on a change of the body. It raises nothing."""
        self._guarded("change_body", lambda: self._inner.change_body(body, covariance), None)

    def _guarded(self, call: str, function: Callable[[], ResultT], otherwise: ResultT) -> ResultT:
        """Return the result of ``function``, and ``otherwise`` with a note if it fails."""
        try:
            return function()
        except Exception as error:  # an installed estimator may raise anything
            self._detail = self._detail or f"{call}: {text_of(error)}"
            return otherwise

    def _continued(self, time_ns: int) -> TargetState:
        """Return the last estimate, moved on at constant rates."""
        last = self._last
        if last is None or last.status == "none":
            return no_estimate(time_ns)
        dt_s = 1e-9 * (time_ns - last.time_ns)
        q, omega, turned = constant_rates(last.q_wxyz, last.omega_rad_s, dt_s)
        transition = np.eye(12)
        transition[:3, 3:6] = dt_s * np.eye(3)
        transition[6:, 6:] = turned
        lost = last.status == "lost" or self._watch.persists(FAILED)
        return TargetState(
            time_ns,
            last.position_m + dt_s * last.velocity_m_s,
            last.velocity_m_s,
            q,
            omega,
            transition @ last.covariance @ transition.T,
            "lost" if lost else "predicting",
            0,
            (),
        )


def _check_estimate(found: Any, time_ns: int, chasers: int) -> None:
    """Raise TypeError or ValueError unless the result of an update may be used."""
    if not isinstance(found, Estimate):
        raise TypeError(f"returned {type(found).__name__}, not an Estimate")
    _check_target(found.target, time_ns, chasers)
    _check_numbers("chasers", [motion.chaser for motion in found.chasers], chasers)
    for motion in found.chasers:
        name = f"chaser {motion.chaser}"
        _check(name, motion, ChaserMotion)
        if motion.relative is not None:
            _check(f"{name}, relative", motion.relative, RelativePose)
            if motion.relative.random_covariance is not None:
                _check_covariance(
                    f"{name}, random_covariance", motion.relative.random_covariance, _6x6
                )
        if motion.camera is not None:
            _check(f"{name}, camera", motion.camera, CameraError)
            _check_values(f"{name}, focal_share", np.array(motion.camera.focal_share), ())
    for innovation in found.innovations or ():
        _check_innovation(innovation, chasers)
    for event in found.events:
        if event.level not in _LEVELS or not isinstance(event.text, str):
            raise ValueError(f"event {event!r} must have a level of {_LEVELS} and a text")


def _check_innovation(found: Any, chasers: int) -> None:
    if not isinstance(found, Innovation):
        raise TypeError(f"innovations hold a {type(found).__name__}, not an Innovation")
    _check_numbers("innovations, chaser", [found.chaser], chasers)
    if not 0.0 <= found.squared <= MAX_MAGNITUDE or found.freedoms < 1:
        raise ValueError(
            f"innovations, chaser {found.chaser}: squared must be from 0 to {MAX_MAGNITUDE:g}, "
            f"freedoms from 1 on: {found.squared!r}, {found.freedoms!r}"
        )


def _check_target(found: Any, time_ns: int, chasers: int) -> None:
    _check("target", found, TargetState)
    if found.time_ns != time_ns:
        raise ValueError(f"target.time_ns must be {time_ns}, not {found.time_ns!r}")
    if found.status not in _STATUS:
        raise ValueError(f"target.status must be one of {_STATUS}, not {found.status!r}")
    _check_numbers("target.rejected", found.rejected, chasers)


def _check_numbers(name: str, found: Any, chasers: int) -> None:
    """Raise ValueError unless these are different numbers of chasers."""
    known = range(chasers)
    if len(set(found)) != len(found) or not all(type(i) is int and i in known for i in found):
        raise ValueError(f"{name} must be different numbers from 0 to {chasers - 1}: {found!r}")


def _check(name: str, found: Any, kind: type) -> None:
    """Raise TypeError unless ``found`` is of a kind, ValueError for arrays that it may not have."""
    if not isinstance(found, kind):
        raise TypeError(f"{name} is a {type(found).__name__}, not a {kind.__name__}")
    for field, shape in _SHAPES[kind].items():
        value = getattr(found, field)
        if field == "covariance":
            _check_covariance(f"{name}, {field}", value, shape)
        else:
            _check_values(f"{name}, {field}", value, shape)
        if field == "q_wxyz" and abs(np.linalg.norm(value) - 1.0) > UNIT_QUATERNION_TOLERANCE:
            raise ValueError(f"{name}, {field} is of length {np.linalg.norm(value):g}, not 1")


def _check_values(name: str, value: Any, shape: tuple[int, ...]) -> None:
    if not isinstance(value, np.ndarray) or value.dtype != np.float64 or value.shape != shape:
        raise TypeError(f"{name} must be an array {shape} of float64")
    if not (np.abs(value) <= MAX_MAGNITUDE).all():
        raise ValueError(f"{name} holds a value that is not finite or beyond {MAX_MAGNITUDE:g}")


def _check_covariance(name: str, value: Any, shape: tuple[int, ...]) -> None:
    _check_values(name, value, shape)
    if value.diagonal().min() < 0.0:
        raise ValueError(f"{name} has a negative variance")
    if np.abs(value - value.T).max() > _ASYMMETRY * np.abs(value).max():
        raise ValueError(f"{name} is not symmetric")
