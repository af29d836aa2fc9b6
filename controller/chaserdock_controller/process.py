# SPDX-License-Identifier: Apache-2.0
"""The controller process: receive the messages of a tick, process it, publish the outputs."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import msgspec
from chaserdock_protocol import topics
from chaserdock_protocol.fault_injection import LostMessage, create_fault_layer
from chaserdock_protocol.leases import defect_of, no_command
from chaserdock_protocol.messages import (
    CommandedWrench,
    CommandReply,
    ControllerState,
    DockingStatus,
    Event,
    JoinReply,
    Lease,
    Level,
    MissionEnd,
    Odometry,
    OperatorCommand,
    Presence,
    Sighting,
    ThrusterReport,
    Tick,
    WrenchCommand,
)
from chaserdock_protocol.process import ProcessOptions, StopSignal, print_status
from chaserdock_protocol.scenario import FlightScenario, flight_scenario_from_json
from chaserdock_protocol.scenario.faults import process_faults_from_json
from chaserdock_protocol.stall import DEFAULT_STALL_S
from chaserdock_protocol.transport import Node, ReceivedMessage
from chaserdock_protocol.transport.session import Heartbeat, create_health, run_member

from .core import ControllerCore
from .ingest.early_messages import EarlyMessages
from .ingest.tick_inputs import TickInputCollector
from .interfaces import TickOutputs
from .redundancy.checkpoint import Checkpoint, CheckpointError
from .redundancy.operator_requests import OperatorRequests
from .redundancy.standby import HotStandby

_IDLE_RECEIVES = 5
"""In lock-step, number of receives without a message after which none is expected any more."""
_PATIENCE_TICKS = 0.5
"""In real time, share of a tick's period for which the tick waits for its sightings."""
_RECEIVE_TIMEOUT_S = 0.2
"""Longest wait for a message, s, before the process checks whether it has to stop."""


def main(options: ProcessOptions) -> int:
    """Run the controller; return 0 when the mission ended, 1 when stopped before, 2 when it could
    not join.
    """

    def work(node: Node, mission: JoinReply, instance: str, stop: StopSignal) -> int:
        scenario = flight_scenario_from_json(mission.scenario_json, "the world's scenario")
        faults, realtime = process_faults_from_json(mission.faults), mission.mode == "realtime"
        now_s = node.host.now_s
        core = ControllerCore(scenario, now_s, realtime=realtime)
        controller = ControllerProcess(node, scenario, core, realtime, now_s=now_s)
        node.message_filter = create_fault_layer(
            faults, node.name, scenario.timing, not realtime, node.host
        )
        controller.open(instance, options.stall_s)
        node.host.finish_startup()
        while not (
            controller.ended
            or controller.replaced
            or stop()
            or controller.heartbeat.world_is_gone()
        ):
            controller.listen()
        if not controller.replaced:
            controller.farewell()
        return 0 if controller.ended else 1

    return run_member("standby" if options.standby else "controller", "controller", options, work)


class ControllerProcess:
    """Barrier and I/O: processes a tick once every message that it needs has arrived or is lost.

    In real time a tick is processed with what has arrived when its patience is over, by ``now_s``,
    or when the first odometry of the next tick arrives. A standby processes the same ticks without
    publishing. ``replaying``: this process leads in every tick.
    """

    def __init__(
        self,
        node: Node,
        scenario: FlightScenario,
        core: ControllerCore,
        realtime: bool = False,
        replaying: bool = False,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.node, self.name = node, node.name
        self.scenario = scenario
        self.core = core
        self.realtime, self.replaying = realtime, replaying
        self.now_s = now_s
        self.ended = self.replaced = False
        self.tick: Tick | None = None
        self.done_tick = -1
        self.inputs = TickInputCollector(scenario)
        self.requests = OperatorRequests()
        self.standby = HotStandby(self.name, realtime, replaying)
        self.checkpoint = Checkpoint(core, [c.validation for c in self.inputs.chasers])
        self._early = EarlyMessages(node)
        self._left_at = (-1, -1)
        self._last_result: tuple[Tick, TickOutputs, float] | None = None
        self._idle_receives = 0
        self._on_network = False
        self._patience_s = _PATIENCE_TICKS / scenario.time.rate_hz
        self._deadline_s = 0.0

    def open(self, instance: str, stall_s: float = DEFAULT_STALL_S) -> None:
        """Advertise and subscribe the topics, then start the heartbeat."""
        node = self.node
        self.standby.join(instance)
        self._on_network = True
        for topic in (
            topics.TARGET,
            topics.STACK,
            topics.SOLVER,
            topics.COMMAND,
            topics.OPERATED,
            topics.STATE,
        ):
            node.advertise(topic)
        for i in range(len(self.scenario.chasers)):
            for topic in (topics.WRENCH, topics.REFERENCE, topics.PLAN):
                node.advertise(topic, i)
            if self.scenario.limits.passive_safety != "off":
                node.advertise(topics.SAFETY, i)
        inputs = (topics.ODOMETRY, topics.DOCKING, topics.SIGHTING, topics.THRUSTERS)
        for topic in (topics.TICK, topics.END, *inputs, topics.LEASE, topics.STATE):
            node.subscribe(topic)
        self.heartbeat = Heartbeat(node, instance, stall_s)

    def operate(self, command: OperatorCommand, reply: Callable[[CommandReply], None]) -> None:
        """Queue an operator command for the next tick. Runs on Zenoh's thread."""
        self.requests.add(command, reply)

    def farewell(self) -> None:
        """Publish the last messages of this process."""
        self.heartbeat.farewell(self.done_tick, self.tick.sim_time_ns if self.tick else 0)

    # -- receiving ---------------------------------------------------------------------------------

    def listen(self) -> None:
        """Receive one message, and process the tick if it is ready then."""
        released = self.standby.release(self.done_tick)
        received = released or self.node.receive(self._timeout_s())
        self._idle_receives = 0 if received is not None else self._idle_receives + 1
        if self._on_network:
            self.heartbeat.report_waiting(received, self._missing_keys)
        if released is not None:
            self._dispatch(released)
        elif received is not None:
            for due in self._early.in_turn(received):
                self._take(due)
        tick = self.tick
        if tick is not None and tick.tick > self.done_tick and self._is_ready(tick):
            self._process(tick)

    def _take(self, received: ReceivedMessage) -> None:
        """Apply a message, or hold it until this process knows its role."""
        if not self._dispatch_leadership(received) and not self.standby.hold_back(
            received, self.done_tick
        ):
            self._dispatch(received)

    def _missing_keys(self) -> tuple[str, ...]:
        """Return the keys of the messages for which the open tick waits, or with which the next one
        begins.
        """
        tick = self.tick
        if tick is None or tick.tick <= self.done_tick:
            return (topics.TICK.key_of(),)
        leases = tuple(topics.LEASE.key_of(i) for i in self.standby.leases.missing(tick))
        return self.inputs.missing_keys(tick) + leases or (topics.STATE.key_of(),)

    def _open_tick(self) -> Tick | None:
        """Return the tick that waits for its deadline; only in real time."""
        tick = self.tick
        is_open = (
            self.realtime and not self.replaying and tick is not None and tick.tick > self.done_tick
        )
        return tick if is_open else None

    def _timeout_s(self) -> float:
        if self._open_tick() is None:
            return _RECEIVE_TIMEOUT_S
        return min(_RECEIVE_TIMEOUT_S, max(0.0, self._deadline_s - self.now_s()))

    def _is_ready(self, tick: Tick) -> bool:
        if not self.standby.may_process() or not self.standby.is_decided(tick):
            return False
        if self.inputs.is_complete(tick) and self.standby.has_leader_commands(tick.tick):
            return True
        if self._open_tick() is not None:
            return self.now_s() >= self._deadline_s
        idle = self._idle_receives >= _IDLE_RECEIVES and not self.realtime
        return idle and self.standby.on_idle(tick.tick)

    def _dispatch(self, received: ReceivedMessage) -> None:
        match received.message:
            case Tick() as tick:
                if self.tick is not None and tick.tick > self.tick.tick > self.done_tick:
                    self._process(self.tick)
                self.tick, self._deadline_s = tick, self.now_s() + self._patience_s
            case Odometry() as odometry:
                self._add_odometry(odometry)
            case DockingStatus() as docking:
                self.node.counts.stale += not self.inputs.add_docking(docking)
            case Sighting() as sighting:
                self.node.counts.stale += not self.inputs.add_sighting(sighting)
            case ThrusterReport() as report:
                self.node.counts.stale += not self.inputs.add_thruster_report(report)
            case Presence() as presence:
                self.heartbeat.take(presence)
            case MissionEnd():
                self.ended = True
            case LostMessage(tick=tick):
                self.inputs.add_lost(received.topic, int(received.place or 0), tick)

    def _add_odometry(self, odometry: Odometry) -> None:
        late = self._open_tick()
        if late is not None and odometry.tick > late.tick:
            self._process(late)  # while its own odometry is still the newest
        events = self.inputs.add_odometry(odometry, self.core.doubts(odometry.chaser))
        self.node.counts.stale += events is None
        for level, text in events or ():
            if self.standby.leads:
                self._publish_event(level, text, odometry)

    # -- processing --------------------------------------------------------------------------------

    def _process(self, tick: Tick) -> None:
        start_s = self.now_s()
        if self.realtime:
            self._decide(tick)
        leads = self.standby.leads_at(tick.tick)
        requests = self.requests.take() if leads else []
        if not self.standby.leads:
            self._refuse_requests(tick)
        operated = tuple(command for command, _ in requests)
        commands = self.standby.take_leader_commands(tick.tick) + operated
        out = self.core.step(self.inputs.take(tick, commands))
        for part in self.core.failed_parts():
            self.node.counts.rejected[f"tick:{part}"] += 1
        if leads:
            replies = out.replies[len(out.replies) - len(requests) :]
            for (command, reply), message in zip(requests, replies, strict=True):
                reply(message)
                stamp = {"tick": tick.tick, "sim_time_ns": tick.sim_time_ns}
                self.node.publish(topics.OPERATED, msgspec.structs.replace(command, **stamp))
        for i in tick.chasers:
            if i not in out.wrenches:
                out.wrenches[i] = no_command(i, tick)
        wall_s = self.now_s() - start_s
        self._last_result = (tick, out, wall_s)
        self.done_tick = tick.tick
        self._take_commanded()
        if leads:
            self._publish(tick, out, wall_s, operated)
        if tick.tick % self.scenario.time.rate_hz == 0:
            health = create_health(self.node, tick.tick, tick.sim_time_ns)
            self.node.publish(topics.HEALTH, health, self.name)

    # -- publishing --------------------------------------------------------------------------------

    def _publish(
        self, tick: Tick, out: TickOutputs, wall_s: float, operated: tuple[OperatorCommand, ...]
    ) -> None:
        node = self.node
        if self.standby.others:
            # State before wrenches: once a tick is answered, the standby must know the commands
            # that were processed with it.
            wrenches = out.wrenches if self.realtime else {}
            commanded = tuple(
                CommandedWrench(chaser=i, force_N=w.force_N, torque_N_m=w.torque_N_m)
                for i, w in wrenches.items()
            )
            self._publish_state(tick, operated=operated, commanded=commanded)
        node.publish(topics.TARGET, out.target)
        if out.stack is not None:
            node.publish(topics.STACK, out.stack)
        for i, wrench in out.wrenches.items():
            if i in out.plans:
                node.publish(topics.PLAN, out.plans[i], i)
            self._publish_wrench(wrench)
        for i, reference in out.references.items():
            node.publish(topics.REFERENCE, reference, i)
        for i, safety in out.safety.items():
            node.publish(topics.SAFETY, safety, i)
        for reply in out.replies:
            node.publish(topics.COMMAND, reply)
        for event in out.events:
            node.publish(topics.EVENT, msgspec.structs.replace(event, process=self.name), self.name)
        # Last: the recorder takes it as the end of the tick.
        if out.solver is not None:
            node.publish(topics.SOLVER, msgspec.structs.replace(out.solver, wall_tick_s=wall_s))
        if self.standby.should_send_state(periodic=tick.tick % self.scenario.time.rate_hz == 0):
            try:
                self._publish_state(tick, state=self.checkpoint.save())
            except CheckpointError as error:
                self._publish_event("warning", f"the state cannot be serialized: {error}", tick)

    def _publish_wrench(self, wrench: WrenchCommand) -> None:
        sender = self.standby.authority
        head = {"term": sender.term, "commander": sender.name, "instance": sender.instance}
        self.node.publish(topics.WRENCH, msgspec.structs.replace(wrench, **head), wrench.chaser)

    def _publish_state(self, tick: Tick, **fields: Any) -> None:
        sender = self.standby.authority
        state = ControllerState(
            process=self.name, term=sender.term, instance=sender.instance, **fields
        )
        stamp = {"tick": tick.tick, "sim_time_ns": tick.sim_time_ns}
        self.node.publish(topics.STATE, msgspec.structs.replace(state, **stamp))

    def _publish_event(
        self, level: Level, text: str, at: Tick | Odometry | ControllerState
    ) -> None:
        event = Event(
            tick=at.tick, sim_time_ns=at.sim_time_ns, process=self.name, level=level, what=text
        )
        self.node.publish(topics.EVENT, event, self.name)

    def _report_role(self, text: str, at: Tick) -> None:
        """Publish, and print, that this controller starts or stops to command."""
        if self._on_network:
            print_status(self.name, f"{at.sim_time_ns / 1e9:.2f} s: {text}")
        self._publish_event("info", text, at)

    # -- leader and standby ------------------------------------------------------------------------

    def _dispatch_leadership(self, received: ReceivedMessage) -> bool:
        """Apply what a message says about the leader, ahead of held messages. Returns whether it
        says nothing else.
        """
        match received.message:
            case ControllerState() as state:
                if state.process != self.name:
                    self._apply_leader_state(state)
                return True
            case Lease() as lease:
                if defect_of(lease, self.scenario.time.rate_hz):
                    self.node.counts.rejected["lease:contradictory"] += 1
                    self.standby.leases.add_lost(lease.chaser, lease.tick)
                else:
                    self.standby.leases.add(lease)
                self._decide()
                return True
            case LostMessage(tick=tick) if received.topic is topics.LEASE:
                self.standby.leases.add_lost(int(received.place or 0), tick)
                self._decide()
                return True
            case Tick() as tick:
                self.replaced |= self.heartbeat.is_replaced(tick.controllers.get(self.name))
                if self.replaced:
                    return True
                self.heartbeat.in_flight.set()
                led = self.standby.leads
                self.standby.update(tick)
                if self.replaying and not led:
                    self._change_role(tick)
                self._decide()
        return False

    def _decide(self, processed: Tick | None = None) -> None:
        """Determine who commands, and start or stop to command. ``processed``: see
        ``HotStandby.decide``.
        """
        standby = self.standby
        newest, led = processed or standby.newest, standby.leads
        if newest is None:
            return
        if standby.decide(processed):
            self._publish_event(
                "warning", "takes over without any state of the flight so far", newest
            )
        if standby.leads != led:
            self._change_role(newest)
        if not standby.leads and (processed is not None or not self.realtime):
            self._leave_unused_leases(newest)

    def _leave_unused_leases(self, tick: Tick) -> None:
        """Let chasers wait that have granted their lease to this controller while it lacks a
        majority.
        """
        stamp = (tick.tick, tick.revision)
        if stamp <= self._left_at or not self.standby.is_decided(tick):
            return
        self._left_at = stamp
        for i, (term, gives_back) in sorted(self.standby.leases.take_idle(tick).items()):
            mode = "yield" if gives_back else "wait"
            head = {"term": term, "commander": self.name, "instance": self.standby.instance}
            self.node.publish(
                topics.WRENCH, msgspec.structs.replace(no_command(i, tick), mode=mode, **head), i
            )

    def _change_role(self, tick: Tick) -> None:
        leads, term = self.standby.leads, self.standby.authority.term
        if self._on_network and leads:
            self.node.restart_numbering()
            self.node.declare_queryable(topics.OPERATE_KEY, OperatorCommand, self.operate)
        elif self._on_network:
            self.node.undeclare_queryable(topics.OPERATE_KEY)
            self._refuse_requests(tick)
        if term > 1 or not leads:
            self._report_role(f"commands in term {term}" if leads else "stands by", tick)
        result = self._last_result
        if leads and result is not None and result[0].tick == tick.tick:
            # It was processed already, as a standby, for a leader that can no longer publish its
            # own result.
            self._publish(tick, result[1], result[2], ())

    def _refuse_requests(self, tick: Tick) -> None:
        leader = self.standby.leader
        self.requests.refuse(tick, "" if leader is None else leader.name)

    def _take_commanded(self) -> None:
        """Take what another leader has commanded in place of what this process computed."""
        for tick, wrenches in self.standby.take_commanded(self.done_tick).items():
            if not self.standby.leads_at(tick):
                self.core.output.take_commanded(tick, wrenches)

    def _apply_leader_state(self, state: ControllerState) -> None:
        if self.standby.is_deposed(state):
            self.node.counts.stale += 1
        elif not state.state:
            self.standby.add_leader_commands(state)
            self._take_commanded()
        elif self.standby.needs_state(state.tick, self.done_tick):
            try:
                self.checkpoint.restore(state.state)
            except CheckpointError as error:
                self.node.counts.rejected["controller/state:format"] += 1
                self._publish_event(
                    "error", f"the leader's state cannot be restored: {error}", state
                )
                return
            self.done_tick = max(self.done_tick, state.tick)
            self.standby.state_restored(state.tick)
            self._publish_event("info", "restored the leader's state", state)
