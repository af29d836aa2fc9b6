# SPDX-License-Identifier: Apache-2.0
"""Base classes of the terms of the problem. A term is one cost or constraint, stated in one file of
`terms`.

A term is a frozen dataclass. Its fields are its settings, which are keys of the same names in the
scenario's sections ``controller`` and ``limits`` (default and range there). It also declares its
checks of a problem, the members of C's `Problem` (native/problem.c) that it fills, and the same
term in CasADi, which `ipopt` solves and tests compare with C.
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
    """Names and ctypes types of the term's members of `Problem`, in the order of that structure."""

    def check(self, problem: NmpcInput, n: int, d: int) -> Mapping[str, Array]:
        """Check the term's fields of ``problem`` for ``n`` chasers and ``d`` stages. Returns them
        expanded to contiguous arrays. Raises ValueError, naming the field.
        """
        return {}

    def of_lost(self, problem: NmpcInput, margins_m: Sequence[float]) -> Mapping[str, Array | None]:
        """Return the term's fields of an unchecked problem, extended by a row for each lost chaser.

        A lost chaser is an obstacle. ``margins_m``: added to the others' distances from it.
        """
        return {}


@dataclass(frozen=True)
class CostTerm(Term, ABC):
    """A term of the cost: a weighted sum of squares for each chaser and stage. Its member of
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
    """A term that restricts states or inputs. Unless it derives from a subclass below it has no
    twin in CasADi, and only `rti` keeps it.
    """

    @abstractmethod
    def native(self, problem: NmpcInput) -> Sequence[Any]:
        """Return the values of `MEMBERS` for a checked problem; `address_of` gives addresses of
        arrays.
        """


@dataclass(frozen=True)
class ChaserConstraint(Constraint, ABC):
    """A soft constraint of each chaser at stages 1..D: a margin (m) that is not to be negative."""

    DATA: ClassVar[int]
    """Number of values per chaser and stage that state the constraint."""

    def data(self, problem: NmpcInput) -> Array:
        """Return these values (N, D+1, DATA) from a checked problem."""
        return np.empty((*problem.references.shape[:2], 0))

    def applies(self, problem: NmpcInput) -> NDArray[np.bool_]:
        """Return at which chasers and stages (N, D+1) the constraint applies."""
        return np.ones(problem.references.shape[:2], dtype=bool)

    @abstractmethod
    def margin(self, stage: ChaserStage, data: Any) -> Any:
        """Return the margin of a chaser at a stage in CasADi; ``data`` (DATA,)."""


@dataclass(frozen=True)
class PairConstraint(Constraint, ABC):
    """A soft constraint of each pair of chasers, as `ChaserConstraint`, stated by one value."""

    @abstractmethod
    def data(self, problem: NmpcInput) -> Array:
        """Return these values from a checked problem, (N, N), symmetric."""

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
