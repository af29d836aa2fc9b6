"""Missions in one process, without Zenoh: world, eyes and controller called in turn, tick by tick.

The same code flies as in the processes; what is left out is what carries messages. Eyes are given, so that a
statistical model can stand in for images; chasers have thrusters or not, and thrusters fail, as the scenario has it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from chaserdock_agents.chaser.command_gate import passed_on
from chaserdock_agents.chaser.perception import make_perception
from chaserdock_agents.chaser.sighting import look, prediction_from
from chaserdock_agents.chaser.thrusters.controller import ThrusterController
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.interfaces import TickInputs, TickOutputs
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import ActuatorCommand, OperatorCommand, PoseSolution, Sighting
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.actuators.ideal import fly_to
from chaserdock_world.actuators.thrusters import make_actuators
from chaserdock_world.physics.simulation import TARGET, BodyState, Physics
from chaserdock_world.rendering.cameras import Cameras
from chaserdock_world.sensors.publish import docking_status, odometry_of

States = dict[str, BodyState]
CameraPose = Callable[[int, int, int, States], Sighting]
"""From chaser, tick, time (ns) and all bodies' states to what that chaser sees."""


def seeing_eye(scenario: Scenario) -> CameraPose:
    """Real images, rendered and searched for markers as in the chaser's process."""
    cameras = Cameras(scenario)
    perception = make_perception(scenario)
    last: dict[int, Sighting] = {}

    def see(chaser: int, tick: int, time_ns: int, states: States) -> Sighting:
        number = tick // scenario.timing.ticks_per_image
        image = cameras.image(chaser, number, tick, time_ns, states)
        last[chaser] = look(perception, image, prediction_from(last.get(chaser)))
        return last[chaser]

    return see


def statistical_eye(
    scenario: Scenario, seed: int, position_m: float, attitude_rad: float, blind: float = 0.0
) -> CameraPose:
    """The target's true pose with white noise of these sigmas an axis; in the share ``blind`` of images, nothing."""
    rng = np.random.default_rng([seed, 0xE1E])
    camera = scenario.camera_model()
    covariance = vector(np.diag([position_m**2] * 3 + [attitude_rad**2] * 3))

    def see(chaser: int, tick: int, time_ns: int, states: States) -> Sighting:
        own, target = states[f"chaser/{chaser}"], states[TARGET]
        at, attitude = camera.irf_pose_in_world(own.position_m, own.q_wxyz)
        position = rotations.rotate_inverse(attitude, target.position_m - at) + rng.normal(0, position_m, 3)
        turned = rotations.multiply(target.q_wxyz, rotations.exp(rng.normal(0.0, attitude_rad, 3)))
        q = rotations.multiply(rotations.conjugate(attitude), turned)
        seen = PoseSolution(
            position_m=vector(position), q_wxyz=vector(q), covariance=covariance, reprojection_rms_px=0.1
        )
        nothing = rng.random() < blind
        return Sighting(
            tick=tick,
            sim_time_ns=time_ns,
            chaser=chaser,
            status="nothing" if nothing else "seen",
            solutions=() if nothing else (seen,),
            marker_ids=() if nothing else (0, 1, 2, 3),
            corners_px=(),
            rejected_ids=(),
        )

    return see


@dataclass
class Offline:
    """A mission in flight. ``actuators`` by chaser's name; ``last`` is the controller's latest answer;
    ``actuator_gain``: what ideal actuators give of what they are asked for.

    ``touched``: pairs of bodies that touched since the start, but for a probe's tip on the target; ``events``, with
    what the chasers found of their thrusters (``verdicts``); ``propellant_kg``, of all chasers.
    """

    scenario: Scenario
    eye: CameraPose
    actuator_gain: float = 1.0
    tick: int = 0
    touched: set[tuple[str, str]] = field(default_factory=set)
    touches: list[Any] = field(default_factory=list)
    events: list[tuple[float, str]] = field(default_factory=list)
    verdicts: list[tuple[float, str]] = field(default_factory=list)
    propellant_kg: float = 0.0
    last: TickOutputs | None = None

    def __post_init__(self) -> None:
        s = self.scenario
        self.physics = Physics(s)
        self.flight = ControllerCore(s, lambda: 0.0)
        self.actuators = {f"chaser/{i}": make_actuators(s, i) for i in range(len(s.chasers))}
        thrusters = s.chaser.actuation == "thrusters"
        self.pilots = {i: ThrusterController(s, i) for i in range(len(s.chasers))} if thrusters else {}

    @property
    def time_s(self) -> float:
        return self.scenario.timing.tick_time_ns(self.tick) / 1e9

    def states(self) -> States:
        return {name: self.physics.state(name) for name in self.physics.bodies}

    def phase(self, chaser: int) -> str:
        return self.flight.guidance.chasers[chaser].phase

    def step(self, commands: tuple[OperatorCommand, ...] = ()) -> TickOutputs:
        """Flies one tick: senses, decides, acts, and moves on to the next."""
        s, timing, physics = self.scenario, self.scenario.timing, self.physics
        tick, time_ns, states = self.tick, timing.tick_time_ns(self.tick), self.states()
        chasers = range(len(s.chasers))
        docking = {x.chaser: docking_status(x, tick, time_ns) for x in physics.latches.values()}
        for latch in physics.latches.values():
            self.touches += latch.take_touches()
        odometry = {i: odometry_of(i, states[f"chaser/{i}"], tick, time_ns) for i in chasers}
        reports = {}
        for i, pilot in self.pilots.items():
            felt = docking.get(i)
            reports[i] = pilot.observe(odometry[i], felt is not None and (felt.contact or felt.latched))
            self.verdicts += [
                (time_ns / 1e9, f"{what}, {detail}") for _, what, detail in pilot.drain_events()
            ]
        seen = tuple(self.eye(i, tick, time_ns, states) for i in chasers) if timing.has_images(tick) else ()
        out = self.flight.step(TickInputs(tick, time_ns, odometry, seen, commands, reports, docking))
        for i, wrench in out.wrenches.items():
            command = passed_on(wrench)
            if i in self.pilots:
                self.pilots[i].apply_command(wrench)
                command = self.pilots[i].add_pulses(command)
            if self.actuator_gain != 1.0:
                command = stronger(command, self.actuator_gain)
            effective = timing.step_of_time(command.effective_time_ns)
            self.actuators[f"chaser/{i}"].command(command, effective, physics.step_count)
            physics.command_latch(i, command.latch, effective)
        self.events += [(time_ns / 1e9, e.what) for e in out.events]
        self.fly(timing.step_of_tick(tick + 1))
        for name in self.actuators:
            self.given(name)
        self.tick += 1
        self.last = out
        return out

    def fly(self, step: int) -> None:
        """Moves the world on to a physics step."""
        step_s = 1.0 / self.scenario.timing.physics_hz
        self.touched |= fly_to(step, self.physics, self.actuators, step_s)

    def given(self, name: str) -> Array:
        """Impulse (6,), N s and N m s, body axes, that a chaser's actuators gave since this was last asked."""
        took = self.actuators[name].take_output(self.physics.step_count)
        self.propellant_kg += took.propellant_kg
        return took.impulse

    def close(self) -> None:
        self.physics.close()


def stronger(command: ActuatorCommand, gain: float) -> ActuatorCommand:
    """The command to ideal actuators that gives ``gain`` times as much."""
    return msgspec.structs.replace(
        command,
        force_N=vector(gain * np.array(command.force_N)),
        torque_N_m=vector(gain * np.array(command.torque_N_m)),
    )


def momentum(physics: Physics, masses: dict[str, tuple[float, Array]]) -> tuple[Array, Array]:
    """Momentum (3,), N s, and angular momentum (3,) about the common centre of mass, N m s, in WRF axes.

    ``masses``: mass and principal inertia (3,) of every body by name.
    """
    states = {name: physics.state(name) for name in masses}
    total = sum(m for m, _ in masses.values())
    centre = sum((m * states[n].position_m for n, (m, _) in masses.items()), np.zeros(3)) / total
    linear = sum((m * states[n].velocity_m_s for n, (m, _) in masses.items()), np.zeros(3))
    angular = np.zeros(3)
    for name, (m, inertia) in masses.items():
        s = states[name]
        angular += np.cross(s.position_m - centre, m * (s.velocity_m_s - linear / total))
        angular += rotations.rotate(s.q_wxyz, inertia * s.omega_rad_s)
    return linear, angular
