# SPDX-License-Identifier: Apache-2.0
"""Simulate the rigid bodies of a scenario, with disturbances, latches and loads, on an engine.

The interface is in body frames with body rates. The forces of an orbit are applied to every body
(orbital_forces.py).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.thruster_model import G0_M_S2
from chaserdock_protocol.messages import Latch
from chaserdock_protocol.scenario import Scenario

from chaserdock_world.orbit import TargetOrbit
from chaserdock_world.plant import chaser_plant, target_plant

from .definitions import TARGET, engine_setup
from .disturbances import Disturbances
from .engine import BodyMotion
from .engine_factory import make_engine
from .floor import Floor, on_floor
from .gyroscopic import midpoint_torque, midpoint_torque_of_rates, split_loads
from .latch import ProbeLatch
from .latching import ContactPairs, Latching
from .moving_bodies import MovingBodies
from .orbital_forces import OrbitalForces
from .oscillators import BodyOscillators, carried_by
from .plume_loads import PlumeLoads
from .port_loads import PortLoadRecorder
from .target_motion import PrescribedMotion, prescribed_state

_ZERO = (0.0, 0.0, 0.0)  # N or N m
_NO_WRENCH = np.zeros(6)
_KEYS_OF_BODY = 1000
"""Distance of the keys of what bodies carry, above the numbers of the bodies."""


class Physics:
    """Simulate the bodies of a scenario on an engine of its own.

    ``plumes``: loads of the thrusters' plumes, None if the scenario has none. Raises
    MissingPackageError without the engine's package.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        chasers = {f"chaser/{i}": chaser_plant(scenario, i) for i in range(len(scenario.chasers))}
        self.plants = {TARGET: target_plant(scenario)} | chasers
        if scenario.chaser.is_planar:
            self.plants = on_floor(scenario, self.plants)
        self.plants, self._carried = carried_by(scenario, self.plants)
        setup = engine_setup(scenario, self.plants)
        self._engine = make_engine(scenario.world.engine, setup)
        prescribed = PrescribedMotion(scenario) if scenario.target.motion != "torque_free" else None
        self._bodies = MovingBodies(self._engine, self.plants, prescribed)
        self._latching = Latching(scenario, self._bodies)
        self._disturbances = Disturbances(scenario, self.plants)
        # Bodies that the engine integrates, with principal moments, force and torque of each.
        self._free = tuple(chasers if prescribed else (*chasers, TARGET))
        self._free_numbers = np.array([self._bodies.numbers[n] for n in self._free], dtype=np.int64)
        self._loads = np.zeros((len(self._free), 9))
        self._loads[:, :3] = [self.plants[name].moments_kg_m2 for name in self._free]
        self._floor: Floor | None = None
        if scenario.chaser.is_planar:
            self._floor = Floor(self._engine, self._free_numbers.tolist())
        self._orbital: OrbitalForces | None = None
        if scenario.orbit is not None:
            self._orbital = OrbitalForces(
                TargetOrbit(scenario.orbit), setup.step_s, scenario.timing.steps_per_tick
            )
        for name, carried in self._carried.items():
            carried.settle(self._engine.motion(self._bodies.numbers[name]))
        self.plumes = None if scenario.plume is None else PlumeLoads(scenario, scenario.plume)

    # -- bodies ------------------------------------------------------------------------------------

    @property
    def step_count(self) -> int:
        """Return the number of physics steps made."""
        return self._bodies.step_count

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of all bodies: ``target``, ``chaser/0``, ..."""
        return self._bodies.names

    def state(self, name: str) -> BodyState:
        """Return the current state of a body; that of a prescribed target is exact."""
        return self._bodies.state(name)

    def place(self, name: str, state: BodyState) -> None:
        """Set the state of a body. Contacts are not checked."""
        self._bodies.place(name, state)
        if name in self._carried:
            self._carried[name].settle(self._engine.motion(self._bodies.numbers[name]))

    @property
    def carried(self) -> Mapping[str, BodyOscillators]:
        """Return what bodies carry on springs, by the bodies' names."""
        return self._carried

    def deflections_m(self, name: str) -> Array:
        """Return the displacements (n, 3) of what a body carries from its places, body axes."""
        return self._carried[name].deflections_m(self._engine.motion(self._bodies.numbers[name]))

    @property
    def burns_propellant(self) -> bool:
        """Whether the chasers' masses fall with their propellant, which ``burn`` consumes."""
        return any(o.propellant for o in self._scenario.truth.oscillators("chaser"))

    def burn(self, name: str, thrusts_N: Array, time_s: float) -> None:
        """Consume the propellant of a chaser's thrusters with these thrusts (n,) for a time."""
        exhaust_m_s = [t.isp_s * G0_M_S2 for t in self._scenario.chaser.thrusters]
        self._carried[name].burn(float(np.sum(thrusts_N / exhaust_m_s)) * time_s)

    # -- latches -----------------------------------------------------------------------------------

    @property
    def latches(self) -> dict[str, ProbeLatch]:
        """Return the latches of the chasers that have a port, by name."""
        return self._latching.latches

    @property
    def port_loads(self) -> dict[str, PortLoadRecorder]:
        """Return the loads at the ports, by the chasers' names."""
        return self._latching.port_loads

    def command_latch(self, chaser: int, command: Latch, effective_step: int) -> None:
        """Command a chaser's latch from ``effective_step`` on; ignored for a chaser without a
        port.
        """
        latch = self.latches.get(f"chaser/{chaser}")
        if latch is not None:
            latch.command(command, effective_step)

    def close_latch(self, chaser: int) -> None:
        """Latch a chaser to the target in their present relative pose, without contact.

        So a flight as a stack starts.
        """
        latch = self.latches[f"chaser/{chaser}"]
        latch.armed = latch.latched = True
        self._latching.attach(f"chaser/{chaser}")

    def take_openings(self) -> list[tuple[int, str]]:
        """Return chaser and reason of each latch that has opened without a command since the last
        call.
        """
        openings, self._latching.openings = self._latching.openings, []
        return openings

    def contacts(self) -> ContactPairs:
        """Return the pairs of bodies in contact after the last step, sorted, without probe tips on
        the target.
        """
        return self._latching.find_contacts()[0]

    # -- steps -------------------------------------------------------------------------------------

    def next_change(self, step: int) -> int | None:
        """Return the first step after ``step`` at which a disturbance changes, None if all are
        constant.
        """
        return self._disturbances.next_change(step)

    def advance(self, steps: int, wrenches: dict[str, Array]) -> set[tuple[str, str]]:
        """Make ``steps`` physics steps under constant wrenches; return the pairs of bodies that
        touched.

        ``wrenches`` maps a chaser's name to force and torque (6,) at its origin in its body axes, N
        and N m. Disturbances must not change in between (see ``next_change``).
        """
        for k, name in enumerate(self._free):
            wrench = wrenches.get(name, _NO_WRENCH)
            wrench = self._disturbances.added_to(wrench, name, self.step_count)
            self._loads[k, 3:] = self.plants[name].wrench_in_engine(wrench)
        if self._floor is not None:
            self._floor.carry(self._loads[:, 3:])
        if self.latches or self._orbital is not None or self._carried:
            return self._advance_by_step(steps)
        bodies = self._bodies
        touched: set[tuple[str, str]] = set()
        end = bodies.step_count + steps
        while bodies.step_count < end:
            path = None
            if bodies.prescribed is not None:
                path = bodies.prescribed.path(bodies.numbers[TARGET], bodies.step_count, end)
            made, touching = self._engine.advance(
                self._free_numbers, self._loads, end - bodies.step_count, path
            )
            bodies.step_count += made
            if touching:
                touched.update(self._latching.process_contacts())
                bodies.place_target()
                if self._floor is not None:
                    self._floor.hold()
        return touched

    def _advance_by_step(self, steps: int) -> set[tuple[str, str]]:
        """Make steps in which loads depend on the motion: with latches, or in an orbit."""
        step_s = 1.0 / self._scenario.time.physics_hz
        loads = split_loads(self._free_numbers, self._loads)
        touched: set[tuple[str, str]] = set()
        engine, bodies, latching = self._engine, self._bodies, self._latching
        motion_of, push, before = engine.motion, engine.push, bodies.before
        carried = {bodies.numbers[name] for name in self._carried}
        for _ in range(steps):
            jointed = latching.begin_step()
            for body, inertia, force, torque in loads:
                motion = motion_of(body)
                if body in carried:
                    force, torque = self._with_carried(body, motion, force, torque)
                if body in jointed:
                    last = before.get(body, motion)
                    x, y, z = midpoint_torque_of_rates(inertia, motion[1], motion[3], last[3])
                else:
                    x, y, z = midpoint_torque(inertia, motion[1], motion[3], torque, step_s)
                before[body] = motion
                push(body, force, (torque[0] + x, torque[1] + y, torque[2] + z))
                if self._orbital is not None:
                    self._apply_orbital(self._orbital, body, motion)
            latching.push()
            engine.step()
            bodies.step_count += 1
            latching.end_step()
            # A bounce may last a single step, so contacts are checked after each.
            touching = engine.touching()
            if touching:
                touched.update(latching.process_contacts())
            bodies.place_target()
            if self._floor is not None and (touching or jointed):
                self._floor.hold()
        return touched

    def _with_carried(
        self, body: int, motion: BodyMotion, force: list[float], torque: list[float]
    ) -> tuple[list[float], list[float]]:
        """Move what a body carries by one step; return the loads with what that exerts on it."""
        carried = self._carried[self.bodies[body]]
        others = None if self._orbital is None else self._orbital_on(carried, body, self._orbital)
        added_force, added_torque = carried.step(motion, others)
        return (added_force + force).tolist(), (added_torque + torque).tolist()

    def _orbital_on(self, carried: BodyOscillators, body: int, orbital: OrbitalForces) -> Array:
        """Return the loads of the orbit (n, 3) on what a body carries."""
        orbital.set_step(self.step_count)
        first = (body + 1) * _KEYS_OF_BODY
        has_drag = self.bodies[body] != TARGET
        rows = zip(*(part.tolist() for part in carried.momenta()), strict=True)
        return np.array(
            [orbital.force(first + k, m, x, v, has_drag) for k, (m, x, v) in enumerate(rows)]
        )

    def _apply_orbital(self, orbital: OrbitalForces, body: int, motion: BodyMotion) -> None:
        """Apply the loads of the orbit to a body for one step."""
        name, (position, q_wxyz, velocity, omega_world) = self.bodies[body], motion
        plant = self.plants[name]
        orbital.set_step(self.step_count)
        force = orbital.force(body, plant.mass_kg, position, velocity, name != TARGET)
        torque = orbital.torque(q_wxyz, omega_world, plant.moments_kg_m2)
        self._engine.push_at(body, force, _ZERO, position)
        self._engine.push(body, _ZERO, torque)

    def close(self) -> None:
        """Free the engine."""
        self._engine.close()


__all__ = ["TARGET", "BodyState", "Physics", "prescribed_state"]
