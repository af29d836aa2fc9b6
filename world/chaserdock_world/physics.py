"""The PyBullet adapter: the only module that imports pybullet, and the only one that knows its conventions.

PyBullet orders quaternions x, y, z, w and gives angular velocity in world axes; everything that leaves this module is
scalar first and has body rates. There is no gravity, damping or sleeping.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pybullet
from chaserdock_protocol import rotations
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario_bodies import cuboid_inertia
from chaserdock_protocol.targets import TargetModel
from pybullet_utils.bullet_client import BulletClient

from .gyroscopic import midpoint_torque

TARGET = "target"


@dataclass(frozen=True)
class BodyState:
    """Position (3,) and velocity (3,) WRF, attitude (4,) body to WRF, rate (3,) in body axes."""

    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array


class Physics:
    """The bodies of a scenario in a PyBullet world of their own; ``advance`` moves them on."""

    def __init__(self, scenario: Scenario) -> None:
        self.step_count = 0
        self._scenario = scenario
        self._prescribed = scenario.target.motion != "torque_free"
        # How often Bullet's copy of a prescribed target is moved along; its ``state`` is exact at any step.
        self._steps_per_move = max(1, scenario.time.physics_hz // 120)
        self._bullet = BulletClient(connection_mode=pybullet.DIRECT)
        self._client: int = self._bullet._client  # the wrapper is too slow for what happens every step
        self._bullet.setGravity(0, 0, 0)
        self._bullet.setTimeStep(1.0 / scenario.time.physics_hz)
        self._bodies: dict[str, int] = {TARGET: self._add_target(scenario)}
        for i in range(len(scenario.chasers)):
            self._bodies[f"chaser/{i}"] = self._add_chaser(scenario, i)
        # Bodies whose motion is Bullet's, with their principal moments of inertia.
        self._free = {f"chaser/{i}": scenario.chaser.inertia for i in range(len(scenario.chasers))}
        if not self._prescribed:
            self._free[TARGET] = self._target_inertia(scenario)
        self._names = {number: name for name, number in self._bodies.items()}

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of all bodies: ``target``, ``chaser/0``, …"""
        return tuple(self._bodies)

    def _add(self, shape: int, mass_kg: float, inertia: tuple[float, float, float], state: BodyState) -> int:
        body = self._bullet.createMultiBody(
            baseMass=mass_kg,
            baseCollisionShapeIndex=shape,
            basePosition=state.position_m.tolist(),
            baseOrientation=_xyzw(state.q_wxyz),
        )
        self._bullet.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0, maxJointVelocity=1e6)
        if mass_kg > 0:
            self._bullet.changeDynamics(body, -1, localInertiaDiagonal=list(inertia))
        self._set_velocity(body, state)
        return body

    def _set_velocity(self, body: int, state: BodyState) -> None:
        omega_world = rotations.rotate(state.q_wxyz, state.omega_rad_s)
        self._bullet.resetBaseVelocity(body, state.velocity_m_s.tolist(), omega_world.tolist())

    def _add_target(self, scenario: Scenario) -> int:
        target, model = scenario.target, scenario.target_model()
        mass = 0.0 if self._prescribed else target.mass_kg
        inertia = self._target_inertia(scenario)
        return self._add(self._box_shape(model), mass, inertia, prescribed_state(scenario, 0.0))

    @staticmethod
    def _target_inertia(scenario: Scenario) -> tuple[float, float, float]:
        target, model = scenario.target, scenario.target_model()
        return target.inertia_kg_m2 or cuboid_inertia(target.mass_kg, model.size_m)

    def _box_shape(self, model: TargetModel) -> int:
        boxes = model.boxes
        return self._bullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * len(boxes),
            halfExtents=[[s / 2 for s in box.size_m] for box in boxes],
            collisionFramePositions=[list(box.position_m) for box in boxes],
            collisionFrameOrientations=[_xyzw(np.asarray(box.q_wxyz)) for box in boxes],
        )

    def _add_chaser(self, scenario: Scenario, i: int) -> int:
        body = scenario.chaser
        shape = self._bullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[s / 2 for s in body.size_m])
        position, attitude = scenario.start_pose(i)
        state = BodyState(position, np.asarray(scenario.chasers[i].start_velocity_m_s), attitude, np.zeros(3))
        return self._add(shape, body.mass_kg, body.inertia, state)

    def state(self, name: str) -> BodyState:
        """State of a body now; the prescribed target's is exact."""
        if name == TARGET and self._prescribed:
            return prescribed_state(self._scenario, self.step_count / self._scenario.time.physics_hz)
        body = self._bodies[name]
        position, xyzw = self._bullet.getBasePositionAndOrientation(body)
        velocity, omega_world = self._bullet.getBaseVelocity(body)
        q = rotations.normalize([xyzw[3], *xyzw[:3]])
        return BodyState(np.array(position), np.array(velocity), q, rotations.rotate_inverse(q, omega_world))

    def advance(self, steps: int, wrenches: dict[str, Array]) -> set[tuple[str, str]]:
        """Makes ``steps`` physics steps under constant wrenches; returns the pairs of bodies that touched.

        ``wrenches`` maps a chaser's name to force and torque (6,) in its body axes, N and N m.
        """
        still = np.zeros(6)
        pushes = []
        for name, inertia in self._free.items():
            wrench = wrenches.get(name, still)
            pushes.append((self._bodies[name], inertia, wrench[:3].tolist(), wrench[3:].tolist()))
        step_s = 1.0 / self._scenario.time.physics_hz
        moves = self._prescribed and self._scenario.target.motion != "static"
        touched: set[tuple[str, str]] = set()
        frame, client = pybullet.LINK_FRAME, self._client
        force_on, torque_on = pybullet.applyExternalForce, pybullet.applyExternalTorque
        pose_of, rates_of = pybullet.getBasePositionAndOrientation, pybullet.getBaseVelocity
        for _ in range(steps):
            # Bullet forgets external forces after every step.
            for body, inertia, force, torque in pushes:
                attitude, rate = pose_of(body, client)[1], rates_of(body, client)[1]
                x, y, z = midpoint_torque(inertia, attitude, rate, torque, step_s)
                force_on(body, -1, force, (0, 0, 0), frame, client)
                torque_on(body, -1, (torque[0] + x, torque[1] + y, torque[2] + z), frame, client)
            pybullet.stepSimulation(client)
            self.step_count += 1
            # A bounce lasts a single step: look after every one.
            if pybullet.getContactPoints(physicsClientId=client):
                touched.update(self.contacts())
            if moves and self.step_count % self._steps_per_move == 0:
                self._move_target()
        return touched

    def _move_target(self) -> None:
        state, body = self.state(TARGET), self._bodies[TARGET]
        self._bullet.resetBasePositionAndOrientation(body, state.position_m.tolist(), _xyzw(state.q_wxyz))
        self._set_velocity(body, state)

    def contacts(self) -> tuple[tuple[str, str], ...]:
        """Pairs of bodies that touched or overlapped in the last step, sorted."""
        pairs = {
            tuple(sorted((self._names[c[1]], self._names[c[2]])))
            for c in self._bullet.getContactPoints()
            # Bullet stops bodies at a distance (c[8]) of zero, give or take rounding: the force (c[9]) tells as well.
            if c[8] <= 0.0 or c[9] > 0.0
        }
        return tuple(sorted((a, b) for a, b in pairs))

    def close(self) -> None:
        """Frees the PyBullet world."""
        self._bullet.disconnect()


def prescribed_state(scenario: Scenario, time_s: float) -> BodyState:
    """The target's state at a simulated time under constant rates (exact); at zero, its initial state."""
    target = scenario.target
    still = target.motion == "static"
    velocity = np.zeros(3) if still else np.asarray(target.velocity_m_s)
    omega = np.zeros(3) if still else np.asarray(target.omega_rad_s)
    position = np.asarray(target.position_m) + velocity * time_s
    attitude = rotations.integrate(target.q_wxyz, omega, time_s)
    return BodyState(position, velocity, attitude, omega)


def _xyzw(q_wxyz: Array) -> list[float]:
    w, x, y, z = np.asarray(q_wxyz, dtype=float).tolist()
    return [x, y, z, w]
