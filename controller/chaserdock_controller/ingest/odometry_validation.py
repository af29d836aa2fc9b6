"""A chaser's odometry that jumps farther than it can have moved: the jump is taken out again, and told. No I/O.

Relative motion keeps a mission safe: whoever believes that it is suddenly somewhere else flies there, into the target if
that lies between. So the controller goes on from where the chaser must be; a jump back takes the correction away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.codec import vector
from chaserdock_protocol.extrapolation import extrapolate
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.messages.fields import Level
from chaserdock_protocol.scenario import Scenario

PLAUSIBLE_M = 0.02
PLAUSIBLE_RAD = math.radians(2.0)
LONGEST_S = 1.0
"""After longer silence anything is believed."""


@dataclass
class Known:
    last: Odometry
    """As corrected."""
    off_m: Array = field(default_factory=lambda: np.zeros(3))
    turn: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))

    @property
    def corrected(self) -> bool:
        return bool(np.any(self.off_m)) or bool(self.turn[0] != 1.0)


class OdometryValidation:
    """The odometry of all chasers, each as far as it can be believed."""

    def __init__(self, scenario: Scenario) -> None:
        body, o = scenario.chaser, scenario.odometry
        # Six sigma of the difference of two.
        self._noise_m = 6 * math.sqrt(2.0) * o.position_noise_m
        self._noise_rad = 6 * math.sqrt(2.0) * math.radians(o.attitude_noise_deg)
        self._slip_m_s = 6 * o.velocity_noise_m_s
        self._acceleration_m_s2 = math.sqrt(3.0) * body.force_max_N / body.mass_kg
        self._alpha_rad_s2 = math.sqrt(3.0) * body.torque_max_N_m / min(body.inertia)
        self._known: dict[int, Known] = {}

    def believed(self, odometry: Odometry) -> tuple[Odometry, list[tuple[Level, str]]]:
        """A chaser's next odometry, without jumps; what is to be told of it."""
        known = self._known.get(odometry.chaser)
        after_s = 0.0 if known is None else (odometry.sim_time_ns - known.last.sim_time_ns) / 1e9
        if known is None or not 0.0 < after_s <= LONGEST_S:
            self._known[odometry.chaser] = Known(odometry)
            return odometry, []
        ahead = extrapolate(known.last, odometry.tick, odometry.sim_time_ns)
        limit_m = (
            PLAUSIBLE_M + self._noise_m + self._slip_m_s * after_s + self._acceleration_m_s2 * after_s**2
        )
        limit_rad = PLAUSIBLE_RAD + self._noise_rad + self._alpha_rad_s2 * after_s**2

        def far(told: Odometry) -> tuple[float, float]:
            return math.dist(told.position_m, ahead.position_m), float(
                rotations.angle_between(told.q_wxyz, ahead.q_wxyz)
            )

        def plausible(told: Odometry) -> bool:
            off_m, off_rad = far(told)
            return off_m <= limit_m and off_rad <= limit_rad

        told: list[tuple[Level, str]] = []
        now = _without(odometry, known.off_m, known.turn)
        if plausible(now):
            known.last = now
            return now, told
        if known.corrected and plausible(odometry):
            self._known[odometry.chaser] = Known(odometry)
            return odometry, [
                ("info", f"chaser {odometry.chaser}: its odometry has jumped back, and is believed again")
            ]
        off_m, off_rad = far(now)
        text = f"its odometry jumped by {off_m * 1e3:.0f} mm, {math.degrees(off_rad):.1f} deg, which it cannot have moved"
        off = np.subtract(odometry.position_m, ahead.position_m)
        turn = rotations.multiply(rotations.conjugate(ahead.q_wxyz), odometry.q_wxyz)
        self._known[odometry.chaser] = Known(_without(odometry, off, turn), off, turn)
        return self._known[odometry.chaser].last, [
            ("warning", f"chaser {odometry.chaser}: {text}; taken out")
        ]


def _without(odometry: Odometry, off_m: Array, turn: Array) -> Odometry:
    """Odometry less an offset (WRF) and a turn (4,) (CRF); the very same when there is neither."""
    if not off_m.any() and turn[0] == 1.0:
        return odometry
    q = rotations.multiply(odometry.q_wxyz, rotations.conjugate(turn))
    return msgspec.structs.replace(
        odometry,
        position_m=vector(np.subtract(odometry.position_m, off_m)),
        q_wxyz=vector(rotations.normalize(q)),
    )
