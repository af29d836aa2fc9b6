# SPDX-License-Identifier: Apache-2.0
"""Array interface of the joint filter's compiled kernels (`native`); names are the same.

A mean is one array: position, velocity, attitude and rate of the target (13), then for each chaser
the same and its additive states (44). Within an update only the lower triangle of a covariance is
valid; ``complete`` fills the upper one.
"""

from __future__ import annotations

import ctypes
import itertools
from ctypes import Structure, c_double, c_int64, c_void_p
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.native import address, location, scratch
from numpy.typing import NDArray

from chaserdock_controller.bodies.body_shape import SHAPE

from .native import LIBRARY, function

# Numbers of doubles in the kernels' arrays: see native/layout.h.
TARGET_MEAN, CHASER_MEAN = 13, 44
TARGET, CHASER = 12, 43
"""Components of the target's error, and of a chaser's."""
MOST_ROWS = 18
"""Largest number of rows that a chaser measures in a tick: 6 of a sighting, 12 of odometry."""
# Components of the error that a chaser's measurements depend on (see native/layout.h).
_SEEN = TARGET + CHASER
# Number of gated channels (`state.CHANNELS`).
_CHANNELS = 5


@LIBRARY.structure("Motion")
class MotionParameters(Structure):
    """`Motion` of native/motion.c."""

    _fields_ = [
        ("dt", c_double),
        ("mass", c_double),
        ("inertia", c_double * 3),
        *(
            (name, c_double)
            for name in (
                "mean_motion", "fade_position", "fade_attitude", "unknown_s", "control_force_share",
                "control_torque_share",
                "control_arm", "force_max", "torque_max", "disturbance_force", "disturbance_torque",
                "latched_acceleration",
                "latched_angular_acceleration",
            )
        ),
    ]  # fmt: skip


@LIBRARY.structure("Measurement")
class _Measurement(Structure):
    _fields_ = [
        ("n", c_int64),
        ("i", c_int64),
        *(
            (name, c_void_p)
            for name in (
                "lens",
                "axes",
                "camera",
                "odometry",
                "odometry_noise",
                "sighting",
                "stated",
                "view",
            )
        ),
        ("white_ratio", c_double),
        ("view_ratio", c_double),
    ]


@LIBRARY.structure("Innovation")
class _Innovation(Structure):
    _fields_ = [
        *(
            (name, c_void_p)
            for name in (
                "residual",
                "jacobian",
                "noise",
                "s",
                "cross",
                "white",
                "correction",
                "values",
            )
        ),
        ("stride", c_int64),
        ("size", c_int64),
    ]


class NativeMeasurement:
    """Odometry and sighting of chaser ``i`` of ``n`` for the kernels; one of them may be None.

    ``mounting``: lens (3,), camera axes (3, 3), attitude (4,). ``odometry``: (13,) and noise (12,
    12). ``sighting``: pose (7,) in IRF; stated covariance (6, 6); covariance (6, 6) that defines
    the unit of the view error; ratios of white noise and view error to them.
    """

    def __init__(
        self,
        n: int,
        i: int,
        mounting: tuple[Array, Array, Array],
        odometry: tuple[Array, Array] | None,
        sighting: tuple[Array, Array, Array, float, float] | None,
    ) -> None:
        self.rows = (0 if odometry is None else 12) + (0 if sighting is None else 6)
        self.chaser, self.n = i, n
        self._kept = mounting, odometry, sighting  # the kernels hold addresses of these arrays
        state, noise = (None, None) if odometry is None else map(location, odometry)
        seen = (None, None, None, 0.0, 0.0)
        if sighting is not None:
            seen = (*map(location, sighting[:3]), *sighting[3:])
        self.native = _Measurement(n, i, *map(location, mounting), state, noise, *seen)


class JointInnovation:
    """Working memory of a tick's updates for a covariance (D, D) and a mean; `Innovation` of
    native/update.c.
    """

    def __init__(self, n: int, size: int) -> None:
        stride = -(-size // 8) * 8
        sizes = (
            MOST_ROWS, MOST_ROWS * _SEEN, MOST_ROWS**2, MOST_ROWS**2, MOST_ROWS * stride,
            MOST_ROWS * stride, size,
            _CHANNELS + 1,
        )  # fmt: skip
        *starts, end = itertools.accumulate(sizes, initial=0)
        memory = scratch(end)
        self.correction: Array = memory[starts[-2] : starts[-1]]
        """Last correction (D,)."""
        self.values: Array = memory[starts[-1] :]
        begin = location(memory)
        self._native = _Innovation(*(begin + 8 * start for start in starts), stride, size)
        self._work = scratch(_work_size("innovate_workspace", size))
        self._address, self._work_address = ctypes.byref(self._native), address(self._work)
        self._n = c_int64(n)

    def innovate(self, z: NativeMeasurement, mean: Array, prior: Array, covariance: Array) -> None:
        """Compute the innovation of measurements linearized at ``mean``, relative to ``prior`` (may
        be the same array).
        """
        function("innovate")(
            ctypes.byref(z.native), address(mean), address(prior), address(covariance),
            self._address, self._work_address
        )  # fmt: skip

    def correct(
        self, z: NativeMeasurement, used: NDArray[np.int64], prior: Array, mean: Array
    ) -> bool:
        """Write ``prior``, corrected by the rows ``used``, to ``mean``. Returns False if the
        innovation covariance of these rows is not positive definite.
        """
        return bool(
            function("correct", c_int64)(
                self._n, c_int64(z.rows), address(used), c_int64(len(used)), self._address,
                address(prior), address(mean)
            )
        )  # fmt: skip

    def reduce(self, z: NativeMeasurement, rows: int, covariance: Array) -> None:
        """Reduce the covariance by the last correction, which used ``rows`` rows."""
        function("reduce")(c_int64(z.chaser), c_int64(rows), self._address, address(covariance))


def _error_size(n: int) -> int:
    """Return the number of error components of a target without shape and ``n`` chasers."""
    return TARGET + CHASER * n


def check_size(mean: Array, covariance: Array) -> int:
    """Return the number of chasers of a state. Raises ValueError if the covariance does not match,
    with or without a shape.
    """
    n, rest = divmod(mean.size - TARGET_MEAN, CHASER_MEAN)
    size = _error_size(n)
    if rest or covariance.shape not in ((size, size), (size + SHAPE, size + SHAPE)):
        raise ValueError(f"a state of {n} chasers with a covariance of shape {covariance.shape}")
    return n


def _work_size(name: str, *sizes: int) -> int:
    return function(name, c_int64)(*map(c_int64, sizes))


def complete(covariance: Array) -> None:
    """Make a covariance (D, D) symmetric by its lower triangle."""
    function("complete")(c_int64(len(covariance)), address(covariance))


def predict(
    motion: MotionParameters,
    target: Array,
    target_noise: Array,
    given: Array,
    orbital: Array,
    fade_view: Array,
    prior: Array,
    alive: NDArray[np.int64],
    latched: NDArray[np.int64],
    mean: Array,
    covariance: Array,
) -> Array:
    """Predict the chasers of ``mean`` in place and return the covariance (D, D); `predict` of
    native/covariance.c.

    Raises ValueError for sizes that contradict each other, as in a damaged checkpoint.
    """
    n = check_size(mean, covariance)
    if any(len(a) != n for a in (given, orbital, fade_view, alive, latched)):
        raise ValueError(f"a state of {n} chasers with other numbers of chasers in its fields")
    out = np.empty_like(covariance)
    work = scratch(_work_size("predict_workspace", n, len(covariance)))
    arrays: tuple[NDArray[Any], ...] = (
        target, target_noise, given, orbital, fade_view, prior, alive, latched, mean, covariance,
        out, work,
    )  # fmt: skip
    function("predict")(
        ctypes.byref(motion), c_int64(n), c_int64(len(covariance)), *map(address, arrays)
    )
    return out


def wrench_at_origin(
    wrench: Array, centre_m: Array, omega_rad_s: Array, mass_kg: float, inertia: Array
) -> Array:
    """Return the wrench (6,) that moves a body with its centre of mass at the origin as ``wrench``
    moves one with it at ``centre_m`` (3,); native/motion.c.
    """
    out = np.empty(6)
    function("wrench_at_origin")(
        address(wrench), address(centre_m), address(omega_rad_s), c_double(mass_kg),
        address(inertia), address(out)
    )  # fmt: skip
    return out


def linearize(z: NativeMeasurement, mean: Array) -> tuple[Array, Array, Array]:
    """Return residual (k,), Jacobian (k, 55) by the errors of target and chaser, and noise
    covariance (k, k).
    """
    k = z.rows
    out = np.empty(k), np.empty((k, _SEEN)), np.empty((k, k))
    function("linearize")(ctypes.byref(z.native), address(mean), *map(address, out))
    return out


def predict_sighting(
    mean: Array, i: int, mounting: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Return the predicted pose (7,) of the target in IRF and its Jacobian (6, 55), without the
    view error.
    """
    pose, jacobian = np.empty(7), np.empty((6, _SEEN))
    function("predict_sighting")(
        address(mean), c_int64(i), *map(address, mounting), address(pose), address(jacobian)
    )
    return pose, jacobian


def difference(a: Array, b: Array) -> Array:
    """Return the error (D,) that takes the mean ``a`` to ``b``."""
    n = (len(a) - TARGET_MEAN) // CHASER_MEAN
    error = np.empty(_error_size(n))
    function("difference")(c_int64(n), address(a), address(b), address(error))
    return error


def inject(mean: Array, error: Array) -> Array:
    """Return the mean corrected by an error (D,)."""
    out = np.empty_like(mean)
    n = (len(mean) - TARGET_MEAN) // CHASER_MEAN
    function("inject")(c_int64(n), address(mean), address(error), address(out))
    return out
