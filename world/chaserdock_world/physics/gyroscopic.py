# SPDX-License-Identifier: Apache-2.0
"""Compute the torque that makes an engine's integration of rotation second order.

The engines evaluate the gyroscopic torque omega x I omega at the beginning of a step, so that
angular momentum drifts in proportion to the step. The midpoint rule evaluates it in the middle of
the step; the difference is applied as an external torque.
"""

from __future__ import annotations

from collections.abc import Sequence

from chaserdock_models.arrays import Array, IntArray

from .engine import PlacementPath, RigidBodyEngine


def _gyroscopic_torque(
    inertia: Sequence[float], a: float, b: float, c: float
) -> tuple[float, float, float]:
    """Return omega x I omega for principal moments ``inertia`` and rates (a, b, c)."""
    ia, ib, ic = inertia
    return (b * c * (ic - ib), c * a * (ia - ic), a * b * (ib - ia))


def _rotate_to_body(
    q_wxyz: Sequence[float], omega_world: Sequence[float]
) -> tuple[float, float, float]:
    """Return a rate in body axes: q* omega q."""
    w, x, y, z = q_wxyz
    u, v, s = omega_world
    tx, ty, tz = 2.0 * (v * z - s * y), 2.0 * (s * x - u * z), 2.0 * (u * y - v * x)
    return (
        u + w * tx + ty * z - tz * y,
        v + w * ty + tz * x - tx * z,
        s + w * tz + tx * y - ty * x,
    )


def midpoint_torque(
    inertia: Sequence[float],
    q_wxyz: Sequence[float],
    omega_world: Sequence[float],
    torque: Sequence[float],
    step_s: float,
) -> tuple[float, float, float]:
    """Return the torque (3,), N m, body axes, to add to ``torque`` for one step of ``step_s``.

    ``torque`` (3,): N m, body axes. ``inertia``: principal moments, kg m^2. ``q_wxyz``: attitude
    body to world. ``omega_world``: rate in world axes, rad/s. Plain floats, as this runs for every
    body in every physics step.
    """
    a, b, c = _rotate_to_body(q_wxyz, omega_world)
    ia, ib, ic = inertia
    # _gyroscopic_torque, twice, without the calls.
    ab, bc, ca = ib - ia, ic - ib, ia - ic
    gx, gy, gz = b * c * bc, c * a * ca, a * b * ab
    h = 0.5 * step_s
    ma = a + h * (torque[0] - gx) / ia
    mb = b + h * (torque[1] - gy) / ib
    mc = c + h * (torque[2] - gz) / ic
    return (gx - mb * mc * bc, gy - mc * ma * ca, gz - ma * mb * ab)


def midpoint_torque_of_rates(
    inertia: Sequence[float],
    q_wxyz: Sequence[float],
    omega_world: Sequence[float],
    omega_world_before: Sequence[float],
) -> tuple[float, float, float]:
    """Return the torque of ``midpoint_torque`` for a body with a joint.

    The constraint torque is not known in advance. So the rate in the middle of the step is
    extrapolated from that of the previous step, ``omega_world_before``.
    """
    middle = [a + 0.5 * (a - b) for a, b in zip(omega_world, omega_world_before, strict=True)]
    gx, gy, gz = _gyroscopic_torque(inertia, *_rotate_to_body(q_wxyz, omega_world))
    nx, ny, nz = _gyroscopic_torque(inertia, *_rotate_to_body(q_wxyz, middle))
    return (gx - nx, gy - ny, gz - nz)


def split_loads(
    bodies: IntArray, loads: Array
) -> list[tuple[int, list[float], list[float], list[float]]]:
    """Return body, principal moments, force and torque of each row of ``loads``.

    As ``RigidBodyEngine.advance`` takes them.
    """
    return [
        (b, row[:3], row[3:6], row[6:])
        for b, row in zip(bodies.tolist(), loads.tolist(), strict=True)
    ]


def advance_free(
    engine: RigidBodyEngine,
    bodies: IntArray,
    loads: Array,
    steps: int,
    path: PlacementPath | None,
    step_s: float,
) -> tuple[int, bool]:
    """Make the steps of ``RigidBodyEngine.advance`` one by one, of ``step_s`` each."""
    rows = split_loads(bodies, loads)
    for made in range(1, steps + 1):
        for body, inertia, force, torque in rows:
            _, q_wxyz, _, omega_world = engine.motion(body)
            x, y, z = midpoint_torque(inertia, q_wxyz, omega_world, torque, step_s)
            engine.push(body, force, (torque[0] + x, torque[1] + y, torque[2] + z))
        engine.step()
        if engine.touching():
            return made, True
        if path is not None and (state := path.placement(made)) is not None:
            engine.place(path.body, state)
    return steps, False
