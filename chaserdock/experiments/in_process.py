# SPDX-License-Identifier: Apache-2.0
"""Flies a mission in one process: physics, sensors and actuators of the world with the cores of
chasers and controller.

They are called in the order and with the latencies of a lock-step mission, so that the bodies of a
scenario move exactly as with ``chaserdock run`` (tests/missions/test_in_process.py). All sensor and
actuator errors of the scenario apply. Left out is what a network and separate processes add:
message faults, process failures, access control.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Self

import msgspec
import numpy as np
from chaserdock_agents.chaser.core import ChaserCore
from chaserdock_agents.chaser.outbox import ChaserOutputs
from chaserdock_agents.chaser.vision import Vision
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.ingest.odometry_validation import OdometryValidation
from chaserdock_controller.interfaces import ChaserInputs, TickInputs, TickOutputs
from chaserdock_models import rotations
from chaserdock_protocol import topics
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import (
    ActuatorCommand,
    DockingStatus,
    Event,
    Message,
    Odometry,
    OperatorCommand,
    ProbeTouch,
    Sighting,
    ThrusterReport,
    Tick,
    WrenchCommand,
)
from chaserdock_protocol.scenario import Scenario, flight_scenario
from chaserdock_protocol.scenario.faults import faults_of
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import ReceivedMessage
from chaserdock_world.actuators.ideal import ActuatorOutput, fly_to
from chaserdock_world.actuators.thrusters import make_actuators
from chaserdock_world.physics.port_loads import IntervalLoads
from chaserdock_world.physics.simulation import TARGET, BodyState, Physics
from chaserdock_world.rendering.cameras import States
from chaserdock_world.sensors.errors import OdometrySensor
from chaserdock_world.sensors.publish import docking_status, odometry_of

from .perception import PerceptionModel, RenderedImages
from .perfect_knowledge import PerfectEstimator


@dataclass(frozen=True)
class TickRecord:
    """One tick: true states at its beginning, sightings, decisions, commands, actuator output.

    ``outputs``: None while a delayed controller is busy. ``tracking_errors``: distance (m) and
    angle (rad) of each chaser from its reference pose on the true target. ``loads``: at each port,
    since the previous tick.
    """

    tick: int
    time_ns: int
    states: States
    odometry: dict[int, Odometry]
    sightings: tuple[Sighting, ...]
    outputs: TickOutputs | None
    commands: dict[int, ActuatorCommand]
    tracking_errors: dict[int, tuple[float, float]]
    delivered: dict[int, ActuatorOutput]
    loads: dict[int, IntervalLoads]

    @property
    def time_s(self) -> float:
        return self.time_ns / 1e9


class InProcessMission:
    """A mission in flight, one ``step`` per tick.

    ``perception`` maps the true states to a sighting; with None the controller knows the target's
    motion, which must be prescribed, perfectly. ``actuator_gain``: delivered over commanded wrench.
    ``solve_delay_s`` maps the wall-clock seconds of a solve to the time from a tick to its
    command's effect, in place of the scenario's latency. The controller does not know of it and
    skips the ticks meanwhile. Both require ideal actuation, else ValueError.

    ``contacts``: pairs of bodies that have touched, without a probe's tip on the target;
    ``touches``: those of the tips. ``events`` of the controller: (time in s, level, text).
    ``thruster_events`` of the chasers: (time in s, chaser, text).
    """

    def __init__(
        self,
        scenario: Scenario,
        perception: PerceptionModel | None = None,
        *,
        actuator_gain: float = 1.0,
        solve_delay_s: Callable[[float], float] | None = None,
    ) -> None:
        ideal = scenario.chaser.actuation == "ideal"
        if not ideal and (actuator_gain != 1.0 or solve_delay_s is not None):
            raise ValueError('actuator_gain and solve_delay_s need chaser.actuation = "ideal"')

        self.scenario = scenario
        self.perception = perception
        self.chasers = range(len(scenario.chasers))

        estimator = PerfectEstimator(scenario.target) if perception is None else None
        flight = flight_scenario(scenario)
        self.controller = ControllerCore(flight, time.perf_counter, estimator)

        self.physics = Physics(scenario)
        self.actuators = {f"chaser/{i}": make_actuators(scenario, i) for i in self.chasers}
        rendered = perception.visions if isinstance(perception, RenderedImages) else None
        self.cores = [
            ChaserCore(
                flight,
                i,
                failures=faults_of(scenario, f"chaser/{i}").reported_failures,
                vision=rendered[i] if rendered else Vision(None),
            )
            for i in self.chasers
        ]

        self.tick = 0
        self.contacts: set[tuple[str, str]] = set()
        self.touches: list[ProbeTouch] = []
        self.events: list[tuple[float, str, str]] = []
        self.thruster_events: list[tuple[float, int, str]] = []
        self.propellant_kg = 0.0

        self._gain, self._solve_delay_s = actuator_gain, solve_delay_s
        self._busy_until_ns = 0
        self._odometry_sensor = OdometrySensor(scenario)
        self._validations = tuple(OdometryValidation(flight) for _ in flight.chasers)

    def retreats(self, chaser: int) -> list[str]:
        """Return the retreats of a chaser in order: phase and reason."""
        begin = f"chaser {chaser}: retreat ("
        return [
            text.removeprefix(begin).rstrip(")")
            for _, _, text in self.events
            if text.startswith(begin)
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the physics engine's world."""
        self.physics.close()

    @property
    def time_s(self) -> float:
        return self.scenario.timing.tick_time_ns(self.tick) / 1e9

    def states(self) -> States:
        """Return the true state of every body now."""
        return {name: self.physics.state(name) for name in self.physics.bodies}

    def phase(self, chaser: int) -> str:
        """Return a chaser's guidance phase."""
        return self.controller.guidance.chasers[chaser].phase

    def ticks(self) -> Iterator[TickRecord]:
        """Fly to the scenario's end, tick by tick."""
        while self.tick < self.scenario.ticks:
            yield self.step()

    def step(self, commands: tuple[OperatorCommand, ...] = ()) -> TickRecord:
        """Fly one tick, with these operator commands."""
        timing, states = self.scenario.timing, self.states()
        time_ns = timing.tick_time_ns(self.tick)

        docking = {
            x.chaser: docking_status(x, self.tick, time_ns) for x in self.physics.latches.values()
        }
        for latch in self.physics.latches.values():
            self.touches += latch.take_touches()
        loads = {
            x.chaser: self.physics.port_loads[name].take()
            for name, x in self.physics.latches.items()
        }

        odometry = {i: self.measure(i, time_ns, states) for i in self.chasers}
        reports = {}
        for i in self.chasers:
            if (report := self._sense(odometry[i], docking.get(i))) is not None:
                reports[i] = report

        sightings = ()
        if self.perception is not None and timing.has_images(self.tick):
            sightings = tuple(self.perception(i, self.tick, time_ns, states) for i in self.chasers)

        outputs = None
        if time_ns >= self._busy_until_ns:
            received = tuple(
                ChaserInputs(
                    i, self._validated(o), thrusters=reports.get(i), docking=docking.get(i)
                )
                for i, o in odometry.items()
            )
            outputs = self._control(TickInputs(self.tick, time_ns, received, sightings, commands))

        errors = {i: self.tracking_error(i, states, outputs) for i in self.chasers}
        actuator_commands, delivered = self._act(outputs, odometry, time_ns)

        record = TickRecord(
            self.tick,
            time_ns,
            states,
            odometry,
            sightings,
            outputs,
            actuator_commands,
            errors,
            delivered,
            loads,
        )
        self.tick += 1
        return record

    def measure(self, chaser: int, time_ns: int, states: States) -> Odometry:
        """Return a chaser's odometry; to be overridden where it fails."""
        return odometry_of(
            self._odometry_sensor, chaser, states[f"chaser/{chaser}"], self.tick, time_ns
        )

    def _validated(self, odometry: Odometry) -> Odometry:
        doubtful = self.controller.doubts(odometry.chaser)
        validated, events = self._validations[odometry.chaser].update(odometry, doubtful)
        self.events += [(odometry.sim_time_ns / 1e9, level, text) for level, text in events]
        return validated

    def _deliver(self, chaser: int, topic: Topic, message: Message) -> ChaserOutputs:
        return self.cores[chaser].step(ReceivedMessage(topic, str(chaser), message, 0))

    def _sense(self, odometry: Odometry, docking: DockingStatus | None) -> ThrusterReport | None:
        """Start a chaser's tick with its sensors' output. Returns the report of its thrusters, if
        it has any.
        """
        chaser, time_ns, report = odometry.chaser, odometry.sim_time_ns, None
        tick = Tick(
            tick=self.tick,
            sim_time_ns=time_ns,
            images=self.scenario.timing.has_images(self.tick),
            chasers=tuple(self.chasers),
            controllers={topics.CONTROLLERS[0]: ""},
        )
        self._deliver(chaser, topics.TICK, tick)
        if docking is not None:
            self._deliver(chaser, topics.DOCKING, docking)
        for _, _, message in self._deliver(chaser, topics.ODOMETRY, odometry).messages:
            match message:
                case ThrusterReport():
                    report = message
                case Event(what=what, detail=detail):
                    self.thruster_events.append((time_ns / 1e9, chaser, f"{what}: {detail}"))
        return report

    def _control(self, inputs: TickInputs) -> TickOutputs | None:
        """Return the controller's outputs; to be overridden where it is silent."""
        outputs = self.controller.step(inputs)
        self.events += [(inputs.time_ns / 1e9, e.level, e.what) for e in outputs.events]
        return outputs

    def _act(
        self, outputs: TickOutputs | None, odometry: Mapping[int, Odometry], time_ns: int
    ) -> tuple[dict[int, ActuatorCommand], dict[int, ActuatorOutput]]:
        """Deliver the commands when a lock-step mission does, and advance the bodies to the next
        tick.
        """
        timing = self.scenario.timing
        begin, end = timing.step_of_tick(self.tick), timing.step_of_tick(self.tick + 1)
        if self._solve_delay_s is None:
            self.advance(min(end, begin + timing.latency_steps))
        commands = (
            self.uncommanded(odometry, time_ns)
            if outputs is None
            else self._actuator_commands(outputs, time_ns)
        )
        for i, command in commands.items():
            effective = timing.step_of_time(command.effective_time_ns)
            self.actuators[f"chaser/{i}"].command(command, effective, self.physics.step_count)
            self.physics.command_latch(i, command.latch, effective)
        self.advance(end)
        return commands, {i: self.take_delivered(i) for i in self.chasers}

    def uncommanded(
        self, odometry: Mapping[int, Odometry], time_ns: int
    ) -> dict[int, ActuatorCommand]:
        """Return what the chasers do without commands of a controller. Override it for chasers that
        are silent.
        """
        return {}

    def _actuator_commands(self, outputs: TickOutputs, time_ns: int) -> dict[int, ActuatorCommand]:
        commands = {}
        for i, wrench in outputs.wrenches.items():
            command = self._executed(wrench, outputs)
            if self._gain != 1.0:
                command = msgspec.structs.replace(
                    command,
                    force_N=vector(self._gain * np.array(command.force_N)),
                    torque_N_m=vector(self._gain * np.array(command.torque_N_m)),
                )
            commands[i] = command
        if self._solve_delay_s is None:
            return commands
        took_s = 0.0 if outputs.solver is None else outputs.solver.wall_solve_s
        self._busy_until_ns = time_ns + round(self._solve_delay_s(took_s) * 1e9)
        late = {"effective_time_ns": self._busy_until_ns}
        return {i: msgspec.structs.replace(command, **late) for i, command in commands.items()}

    def _executed(self, wrench: WrenchCommand, outputs: TickOutputs) -> ActuatorCommand:
        """Return the actuator command that a chaser derives from its wrench. Raises RuntimeError if
        it refuses the wrench.
        """
        i = wrench.chaser
        lease = self.cores[i].gate.leases
        head = {"term": lease.term, "commander": lease.holder, "instance": lease.instance}
        self._deliver(i, topics.TARGET, outputs.target)
        if i in outputs.plans:
            self._deliver(i, topics.PLAN, outputs.plans[i])
        done = self._deliver(i, topics.WRENCH, msgspec.structs.replace(wrench, **head))
        for _, _, message in done.messages:
            match message:
                case ActuatorCommand(source="command"):
                    return message
                case Event(level="warning", what=what, detail=detail):
                    raise RuntimeError(f"chaser {i}: {what}: {detail}")
        raise RuntimeError(f"chaser {i} refuses a command: {done.rejected or wrench.mode}")

    def advance(self, step: int) -> None:
        """Move the bodies to a physics step; to be overridden where single steps are measured."""
        step_s = 1.0 / self.scenario.timing.physics_hz
        self.contacts |= fly_to(step, self.physics, self.actuators, step_s)

    def take_delivered(self, chaser: int) -> ActuatorOutput:
        """Return what a chaser's actuators have delivered since the last call."""
        delivered = self.actuators[f"chaser/{chaser}"].take_output(self.physics.step_count)
        self.propellant_kg += delivered.propellant_kg
        return delivered

    def tracking_error(
        self, chaser: int, states: States, outputs: TickOutputs | None = None
    ) -> tuple[float, float]:
        """Return distance (m) and angle (rad) of a chaser from its reference pose, placed on the
        true target.

        The reference is that of ``outputs``; without one it is the guidance's, with the nominal
        attitude.
        """
        reference = outputs.references.get(chaser) if outputs is not None else None
        if outputs is not None and reference is not None:
            estimate = outputs.target
            relative = np.array(reference.position_m) - estimate.position_m
            offset = rotations.rotate_inverse(estimate.q_wxyz, relative)
            q_offset = rotations.multiply(rotations.conjugate(estimate.q_wxyz), reference.q_wxyz)
        else:
            offset = self.controller.guidance.chasers[chaser].state.move.at(
                np.array([self.time_s])
            )[0][0]
            q_offset = np.array(self.scenario.chasers[chaser].q_wxyz)
        return pose_error(states[TARGET], offset, q_offset, states[f"chaser/{chaser}"])


def pose_error(
    target: BodyState, offset_m: np.ndarray, q_offset_wxyz: np.ndarray, body: BodyState
) -> tuple[float, float]:
    """Return distance (m) and angle (rad) of a body from a pose given in the target's frame."""
    position = target.position_m + rotations.rotate(target.q_wxyz, offset_m)
    attitude = rotations.multiply(target.q_wxyz, q_offset_wxyz)
    distance_m = float(np.linalg.norm(position - body.position_m))
    return distance_m, float(rotations.angle_between(attitude, body.q_wxyz))
