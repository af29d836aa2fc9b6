# SPDX-License-Identifier: Apache-2.0
"""Motion of the stack: the target with the chasers that are latched to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, Vector3
from numpy.typing import NDArray

from .flight import RecordedFlight
from .motion import TARGET


@dataclass(frozen=True)
class RecordedStack:
    """Motion of a stack at times (K,) s: angular rate (K,) of the target, speed (K,) of the common
    centre of mass (WRF), and magnitude (K,) of the angular momentum about that centre.
    """

    time_s: Array
    rate_rad_s: Array
    speed_m_s: Array
    angular_momentum_N_m_s: Array


def stack_motion(
    flight: RecordedFlight, members: Mapping[int, NDArray[np.bool_] | None]
) -> RecordedStack | None:
    """Return the motion of the target with ``members``: chasers, and when (K,) each belongs to the
    stack; None: always. None if the motion of one of them, or its rates, is not known.
    """
    names = {"target": None} | {f"chaser/{i}": when for i, when in members.items()}
    if any(name not in flight.motion for name in names) or not flight.motion.has_rates():
        return None
    tracks = {name: flight.motion[name] for name in names}
    n = min(len(track.time_s) for track in tracks.values())
    parts = []
    for name, track in tracks.items():
        mass_kg, centre_m, inertia = _mass_properties(flight, name)
        q, omega = track.q_wxyz[:n], track.omega_rad_s[:n]
        place = track.position_m[:n] + rotations.rotate(q, np.broadcast_to(centre_m, (n, 3)))
        velocity = track.velocity_m_s[:n] + rotations.rotate(q, np.cross(omega, centre_m))
        spin = rotations.rotate(q, omega @ inertia.T)
        when = names[name]
        share = np.ones(n) if when is None else when[:n].astype(float)
        parts.append(((share * mass_kg)[:, None], place, velocity, share[:, None] * spin))
    mass = sum(m for m, *_ in parts)
    centre = sum(m * place for m, place, *_ in parts) / mass
    moving = sum(m * velocity for m, _, velocity, _ in parts) / mass
    momentum = sum(spin + m * np.cross(r - centre, v - moving) for m, r, v, spin in parts)
    target = tracks[TARGET]
    return RecordedStack(
        target.time_s[:n],
        np.linalg.norm(target.omega_rad_s[:n], axis=1),
        np.linalg.norm(moving, axis=1),
        np.linalg.norm(momentum, axis=1),
    )


def _mass_properties(flight: RecordedFlight, name: str) -> tuple[float, Vector3, Array]:
    """Return mass, kg, centre of mass, m, and inertia (3, 3) about it, kg m^2, of a body in its
    axes: the true ones, or else those stated.
    """
    for drawn in flight.drawn:
        if drawn.body == name:
            inertia = np.reshape(drawn.inertia_kg_m2, (3, 3))
            return drawn.mass_kg, drawn.centre_of_mass_m, inertia
    if name == TARGET:
        target = flight.scenario.target
        return target.mass_kg, target.centre_of_mass_m, target.inertia_tensor
    chaser = flight.scenario.chaser
    return chaser.mass_kg, (0.0, 0.0, 0.0), np.diag(chaser.inertia)
