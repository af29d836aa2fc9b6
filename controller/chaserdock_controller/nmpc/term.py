# SPDX-License-Identifier: Apache-2.0
"""A term of the problem: one cost or constraint, stated in one file of `terms`.

A term is a frozen dataclass. Its fields are its settings: keys of the scenario's sections
``controller`` and ``limits`` with the same names, which state default and range. Beside them it
declares what it checks of a problem, the members of C's `Problem` (native/problem.c) that it fills,
and the same term in CasADi, which `ipopt` solves and the tests compare with C.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from ctypes import c_void_p
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.native import location
from numpy.typing import NDArray

from .kernels import sign_of
from .types import NmpcInput


@dataclass(frozen=True)
class Term:
    """Base of all terms."""

    MEMBERS: ClassVar[tuple[tuple[str, Any], ...]]
    """Name and ctypes type of its members of `Problem`, in the order of that structure."""

    def check(self, problem: NmpcInput, n: int, d: int) -> Mapping[str, Array]:
        """Return its fields of ``problem``, for ``n`` chasers and ``d`` stages, expanded as
        contiguous arrays. Raises ValueError, naming the field.
        """
        return {}

    def of_lost(self, problem: NmpcInput, margins_m: Sequence[float]) -> Mapping[str, Array | None]:
        """Return its fields of a problem that is not checked yet with a row more for each lost
        chaser, an obstacle; ``margins_m``: added to the others' distances from it.
        """
        return {}


@dataclass(frozen=True)
class CostTerm(Term, ABC):
    """A term of the cost: a weighted sum of squares of each chaser at each stage. Its member of
    `Problem` are the weights.
    """

    @abstractmethod
    def weights(self, falling: Array) -> Array:
        """Return the weights at stages 0..D, (D+1,) or (D+1, W); ``falling`` (D+1,): the factors by
        which stage weights fall off along the horizon.
        """

    @abstractmethod
    def cost(self, stage: ChaserStage, weights: Any) -> Any:
        """Return the cost of a chaser at a stage in CasADi; ``weights`` (W,): those of the
        stage.
        """


@dataclass(frozen=True)
class Constraint(Term, ABC):
    """A term that restricts states or inputs. One that is not among its subclasses below has no
    twin in CasADi: only `rti` keeps it.
    """

    @abstractmethod
    def native(self, problem: NmpcInput) -> Sequence[Any]:
        """Return the values of `MEMBERS` for a checked problem; addresses by `address_of`."""


@dataclass(frozen=True)
class ChaserConstraint(Constraint, ABC):
    """A constraint of each chaser: a margin (m) that is not negative, soft, at stages 1..D."""

    DATA: ClassVar[int]
    """Number of values that a problem states of it for each chaser and stage."""

    def data(self, problem: NmpcInput) -> Array:
        """Return these values (N, D+1, DATA) of a checked problem."""
        return np.empty((*problem.references.shape[:2], 0))

    def applies(self, problem: NmpcInput) -> NDArray[np.bool_]:
        """Return for which chasers and stages (N, D+1) it applies."""
        return np.ones(problem.references.shape[:2], dtype=bool)

    @abstractmethod
    def margin(self, stage: ChaserStage, data: Any) -> Any:
        """Return the margin of a chaser at a stage in CasADi; ``data`` (DATA,)."""


@dataclass(frozen=True)
class PairConstraint(Constraint, ABC):
    """A constraint of each pair of chasers, as `ChaserConstraint`; one value states it."""

    @abstractmethod
    def data(self, problem: NmpcInput) -> Array:
        """Return these values of a checked problem, (N, N), symmetric."""

    @abstractmethod
    def margin(self, one: Any, other: Any, data: Any) -> Any:
        """Return the margin of two chasers in states ``one`` and ``other`` (13) in CasADi."""


@dataclass(frozen=True)
class ChaserStage:
    """CasADi expressions of a chaser at a stage: state (13), reference (7), target position (3),
    input (6) and its reference (6), both zero at stage D.
    """

    x: Any
    reference: Any
    target: Any
    u: Any
    u_ref: Any


def pointer(name: str) -> tuple[str, Any]:
    """Return a member of `Problem` that points to an array."""
    return name, c_void_p


def address_of(value: Array | float | None) -> int:
    """Return the address of a field that `Term.check` has expanded."""
    assert isinstance(value, np.ndarray)
    return location(value)


def require_positive(owner: object, *names: str) -> None:
    """Raise ValueError for an attribute that is not positive and finite."""
    for name in names:
        value = getattr(owner, name)
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} must be positive and finite, not {value!r}")


def require_not_negative(owner: object, *names: str) -> None:
    """Raise ValueError for an attribute that is negative or not finite."""
    for name in names:
        value = getattr(owner, name)
        if not (math.isfinite(value) and value >= 0.0):
            raise ValueError(f"{name} must be finite and not negative, not {value!r}")


def checked_array(
    name: str, value: object, shape: tuple[int, ...], negative: bool = False
) -> Array:
    """Return a contiguous copy of ``value``. Raises ValueError for another shape, a value that is
    not finite, or a negative one unless ``negative`` allows it.
    """
    array = np.array(value, dtype=np.float64, order="C")
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {array.shape}")
    code = sign_of(array)
    if code == 1:
        raise ValueError(f"{name} holds a value that is not finite")
    if code == 2 and not negative:
        raise ValueError(f"{name} must not be negative")
    return array
