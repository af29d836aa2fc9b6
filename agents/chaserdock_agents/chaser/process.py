# SPDX-License-Identifier: Apache-2.0
"""The chaser process: images to sightings, wrench commands to actuator commands. It has no access
to ground truth.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import cv2
import msgspec
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.extrapolation import extrapolate
from chaserdock_protocol.fault_injection import LostMessage, create_fault_layer
from chaserdock_protocol.leases import longest_lease_ticks
from chaserdock_protocol.messages import (
    ActuatorCommand,
    DockingStatus,
    Event,
    ExpectedPose,
    Image,
    JoinReply,
    Level,
    Message,
    MissionEnd,
    Odometry,
    Plan,
    Presence,
    Sighting,
    TargetEstimate,
    Tick,
    WrenchCommand,
)
from chaserdock_protocol.process import ProcessOptions, StopSignal
from chaserdock_protocol.scenario import FlightScenario, flight_scenario_from_json
from chaserdock_protocol.scenario.faults import process_faults_from_json
from chaserdock_protocol.stall import DEFAULT_STALL_S
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import Node
from chaserdock_protocol.transport.session import Heartbeat, create_health, run_member

from chaserdock_agents.chaser.thrusters.controller import ThrusterController
from chaserdock_agents.chaser.thrusters.failure_reports import FailureReports

from .command_gate import autonomous_command, brake_command, damping_command, passed_on, refusal
from .fallback import FallbackState, LastCommand, fallback_limits, fallback_wrench, next_state
from .lease_grantor import LeaseGrantor
from .local_damping import LocalDamping
from .perception import make_perception
from .sighting import apply_geometry, look, prediction_from


def main(options: ProcessOptions) -> int:
    """Run chaser ``options.chaser``; return 0 if the mission ended, 1 if stopped before, 2 if it
    could not join.
    """
    cv2.setNumThreads(1)
    number = int(options.chaser or 0)

    def work(node: Node, mission: JoinReply, instance: str, stop: StopSignal) -> int:
        scenario = flight_scenario_from_json(mission.scenario_json, "the world's scenario")
        faults = process_faults_from_json(mission.faults)
        lockstep = mission.mode == "lockstep"
        node.message_filter = create_fault_layer(
            faults, node.name, scenario.timing, lockstep, node.host
        )
        chaser = ChaserProcess(
            node, scenario, number, reports=FailureReports(faults.reported_failures)
        )
        chaser.open(instance, realtime=not lockstep, stall_s=options.stall_s)
        node.host.finish_startup()
        while not (chaser.ended or chaser.replaced or stop() or chaser.heartbeat.world_is_gone()):
            chaser.listen()
        if not chaser.replaced:
            chaser.publish_farewell()
        return 0 if chaser.ended else 1

    return run_member(f"chaser/{number}", "chaser", options, work)


@dataclass
class ChaserProcess:
    """The state of one chaser process: latest messages, last executed command and fallback.

    ``executed_tick`` and ``executed_ns``: tick of the last actuator command for which the world
    need not wait any more, and time of the last executed command of the controller. ``reports``:
    the thruster failures that the test bed reports. ``replaced``: this process was lost, and the
    mission goes on with another one of its name.
    """

    node: Node
    scenario: FlightScenario
    number: int
    ended: bool = False
    replaced: bool = False
    odometry: Odometry | None = None
    docking: DockingStatus | None = None
    sighting: Sighting | None = None
    tick: Tick | None = None
    executed_tick: int = -1
    executed_ns: int | None = None
    realtime: bool = False
    reports: FailureReports = field(default_factory=FailureReports)

    def __post_init__(self) -> None:
        self.name = f"chaser/{self.number}"
        # Whether the current series of missing, refused or stale commands has been reported.
        self._reported_missing = self._reported_refusal = self._reported_stale = False
        self._refused = 0  # commands refused since the last one that was executed
        self._term, self._instance = 0, ""
        self.leases = LeaseGrantor(self.number, self.scenario.time.rate_hz)
        self._plan: Plan | None = None
        self._target: TargetEstimate | None = None
        self._expected: ExpectedPose | None = None
        self._last = LastCommand()
        self._last_tick = -1
        self._fallback: FallbackState | None = None
        self._fallback_limits = fallback_limits(self.scenario, self.number)
        self._thrusters_tick = self._uncommanded_tick = -1
        self._odometry_ns, self._odometry_arrived_s = 0, 0.0
        self._odometry_tick = self._docking_tick = -1
        self._processed_images: deque[int] = deque(maxlen=64)
        self._has_port = self.scenario.docking.port_of(self.number) is not None
        self._thrusters = (
            ThrusterController(self.scenario, self.number)
            if self.scenario.chaser.actuation == "thrusters"
            else None
        )
        self._damping = (
            LocalDamping(self.scenario, self.number)
            if self._has_port and self._thrusters is not None
            else None
        )
        self._was_detumbling = self._is_damping = False
        self.perception = make_perception(self.scenario)

    def open(self, instance: str, realtime: bool, stall_s: float = DEFAULT_STALL_S) -> None:
        """Advertise and subscribe the topics, then start the heartbeat."""
        node, i = self.node, self.number
        self.realtime, self._instance = realtime, instance
        node.advertise(topics.SIGHTING, i)
        node.advertise(topics.ACTUATORS, i)
        node.advertise(topics.LEASE, i)
        if self._thrusters is not None:
            node.advertise(topics.THRUSTERS, i)
        node.subscribe(topics.IMAGE, i, latest=realtime)
        node.subscribe(topics.ODOMETRY, i, latest=realtime)
        node.subscribe(topics.DOCKING, i)
        for topic in (topics.PLAN, topics.WRENCH):
            node.subscribe(topic, i)
        node.subscribe(topics.TARGET)
        node.subscribe(topics.TICK)
        node.subscribe(topics.END)
        self.heartbeat = Heartbeat(node, instance, stall_s)

    def publish_farewell(self) -> None:
        """Publish the last messages of this process."""
        tick = self.tick
        self.heartbeat.farewell(tick.tick if tick else -1, tick.sim_time_ns if tick else 0)

    # -- receiving ---------------------------------------------------------------------------------

    def listen(self) -> None:
        """Wait for one message and handle it."""
        received = self.node.receive(0.2)
        self.heartbeat.report_waiting(received, self._missing_keys)
        match received.message if received is not None else None:
            case Image() as image:
                self._process_image(image)
            case Odometry() as odometry if received is not None:
                if odometry.tick > self._odometry_tick:
                    self._odometry_tick, self._odometry_ns = odometry.tick, odometry.sim_time_ns
                    self._odometry_arrived_s = received.arrived_s
                self._update_odometry(odometry)
            case DockingStatus() as docking:
                self._update_docking(docking)
            case Plan() as plan:
                self._update_plan(plan)
            case TargetEstimate() as target:
                self._update_target(target)
            case WrenchCommand() as command:
                self._handle_command(command)
            case Tick() as tick:
                self._begin_tick(tick)
            case Presence() as presence:
                self.heartbeat.take(presence)
            case MissionEnd():
                self.ended = True
            case LostMessage() as lost if received is not None:
                self._replace_lost(received.topic, lost)

    def _missing_keys(self) -> tuple[str, ...]:
        """Return the keys of the messages that this chaser needs to reply to the open tick, or to
        get the next one.
        """
        tick = self.tick
        if tick is None or tick.tick <= self.executed_tick or self.number not in tick.chasers:
            return (topics.TICK.key_of(),)
        latest: dict[Topic, Message | None] = {topics.ODOMETRY: self.odometry}
        if self._has_port:
            latest[topics.DOCKING] = self.docking
        missing = [topic for topic, last in latest.items() if last is None or last.tick < tick.tick]
        if tick.images and tick.tick not in self._processed_images:
            missing.append(topics.IMAGE)
        return tuple(topic.key_of(self.number) for topic in missing or [topics.WRENCH])

    def _begin_tick(self, tick: Tick) -> None:
        if self.tick is not None and (tick.tick, tick.revision) < (
            self.tick.tick,
            self.tick.revision,
        ):
            return
        self.replaced |= self.heartbeat.is_replaced(tick.chaser_instances.get(self.name))
        if self.replaced:
            return
        self.tick = tick
        self.heartbeat.in_flight.set()
        if (lease := self.leases.update(tick)) is not None:
            self.node.publish(topics.LEASE, lease, self.number)
        self._report_thrusters()
        self._reply_without_command()
        if tick.revision == 0 and tick.tick % self.scenario.time.rate_hz == 0:
            health = create_health(self.node, tick.tick, tick.sim_time_ns)
            self.node.publish(topics.HEALTH, health, self.name)

    def _update_odometry(self, odometry: Odometry) -> None:
        """Update the own state, unless a newer one has arrived before."""
        if self.odometry is not None and odometry.tick < self.odometry.tick:
            self.node.counts.stale += 1
            return
        self.odometry = odometry
        self._report_thrusters()
        self._reply_without_command()
        self._check_command_timeout(odometry)

    def _update_docking(self, docking: DockingStatus) -> None:
        """Update the state of the docking sensor, unless a newer one has arrived before."""
        if docking.tick <= self._docking_tick:
            self.node.counts.stale += 1
            return
        self._docking_tick = docking.tick
        if self.docking is not None and self.docking.tick > docking.tick:
            # Late: the newest known, of a tick for which an older one was assumed.
            docking = _assume_docking(docking, self.docking.tick, self.docking.sim_time_ns)
        self.docking = docking
        self._report_thrusters()

    def _update_plan(self, plan: Plan) -> None:
        if self._plan is not None and plan.tick < self._plan.tick:
            self.node.counts.stale += 1
            return
        self._plan = plan
        if plan.tick == self._last_tick:  # the plan arrived after its command
            self._last = LastCommand(plan, self._last.target)

    def _update_target(self, target: TargetEstimate) -> None:
        if self._target is not None and target.tick < self._target.tick:
            self.node.counts.stale += 1
            return
        self._target = target
        if target.tick == self._last_tick:  # the estimate arrived after its command
            self._last = LastCommand(self._last.plan, target)

    def _replace_lost(self, topic: Topic, lost: LostMessage) -> None:
        """Lock-step: handle the loss of a message, so that the tick is still replied to."""
        if topic is topics.IMAGE:
            no_image = Sighting(
                tick=lost.tick,
                sim_time_ns=lost.sim_time_ns,
                chaser=self.number,
                status="bad_image",
                solutions=(),
                marker_ids=(),
                corners_px=(),
                rejected_ids=(),
                detail="image lost",
            )
            self.node.publish(topics.SIGHTING, no_image, self.number)
        elif topic is topics.ODOMETRY and self.odometry is not None:
            self._update_odometry(extrapolate(self.odometry, lost.tick, lost.sim_time_ns))
        elif topic is topics.DOCKING and (self.docking is None or lost.tick > self.docking.tick):
            last = self.docking or DockingStatus(
                chaser=self.number, contact=False, armed=False, latched=False
            )
            self.docking = _assume_docking(last, lost.tick, lost.sim_time_ns)
            self._report_thrusters()
        elif topic is topics.WRENCH and lost.sender in ("", self.leases.holder):
            self._mark_uncommanded(lost.tick)

    def _process_image(self, image: Image) -> None:
        if image.tick in self._processed_images:
            self.node.counts.stale += 1
            return
        self._processed_images.append(image.tick)
        started_s = self.node.host.now_s()
        sighting = look(
            self.perception,
            image,
            prediction_from(self.sighting, self._expected, image.sim_time_ns),
        )
        elapsed_s = self.node.host.now_s() - started_s
        if sighting.status == "bad_image" and (
            self.sighting is None or self.sighting.status != "bad_image"
        ):
            self._publish_warning("bad image", sighting.detail, image.tick, image.sim_time_ns)
        self.sighting = sighting
        sighting = msgspec.structs.replace(sighting, wall_estimate_s=elapsed_s)
        self.node.publish(topics.SIGHTING, sighting, self.number)

    def _report_thrusters(self) -> None:
        """Publish the thrusters' capability and the events of fault detection.

        Runs once per open tick, when its odometry and, with a docking sensor, the sensor's status
        have arrived in any order. The last odometry belongs to no open tick and may arrive before
        or after the mission's end.
        """
        tick, odometry, docking = self.tick, self.odometry, self.docking
        if self._thrusters is None or tick is None or odometry is None:
            return
        if odometry.tick != tick.tick or self._thrusters_tick >= tick.tick:
            return
        if self._has_port and (docking is None or docking.tick != tick.tick):
            return
        self._thrusters_tick = tick.tick
        self.reports.deliver(self._thrusters, odometry.sim_time_ns)
        touched = docking is not None and (docking.contact or docking.latched)
        self.node.publish(topics.THRUSTERS, self._thrusters.observe(odometry, touched), self.number)
        for level, what, detail in self._thrusters.drain_events():
            self._publish_event(level, what, detail, odometry.tick, odometry.sim_time_ns)

    # -- commands ----------------------------------------------------------------------------------

    def _handle_command(self, command: WrenchCommand) -> None:
        """Execute a command of the controller, or refuse it."""
        now_ns = self._now_ns()
        newest = -1 if self.tick is None else self.tick.tick
        # It would count as newer than all commands to come, and extend the lease.
        early = command.tick > newest + longest_lease_ticks(self.scenario.time.rate_hz)
        stale = (
            f"for tick {command.tick}, the newest is {newest}"
            if early
            else self.leases.refusal(command)
        )
        tick = newest if early else command.tick
        if stale:
            self.node.counts.rejected["wrench:early tick" if early else "wrench:stale term"] += 1
            self._refused += 1
            if not self._reported_stale:  # the first of a series
                self._publish_warning("command refused", stale, tick, now_ns)
            self._reported_stale = True
            # A holder that does not know its term sends nothing else in this tick.
            if self.leases.is_of_holder(command) and not self.realtime:
                self._mark_uncommanded(tick)
            return
        if command.mode in ("none", "wait", "yield"):
            self._take_no_command(command)
            return
        if command.tick == self.executed_tick and command.term > self._term:
            self._renew_lease(command)
            return  # repeated by a controller that became commander within the tick
        due_ns = self.scenario.timing.effective_ns(command.tick)
        reason = refusal(
            command, self.number, self.scenario.chaser, self.executed_tick, now_ns, due_ns
        )
        if reason is None:
            self._renew_lease(command)
            # Ticks are the clock that all share: that of the controller may be wrong.
            self._execute(msgspec.structs.replace(command, effective_time_ns=due_ns))
            return
        self.node.counts.stale += 1
        self._refused += 1
        if not self._reported_refusal:  # the first of a series; all are counted
            self._publish_warning("command refused", reason, command.tick, now_ns)
        self._reported_refusal = True
        # The world waits for a reply to the tick: without this command, a safe one.
        self._mark_uncommanded(command.tick)

    def _take_no_command(self, command: WrenchCommand) -> None:
        """Go on without a command of the lease's holder, which sends none in this tick."""
        if command.mode == "yield":
            self.leases.give_back(command)
        elif command.mode == "none":
            self._renew_lease(command)
        if not self.realtime:  # in real time the last command remains valid for its lifetime
            self._mark_uncommanded(command.tick)

    def _renew_lease(self, command: WrenchCommand) -> None:
        self.leases.renew(command)
        if self.realtime and self.tick is not None:
            # The holder may need it before this process receives the next tick.
            self.node.publish(topics.LEASE, self.leases.stated(self.tick), self.number)

    def _now_ns(self) -> int:
        """Return the simulated time: in real time it continues while this process does not run or
        receives nothing.
        """
        if self.odometry is None:
            return 0
        silent_s = self.node.host.now_s() - self._odometry_arrived_s if self.realtime else 0.0
        return self.odometry.sim_time_ns + round(max(0.0, silent_s) * 1e9)

    def _execute(self, command: WrenchCommand) -> None:
        self.executed_ns, self._term = command.sim_time_ns, command.term
        if self._refused:
            self._publish_event(
                "info",
                "commands accepted again",
                f"{self._refused} refused",
                command.tick,
                command.sim_time_ns,
            )
        self._refused = 0
        self._reported_missing = self._reported_refusal = self._reported_stale = False
        # The estimate of the command before: that of this one may arrive later.
        known = self._last.target
        self._remember(command)
        self._was_detumbling = command.mode == "detumble"
        # Before the reply, so that the next image is seen with it in lock-step.
        self.inform_perception(command)
        if self._thrusters is not None:
            self._thrusters.avoid_plumes(known)
            self._thrusters.apply_command(command)
        self._reply(passed_on(command), np.array(command.thrusts_N) if command.thrusts_N else None)

    def inform_perception(self, command: WrenchCommand) -> None:
        """Pass on what a command states about the target: its geometry, and where it is expected in
        the next image.
        """
        self._expected = command.expected
        if (refused := apply_geometry(self.perception, command.geometry)) is not None:
            self._publish_warning("geometry refused", refused, command.tick, command.sim_time_ns)

    def _remember(self, command: WrenchCommand) -> None:
        """Store the plan and target estimate of a command for the fallback, and end the fallback."""
        plan, target, self._last_tick = self._plan, self._target, command.tick
        self._last = LastCommand(
            plan if plan is not None and plan.tick == command.tick else None,
            target if target is not None and target.tick == command.tick else self._last.target,
        )
        if self._fallback is not None or self._is_damping:
            detail = f"tick {command.tick}"
            self._publish_event("info", "fallback ends", detail, command.tick, command.sim_time_ns)
        self._fallback, self._is_damping = None, False
        if self._damping is not None:
            self._damping.reset()

    # -- fallback ----------------------------------------------------------------------------------

    def _mark_uncommanded(self, tick: int) -> None:
        """Record that no command arrives for a tick; the chaser replies itself once it knows its
        state.
        """
        self._uncommanded_tick = max(tick, self._uncommanded_tick)
        self._reply_without_command()

    def _reply_without_command(self) -> None:
        """Reply to the open tick with a fallback command if there is no controller or no command
        for the tick.
        """
        tick, odometry = self.tick, self.odometry
        if tick is None or odometry is None or odometry.tick != tick.tick:
            return
        commanded = self.leases.is_held_at(tick)
        if commanded and self._uncommanded_tick < tick.tick:
            return
        if self.number in tick.chasers and tick.tick > self.executed_tick:
            if commanded and not self._reported_missing:
                self._reported_missing = True
                self._publish_warning(
                    "no command", "lost or refused", tick.tick, odometry.sim_time_ns
                )
            self._reply(*self._fallback_command(odometry))

    def _check_command_timeout(self, odometry: Odometry) -> None:
        """Real time: start the fallback when no command has arrived for its lifetime."""
        if not self.realtime:
            return
        if self.executed_ns is None:
            self.executed_ns = odometry.sim_time_ns
        silent_ns = odometry.sim_time_ns - self.executed_ns
        if silent_ns <= self.scenario.controller.command_lifetime_s * 1e9:
            return
        if not self._reported_missing:
            self._reported_missing = True
            detail = f"for {silent_ns / 1e9:.2f} s"
            self._publish_warning("no command", detail, odometry.tick, odometry.sim_time_ns)
        # Not recorded as the reply to this tick: a command that still arrives takes precedence.
        self._actuate(*self._fallback_command(odometry))

    def _fallback_command(self, odometry: Odometry) -> tuple[ActuatorCommand, Array | None]:
        """Return the chaser's own command (see ``fallback``), and thrusts (n,) in place of an
        allocation.
        """
        effective_ns = self.scenario.timing.effective_ns(odometry.tick)
        body = self.scenario.chaser
        latched = self.docking is not None and self.docking.latched
        # Without recent odometry the motion is unknown and cannot be braked.
        odometry_age_ns = odometry.sim_time_ns - self._odometry_ns
        stale = odometry_age_ns > self.scenario.controller.command_lifetime_s * 1e9
        if latched and not stale and self._was_detumbling and self._damping is not None:
            return self._damp(self._damping, odometry, effective_ns)
        if latched or stale:
            return brake_command(odometry, body, effective_ns, latched=True), None
        before = self._fallback
        state = next_state(before, odometry, effective_ns, self._last, self._fallback_limits)
        self._fallback = state
        if before is None or before.mode != state.mode:
            what = f"fallback: {state.mode}"
            self._publish_warning(what, state.text(), odometry.tick, odometry.sim_time_ns)
        wrench = fallback_wrench(state, odometry, effective_ns, self._last, body)
        return autonomous_command(odometry, effective_ns, state.mode, wrench), None

    def _damp(
        self, damping: LocalDamping, odometry: Odometry, effective_ns: int
    ) -> tuple[ActuatorCommand, Array]:
        """Return the command of a latched chaser that the controller left while it stopped the
        stack (``local_damping``).
        """
        if not self._is_damping:
            detail = "stopping the stack by the chaser's own odometry"
            self._publish_warning("fallback: brake", detail, odometry.tick, odometry.sim_time_ns)
        self._is_damping = True
        return damping_command(damping, odometry, effective_ns, self.scenario.chaser)

    # -- publishing --------------------------------------------------------------------------------

    def _reply(self, command: ActuatorCommand, thrusts_N: Array | None = None) -> None:
        """Publish the actuator command that is the reply to its tick."""
        self.executed_tick = command.tick
        self._actuate(command, thrusts_N)

    def _actuate(self, command: ActuatorCommand, thrusts_N: Array | None = None) -> None:
        if self._thrusters is not None:
            command = self._thrusters.add_pulses(command, thrusts_N)
        own = msgspec.structs.replace(command, instance=self._instance)
        self.node.publish(topics.ACTUATORS, own, self.number)

    def _publish_warning(self, what: str, detail: str, tick: int, time_ns: int) -> None:
        self._publish_event("warning", what, detail, tick, time_ns)

    def _publish_event(self, level: Level, what: str, detail: str, tick: int, time_ns: int) -> None:
        event = Event(
            tick=tick,
            sim_time_ns=time_ns,
            process=self.name,
            level=level,
            what=what,
            detail=detail,
        )
        self.node.publish(topics.EVENT, event, self.name)


def _assume_docking(last: DockingStatus, tick: int, time_ns: int) -> DockingStatus:
    """Return the status to assume for a tick whose status is lost: as last known, without contact."""
    return msgspec.structs.replace(last, tick=tick, sim_time_ns=time_ns, contact=False)
