# SPDX-License-Identifier: Apache-2.0
"""Mass properties and frequencies of a rigid body that carries masses on springs.

A mode of a panel, or of fuel that sloshes, acts on the body that carries it as a mass on a spring
does: the effective mass of a mode with its base held (W. C. Hurty 1965; P. W. Likins 1970).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .arrays import Array


class MassDistribution(NamedTuple):
    """Mass, centre of mass (3,) and inertia (3, 3) about it, in one frame."""

    mass_kg: float
    centre_m: Array
    inertia_kg_m2: Array


def _parallel_axis(mass_kg: float, place_m: Array) -> Array:
    """Return the inertia (3, 3) about the origin of a point mass."""
    x, y, z = place_m.tolist()
    r = np.array([x, y, z])
    return mass_kg * ((x * x + y * y + z * z) * np.eye(3) - np.outer(r, r))


def rigid_rest(whole: MassDistribution, masses_kg: Array, places_m: Array) -> MassDistribution:
    """Return what is left of a body without point masses (n,) at ``places_m`` (n, 3).

    Frame as of ``whole``. The result need not be a body that can exist: see ``rest_fault``.
    """
    mass = whole.mass_kg - float(masses_kg.sum())
    centre = (whole.mass_kg * whole.centre_m - masses_kg @ places_m) / mass
    inertia = whole.inertia_kg_m2 + _parallel_axis(whole.mass_kg, whole.centre_m)
    for m, place in zip(masses_kg.tolist(), places_m, strict=True):
        inertia = inertia - _parallel_axis(m, place)
    return MassDistribution(mass, centre, inertia - _parallel_axis(mass, centre))


def rest_fault(rest: MassDistribution) -> str:
    """Return why no rigid body has these mass properties; empty if one has."""
    moments = np.linalg.eigvalsh(rest.inertia_kg_m2)
    if moments[0] > 0.0 and 2.0 * moments[2] <= moments.sum() * (1.0 + 1e-9):
        return ""
    named = ", ".join(f"{m:.4g}" for m in moments.tolist())
    return f"no body has the inertia of its rigid rest, with principal moments {named} kg m²"


def frequencies_hz(
    rest: MassDistribution, masses_kg: Array, places_m: Array, held_hz: Array
) -> Array:
    """Return the frequencies (3 n,), ascending, of a free body with masses on springs.

    ``held_hz`` (n, 3): of each mass along each axis while the body is held. The free body's are
    higher, as it moves against the masses.
    """
    n = len(masses_kg)
    inverse = np.zeros((6 + 3 * n, 6 + 3 * n))
    inverse[:3, :3] = np.eye(3) / rest.mass_kg
    inverse[3:6, 3:6] = np.linalg.inv(rest.inertia_kg_m2)
    inverse[6:, 6:] = np.diag(np.repeat(1.0 / masses_kg, 3))
    # Stretch of the springs by displacement and rotation of the rest, and the displacements.
    stretch = np.zeros((3 * n, 6 + 3 * n))
    stretch[:, 6:] = np.eye(3 * n)
    for k, (x, y, z) in enumerate((places_m - rest.centre_m).tolist()):
        rows = slice(3 * k, 3 * k + 3)
        stretch[rows, :3] = -np.eye(3)
        stretch[rows, 3:6] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    root = np.sqrt(np.repeat(masses_kg, 3)) * (2.0 * math.pi * held_hz.ravel())
    coupled = root[:, None] * (stretch @ inverse @ stretch.T) * root
    return np.sqrt(np.maximum(np.linalg.eigvalsh(coupled), 0.0)) / (2.0 * math.pi)
