# SPDX-License-Identifier: Apache-2.0
"""Run the world: own simulated time, simulate the bodies, render images, publish ground truth.

Lock-step: a tick ends when all expected replies have arrived; nothing depends on the order of
arrival or on the wall clock. Real time: the wall clock ends a tick.
"""

from __future__ import annotations

import cv2
from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import ThrusterFaultCommand
from chaserdock_protocol.mission.command_intake import CommandIntake
from chaserdock_protocol.mission.host import (
    MissionHost,
    load_mission_scenario,
    open_mission,
    open_world_node,
)
from chaserdock_protocol.process import ProcessOptions, StopSignal, print_status
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.transport import Node

from chaserdock_world.actuators.ideal import fly_to
from chaserdock_world.actuators.operator_faults import ThrusterFaultHandler
from chaserdock_world.actuators.thrusters import make_actuators
from chaserdock_world.physics.simulation import Physics
from chaserdock_world.rendering.cameras import States
from chaserdock_world.rendering.pose_cameras import make_cameras
from chaserdock_world.requirements import require_packages
from chaserdock_world.sensors.errors import OdometrySensor
from chaserdock_world.sensors.publish import (
    drawn_truth,
    publish_docking,
    publish_odometry,
    publish_plume_loads,
    publish_port_loads,
    publish_truth,
)

_REALTIME_SLICES_HZ = 240
"""Rate, Hz, at which physics follows the wall clock: a command acts within 4 ms of its arrival, and
a slice is still several steps of physics.
"""


def main(options: ProcessOptions) -> int:
    """Run the world of ``options.scenario``; return 0 if the mission was completed, 1 if not, 2 for
    invalid input.
    """
    # The other processes need the cores, and OpenCV's idle threads spin between the many short
    # calls of an image.
    cv2.setNumThreads(1)
    node: Node | None = None
    try:
        scenario = load_mission_scenario(options)
        require_packages(scenario)
        node = open_world_node(options)
        return World(scenario, options, node).run(options.stop_signal())
    except ChaserdockError as error:
        print_status("world", str(error))
        return 2
    finally:
        if node is not None:
            node.close()


class World:
    """Run one mission: simulation, sensors, actuators and the barrier of its ticks.

    Processes can join once it is made.
    """

    def __init__(self, scenario: Scenario, options: ProcessOptions, node: Node) -> None:
        self._scenario, self._options, self._node = scenario, options, node
        self._timing, self._realtime = scenario.timing, options.mode == "realtime"
        self._cameras, self._physics = make_cameras(scenario), Physics(scenario)
        self._odometry = OdometrySensor(scenario)
        self._actuators = {
            f"chaser/{i}": make_actuators(scenario, i) for i in range(len(scenario.chasers))
        }
        self._faults = ThrusterFaultHandler(scenario, self._actuators)
        self._contacts: set[tuple[str, str]] = set()
        self._started_s = 0.0
        self._host = self._open_mission()
        self._barrier = self._host.barrier

    def _open_mission(self) -> MissionHost:
        """Advertise what the world publishes, and open the mission."""
        node, scenario = self._node, self._scenario
        for topic in (topics.TRUTH_WORLD, topics.TRUTH_DRAWN):
            node.advertise(topic)
        for i in range(len(scenario.chasers)):
            node.advertise(topics.ODOMETRY, i)
            if f"chaser/{i}" in self._physics.latches:
                node.advertise(topics.DOCKING, i)
                node.advertise(topics.TRUTH_LOAD, i)
            node.advertise(topics.IMAGE, i)
        if self._physics.plumes is not None:
            for name in self._physics.plumes.bodies:
                node.advertise(topics.TRUTH_PLUME, name)
        node.declare_queryable(topics.THRUSTER_FAULT_KEY, ThrusterFaultCommand, self._faults.submit)
        commands = CommandIntake(
            self._timing,
            self._actuators,
            lambda: self._physics.step_count,
            self._physics.command_latch,
            scenario.controller.command_lifetime_s,
        )
        return open_mission(scenario, self._options, node, commands)

    def run(self, stop: StopSignal) -> int:
        """Wait for the processes, simulate all ticks and end the mission; return the exit
        status.
        """
        if reason := self._host.wait_for_processes(stop):
            return self._host.end(0, reason, complete=False)
        self._node.publish(topics.TRUTH_DRAWN, drawn_truth(self._scenario, self._odometry))
        self._started_s, tick = self._node.host.now_s(), 0
        while True:
            states = self._publish_state(tick)
            if tick == self._scenario.ticks:
                return self._host.end(tick, "completed", complete=True)
            self._open_tick(tick)
            self._expose_images(tick, states)
            if self._realtime:
                self._step_realtime(tick)
            elif stalled := self._await_replies_and_step(tick, stop):
                return self._host.end(tick, stalled, complete=False)
            if stop() or self._barrier.lost_all_chasers(self._options.rejoin_s, stop):
                return self._host.end(
                    tick, "stopped" if stop() else "no chaser is left", complete=False
                )
            tick += 1

    def _publish_state(self, tick: int) -> States:
        """Publish odometry, docking sensors and ground truth at the beginning of a tick.

        Return the bodies' states.
        """
        node, physics, timing = self._node, self._physics, self._timing
        states = {name: physics.state(name) for name in physics.bodies}
        publish_docking(
            node, physics.latches, tick, timing
        )  # first, as the ground truth takes the touches
        publish_truth(node, states, tick, timing, self._actuators, self._contacts, physics.latches)
        publish_port_loads(node, physics, tick, timing)
        publish_plume_loads(node, physics, tick, timing)
        publish_odometry(node, states, tick, timing, self._odometry)
        return states

    def _open_tick(self, tick: int) -> None:
        self._barrier.open_tick(tick, self._timing.has_images(tick))
        for what, detail in self._faults.apply_pending(tick, self._timing):
            self._barrier.publish_warning(what, detail)
        for chaser, reason in self._physics.take_openings():
            self._barrier.publish_warning("latch opened", f"chaser {chaser}: {reason}")

    def _expose_images(self, tick: int, states: States) -> None:
        """Render and publish the images of a tick.

        In lock-step each is published as soon as it is rendered, in real time all together, as
        synchronized cameras do.
        """
        timing, chasers = self._timing, self._barrier.chasers
        if not timing.has_images(tick):
            return
        exposure = (tick // timing.ticks_per_image, tick, timing.tick_time_ns(tick), states)
        one_by_one = (self._cameras.image(i, *exposure) for i in chasers)
        for image in self._cameras.images(chasers, *exposure) if self._realtime else one_by_one:
            self._node.publish(topics.IMAGE, image, image.chaser)

    def _await_replies_and_step(self, tick: int, stop: StopSignal) -> str:
        """Step the physics to the end of a lock-step tick, and wait for all replies before they
        take effect.

        Return why the tick cannot end, empty if it does.
        """
        timing, barrier = self._timing, self._barrier
        end = timing.step_of_tick(tick + 1)
        self._contacts = set()
        # No reply takes effect before the latency has passed: simulate until then while chasers
        # compute.
        self._step_to(min(end, timing.step_of_tick(tick) + timing.latency_steps))
        stalled = barrier.await_replies(stop, self._options.stall_s)
        if not stalled and not stop():
            self._step_to(end)
        return stalled

    def _step_realtime(self, tick: int) -> None:
        """Step the physics with the wall clock, in slices, so that a command acts as soon as it
        arrives.
        """
        timing = self._timing
        self._contacts = set()
        slices = max(1, timing.steps_per_tick // max(1, timing.physics_hz // _REALTIME_SLICES_HZ))
        for k in range(1, slices + 1):
            step = timing.step_of_tick(tick) + timing.steps_per_tick * k // slices
            self._barrier.process_until(self._started_s + step / timing.physics_hz)
            self._step_to(step)

    def _step_to(self, step: int) -> None:
        self._contacts |= fly_to(
            step, self._physics, self._actuators, 1.0 / self._timing.physics_hz
        )
