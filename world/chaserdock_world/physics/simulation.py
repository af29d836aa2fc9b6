# SPDX-License-Identifier: Apache-2.0
"""Rigid-body simulation of a scenario on one of the engines (engine.py): bodies, disturbances,
latches and loads.

The interface is in body frames with body rates. The forces of an orbit are applied to every body
(orbital_forces.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

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

from .collision_hulls import collision_hulls, triangles_of
from .compliant_latch import ENGAGED_M, CompliantLatch, Grip
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
from .engine_factory import make_engine
from .gyroscopic import midpoint_torque, midpoint_torque_of_rates, split_loads
from .latch import ProbeLatch, latch_faults
from .orbital_forces import OrbitalForces
from .plume_loads import PlumeLoads
from .port_loads import PortLoadRecorder, port_attitude

TARGET = "target"
PROBE_RADIUS_M = 0.006
_Z_TO_X_WXYZ = np.array([0.5**0.5, 0.0, 0.5**0.5, 0.0])
# A compliant contact: restitution 0.35 and 0.3 mm penetration at 1 cm/s (docs/docking.md).
_STIFFNESS_N_M, _DAMPING_N_S_M = 1e4, 100.0
_ZERO = (0.0, 0.0, 0.0)
_NO_WRENCH = np.zeros(6)


class Physics:
    """Simulates the bodies of a scenario on an engine of its own. Raises MissingPackageError
    without the engine's package.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.step_count = 0
        self._scenario = scenario
        self._prescribed = scenario.target.motion != "torque_free"
        # Interval at which the engine's copy of a prescribed target is moved; ``state`` is exact at
        # every step.
        self._steps_per_target_update = max(1, scenario.time.physics_hz // 120)
        chasers = {f"chaser/{i}": i for i in range(len(scenario.chasers))}
        self.plants = {TARGET: target_plant(scenario)}
        self.plants |= {name: chaser_plant(scenario, i) for name, i in chasers.items()}
        self._bodies = {name: number for number, name in enumerate(self.plants)}
        self._names = tuple(self.plants)
        hz, docking = scenario.time.physics_hz, scenario.docking
        ports = docking.ports if docking.kind == "capture" else ()
        self.latches = {
            f"chaser/{p.chaser}": ProbeLatch(
                p.chaser, p, docking.tolerances, hz, latch_faults(scenario, p.chaser)
            )
            for p in ports
        }
        definitions = [
            self._target_definition(),
            *(self._chaser_definition(i) for i in chasers.values()),
        ]
        joints = tuple((self._bodies[TARGET], self._bodies[name]) for name in self.latches)
        setup = EngineSetup(definitions, 1.0 / hz, self._contact_spring(), joints)
        self._engine = make_engine(scenario.world.engine, setup)
        # Bodies that the engine integrates.
        self._free = {name: self.plants[name] for name in chasers}
        if not self._prescribed:
            self._free[TARGET] = self.plants[TARGET]
        self._free_bodies = np.array([self._bodies[name] for name in self._free], dtype=np.int64)
        # Principal moments, force and torque of the free bodies.
        self._loads = np.zeros((len(self._free), 9))
        self._loads[:, :3] = [plant.moments_kg_m2 for plant in self._free.values()]
        self._prescribed_start = _prescribed_start(scenario)
        self._disturbed = {name for name, plant in self.plants.items() if plant.disturbance.any()}
        self._moves_target = self._prescribed and scenario.target.motion != "static"
        self._orbital: OrbitalForces | None = None
        if scenario.orbit is not None:
            self._orbital = OrbitalForces(
                TargetOrbit(scenario.orbit), 1.0 / hz, scenario.timing.steps_per_tick
            )
        self.plumes = None if scenario.plume is None else PlumeLoads(scenario, scenario.plume)
        self._noise = {
            name: _disturbance_noise(scenario, i)
            for name, i in chasers.items()
            if _has_noise(scenario)
        }
        self.port_loads = {
            name: self._load_recorder(name, p.chaser) for name, p in self.latches.items()
        }
        self._joints: list[
            str
        ] = []  # chasers with a rigid joint, in the order in which they latched
        self._compliant: dict[str, CompliantLatch] = {}
        self._openings: list[tuple[int, str]] = []
        self._closing = (
            False  # a latch closed in the last step: its joint acts first in the next one
        )
        # Motion of every free body at the beginning of the last step.
        self._before: dict[int, BodyMotion] = {}

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

    def _contact_spring(self) -> ContactSpring | None:
        """Return the contact of docking by capture; bodies that are not meant to touch are hard."""
        if self._scenario.docking.kind != "capture":
            return None
        target, chaser = self.plants[TARGET].mass_kg, self._scenario.chaser.mass_kg
        return ContactSpring(_STIFFNESS_N_M, _DAMPING_N_S_M, target * chaser / (target + chaser))

    def _target_definition(self) -> RigidBodyDefinition:
        scenario, plant = self._scenario, self.plants[TARGET]
        model, mesh = scenario.target_model(), true_mesh(scenario)
        hulls = collision_hulls(mesh) if model.hulls and mesh is not None else []
        solids = _hull_solids(hulls, plant) if hulls else _box_solids(model, plant)
        mass_kg = 0.0 if self._prescribed else plant.mass_kg
        state = self._engine_state(TARGET, prescribed_state(scenario, 0.0))
        return RigidBodyDefinition(mass_kg, plant.moments_kg_m2, solids, state)

    def _chaser_definition(self, i: int) -> RigidBodyDefinition:
        scenario, body, plant = self._scenario, self._scenario.chaser, self.plants[f"chaser/{i}"]
        half = [s / 2 for s in body.size_m]
        solids: list[CollisionSolid] = [
            SolidBox(half, *_place(plant, np.zeros(3), rotations.IDENTITY))
        ]
        if scenario.docking.kind == "capture":
            # The probe: a massless capsule from the body's front to the tip.
            length = body.probe_reach_m - half[0] - PROBE_RADIUS_M
            middle = np.array([half[0] + length / 2, 0.0, 0.0])
            solids.append(
                SolidCapsule(PROBE_RADIUS_M, length, *_place(plant, middle, _Z_TO_X_WXYZ))
            )
        position, attitude = scenario.start_pose(i)
        state = BodyState(
            position, np.asarray(scenario.chasers[i].start_velocity_m_s), attitude, np.zeros(3)
        )
        state = self._engine_state(f"chaser/{i}", state)
        return RigidBodyDefinition(plant.mass_kg, plant.moments_kg_m2, solids, state)

    def state(self, name: str) -> BodyState:
        """Return the current state of a body; that of a prescribed target is exact."""
        if name == TARGET and self._prescribed:
            return _moved(self._prescribed_start, self.step_count / self._scenario.time.physics_hz)
        return self._body_state(name, self._engine.motion(self._bodies[name]))

    def _body_state(self, name: str, motion: BodyMotion) -> BodyState:
        """Return the state of a body's frame from the engine's motion of it."""
        state, frame = _state_of(motion), self.plants[name].frame
        return state if frame is None else frame.to_body(state)

    def _engine_state(self, name: str, state: BodyState) -> BodyState:
        """Return the state of the frame that the engine integrates from that of a body's frame."""
        frame = self.plants[name].frame
        return state if frame is None else frame.from_body(state)

    def place(self, name: str, state: BodyState) -> None:
        """Set the state of a body. Contacts are not checked."""
        self._engine.place(self._bodies[name], self._engine_state(name, state))

    def next_change(self, step: int) -> int | None:
        """Return the first step after ``step`` at which a disturbance changes, None if all are
        constant.
        """
        per_tick = self._scenario.timing.steps_per_tick
        return (step // per_tick + 1) * per_tick if self._noise else None

    def _wrench_on(self, name: str, wrench: Array) -> Array:
        """Return force and torque (6,), in the engine's frame of a body, of its actuators and its
        present disturbances.
        """
        plant = self.plants[name]
        if name in self._disturbed:
            wrench = wrench + plant.disturbance
        if name in self._noise:
            noise, sigma = self._noise[name]
            wrench = wrench + sigma * noise.at(
                self.step_count // self._scenario.timing.steps_per_tick
            )
        return wrench if plant.frame is None else plant.frame.wrench(wrench)

    def advance(self, steps: int, wrenches: dict[str, Array]) -> set[tuple[str, str]]:
        """Make ``steps`` physics steps under constant wrenches; return the pairs of bodies that
        touched.

        ``wrenches`` maps a chaser's name to force and torque (6,) at its origin in its body axes, N
        and N m. Disturbances must not change in between (see ``next_change``).
        """
        loads = self._loads
        for k, name in enumerate(self._free):
            loads[k, 3:] = self._wrench_on(name, wrenches.get(name, _NO_WRENCH))
        if self.latches or self._orbital is not None:
            return self._advance_by_step(steps, loads)
        touched: set[tuple[str, str]] = set()
        end = self.step_count + steps
        while self.step_count < end:
            path = self._target_path(end) if self._moves_target else None
            made, touching = self._engine.advance(
                self._free_bodies, loads, end - self.step_count, path
            )
            self.step_count += made
            if touching:
                touched.update(self._process_contacts())
                self._move_target()
        return touched

    def _target_path(self, end: int) -> PlacementPath | None:
        """Return where the engine's copy of a prescribed target is placed until the step ``end``,
        None if nowhere.
        """
        every = self._steps_per_target_update
        first = self.step_count - self.step_count % every + every
        if first > end:
            return None
        times_s = np.arange(first, end + 1, every)[:, None] / self._scenario.time.physics_hz
        states = _moved(self._prescribed_start, times_s)
        return PlacementPath(self._bodies[TARGET], first - self.step_count, every, states)

    def _move_target(self) -> None:
        """Move the engine's copy of a prescribed target, if it is due."""
        if self._moves_target and self.step_count % self._steps_per_target_update == 0:
            self.place(TARGET, self.state(TARGET))

    def _advance_by_step(self, steps: int, wrenches: Array) -> set[tuple[str, str]]:
        """Make steps in which loads depend on the motion: with latches, or in an orbit.
        ``wrenches``: as ``_loads``.
        """
        step_s = 1.0 / self._scenario.time.physics_hz
        loads = split_loads(self._free_bodies, wrenches)
        touched: set[tuple[str, str]] = set()
        engine, before, jointed = self._engine, self._before, set[int]()
        motion_of, push = engine.motion, engine.push
        for _ in range(steps):
            if self.latches:
                jointed = self._update_joints()
            for body, inertia, force, torque in loads:
                motion = motion_of(body)
                if body in jointed:
                    last = before.get(body, motion)
                    x, y, z = midpoint_torque_of_rates(inertia, motion[1], motion[3], last[3])
                else:
                    x, y, z = midpoint_torque(inertia, motion[1], motion[3], torque, step_s)
                before[body] = motion
                push(body, force, (torque[0] + x, torque[1] + y, torque[2] + z))
                if self._orbital is not None:
                    self._apply_orbital(self._orbital, body, motion)
            if self._compliant:
                self._apply_compliant_latches()
            engine.step()
            self.step_count += 1
            if self._joints:
                self._record_loads()
            # A bounce may last a single step, so contacts are checked after each.
            if engine.touching():
                touched.update(self._process_contacts())
            self._move_target()
        return touched

    def _process_contacts(self) -> tuple[tuple[str, str], ...]:
        """Pass the contacts of the last step to the latches; return ``contacts``."""
        pairs, tips = self._find_contacts()
        self._update_latches(tips)
        return pairs

    def _update_joints(self) -> set[int]:
        """Execute the latches' commands and faults that are due; return the bodies with a closed
        latch.
        """
        for name, latch in self.latches.items():
            if latch.apply_due_commands(self.step_count):
                self._detach(name)
            if latch.faults and latch.latched:
                self._apply_latch_faults(name, latch)
        attached = (*self._joints, *self._compliant)
        return {self._bodies[name] for name in (*attached, TARGET)} if attached else set()

    def _apply_orbital(self, orbital: OrbitalForces, body: int, motion: BodyMotion) -> None:
        """Apply the loads of the orbit to a body for one step."""
        name, (position, q_wxyz, velocity, omega_world) = self._names[body], motion
        plant = self.plants[name]
        orbital.set_step(self.step_count)
        force = orbital.force(body, plant.mass_kg, position, velocity, name != TARGET)
        torque = orbital.torque(q_wxyz, omega_world, plant.moments_kg_m2)
        self._engine.push_at(body, force, _ZERO, position)
        self._engine.push(body, _ZERO, torque)

    def _record_loads(self) -> None:
        """Record the loads at the ports with rigid joints in the last step; open latches that they
        are too large for.
        """
        closing, self._closing = self._closing, False
        target = self._bodies[TARGET]
        for name in tuple(self._joints):
            self._record_load(name, self._engine.reaction(target, self._bodies[name]), closing)

    def _record_load(self, name: str, reaction: Sequence[float], closing: bool = False) -> None:
        q_target, q_chaser = (self._before[self._bodies[n]][1] for n in (TARGET, name))
        self.port_loads[name].add(reaction, q_target, q_chaser, closing)
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
        """Apply the loads of latches with play, and of those that slip, to target and chasers for
        one step.
        """
        reach_m, target = self._scenario.chaser.probe_reach_m, self.state(TARGET)
        for name, compliant in tuple(self._compliant.items()):
            slip = self.latches[name].fault_at("latch_slip", self.step_count)
            grip = Grip() if slip is None else slip.grip
            force, torque, tip = compliant.load(target, self.state(name), reach_m, grip)
            for body, sign in ((self._bodies[TARGET], 1.0), (self._bodies[name], -1.0)):
                self._engine.push_at(
                    body, (sign * force).tolist(), (sign * torque).tolist(), tip.tolist()
                )
            q_chaser = self._before[self._bodies[name]][1]
            self._record_load(name, [*force, *rotations.rotate_inverse(q_chaser, torque)])
            if name in self._compliant and compliant.slipped_m > ENGAGED_M:
                self._open(name, f"slipped {compliant.slipped_m * 1e3:.0f} mm, out of its port")

    def _open(self, name: str, reason: str) -> None:
        """Open a latch that no command opens."""
        self._openings.append((self.latches[name].chaser, reason))
        self.latches[name].open(self.step_count)
        self._detach(name)

    def take_openings(self) -> list[tuple[int, str]]:
        """Return the latches that have opened without a command since the last call: chaser and
        reason.
        """
        openings, self._openings = self._openings, []
        return openings

    def contacts(self) -> tuple[tuple[str, str], ...]:
        """Return the pairs of bodies in contact after the last step, sorted, without probe tips on
        the target.
        """
        return self._find_contacts()[0]

    def _find_contacts(self) -> tuple[tuple[tuple[str, str], ...], set[str]]:
        """Return ``contacts``, and the chasers whose probe tip touches the target."""
        pairs, tips = set(), set()
        for contact in self._engine.contacts():
            if (tip := self._touching_tip(contact)) is not None:
                tips.add(tip)
            else:
                pairs.add(tuple(sorted((self._names[contact.a], self._names[contact.b]))))
        return tuple(sorted((a, b) for a, b in pairs)), tips

    def _touching_tip(self, contact: BodyContact) -> str | None:
        """Return the chaser whose probe tip touches the target in a contact, or None."""
        a, b = self._names[contact.a], self._names[contact.b]
        for name, other, point in ((a, b, contact.point_a_m), (b, a, contact.point_b_m)):
            if other == TARGET and self._is_tip(name, point):
                return name
        return None

    def _is_tip(self, name: str, point_m: Sequence[float]) -> bool:
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
        """Latch a chaser to the target in their present relative pose, without contact: the start
        of a flight as a stack.
        """
        latch = self.latches[f"chaser/{chaser}"]
        latch.armed = latch.latched = True
        self._attach(f"chaser/{chaser}")

    def _update_latches(self, tips: set[str]) -> None:
        """Pass the contacts of the last step to the latches of these chasers."""
        for name in sorted(tips):
            chaser, target = (
                self._body_state(n, self._before[self._bodies[n]]) for n in (name, TARGET)
            )
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
        self._engine.set_collisions(self._bodies[TARGET], self._bodies[name], False)

    def _detach(self, name: str) -> None:
        if name in self._joints:
            self._remove_joint(name)
        self._compliant.pop(name, None)
        self._engine.set_collisions(self._bodies[TARGET], self._bodies[name], True)

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
        chaser, target = (
            self._engine_state(name, chaser),
            self._engine_state(TARGET, self.state(TARGET)),
        )
        if self.plants[name].frame is not None:
            tip = rotations.rotate_inverse(chaser.q_wxyz, tip_world - chaser.position_m)
        relative = rotations.multiply(rotations.conjugate(target.q_wxyz), chaser.q_wxyz)
        port = rotations.rotate_inverse(target.q_wxyz, tip_world - target.position_m)
        self._engine.join(self._bodies[TARGET], self._bodies[name], port, tip, relative)
        self._joints.append(name)

    def _remove_joint(self, name: str) -> None:
        self._joints.remove(name)
        self._engine.separate(self._bodies[TARGET], self._bodies[name])

    def close(self) -> None:
        """Free the engine."""
        self._engine.close()


def _has_noise(scenario: Scenario) -> bool:
    sigma = scenario.truth.mismatch("chaser")
    return bool(sigma.force_noise_N or sigma.torque_noise_N_m)


def _disturbance_noise(scenario: Scenario, chaser: int) -> tuple[GaussMarkov, Array]:
    """Return the processes of a chaser's disturbance and their standard deviations (6,), N and N m."""
    sigma, period_s = scenario.truth.mismatch("chaser"), 1.0 / scenario.time.rate_hz
    times_s = [sigma.disturbance_time_s] * 6
    noise = GaussMarkov(scenario.seed, Stream.DISTURBANCE, chaser, times_s, period_s)
    return noise, np.repeat([sigma.force_noise_N, sigma.torque_noise_N_m], 3)


def _place(plant: Plant, position_m: Array, q_wxyz: Array) -> tuple[Array, Array]:
    """Return the pose of a part in the engine's frame of a body from that in the body's frame."""
    return (position_m, q_wxyz) if plant.frame is None else plant.frame.place(position_m, q_wxyz)


def _box_solids(model: TargetModel, plant: Plant) -> list[SolidBox]:
    return [
        SolidBox(
            [s / 2 for s in box.size_m],
            *_place(plant, np.array(box.position_m), np.asarray(box.q_wxyz)),
        )
        for box in model.boxes
    ]


def _hull_solids(hulls: Sequence[Array], plant: Plant) -> list[SolidHull]:
    return [
        SolidHull(_place(plant, hull, rotations.IDENTITY)[0], triangles_of(hull)) for hull in hulls
    ]


def _state_of(motion: BodyMotion) -> BodyState:
    """Return the state of the engine's frame of a body."""
    position, q_wxyz, velocity, omega_world = motion
    q = rotations.normalize(q_wxyz)
    return BodyState(
        np.array(position), np.array(velocity), q, rotations.rotate_inverse(q, omega_world)
    )


def prescribed_state(scenario: Scenario, time_s: float) -> BodyState:
    """Return the target's exact state at a simulated time under constant velocity and body rate."""
    return _moved(_prescribed_start(scenario), time_s)


def _prescribed_start(scenario: Scenario) -> BodyState:
    target = scenario.target
    still = target.motion == "static"
    velocity = np.zeros(3) if still else np.asarray(target.velocity_m_s)
    omega = np.zeros(3) if still else np.asarray(target.omega_rad_s)
    return BodyState(np.asarray(target.position_m), velocity, np.asarray(target.q_wxyz), omega)


def _moved(start: BodyState, time_s: float | Array) -> BodyState:
    """Return a state after a time, or after times (K, 1), at constant velocity and body rate."""
    velocity, omega = start.velocity_m_s, start.omega_rad_s
    position = start.position_m + velocity * time_s
    return BodyState(position, velocity, rotations.integrate(start.q_wxyz, omega, time_s), omega)
