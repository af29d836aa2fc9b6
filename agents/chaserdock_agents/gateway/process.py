# SPDX-License-Identifier: Apache-2.0
"""Run a gateway: the devices of a laboratory in the place of the world.

It owns time, members and ticks of a mission in real time, and simulates nothing. Each tick it
publishes the odometry of the robots; images and references are published as they arrive, with their
own times. Commands reach the robots when they take effect, if the gateway is armed.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.codec import vector
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import (
    ArmingCommand,
    ArmingReply,
    BodyReference,
    DockingStatus,
    Kill,
    Latch,
    Message,
    Odometry,
    Presence,
)
from chaserdock_protocol.mission.command_intake import CommandIntake
from chaserdock_protocol.mission.host import load_mission_scenario, open_mission, open_world_node
from chaserdock_protocol.process import ProcessOptions, StopSignal, print_status
from chaserdock_protocol.scenario import Scenario, ScenarioError
from chaserdock_protocol.transport import Node

from .actuation import RobotActuation
from .arming import Answer, ArmingRequests, BackgroundArming, listen_to_keys
from .axes import MeasuredPose
from .devices import DeviceError, DeviceHost, ImageArray
from .feeds import ImageWatch, PoseFeed
from .images import image_message
from .lab import Laboratory
from .latency import AddedLatency
from .odometry import FittedState
from .resume import BegunMission, begun_mission, digest_of, forget_mission, note_mission
from .safety import RobotSight, SafetyGate

_NS = 1_000_000_000
"""Nanoseconds of a second."""
_POLL_S = 0.001
"""Interval, s, at which devices are read and commands sent: the latency that the gateway adds. At
2 ms it adds 5.1 to 5.7 ms (p99), above the aim of 5 (docs/evidence/laboratory.md).
"""
_LONGEST_SOURCE = 200
"""Characters of a device's address that a message repeats."""
_POSE_PATIENCE_S = 30.0
"""Wait, s, for the first odometry of all robots, unless an option states another: names are found
on a loaded network in ten.
"""
_SETTLING_NS = 200_000_000
"""Time, ns, whose poses must give the first odometry."""


def main(options: ProcessOptions) -> int:
    """Run the gateway of ``options.scenario``; return 0 if the mission was completed, 1 if not, 2
    for invalid input or a device that does not work.
    """
    cv2.setNumThreads(1)
    node: Node | None = None
    laboratory: Laboratory | None = None
    realtime = dataclasses.replace(options, mode="realtime")
    try:
        scenario = load_mission_scenario(realtime)
        if scenario.lab is None:
            raise ScenarioError(f"{options.scenario}: has no [lab], which names the devices")
        node = open_world_node(realtime)
        now_s = node.host.now_s
        host = DeviceHost(lambda: round(now_s() * 1e9))
        path = options.resume
        begun = None if path is None else begun_mission(path, scenario, host.now_ns())
        laboratory = Laboratory(scenario, host, options.dry_run)
        status = Gateway(scenario, realtime, node, laboratory, begun).run(options.stop_signal())
        if path is not None:
            forget_mission(path)
        return status
    except ChaserdockError as error:
        print_status("gateway", str(error))
        return 2
    finally:
        if laboratory is not None:
            laboratory.close()
        if node is not None:
            node.close()


class Gateway:
    """Fly one mission on the devices of a laboratory. ``begun``: take up this one again, which
    another gateway has begun; robots are disarmed.
    """

    def __init__(
        self,
        scenario: Scenario,
        options: ProcessOptions,
        node: Node,
        laboratory: Laboratory,
        begun: BegunMission | None = None,
    ) -> None:
        assert scenario.lab is not None
        self._scenario, self._node, self._lab = scenario, node, laboratory
        self._timing, self._chasers = scenario.timing, len(scenario.chasers)
        self._gate = SafetyGate(scenario.lab.safety)
        self._requests = ArmingRequests()
        self._arming = BackgroundArming(node, laboratory.arm)
        self._start_ns = 0
        self._begun, self._resume = begun, options.resume
        if begun is not None:  # a recorder that is behind holds up no mission that goes on
            options = dataclasses.replace(options, recorder_expected=False)
        self._used_ns: dict[int, int] = {}
        self._commanded_ns: dict[int, int] = {}
        self._added = AddedLatency()
        self._missing: set[int] = set()
        self._images = ImageWatch(c.device.chaser for c in laboratory.cameras)
        self._actuation = {
            f"chaser/{i}": RobotActuation(scenario.chaser, self._timing, self._command_arrived_ns)
            for i in range(self._chasers)
        }
        for i in range(self._chasers):
            node.advertise(topics.ODOMETRY, i)
            node.advertise(topics.IMAGE, i)
            if i in laboratory.latches:
                node.advertise(topics.DOCKING, i)
        for reference in scenario.lab.reference:
            node.advertise(topics.BODY_REFERENCE, reference.body)
        node.subscribe(topics.KILL)
        node.declare_queryable(topics.ARMING_KEY, ArmingCommand, self._requests.submit)
        commands = CommandIntake(
            self._timing,
            self._actuation,
            lambda: self._timing.step_of_time(self._mission_ns()),
            self._command_latch,
            scenario.controller.command_lifetime_s,
        )
        self._host = open_mission(
            scenario, options, node, commands, None if begun is None else begun.run_id
        )
        self._barrier = self._host.barrier
        self._barrier.take_other = self._take_other

    def _now_ns(self) -> int:
        return round(self._node.host.now_s() * 1e9)

    def _mission_ns(self) -> int:
        return max(0, self._now_ns() - self._start_ns)

    def _command_arrived_ns(self) -> int:
        return max(0, round(self._barrier.arrived_s * 1e9) - self._start_ns)

    def run(self, stop: StopSignal) -> int:
        """Wait for the processes, fly all ticks and end the mission; return the exit status."""
        end_keys = listen_to_keys(self._requests)
        try:
            reason = self._host.wait_for_processes(stop) or self._wait_for_poses(stop)
            reason = reason or self._wait_for_arming(stop)
            if reason:
                return self._host.end(0, reason, complete=False)
            self._begin()
            return self._fly(stop)
        finally:
            end_keys()
            self._lab.stop()
            if added := str(self._added):
                print_status("gateway", f"added latency: {added}")

    def _begin(self) -> None:
        """Let the mission's time begin, or go on from its beginning by another gateway."""
        self._start_ns = self._now_ns() if self._begun is None else self._begun.start_ns
        self._images.expect(self._mission_ns())
        if self._begun is None and self._resume is not None:
            begun = BegunMission(
                run_id=self._host.run_id,
                start_ns=self._start_ns,
                scenario=digest_of(self._scenario),
            )
            note_mission(self._resume, begun)

    def _wait_for_poses(self, stop: StopSignal) -> str:
        """Read the devices until each robot has odometry; return why there is none, else
        nothing.
        """
        begun_s = self._node.host.now_s()
        patience_s = self._host.options.patience_s or _POSE_PATIENCE_S
        while not stop():
            self._lab.read_odometry()
            for _ in self._lab.read_images():
                pass
            now_ns = self._now_ns()
            late = [
                feed.watch.name
                for feed in self._lab.odometry.values()
                if feed.track.at(now_ns, now_ns - _SETTLING_NS) is None
            ]
            if not late:
                return ""
            if self._node.host.now_s() - begun_s > patience_s:
                return f"no odometry within {patience_s:g} s: {', '.join(late)}"
            self._barrier.process_until(self._node.host.now_s() + _POLL_S)
        return "stopped before the first tick"

    def _wait_for_arming(self, stop: StopSignal) -> str:
        """Guard the robots until they are armed; return why they are not, else nothing."""
        print_status("gateway", "waiting for `chaserdock command arm`")
        self._requests.not_yet = ""
        while not stop() and self._gate.state != "killed":
            self._read()
            self._guard()
            if self._gate.is_armed:
                return ""
            self._barrier.process_until(self._node.host.now_s() + _POLL_S)
        return "killed" if self._gate.state == "killed" else "stopped before the first tick"

    def _fly(self, stop: StopSignal) -> int:
        """Open the ticks of the mission while robots are armed: flight software would take what it
        commands to disarmed ones for their motion. Time goes on meanwhile.
        """
        first = self._mission_ns() * self._timing.rate_hz // _NS + 1 if self._begun else 0
        for tick in range(min(first, self._scenario.ticks), self._scenario.ticks + 1):
            self._work_until(self._start_ns + self._timing.tick_time_ns(tick))
            if tick == self._scenario.ticks:
                return self._host.end(tick, "completed", complete=True)
            if stop():
                return self._host.end(tick, "stopped", complete=False)
            if not self._gate.is_armed:
                continue
            self._publish_odometry(tick)
            self._publish_docking(tick)
            for chaser in self._images.newly_blind(self._mission_ns()):
                self._barrier.publish_warning("no new image", f"chaser {chaser}")
            # Cameras run freely: no image belongs to a tick, and no tick waits for one.
            self._barrier.open_tick(tick, images=False)
            if tick == first > 0:
                self._barrier.publish_warning("gateway restarted", "the mission goes on")
            if stop() or self._barrier.lost_all_chasers(self._host.options.rejoin_s, stop):
                reason = "stopped" if stop() else "no chaser is left"
                return self._host.end(tick, reason, complete=False)
        raise AssertionError("the last tick ends the mission")

    def _work_until(self, due_ns: int) -> None:
        """Read devices, guard the robots and command them until a time of the host's clock."""
        while True:
            self._read()
            self._guard()
            self._actuate()
            left_ns = due_ns - self._now_ns()
            if left_ns <= 0:
                return
            wait_s = min(_POLL_S, left_ns / 1e9)
            self._barrier.process_until(self._node.host.now_s() + wait_s)

    # -- devices to mission ------------------------------------------------------------------------

    def _read(self) -> None:
        try:
            self._lab.read_odometry()
            for chaser, image, time_ns, arrived_ns in self._lab.read_images():
                if self._publish_image(chaser, image, time_ns):
                    self._added.note("images", arrived_ns, self._now_ns())
            for feed, pose in self._lab.read_references():
                self._name_jump(feed)
                self._publish_reference(feed, pose)
        except DeviceError as error:
            self._trip(str(error))

    def _name_jump(self, feed: PoseFeed) -> None:
        """Warn of a reference that has jumped for good: results are not judged by it from then."""
        jumped_m, feed.track.jumped_m = feed.track.jumped_m, 0.0
        if jumped_m > 0.0:
            detail = f"{feed.device.body} by {jumped_m:.2f} m"
            self._barrier.publish_warning("reference jumped", detail)

    def _publish_reference(self, feed: PoseFeed, pose: MeasuredPose) -> None:
        measured_ns = pose.time_ns - self._start_ns
        if not self._start_ns or measured_ns < 0:
            return
        body = feed.device.body
        message = BodyReference(
            tick=measured_ns * self._timing.rate_hz // _NS,
            sim_time_ns=measured_ns,
            body=body,
            source=feed.device.address[:_LONGEST_SOURCE],
            position_m=vector(pose.position_m),
            q_wxyz=vector(pose.q_wxyz),
            sigma_m=_sigma(pose.position_covariance_m2),
            sigma_rad=_sigma(pose.attitude_covariance_rad2),
            velocity_m_s=None if pose.velocity_m_s is None else vector(pose.velocity_m_s),
            omega_rad_s=None if pose.omega_rad_s is None else vector(pose.omega_rad_s),
        )
        self._node.publish(topics.BODY_REFERENCE, message, body)
        self._added.note("references", feed.watch.newest_ns, self._now_ns())

    def _publish_image(self, chaser: int, image: ImageArray, time_ns: int) -> bool:
        exposed_ns = time_ns - self._start_ns
        if not self._gate.is_armed or exposed_ns <= 0 or chaser not in self._barrier.chasers:
            return False
        quality = self._scenario.camera.effects.jpeg_quality
        message = image_message(self._timing.rate_hz, quality, chaser, image, exposed_ns)
        self._images.note(chaser, self._mission_ns())
        self._node.publish(topics.IMAGE, message, chaser)
        return True

    def _publish_odometry(self, tick: int) -> None:
        time_ns = self._timing.tick_time_ns(tick)
        host_ns = self._start_ns + time_ns
        for chaser, feed in self._lab.odometry.items():
            # Poses of a pause are no line: bodies come to rest meanwhile.
            newest_ns = host_ns - _NS // self._timing.rate_hz
            oldest_ns = 2 * newest_ns - host_ns
            since_ns = max(oldest_ns, self._used_ns.get(chaser, newest_ns))
            state = feed.track.at(host_ns, since_ns)
            if state is None:
                if chaser not in self._missing:
                    self._missing.add(chaser)
                    self._barrier.publish_warning("no odometry", f"chaser {chaser}")
                continue
            self._missing.discard(chaser)
            self._used_ns[chaser] = min(host_ns, feed.track.newest_ns or host_ns)
            self._node.publish(topics.ODOMETRY, odometry_of(state, chaser, tick, time_ns), chaser)

    def _publish_docking(self, tick: int) -> None:
        for chaser, latch in self._lab.latches.items():
            try:
                reading = latch.poll()
            except DeviceError as error:
                self._trip(str(error))
                continue
            if reading is not None:
                message = DockingStatus(
                    tick=tick,
                    sim_time_ns=self._timing.tick_time_ns(tick),
                    chaser=chaser,
                    contact=reading.contact,
                    armed=reading.armed,
                    latched=reading.latched,
                )
                self._node.publish(topics.DOCKING, message, chaser)

    # -- mission to robots -------------------------------------------------------------------------

    def _command_latch(self, chaser: int, latch: Latch, step: int) -> None:
        self._commanded_ns[chaser] = self._now_ns()
        if latch != "keep" and self._gate.is_armed:
            try:
                self._lab.command_latch(chaser, latch)
            except DeviceError as error:
                self._trip(str(error))

    def _actuate(self) -> None:
        mission_ns = self._mission_ns()
        for chaser in range(self._chasers):
            actuation = self._actuation[f"chaser/{chaser}"]
            output = actuation.take(mission_ns)
            if output is None or not self._gate.is_armed:
                continue
            try:
                self._lab.send(chaser, actuation, output)
            except DeviceError as error:
                self._trip(str(error))
            if actuation.due_ns is not None:
                self._added.note("commands", actuation.due_ns, self._mission_ns())

    # -- safety ------------------------------------------------------------------------------------

    def _guard(self) -> None:
        now_ns = self._now_ns()
        ages = {i: (now_ns - at_ns) / 1e9 for i, at_ns in self._commanded_ns.items()}
        sights = self._lab.sights(ages)
        for action, by, answer in self._requests.take():
            if action == "arm":
                self._begin_arming(by, answer, sights)
                continue
            accepted, reason = self._gate.request(action, by, sights)
            if accepted:
                self._arming.cancel()
                self._lab.stop()
            self._answer(action, accepted, reason, answer)
        if self._end_arming(sights):
            return  # ages of commands count from now on
        if reason := self._gate.check(sights):
            self._lab.stop()
            self._barrier.publish_warning("disarmed", reason)

    def _answer(self, action: str, accepted: bool, reason: str, answer: Answer) -> None:
        done = "accepted" if accepted else "refused"
        self._barrier.publish_warning(f"{action} {done}", reason)
        answer(ArmingReply(accepted=accepted, reason=reason))

    def _begin_arming(self, by: str, answer: Answer, sights: tuple[RobotSight, ...]) -> None:
        """Have the robots armed in the background, as they answer after a second, unless something
        forbids it.
        """
        is_under_way = self._arming.is_under_way
        refusal = "robots are being armed" if is_under_way else self._gate.refusal(sights)
        if refusal:
            self._answer("arm", False, refusal, answer)
        else:
            self._arming.begin(by, answer)

    def _end_arming(self, sights: tuple[RobotSight, ...]) -> bool:
        """Let commands pass once all robots are armed, and return whether they are; stop them if
        one is not, or if they were disarmed meanwhile.
        """
        ended = self._arming.take_end()
        if ended is None:
            return False
        if ended.error:
            accepted, reason = False, self._gate.trip(ended.error)
        elif ended.is_cancelled:
            accepted, reason = False, self._gate.reason
        else:
            accepted, reason = self._gate.request("arm", ended.by, sights)
        if accepted:
            self._lab.forget_motion()
            self._commanded_ns.clear()
            self._images.expect(self._mission_ns())
        else:
            self._lab.stop()
        self._answer("arm", accepted, reason, ended.answer)
        return accepted

    def _trip(self, reason: str) -> None:
        if self._gate.is_armed or reason != self._gate.reason:
            self._gate.trip(reason)
            self._arming.cancel()
            self._lab.stop()
            self._barrier.publish_warning("disarmed", reason)

    def _take_other(self, message: Message) -> None:
        match message:
            case Kill(by=by):
                self._requests.add("kill", by or "the topic operator/kill")
            case Presence():
                self._trip("another world or gateway runs in this namespace")


def _sigma(covariance: Array) -> float:
    """Return the standard deviation along an axis, averaged over the axes."""
    return math.sqrt(float(np.trace(covariance)) / 3.0)


def odometry_of(state: FittedState, chaser: int, tick: int, time_ns: int) -> Odometry:
    """Return a body's state at a tick as odometry."""
    return Odometry(
        tick=tick,
        sim_time_ns=time_ns,
        chaser=chaser,
        position_m=vector(state.position_m),
        velocity_m_s=vector(state.velocity_m_s),
        q_wxyz=vector(state.q_wxyz),
        omega_rad_s=vector(state.omega_rad_s),
        position_covariance_m2=vector(state.position_covariance_m2),
        velocity_covariance_m2_s2=vector(state.velocity_covariance_m2_s2),
        attitude_covariance_rad2=vector(state.attitude_covariance_rad2),
        omega_covariance_rad2_s2=vector(state.omega_covariance_rad2_s2),
    )
