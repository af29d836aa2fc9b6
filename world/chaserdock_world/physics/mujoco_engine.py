# SPDX-License-Identifier: Apache-2.0
"""Simulate rigid bodies in MuJoCo (the interface is engine.py). No other module imports it.

Integrator: ``Euler``, semi-implicit. With the correction of gyroscopic.py its rotation is of second
order, and a step exerts exactly the constraint forces that it reports, which are the loads at the
ports. ``implicitfast`` damps a tumble; ``RK4`` solves the constraints four times per step and
reports the forces of its last stage only.

A free body's six velocities are that of its centre of mass in WRF and the rate in its own axes;
loads are in the same axes. Constraints are soft: a1 + b v + k r = (1 - d) a0, where r is the
violation, v its rate, a0 and a1 its acceleration without and with the constraint, and d < 1
(MuJoCo, "Computation", Constraint model).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco as untyped_mujoco
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.orbit import Scalars3
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.scalar_rotations import cross_components, rotated_components

from .engine import (
    BodyContact,
    BodyMotion,
    CollisionSolid,
    ContactSpring,
    EngineSetup,
    PlacementPath,
    RigidBodyDefinition,
    SolidBox,
    SolidCapsule,
    SolidHull,
)
from .gyroscopic import advance_free

mujoco: Any = untyped_mujoco  # has no type stubs

_IMPEDANCE = [0.9999, 0.9999, 0.001, 0.5, 2.0]
"""Impedance d of constraints, whatever the violation: the largest that MuJoCo takes."""
_FRICTION = [0.25, 0.005, 0.0001]
"""Coefficients of friction: sliding as in PyBullet; torsion and rolling are not used."""
_PLANE_HULL_HALF_M = 0.0005
"""Half thickness, m, of the plate that stands for points in a plane, which are no body."""


class MujocoEngine:
    """Simulate bodies in a MuJoCo model of their own; see ``RigidBodyEngine``."""

    def __init__(self, setup: EngineSetup) -> None:
        spec = mujoco.MjSpec()
        _set_options(spec, setup.step_s)
        for number, body in enumerate(setup.bodies):
            _add_body(spec, number, body, _contact_reference(setup.spring, setup.step_s))
        for a, b in setup.joints:
            _add_joint(spec, a, b, setup.step_s)
        self._step_s = setup.step_s
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._free = [body.mass_kg > 0.0 for body in setup.bodies]
        # Index of a body's first velocity (of six) and coordinate (of seven); of a placed body, its
        # number among these.
        numbers = {True: 0, False: 0}
        self._index = []
        for free in self._free:
            self._index.append(numbers[free])
            numbers[free] += 1
        self._placed_velocity: dict[int, tuple[Scalars3, Scalars3]] = {}
        self._load = [0.0] * self._model.nv
        self._joints = {pair: number for number, pair in enumerate(setup.joints)}
        self._anchors: dict[tuple[int, int], list[float]] = {}
        # Numbers of the closed joints in ascending order, now and in the last step.
        self._closed: tuple[int, ...] = ()
        self._solved: tuple[int, ...] = ()
        self._motions: dict[int, BodyMotion] = {}
        for number, body in enumerate(setup.bodies):
            self.place(number, body.state)

    def motion(self, body: int) -> BodyMotion:
        """See ``RigidBodyEngine.motion``."""
        found = self._motions.get(body)
        if found is None:
            found = self._motions[body] = self._read_motion(body)
        return found

    def _read_motion(self, body: int) -> BodyMotion:
        data, index = self._data, self._index[body]
        if not self._free[body]:
            x, y, z = data.mocap_pos[index].tolist()
            w, a, b, c = data.mocap_quat[index].tolist()
            velocity, omega_world = self._placed_velocity[body]
            return (x, y, z), (w, a, b, c), velocity, omega_world
        x, y, z, w, a, b, c = data.qpos[7 * index : 7 * index + 7].tolist()
        u, v, s, *omega = data.qvel[6 * index : 6 * index + 6].tolist()
        p, q, r = rotated_components(w, a, b, c, *omega)
        return (x, y, z), (w, a, b, c), (u, v, s), (p, q, r)

    def place(self, body: int, state: BodyState) -> None:
        """See ``RigidBodyEngine.place``."""
        data, index = self._data, self._index[body]
        if self._free[body]:
            data.qpos[7 * index : 7 * index + 7] = [*state.position_m, *state.q_wxyz]
            data.qvel[6 * index : 6 * index + 6] = [*state.velocity_m_s, *state.omega_rad_s]
        else:
            data.mocap_pos[index], data.mocap_quat[index] = state.position_m, state.q_wxyz
            u, v, s = state.velocity_m_s.tolist()
            p, q, r = rotations.rotate(state.q_wxyz, state.omega_rad_s).tolist()
            self._placed_velocity[body] = (u, v, s), (p, q, r)
        self._motions.pop(body, None)

    def push(self, body: int, force: Sequence[float], torque: Sequence[float]) -> None:
        """See ``RigidBodyEngine.push``."""
        if not self._free[body]:
            return
        load, first = self._load, 6 * self._index[body]
        if any(force):
            x, y, z = rotated_components(*self.motion(body)[1], *force)
            load[first] += x
            load[first + 1] += y
            load[first + 2] += z
        load[first + 3] += torque[0]
        load[first + 4] += torque[1]
        load[first + 5] += torque[2]

    def push_at(
        self, body: int, force: Sequence[float], torque: Sequence[float], point_m: Sequence[float]
    ) -> None:
        """See ``RigidBodyEngine.push_at``."""
        if not self._free[body]:
            return
        position, (w, x, y, z), _, _ = self.motion(body)
        arm = [p - c for p, c in zip(point_m, position, strict=True)]
        about_centre = [a + b for a, b in zip(torque, cross_components(*arm, *force), strict=True)]
        first = 6 * self._index[body]
        in_body = rotated_components(w, -x, -y, -z, *about_centre)
        for k, value in enumerate((*force, *in_body)):
            self._load[first + k] += value

    def step(self) -> None:
        """See ``RigidBodyEngine.step``."""
        self._data.qfrc_applied[:] = self._load
        self._solved = self._closed
        mujoco.mj_step(self._model, self._data)
        self._load = [0.0] * len(self._load)
        self._motions.clear()

    def advance(
        self, bodies: IntArray, loads: Array, steps: int, path: PlacementPath | None = None
    ) -> tuple[int, bool]:
        """See ``RigidBodyEngine.advance``."""
        return advance_free(self, bodies, loads, steps, path, self._step_s)

    def touching(self) -> bool:
        """See ``RigidBodyEngine.touching``."""
        return self._data.ncon > 0

    def contacts(self) -> list[BodyContact]:
        """See ``RigidBodyEngine.contacts``. MuJoCo finds bodies that penetrate each other at the
        beginning of a step.
        """
        found = []
        body_of = self._model.geom_bodyid
        for contact in self._data.contact:
            a, b = (int(body_of[geom]) - 1 for geom in contact.geom)
            half = 0.5 * contact.dist * contact.frame[:3]  # the normal points from a to b
            found.append(
                BodyContact(a, b, (contact.pos - half).tolist(), (contact.pos + half).tolist())
            )
        return found

    def set_collisions(self, a: int, b: int, enabled: bool) -> None:
        """See ``RigidBodyEngine.set_collisions``."""
        model = self._model
        for body, other in ((a, b), (b, a)):
            own = model.geom_bodyid == body + 1
            bit = np.int32(1 << other)
            model.geom_conaffinity[own] = (
                model.geom_conaffinity[own] | bit if enabled else model.geom_conaffinity[own] & ~bit
            )

    def join(self, a: int, b: int, anchor_a_m: Array, anchor_b_m: Array, q_ab_wxyz: Array) -> None:
        """See ``RigidBodyEngine.join``."""
        joint = self._joints[a, b]
        self._model.eq_data[joint, :10] = [*anchor_b_m, *anchor_a_m, *q_ab_wxyz]
        self._data.eq_active[joint] = True
        self._anchors[a, b] = anchor_b_m.tolist()
        self._closed = tuple(sorted((*self._closed, joint)))

    def separate(self, a: int, b: int) -> None:
        """See ``RigidBodyEngine.separate``."""
        joint = self._joints[a, b]
        self._data.eq_active[joint] = False
        self._closed = tuple(number for number in self._closed if number != joint)

    def reaction(self, a: int, b: int) -> Sequence[float]:
        """See ``RigidBodyEngine.reaction``: from the joint's constraint forces, which the last step
        applied as they are.
        """
        data, first = self._data, 6 * self._index[b]
        # The rows of the closed joints come first, six each.
        row = 6 * self._solved.index(self._joints[a, b])
        jacobian = data.efc_J.reshape(-1, self._model.nv)[row : row + 6, first : first + 6]
        fx, fy, fz, tx, ty, tz = (data.efc_force[row : row + 6] @ jacobian).tolist()
        # The attitude at the beginning of the step: the step has moved the coordinates, but xquat,
        # which follows from them, is still that of before.
        w, x, y, z = data.xquat[b + 1].tolist()
        mx, my, mz = cross_components(
            *self._anchors[a, b], *rotated_components(w, -x, -y, -z, fx, fy, fz)
        )
        return -fx, -fy, -fz, mx - tx, my - ty, mz - tz

    def close(self) -> None:
        """Free model and data."""
        del self._model, self._data


def _set_options(spec: Any, step_s: float) -> None:
    option = spec.option
    option.timestep = step_s
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.gravity = [0.0, 0.0, 0.0]
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations, option.tolerance = 100, 1e-15
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # A state that is not a number must not be replaced by the initial one.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    # Else the stiffness of contacts depends on the attitude of the bodies.
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_DIAGEXACT


def _contact_reference(spring: ContactSpring | None, step_s: float) -> list[float]:
    """Return ``solref`` of contacts.

    A spring is that of an implicit step, as in PyBullet: F = k (r + h v) + c v with the velocity at
    the end of the step. Hard contacts are critically damped, with the shortest time constant that
    MuJoCo takes.
    """
    if spring is None:
        return [2.0 * step_s, 1.0]
    stiffness = spring.stiffness_N_m / 2.0
    damping = 2.0 * spring.damping_N_s_m + step_s * stiffness
    mass_kg = spring.mass_kg + step_s * damping
    return [-stiffness / mass_kg, -damping / mass_kg]


def _add_body(spec: Any, number: int, body: RigidBodyDefinition, reference: list[float]) -> None:
    a, b, c = body.moments_kg_m2
    added = spec.worldbody.add_body(
        name=str(number),
        pos=body.state.position_m,
        quat=body.state.q_wxyz,
        mocap=body.mass_kg == 0.0,
        explicitinertial=True,
        mass=body.mass_kg,
        # Moments of a plane body may violate the triangle inequality by rounding.
        inertia=[min(a, b + c), min(b, c + a), min(c, a + b)],
        ipos=[0.0, 0.0, 0.0],
        iquat=[1.0, 0.0, 0.0, 0.0],
    )
    if body.mass_kg > 0.0:
        added.add_freejoint()
    for index, solid in enumerate(body.solids):
        added.add_geom(
            # Every body may touch every other one: a bit per body.
            contype=1 << number,
            conaffinity=~(1 << number) & 0x7FFFFFFF,
            condim=3,
            friction=_FRICTION,
            solref=reference,
            solimp=_IMPEDANCE,
            **_geometry(spec, f"{number}/{index}", solid),
        )


def _geometry(spec: Any, name: str, solid: CollisionSolid) -> dict[str, object]:
    """Return type, size and pose of a solid; a hull is added to ``spec`` as a mesh of this name."""
    kinds = mujoco.mjtGeom
    if isinstance(solid, SolidBox):
        return {
            "type": kinds.mjGEOM_BOX,
            "size": solid.half_m,
            "pos": solid.position_m,
            "quat": solid.q_wxyz,
        }
    if isinstance(solid, SolidCapsule):
        size = [solid.radius_m, solid.length_m / 2, 0.0]
        return {
            "type": kinds.mjGEOM_CAPSULE,
            "size": size,
            "pos": solid.position_m,
            "quat": solid.q_wxyz,
        }
    vertices = solid.vertices_m if len(solid.triangles) else _thickened(solid)
    spec.add_mesh(
        name=name,
        uservert=vertices.ravel().tolist(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    return {"type": kinds.mjGEOM_MESH, "meshname": name}


def _thickened(hull: SolidHull) -> Array:
    """Return the vertices (2 n, 3) of a plate from points (n, 3) in a plane."""
    normal = np.linalg.svd(hull.vertices_m - hull.vertices_m.mean(axis=0))[2][2]
    return np.concatenate(
        [hull.vertices_m + side * _PLANE_HULL_HALF_M * normal for side in (-1.0, 1.0)]
    )


def _add_joint(spec: Any, a: int, b: int, step_s: float) -> None:
    """Add an inactive joint, stiff enough to stop a relative motion in one step: b = 1 / h, k = 1 /
    (4 h^2).
    """
    spec.add_equality(
        name=f"{a}/{b}",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=str(a),
        name2=str(b),
        active=False,
        solref=[2.0 * step_s, 1.0],
        solimp=_IMPEDANCE,
        # Anchor in b, anchor in a, attitude of b relative to a: set when it closes. Then the scale
        # of torques, m.
        data=[0.0] * 6 + [1.0, 0.0, 0.0, 0.0] + [1.0] + [0.0] * (mujoco.mjNEQDATA - 11),
    )
