# SPDX-License-Identifier: Apache-2.0
"""Simulate a closed latch with play, or one that slips.

Between probe and port act a spring and a damper with a dead zone and a grip. Within the play
nothing acts. Beyond it the latch is as stiff as a contact. A load above the grip moves the place at
which the probe is held (Coulomb friction). A latch without play that does not slip is a rigid joint
instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState

STIFFNESS_N_M, DAMPING_N_S_M = 1e4, 200.0
"""Stiffness and damping at the end of the play: as stiff as a contact
(``definitions.ContactParameters``), with the damping of both bodies of one.
"""
TURN_STIFFNESS_N_M_RAD, TURN_DAMPING_N_M_S_RAD = 1000.0, 20.0
"""Stiffness and damping of a rotation about the tip: those above at an arm of 0.32 m, as of a body
of that length.
"""
ENGAGED_M = 0.02
"""Slip of a probe, m, above which it is out of its port."""


@dataclass(frozen=True)
class Grip:
    """Largest force and torque that a latch transmits without slipping."""

    force_N: float = math.inf
    torque_N_m: float = math.inf


@dataclass
class CompliantLatch:
    """A closed latch.

    ``anchor_m`` (3,) and ``anchor_q_wxyz`` (4,): where it holds the tip, and the chaser's attitude
    there, TRF. ``play_m``, ``play_rad``: motion on either side without a load. ``slipped_m``:
    displacement of the anchor since the latch closed.
    """

    anchor_m: Array
    anchor_q_wxyz: Array
    play_m: float = 0.0
    play_rad: float = 0.0

    def __post_init__(self) -> None:
        self._closed_at_m = self.anchor_m

    @property
    def slipped_m(self) -> float:
        return float(np.linalg.norm(self.anchor_m - self._closed_at_m))

    def load(
        self, target: BodyState, chaser: BodyState, reach_m: float, grip: Grip
    ) -> tuple[Array, Array, Array]:
        """Return force (3,) and torque (3,) about the tip on the port, and the tip (3,); all WRF.

        Moves the anchor in a slip. ``reach_m``: distance of the tip from the chaser's origin along
        +X.
        """
        arm = rotations.rotate(chaser.q_wxyz, np.array([reach_m, 0.0, 0.0]))
        tip = chaser.position_m + arm

        # Velocity and rate of the tip relative to the port.
        turn = rotations.rotate(chaser.q_wxyz, chaser.omega_rad_s) - rotations.rotate(
            target.q_wxyz, target.omega_rad_s
        )
        spin = rotations.rotate(target.q_wxyz, target.omega_rad_s)
        velocity = chaser.velocity_m_s + rotations.cross(turn + spin, arm)
        velocity = velocity - target.velocity_m_s - rotations.cross(spin, tip - target.position_m)

        # Displacement from the anchor, TRF.
        place = rotations.rotate_inverse(target.q_wxyz, tip - target.position_m)
        attitude = rotations.multiply(rotations.conjugate(target.q_wxyz), chaser.q_wxyz)
        turned = rotations.multiply(attitude, rotations.conjugate(self.anchor_q_wxyz))

        force, slip = _transmitted(
            place - self.anchor_m,
            rotations.rotate_inverse(target.q_wxyz, velocity),
            self.play_m,
            (STIFFNESS_N_M, DAMPING_N_S_M),
            grip.force_N,
        )
        torque, slip_rad = _transmitted(
            rotations.log(turned),
            rotations.rotate_inverse(target.q_wxyz, turn),
            self.play_rad,
            (TURN_STIFFNESS_N_M_RAD, TURN_DAMPING_N_M_S_RAD),
            grip.torque_N_m,
        )

        self.anchor_m = self.anchor_m + slip
        if slip_rad.any():
            self.anchor_q_wxyz = rotations.multiply(rotations.exp(slip_rad), self.anchor_q_wxyz)
        return rotations.rotate(target.q_wxyz, force), rotations.rotate(target.q_wxyz, torque), tip


def _transmitted(
    displacement: Array, rate: Array, play: float, spring: tuple[float, float], grip: float
) -> tuple[Array, Array]:
    """Return the load (3,) that a displacement (3,) at a rate (3,) transmits, and the anchor's slip
    (3,).
    """
    stiffness, damping = spring
    size = float(np.linalg.norm(displacement))
    if size < play or (size == 0.0 and play > 0.0):
        return np.zeros(3), np.zeros(3)
    beyond = displacement * (1.0 - play / size) if size > 0.0 else displacement
    load, slip = stiffness * beyond + damping * rate, np.zeros(3)
    if (strain := stiffness * float(np.linalg.norm(beyond))) > grip:
        slip = beyond * (1.0 - grip / strain)
    if (most := float(np.linalg.norm(load))) > grip:
        load = load * (grip / most)
    return load, slip
