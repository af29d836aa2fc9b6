# SPDX-License-Identifier: Apache-2.0
"""Rigid-body simulation in PyBullet; the only module that uses its conventions.

PyBullet orders quaternions x, y, z, w and expresses angular velocity in world axes; this module's interface is scalar first
with body rates. Bullet has no gravity, damping or sleeping; the
forces of an orbit are applied to every body (orbital_forces.py).
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.docking_geometry import view_of
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.targets import TargetModel
from chaserdock_protocol.messages import Latch
from chaserdock_protocol.scenario import Scenario

from chaserdock_world.orbit import TargetOrbit
from chaserdock_world.plant import Plant, chaser_plant, target_plant, true_mesh
from chaserdock_world.random_draws import GaussMarkov, Stream

from .bullet import connect, pybullet
from .collision_hulls import collision_hulls, triangles_of
from .compliant_latch import ENGAGED_M, CompliantLatch, Grip
from .gyroscopic import midpoint_torque, midpoint_torque_of_rates
from .latch import ProbeLatch, latch_faults
from .orbital_forces import OrbitalForces
from .plume_loads import PlumeLoads
from .port_loads import PortLoadRecorder, port_attitude

TARGET = "target"
PROBE_RADIUS_M = 0.006
_Z_TO_X_XYZW = [0.0, 0.5**0.5, 0.0, 0.5**0.5]
# A compliant contact: restitution 0.4 and 0.5 mm penetration at 1 cm/s (docs/docking.md).
_CONTACT = {"contactStiffness": 1e4, "contactDamping": 100.0}


class Physics:
    """Simulates the bodies of a scenario in its own PyBullet client."""

    def __init__(self, scenario: Scenario) -> None:
        self.step_count = 0
        self._scenario = scenario
        self._prescribed = scenario.target.motion != "torque_free"
        # Interval at which Bullet's copy of a prescribed target is moved; ``state`` is exact at every step.
        self._steps_per_target_update = max(1, scenario.time.physics_hz // 120)
        self._bullet = connect()
        self._client: int = self._bullet._client  # direct calls: the wrapper is too slow for every step
        self._bullet.setGravity(0, 0, 0)
        self._bullet.setTimeStep(1.0 / scenario.time.physics_hz)
        chasers = {f"chaser/{i}": i for i in range(len(scenario.chasers))}
        self.plants = {TARGET: target_plant(scenario)}
        self.plants |= {name: chaser_plant(scenario, i) for name, i in chasers.items()}
        self._bodies: dict[str, int] = {TARGET: self._add_target(scenario)}
        for name, i in chasers.items():
            self._bodies[name] = self._add_chaser(scenario, i)
        # Bodies that Bullet integrates.
        self._free = {name: self.plants[name] for name in chasers}
        if not self._prescribed:
            self._free[TARGET] = self.plants[TARGET]
        self._orbital: OrbitalForces | None = None
        if scenario.orbit is not None:
            step_s, per_tick = 1.0 / scenario.time.physics_hz, scenario.timing.steps_per_tick
            self._orbital = OrbitalForces(TargetOrbit(scenario.orbit), step_s, per_tick)
        self.plumes = None if scenario.plume is None else PlumeLoads(scenario, scenario.plume)
        self._noise = {
            name: _disturbance_noise(scenario, i) for name, i in chasers.items() if _has_noise(scenario)
        }
        self._names = {number: name for name, number in self._bodies.items()}
        hz, docking = scenario.time.physics_hz, scenario.docking
        ports = docking.ports if docking.kind == "capture" else ()
        self.latches = {
            f"chaser/{p.chaser}": ProbeLatch(
                p.chaser, p, docking.tolerances, hz, latch_faults(scenario, p.chaser)
            )
            for p in ports
        }
        self.port_loads = {name: self._load_recorder(name, p.chaser) for name, p in self.latches.items()}
        if self.latches:
            # Else the solver stops early, and joint reactions lag behind changes of thrust by a few steps.
            self._bullet.setPhysicsEngineParameter(solverResidualThreshold=0.0)
        self._joints: dict[str, int] = {}
        self._compliant: dict[str, CompliantLatch] = {}
        self._openings: list[tuple[int, str]] = []
        self._closing = False  # a latch closed in the last step: its joint acts first in the next one
        # Pose and rates of every free body at the beginning of the last step, in Bullet's conventions.
        self._before: dict[int, tuple[Any, Any]] = {}

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of all bodies: ``target``, ``chaser/0``, ..."""
        return tuple(self._bodies)

    def _load_recorder(self, name: str, chaser: int) -> PortLoadRecorder:
        q_port = port_attitude(np.asarray(self._scenario.chasers[chaser].q_wxyz))
        frame = self.plants[TARGET].frame
        if frame is not None:
            q_port = rotations.multiply(rotations.conjugate(frame.q_wxyz), q_port)
        return PortLoadRecorder(q_port, 1.0 / self._scenario.time.physics_hz)

    def _add(self, shape: int, plant: Plant, mass_kg: float, body_state: BodyState) -> int:
        state = body_state if plant.frame is None else plant.frame.from_body(body_state)
        body = self._bullet.createMultiBody(
            baseMass=mass_kg,
            baseCollisionShapeIndex=shape,
            basePosition=state.position_m.tolist(),
            baseOrientation=_xyzw(state.q_wxyz),
        )
        self._bullet.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0, maxJointVelocity=1e6)
        if mass_kg > 0:
            self._bullet.changeDynamics(body, -1, localInertiaDiagonal=list(plant.moments_kg_m2))
        if self._scenario.docking.kind == "capture":
            self._bullet.changeDynamics(body, -1, **_CONTACT)
        self._set_velocity(body, state)
        return body

    def _set_velocity(self, body: int, state: BodyState) -> None:
        omega_world = rotations.rotate(state.q_wxyz, state.omega_rad_s)
        pybullet.resetBaseVelocity(body, state.velocity_m_s.tolist(), omega_world.tolist(), self._client)

    def _add_target(self, scenario: Scenario) -> int:
        plant = self.plants[TARGET]
        mass = 0.0 if self._prescribed else plant.mass_kg
        model, mesh = scenario.target_model(), true_mesh(scenario)
        hulls = collision_hulls(mesh) if model.hulls and mesh is not None else []
        shape = self._hull_shape(hulls, plant) if hulls else self._box_shape(model, plant)
        return self._add(shape, plant, mass, prescribed_state(scenario, 0.0))

    def _box_shape(self, model: TargetModel, plant: Plant) -> int:
        boxes = model.boxes
        places = [_place(plant, list(box.position_m), _xyzw(np.asarray(box.q_wxyz))) for box in boxes]
        return self._bullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * len(boxes),
            halfExtents=[[s / 2 for s in box.size_m] for box in boxes],
            collisionFramePositions=[position for position, _ in places],
            collisionFrameOrientations=[xyzw for _, xyzw in places],
        )

    def _hull_shape(self, hulls: Sequence[Array], plant: Plant) -> int:
        """Return a shape of convex pieces: Bullet makes one of every object of an OBJ file."""
        lines, first = [], 1
        for number, hull in enumerate(hulls):
            vertices = hull if plant.frame is None else plant.frame.place(hull, rotations.IDENTITY)[0]
            faces = triangles_of(hull)
            lines.append(f"o piece_{number}")
            lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
            lines += [f"f {a} {b} {c}" for a, b, c in (faces + first).tolist()]
            first += len(vertices)
        with tempfile.TemporaryDirectory(prefix="chaserdock-") as folder:
            path = Path(folder) / "hulls.obj"
            path.write_text("\n".join(lines) + "\n")
            return self._bullet.createCollisionShape(pybullet.GEOM_MESH, fileName=str(path))

    def _add_chaser(self, scenario: Scenario, i: int) -> int:
        body, plant = scenario.chaser, self.plants[f"chaser/{i}"]
        half = [s / 2 for s in body.size_m]
        box_m, box_xyzw = _place(plant, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
        if scenario.docking.kind == "capture":
            # The probe: a massless capsule from the body's front to the tip.
            length = body.probe_reach_m - half[0] - PROBE_RADIUS_M
            probe_m, probe_xyzw = _place(plant, [half[0] + length / 2, 0.0, 0.0], _Z_TO_X_XYZW)
            shape = self._bullet.createCollisionShapeArray(
                shapeTypes=[pybullet.GEOM_BOX, pybullet.GEOM_CAPSULE],
                halfExtents=[half, [0.0, 0.0, 0.0]],
                radii=[0.0, PROBE_RADIUS_M],
                lengths=[0.0, length],
                collisionFramePositions=[box_m, probe_m],
                collisionFrameOrientations=[box_xyzw, probe_xyzw],
            )
        else:
            place = {"collisionFramePosition": box_m, "collisionFrameOrientation": box_xyzw}
            place = {} if plant.frame is None else place
            shape = self._bullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, **place)
        position, attitude = scenario.start_pose(i)
        state = BodyState(position, np.asarray(scenario.chasers[i].start_velocity_m_s), attitude, np.zeros(3))
        return self._add(shape, plant, plant.mass_kg, state)

    def state(self, name: str) -> BodyState:
        """Return the current state of a body; that of a prescribed target is exact."""
        if name == TARGET and self._prescribed:
            return prescribed_state(self._scenario, self.step_count / self._scenario.time.physics_hz)
        body = self._bodies[name]
        client = self._client
        pose = pybullet.getBasePositionAndOrientation(body, client)
        return self._body_state(name, pose, pybullet.getBaseVelocity(body, client))

    def _body_state(self, name: str, pose: Any, rates: Any) -> BodyState:
        """Return the state of a body's frame from Bullet's pose, velocity and rate."""
        state, frame = _state_of(pose, rates), self.plants[name].frame
        return state if frame is None else frame.to_body(state)

    def _bullet_state(self, name: str, state: BodyState) -> BodyState:
        """Return the state of the frame that Bullet integrates from that of a body's frame."""
        frame = self.plants[name].frame
        return state if frame is None else frame.from_body(state)

    def place(self, name: str, state: BodyState) -> None:
        """Set the state of a body. Contacts are not checked."""
        body, state = self._bodies[name], self._bullet_state(name, state)
        position, attitude = state.position_m.tolist(), _xyzw(state.q_wxyz)
        pybullet.resetBasePositionAndOrientation(body, position, attitude, self._client)
        self._set_velocity(body, state)

    def next_change(self, step: int) -> int | None:
        """Return the first step after ``step`` at which a disturbance changes, None if all are constant."""
        per_tick = self._scenario.timing.steps_per_tick
        return (step // per_tick + 1) * per_tick if self._noise else None

    def _wrench_on(self, name: str, wrench: Array) -> Array:
        """Return force and torque (6,), in Bullet's frame of a body, of its actuators and its present disturbances."""
        plant = self.plants[name]
        if plant.disturbance.any():
            wrench = wrench + plant.disturbance
        if name in self._noise:
            noise, sigma = self._noise[name]
            wrench = wrench + sigma * noise.at(self.step_count // self._scenario.timing.steps_per_tick)
        return wrench if plant.frame is None else plant.frame.wrench(wrench)

    def advance(self, steps: int, wrenches: dict[str, Array]) -> set[tuple[str, str]]:
        """Make ``steps`` physics steps under constant wrenches; return the pairs of bodies that touched.

        ``wrenches`` maps a chaser's name to force and torque (6,) at its origin in its body axes, N and N m. Disturbances
        must not change in between (see ``next_change``).
        """
        zero = np.zeros(6)
        loads = []
        for name, plant in self._free.items():
            wrench = self._wrench_on(name, wrenches.get(name, zero))
            loads.append((self._bodies[name], plant.moments_kg_m2, wrench[:3].tolist(), wrench[3:].tolist()))
        step_s = 1.0 / self._scenario.time.physics_hz
        moves = self._prescribed and self._scenario.target.motion != "static"
        touched: set[tuple[str, str]] = set()
        frame, client = pybullet.LINK_FRAME, self._client
        force_on, torque_on = pybullet.applyExternalForce, pybullet.applyExternalTorque
        pose_of, rates_of = pybullet.getBasePositionAndOrientation, pybullet.getBaseVelocity
        step, contact_points = pybullet.stepSimulation, pybullet.getContactPoints
        before, jointed = self._before, set[int]()
        for _ in range(steps):
            if self.latches:
                jointed = self._update_joints()
            # Bullet clears external forces after every step.
            for body, inertia, force, torque in loads:
                pose, rates = pose_of(body, client), rates_of(body, client)
                if body in jointed:
                    last = before.get(body, (pose, rates))[1]
                    x, y, z = midpoint_torque_of_rates(inertia, pose[1], rates[1], last[1])
                else:
                    x, y, z = midpoint_torque(inertia, pose[1], rates[1], torque, step_s)
                before[body] = pose, rates
                if any(force):
                    force_on(body, -1, force, (0, 0, 0), frame, client)
                torque_on(body, -1, (torque[0] + x, torque[1] + y, torque[2] + z), frame, client)
                if self._orbital is not None:
                    self._apply_orbital(self._orbital, body, pose, rates)
            if self._compliant:
                self._apply_compliant_latches()
            step(client)
            self.step_count += 1
            if self._joints:
                self._record_loads()
            # A bounce may last a single step, so contacts are checked after each.
            if contact_points(physicsClientId=client):
                touched.update(self._process_contacts())
            if moves and self.step_count % self._steps_per_target_update == 0:
                self.place(TARGET, self.state(TARGET))
        return touched

    def _process_contacts(self) -> tuple[tuple[str, str], ...]:
        """Pass the contacts of the last step to the latches; return ``contacts``."""
        pairs, tips = self._find_contacts()
        self._update_latches(tips)
        return pairs

    def _update_joints(self) -> set[int]:
        """Execute the latches' commands and faults that are due; return the bodies with a closed latch."""
        for name, latch in self.latches.items():
            if latch.apply_due_commands(self.step_count):
                self._detach(name)
            if latch.faults and latch.latched:
                self._apply_latch_faults(name, latch)
        attached = (*self._joints, *self._compliant)
        return {self._bodies[name] for name in (*attached, TARGET)} if attached else set()

    def _apply_orbital(self, orbital: OrbitalForces, body: int, pose: Any, rates: Any) -> None:
        """Apply the loads of the orbit to a body for one step; ``pose``, ``rates``: Bullet's."""
        name = self._names[body]
        plant = self.plants[name]
        orbital.set_step(self.step_count)
        force = orbital.force(body, plant.mass_kg, pose[0], rates[0], name != TARGET)
        torque = orbital.torque(pose[1], rates[1], plant.moments_kg_m2)
        pybullet.applyExternalForce(body, -1, force, pose[0], pybullet.WORLD_FRAME, self._client)
        pybullet.applyExternalTorque(body, -1, torque, pybullet.LINK_FRAME, self._client)

    def _record_loads(self) -> None:
        """Record the loads at the ports with rigid joints in the last step; open latches that they are too large for."""
        closing, self._closing = self._closing, False
        for name, joint in tuple(self._joints.items()):
            self._record_load(name, pybullet.getConstraintState(joint, self._client), closing)

    def _record_load(self, name: str, reaction: Sequence[float], closing: bool = False) -> None:
        target_xyzw, chaser_xyzw = (self._before[self._bodies[n]][0][1] for n in (TARGET, name))
        self.port_loads[name].add(reaction, target_xyzw, chaser_xyzw, closing)
        strength = self._scenario.truth.latch
        for load, limit, unit in (
            (math.hypot(*reaction[:3]), strength.strength_N, "N"),
            (math.hypot(*reaction[3:]), strength.strength_N_m, "N m"),
        ):
            if limit is not None and load > limit and not closing and self.latches[name].latched:
                self._open(name, f"{load:.3g} {unit} on the port, strength {limit:g} {unit}")

    def _apply_latch_faults(self, name: str, latch: ProbeLatch) -> None:
        """Open a closed latch, or let it slip, where a fault says so."""
        if latch.fault_at("latch_open", self.step_count) is not None:
            self._open(name, "fault latch_open")
        elif name in self._joints and latch.fault_at("latch_slip", self.step_count) is not None:
            self._remove_joint(name)
            self._compliant[name] = self._compliant_latch(name)

    def _apply_compliant_latches(self) -> None:
        """Apply the loads of latches with play, and of those that slip, to target and chasers for one step."""
        force_on, torque_on = pybullet.applyExternalForce, pybullet.applyExternalTorque
        reach_m, target = self._scenario.chaser.probe_reach_m, self.state(TARGET)
        for name, compliant in tuple(self._compliant.items()):
            slip = self.latches[name].fault_at("latch_slip", self.step_count)
            grip = Grip() if slip is None else slip.grip
            force, torque, tip = compliant.load(target, self.state(name), reach_m, grip)
            for body, sign in ((self._bodies[TARGET], 1.0), (self._bodies[name], -1.0)):
                force_on(body, -1, (sign * force).tolist(), tip.tolist(), pybullet.WORLD_FRAME, self._client)
                torque_on(body, -1, (sign * torque).tolist(), pybullet.WORLD_FRAME, self._client)
            x, y, z, w = self._before[self._bodies[name]][0][1]
            self._record_load(name, [*force, *rotations.rotate_inverse([w, x, y, z], torque)])
            if name in self._compliant and compliant.slipped_m > ENGAGED_M:
                self._open(name, f"slipped {compliant.slipped_m * 1e3:.0f} mm, out of its port")

    def _open(self, name: str, reason: str) -> None:
        """Open a latch that no command opens."""
        self._openings.append((self.latches[name].chaser, reason))
        self.latches[name].open(self.step_count)
        self._detach(name)

    def take_openings(self) -> list[tuple[int, str]]:
        """Return the latches that have opened without a command since the last call: chaser and reason."""
        openings, self._openings = self._openings, []
        return openings

    def contacts(self) -> tuple[tuple[str, str], ...]:
        """Return the pairs of bodies in contact after the last step, sorted, without probe tips on the target."""
        return self._find_contacts()[0]

    def _find_contacts(self) -> tuple[tuple[tuple[str, str], ...], set[str]]:
        """Return ``contacts``, and the chasers whose probe tip touches the target."""
        pairs, tips = set(), set()
        for c in self._bullet.getContactPoints():
            # Bullet stops bodies at a distance (c[8]) of zero up to rounding, so the force (c[9]) is checked as well.
            if not (c[8] <= 0.0 or c[9] > 0.0):
                continue
            for name, other, point in ((c[1], c[2], c[5]), (c[2], c[1], c[6])):
                if self._names[other] == TARGET and self._is_tip(self._names[name], point):
                    tips.add(self._names[name])
                    break
            else:
                pairs.add(tuple(sorted((self._names[c[1]], self._names[c[2]]))))
        return tuple(sorted((a, b) for a, b in pairs)), tips

    def _is_tip(self, name: str, point_m: tuple[float, float, float]) -> bool:
        """Return whether a point (3,), WRF, of a chaser's surface is on the round end of its probe."""
        if name not in self.latches:
            return False
        s = self.state(name)
        ahead_m = float(rotations.rotate_inverse(s.q_wxyz, np.array(point_m) - s.position_m)[0])
        return ahead_m > self._scenario.chaser.probe_reach_m - 2.0 * PROBE_RADIUS_M

    def command_latch(self, chaser: int, command: Latch, effective_step: int) -> None:
        """Command a chaser's latch from ``effective_step`` on; ignored for a chaser without a port."""
        latch = self.latches.get(f"chaser/{chaser}")
        if latch is not None:
            latch.command(command, effective_step)

    def close_latch(self, chaser: int) -> None:
        """Latch a chaser to the target in their present relative pose, without contact: the start of a flight as a stack."""
        latch = self.latches[f"chaser/{chaser}"]
        latch.armed = latch.latched = True
        self._attach(f"chaser/{chaser}")

    def _update_latches(self, tips: set[str]) -> None:
        """Pass the contacts of the last step to the latches of these chasers."""
        for name in sorted(tips):
            chaser, target = (self._body_state(n, *self._before[self._bodies[n]]) for n in (name, TARGET))
            latch = self.latches[name]
            q_off = np.asarray(self._scenario.chasers[latch.chaser].q_wxyz)
            reach_m = self._scenario.chaser.probe_reach_m
            view = view_of(latch.port, reach_m, q_off, chaser, target)
            if latch.touch(self.step_count - 1, view):
                self._attach(name)
        if self._closing:
            self._before.clear()  # the joints change the rates abruptly

    def _attach(self, name: str) -> None:
        """Hold a chaser's probe in its port in their current relative pose."""
        play = self._scenario.truth.latch
        if play.play_m or play.play_deg:
            self._compliant[name] = self._compliant_latch(name)
        else:
            self._add_joint(name)
            self._closing = True
        # The contact spring would work against the latch.
        self._bullet.setCollisionFilterPair(self._bodies[TARGET], self._bodies[name], -1, -1, 0)

    def _detach(self, name: str) -> None:
        if name in self._joints:
            self._remove_joint(name)
        self._compliant.pop(name, None)
        self._bullet.setCollisionFilterPair(self._bodies[TARGET], self._bodies[name], -1, -1, 1)

    def _compliant_latch(self, name: str) -> CompliantLatch:
        """Return a latch that holds a chaser where it is."""
        target, chaser, play = self.state(TARGET), self.state(name), self._scenario.truth.latch
        tip = np.array([self._scenario.chaser.probe_reach_m, 0.0, 0.0])
        place = chaser.position_m + rotations.rotate(chaser.q_wxyz, tip) - target.position_m
        return CompliantLatch(
            rotations.rotate_inverse(target.q_wxyz, place),
            rotations.multiply(rotations.conjugate(target.q_wxyz), chaser.q_wxyz),
            play.play_m,
            math.radians(play.play_deg),
        )

    def _add_joint(self, name: str) -> None:
        """Fix a chaser's probe tip to the target in their current relative pose."""
        chaser = self.state(name)
        tip = np.array([self._scenario.chaser.probe_reach_m, 0.0, 0.0])
        tip_world = chaser.position_m + rotations.rotate(chaser.q_wxyz, tip)
        chaser, target = self._bullet_state(name, chaser), self._bullet_state(TARGET, self.state(TARGET))
        if self.plants[name].frame is not None:
            tip = rotations.rotate_inverse(chaser.q_wxyz, tip_world - chaser.position_m)
        relative = rotations.multiply(rotations.conjugate(target.q_wxyz), chaser.q_wxyz)
        a, b = self._bodies[TARGET], self._bodies[name]
        self._joints[name] = self._bullet.createConstraint(
            parentBodyUniqueId=a,
            parentLinkIndex=-1,
            childBodyUniqueId=b,
            childLinkIndex=-1,
            jointType=pybullet.JOINT_FIXED,
            jointAxis=[0, 0, 0],
            parentFramePosition=rotations.rotate_inverse(
                target.q_wxyz, tip_world - target.position_m
            ).tolist(),
            childFramePosition=tip.tolist(),
            parentFrameOrientation=_xyzw(relative),
            childFrameOrientation=[0.0, 0.0, 0.0, 1.0],
        )

    def _remove_joint(self, name: str) -> None:
        self._bullet.removeConstraint(self._joints.pop(name))

    def close(self) -> None:
        """Disconnect the PyBullet client."""
        self._bullet.disconnect()


def _has_noise(scenario: Scenario) -> bool:
    sigma = scenario.truth.mismatch("chaser")
    return bool(sigma.force_noise_N or sigma.torque_noise_N_m)


def _disturbance_noise(scenario: Scenario, chaser: int) -> tuple[GaussMarkov, Array]:
    """Return the processes of a chaser's disturbance and their standard deviations (6,), N and N m."""
    sigma, period_s = scenario.truth.mismatch("chaser"), 1.0 / scenario.time.rate_hz
    times_s = [sigma.disturbance_time_s] * 6
    noise = GaussMarkov(scenario.seed, Stream.DISTURBANCE, chaser, times_s, period_s)
    return noise, np.repeat([sigma.force_noise_N, sigma.torque_noise_N_m], 3)


def _place(plant: Plant, position_m: list[float], xyzw: list[float]) -> tuple[list[float], list[float]]:
    """Return position and attitude (Bullet's order) of a part in Bullet's frame of a body, from those in the body's frame."""
    if plant.frame is None:
        return position_m, xyzw
    position, q = plant.frame.place(np.array(position_m), np.array([xyzw[3], *xyzw[:3]]))
    return position.tolist(), _xyzw(q)


def _state_of(pose: Any, rates: Any) -> BodyState:
    """Return a body's state from Bullet's pose and its velocity and rate in world axes."""
    (position, xyzw), (velocity, omega_world) = pose, rates
    q = rotations.normalize([xyzw[3], *xyzw[:3]])
    return BodyState(np.array(position), np.array(velocity), q, rotations.rotate_inverse(q, omega_world))


def prescribed_state(scenario: Scenario, time_s: float) -> BodyState:
    """Return the target's exact state at a simulated time under constant velocity and body rate."""
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
