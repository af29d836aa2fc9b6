# SPDX-License-Identifier: Apache-2.0
"""Simulate rigid bodies in PyBullet (the interface is engine.py).

With bullet.py the only module that uses its conventions: PyBullet orders quaternions x, y, z, w.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.rigid_body import BodyState

from .bullet import connect, pybullet
from .bullet_stepping import make_stepper
from .engine import (
    BodyContact,
    BodyMotion,
    CollisionSolid,
    EngineSetup,
    PlacementPath,
    RigidBodyDefinition,
    SolidBox,
    SolidCapsule,
    SolidHull,
)
from .gyroscopic import advance_free

_NO_LOAD = (0.0, 0.0, 0.0)  # N or N m


class BulletEngine:
    """Simulate bodies in a PyBullet client of their own; see ``RigidBodyEngine``."""

    def __init__(self, setup: EngineSetup) -> None:
        self._bullet = connect()
        self._client: int = (
            self._bullet._client
        )  # direct calls: the wrapper is too slow for every step
        self._bullet.setGravity(0, 0, 0)
        self._bullet.setTimeStep(setup.step_s)
        self._ids = [self._add(body, setup) for body in setup.bodies]
        self._numbers = {identity: number for number, identity in enumerate(self._ids)}
        if setup.joints:
            # Otherwise the solver stops early, and joint reactions lag behind changes of thrust by
            # a few steps.
            self._bullet.setPhysicsEngineParameter(solverResidualThreshold=0.0)
        self._joints: dict[tuple[int, int], int] = {}
        self._step_s = setup.step_s
        self._stepper = make_stepper(self._ids, self._client, setup.step_s)

    def _add(self, body: RigidBodyDefinition, setup: EngineSetup) -> int:
        identity = self._bullet.createMultiBody(
            baseMass=body.mass_kg,
            baseCollisionShapeIndex=self._shape(body.solids),
            basePosition=body.state.position_m.tolist(),
            baseOrientation=_xyzw(body.state.q_wxyz),
        )
        self._bullet.changeDynamics(
            identity, -1, linearDamping=0.0, angularDamping=0.0, maxJointVelocity=1e6
        )
        if body.mass_kg > 0:
            self._bullet.changeDynamics(identity, -1, localInertiaDiagonal=list(body.moments_kg_m2))
        if (spring := setup.spring) is not None:
            self._bullet.changeDynamics(
                identity,
                -1,
                contactStiffness=spring.stiffness_N_m,
                contactDamping=spring.damping_N_s_m,
            )
        self._set_velocity(identity, body.state)
        return identity

    def _set_velocity(self, identity: int, state: BodyState) -> None:
        omega_world = rotations.rotate(state.q_wxyz, state.omega_rad_s)
        pybullet.resetBaseVelocity(
            identity, state.velocity_m_s.tolist(), omega_world.tolist(), self._client
        )

    def _shape(self, solids: Sequence[CollisionSolid]) -> int:
        hulls = [s for s in solids if isinstance(s, SolidHull)]
        if hulls:
            return self._hull_shape(hulls)
        placed = [s for s in solids if not isinstance(s, SolidHull)]
        return self._bullet.createCollisionShapeArray(
            shapeTypes=[
                pybullet.GEOM_BOX if isinstance(s, SolidBox) else pybullet.GEOM_CAPSULE
                for s in placed
            ],
            halfExtents=[
                list(s.half_m) if isinstance(s, SolidBox) else [0.0, 0.0, 0.0] for s in placed
            ],
            radii=[s.radius_m if isinstance(s, SolidCapsule) else 0.0 for s in placed],
            lengths=[s.length_m if isinstance(s, SolidCapsule) else 0.0 for s in placed],
            collisionFramePositions=[s.position_m.tolist() for s in placed],
            collisionFrameOrientations=[_xyzw(s.q_wxyz) for s in placed],
        )

    def _hull_shape(self, hulls: Sequence[SolidHull]) -> int:
        """Return a shape of convex pieces: Bullet makes one of every object of an OBJ file."""
        lines, first = [], 1
        for number, hull in enumerate(hulls):
            lines.append(f"o piece_{number}")
            lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in hull.vertices_m.tolist()]
            lines += [f"f {a} {b} {c}" for a, b, c in (hull.triangles + first).tolist()]
            first += len(hull.vertices_m)
        with tempfile.TemporaryDirectory(prefix="chaserdock-") as folder:
            path = Path(folder) / "hulls.obj"
            path.write_text("\n".join(lines) + "\n")
            return self._bullet.createCollisionShape(pybullet.GEOM_MESH, fileName=str(path))

    def motion(self, body: int) -> BodyMotion:
        """See ``RigidBodyEngine.motion``."""
        identity, client = self._ids[body], self._client
        position, (x, y, z, w) = pybullet.getBasePositionAndOrientation(identity, client)
        velocity, omega_world = pybullet.getBaseVelocity(identity, client)
        return position, (w, x, y, z), velocity, omega_world

    def place(self, body: int, state: BodyState) -> None:
        """See ``RigidBodyEngine.place``. Contacts are not checked."""
        identity, position = self._ids[body], state.position_m.tolist()
        pybullet.resetBasePositionAndOrientation(
            identity, position, _xyzw(state.q_wxyz), self._client
        )
        self._set_velocity(identity, state)

    def push(self, body: int, force: Sequence[float], torque: Sequence[float]) -> None:
        """See ``RigidBodyEngine.push``."""
        identity, frame, client = self._ids[body], pybullet.LINK_FRAME, self._client
        if any(force):
            pybullet.applyExternalForce(identity, -1, force, _NO_LOAD, frame, client)
        pybullet.applyExternalTorque(identity, -1, torque, frame, client)

    def push_at(
        self, body: int, force: Sequence[float], torque: Sequence[float], point_m: Sequence[float]
    ) -> None:
        """See ``RigidBodyEngine.push_at``."""
        identity, frame, client = self._ids[body], pybullet.WORLD_FRAME, self._client
        pybullet.applyExternalForce(identity, -1, force, point_m, frame, client)
        if any(torque):
            pybullet.applyExternalTorque(identity, -1, torque, frame, client)

    def step(self) -> None:
        """See ``RigidBodyEngine.step``. Bullet clears external loads after it."""
        pybullet.stepSimulation(self._client)

    def advance(
        self, bodies: IntArray, loads: Array, steps: int, path: PlacementPath | None = None
    ) -> tuple[int, bool]:
        """See ``RigidBodyEngine.advance``."""
        if self._stepper is None:
            return advance_free(self, bodies, loads, steps, path, self._step_s)
        return self._stepper.advance(bodies, loads, steps, path)

    def touching(self) -> bool:
        """See ``RigidBodyEngine.touching``."""
        return bool(pybullet.getContactPoints(physicsClientId=self._client))

    def contacts(self) -> list[BodyContact]:
        """See ``RigidBodyEngine.contacts``."""
        number = self._numbers
        # Bullet stops bodies at a distance (c[8]) of zero up to rounding, so the force (c[9]) is
        # checked as well.
        return [
            BodyContact(number[c[1]], number[c[2]], c[5], c[6])
            for c in self._bullet.getContactPoints()
            if c[8] <= 0.0 or c[9] > 0.0
        ]

    def set_collisions(self, a: int, b: int, enabled: bool) -> None:
        """See ``RigidBodyEngine.set_collisions``."""
        self._bullet.setCollisionFilterPair(self._ids[a], self._ids[b], -1, -1, int(enabled))

    def join(self, a: int, b: int, anchor_a_m: Array, anchor_b_m: Array, q_ab_wxyz: Array) -> None:
        """See ``RigidBodyEngine.join``."""
        self._joints[a, b] = self._bullet.createConstraint(
            parentBodyUniqueId=self._ids[a],
            parentLinkIndex=-1,
            childBodyUniqueId=self._ids[b],
            childLinkIndex=-1,
            jointType=pybullet.JOINT_FIXED,
            jointAxis=[0, 0, 0],
            parentFramePosition=anchor_a_m.tolist(),
            childFramePosition=anchor_b_m.tolist(),
            parentFrameOrientation=_xyzw(q_ab_wxyz),
            childFrameOrientation=[0.0, 0.0, 0.0, 1.0],
        )

    def separate(self, a: int, b: int) -> None:
        """See ``RigidBodyEngine.separate``."""
        self._bullet.removeConstraint(self._joints.pop((a, b)))

    def reaction(self, a: int, b: int) -> Sequence[float]:
        """See ``RigidBodyEngine.reaction``."""
        return pybullet.getConstraintState(self._joints[a, b], self._client)

    def close(self) -> None:
        """Disconnect the PyBullet client."""
        self._bullet.disconnect()


def _xyzw(q_wxyz: Array) -> list[float]:
    w, x, y, z = np.asarray(q_wxyz, dtype=float).tolist()
    return [x, y, z, w]
