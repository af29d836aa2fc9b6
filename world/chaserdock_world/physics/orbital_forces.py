# SPDX-License-Identifier: Apache-2.0
"""Compute the loads of an orbit on free bodies, for every physics step.

By them the motion in the Hill frame differs from that in free space. The Hill frame of the middle
of a tick holds for the whole tick: it changes by about 1e-4 of its rate from one to the next.
"""

from __future__ import annotations

from collections.abc import Sequence

from chaserdock_models.orbit import HillFrame, Scalars3
from chaserdock_models.relative_motion import relative_acceleration, relative_torque
from chaserdock_models.scalar_rotations import rotated_components

from chaserdock_world.orbit import TargetOrbit


class OrbitalForces:
    """Compute forces and torques of an orbit on bodies that an engine integrates by steps of
    ``step_s``.
    """

    def __init__(self, orbit: TargetOrbit, step_s: float, steps_per_tick: int) -> None:
        self._orbit, self._step_s, self._steps_per_tick = orbit, step_s, steps_per_tick
        self._frame: HillFrame = orbit.frame_at(0.0)
        self._drag: Scalars3 = (0.0, 0.0, 0.0)
        self._tick = -1
        self._last: dict[int, Scalars3] = {}

    def set_step(self, step: int) -> None:
        """Take the orbit of the tick of this physics step."""
        tick = step // self._steps_per_tick
        if tick == self._tick:
            return
        self._tick = tick
        time_s = (tick + 0.5) * self._steps_per_tick * self._step_s
        self._frame = self._orbit.frame_at(time_s)
        x, y, z = self._orbit.differential_drag(time_s).tolist()
        self._drag = (x, y, z)

    def force(
        self,
        body: int,
        mass_kg: float,
        position_m: Scalars3,
        velocity_m_s: Scalars3,
        has_drag: bool,
    ) -> list[float]:
        """Return the force (3,), WRF, at a body's centre of mass.

        The engines take the velocity at the end of a step for the whole step. So the acceleration
        is that at the middle of the step, with the velocity there from the acceleration of the last
        step; otherwise the Coriolis force would add energy.
        """
        h = 0.5 * self._step_s
        ax, ay, az = self._last.get(body, (0.0, 0.0, 0.0))
        x, y, z = position_m
        u, v, w = velocity_m_s
        middle = (x + h * u, y + h * v, z + h * w)
        found = relative_acceleration(self._frame, middle, (u + h * ax, v + h * ay, w + h * az))
        self._last[body] = found
        drag = self._drag if has_drag else (0.0, 0.0, 0.0)
        return [mass_kg * (a + d) for a, d in zip(found, drag, strict=True)]

    def torque(
        self, q_wxyz: Sequence[float], omega_world: Sequence[float], moments: Scalars3
    ) -> tuple[float, ...]:
        """Return the torque (3,) about a body's principal axes, in these axes.

        ``omega_world``: rate in world axes.
        """
        w, x, y, z = q_wxyz
        a, b, c = rotated_components(w, -x, -y, -z, *omega_world)
        return relative_torque(self._frame, (w, x, y, z), (a, b, c), moments)
