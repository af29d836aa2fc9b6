# SPDX-License-Identifier: Apache-2.0
"""Open ticks in lock-step, and wait for the replies that they expect."""

from __future__ import annotations

from collections.abc import Callable

from chaserdock_models.clock import Timing

from chaserdock_protocol import topics
from chaserdock_protocol.fault_injection import FaultLayer, LostMessage
from chaserdock_protocol.messages import (
    ActuatorCommand,
    Event,
    Message,
    Presence,
    RecorderAck,
)
from chaserdock_protocol.process import print_status
from chaserdock_protocol.stall import StallTimer
from chaserdock_protocol.transport import Node
from chaserdock_protocol.transport.session import Heartbeat, create_health

from .command_intake import CommandIntake
from .membership import Membership
from .open_tick import OpenTick
from .stall import explain_stall

RECORDER_WINDOW_TICKS = 8
"""Most ticks by which the flight is ahead of the recorder's acknowledgements. Bounds the data in
the network.
"""
LONGEST_STEP_S = 5.0
"""Time, s, without a look at its messages after which the world publishes no presence, as if it
were gone.
"""
_STATUS_INTERVAL_S = 5.0
"""Wall time, s, after which the world prints again what it waits for."""
_POLL_S = 0.02
"""Longest wait for one message, s. A departed process is noticed as soon."""
_REPEAT_S, _MOST_REPEATS = 2.0, 3
"""Wall time, s, without a reply after which the first tick since all processes have returned is
repeated, and how often. Chasers then state their leases again, which the network may have lost
while it came up.
"""


class TickBarrier:
    """Open ticks, collect the replies to them, and decide when a tick is complete.

    ``commands``: takes the actuator commands. The chasers decide who commands, by granting leases;
    this process sees it in the commands that they execute.
    """

    def __init__(
        self,
        node: Node,
        membership: Membership,
        heartbeat: Heartbeat,
        timing: Timing,
        commands: CommandIntake,
        recorder_expected: bool,
        standby_expected: bool = False,
        mapper_expected: bool = False,
    ) -> None:
        self.faults: FaultLayer | None = None
        self.take_other: Callable[[Message], None] = lambda message: None
        """Takes messages that are no matter of ticks, and presence of another world."""
        self._node = node
        self._membership = membership
        self._heartbeat = heartbeat
        self._timing = timing
        self._commands = commands
        self._standby_expected, self._mapper_expected = standby_expected, mapper_expected
        self._recorder_expected = self._recorder_configured = recorder_expected
        self._recorded_tick = -1
        self._open = OpenTick()
        self._repeats = 0
        self._no_chaser_since_s: float | None = None
        self.arrived_s = self._polled_s = node.host.now_s()
        heartbeat.hangs = lambda: node.host.now_s() - self._polled_s > LONGEST_STEP_S

    @property
    def chasers(self) -> tuple[int, ...]:
        """Return the chasers whose reply the open tick expects."""
        return self._open.chasers

    # -- before, between and after ticks -----------------------------------------------------------

    def missing_processes(self) -> list[str]:
        """Return the expected processes that are not connected yet."""
        expected = [
            *self._commands.names,
            "controller",
            *(["standby"] if self._standby_expected else []),
            *(["mapper"] if self._mapper_expected else []),
        ]
        expected += ["recorder"] if self._recorder_expected else []
        connected = self._connected()
        return [name for name in expected if name not in connected]

    def start_flight(self) -> None:
        """Start the flight: heartbeats slow down, and joining processes no longer hold back
        connected ones.
        """
        self._membership.flying = True
        self._heartbeat.in_flight.set()

    def open_tick(self, tick: int, images: bool) -> None:
        """Open a tick: determine who takes part in it, and publish it."""
        self._remove_departed()
        connected, instance_of = self._connected(), self._membership.instance_of
        chasers = self._chasers_among(connected)
        controllers = {n: instance_of(n) for n in topics.CONTROLLERS if n in connected}
        instances = {f"chaser/{i}": instance_of(f"chaser/{i}") for i in chasers}
        mapper = instance_of("mapper") if "mapper" in connected else ""
        taking_part = (*instances, *controllers, *(["mapper"] if mapper else []))
        since = {n: self._open.since.get(n, tick) for n in taking_part}
        # A recorder that returns paces the flight again.
        self._recorder_expected |= self._recorder_configured and "recorder" in connected
        self._open = OpenTick(tick, images, chasers, controllers, instances, since, mapper)
        if self.faults is not None:
            for what, detail in self.faults.transitions_at(tick):
                self.publish_warning(what, detail)
        now_ns = self._timing.tick_time_ns(tick)
        for detail in self._commands.stop_uncommanded(now_ns):
            self.publish_warning("actuators stopped", detail)
        self._publish_tick()
        if tick > 0 and tick % self._timing.rate_hz == 0:
            health = create_health(self._node, tick, now_ns)
            self._node.publish(topics.HEALTH, health, "world")

    def is_complete(self) -> bool:
        """Return whether all expected replies to the open tick have arrived and the recorder keeps
        up.
        """
        recorded_tick = self._open.tick - RECORDER_WINDOW_TICKS
        keeps_up = not self._recorder_expected or self._recorded_tick >= recorded_tick
        return keeps_up and not self._open.missing

    def await_replies(self, stopped: Callable[[], bool], stall_s: float) -> str:
        """Process messages until the open tick is complete or ``stopped``.

        Return why it never will be complete, empty otherwise. Without any reply to the tick for
        ``stall_s``, the text names who owes which message.
        """
        timer, progress = StallTimer(self._node.host.now_s), (0, 0, 0)

        def over() -> bool:
            nonlocal progress
            now = (len(self._open.replied), self._recorded_tick, self._open.revision)
            if now != progress:
                progress = now
                timer.reset()
            elif self._repeats and timer.update() >= _REPEAT_S:
                self._repeats -= 1
                self._revise_tick()
            return self.is_complete() or timer.update() >= stall_s

        self.wait_until(over, stopped, lambda: ", ".join(self._owed()))
        self._repeats = 0
        if stopped() or self.is_complete():
            return ""
        owed = self._owed()
        leader = self._commands.commander.name or next(iter(self._open.controllers), "")
        explained = explain_stall(owed, leader, self._membership.progress())
        return f"stalled: no progress for {stall_s:g} s in tick {self._open.tick}: {explained}"

    def _owed(self) -> dict[str, str]:
        """Return the keys of the messages that the open tick waits for, by the process that owes
        them.
        """
        late = {f"chaser/{i}": topics.ACTUATORS.key_of(i) for i in self._open.missing}
        return late or {"recorder": topics.ACK.key_of()}

    def lost_all_chasers(self, rejoin_s: float, stopped: Callable[[], bool]) -> bool:
        """Return whether no chaser is left and none returns within ``rejoin_s`` of wall time.

        All processes are lost at once when the router restarts or the world is cut off. In
        lock-step this waits, with simulated time at rest, until all are back or the time is over;
        in real time it does not wait.
        """
        now_s = self._node.host.now_s()
        if self.chasers or rejoin_s <= 0.0:
            self._no_chaser_since_s = None
            return not self.chasers
        if self._no_chaser_since_s is None:
            self._no_chaser_since_s = now_s
            self.publish_warning(
                "all chasers lost", f"waiting up to {rejoin_s:g} s for their return"
            )
        if self._membership.realtime:
            return now_s - self._no_chaser_since_s > rejoin_s
        self._recorder_expected = self._recorder_configured
        self.wait_until(
            lambda: not self.missing_processes() or self._node.host.now_s() - now_s > rejoin_s,
            stopped,
            lambda: ", ".join(self.missing_processes()),
        )
        missing = self.missing_processes()
        self._recorder_expected &= "recorder" not in missing
        self.publish_warning(
            "end of wait for lost processes", f"missing: {', '.join(missing) or 'none'}"
        )
        self._no_chaser_since_s, self._repeats = None, _MOST_REPEATS
        return not self._chasers_among(self._connected())

    def publish_warning(self, what: str, detail: str) -> None:
        """Publish an event of level warning, and print it."""
        time_ns = self._timing.tick_time_ns(max(self._open.tick, 0))
        event = Event(
            tick=self._open.tick,
            sim_time_ns=time_ns,
            process="world",
            level="warning",
            what=what,
            detail=detail,
        )
        self._node.publish(topics.EVENT, event, "world")
        print_status("world", f"{time_ns / 1e9:.2f} s: {what}: {detail}")

    def publish_farewell(self, tick: int, time_ns: int) -> None:
        """Publish the world's last messages."""
        self._heartbeat.farewell(tick, time_ns)

    # -- receiving ---------------------------------------------------------------------------------

    def wait_until(
        self, done: Callable[[], bool], stopped: Callable[[], bool], waiting_for: Callable[[], str]
    ) -> bool:
        """Process messages until ``done``; return False if ``stopped`` first.

        Prints at intervals what it waits for.
        """
        printed_s = self._node.host.now_s()
        while not done():
            if stopped():
                return False
            self.process_message(_POLL_S)
            if self._node.host.now_s() - printed_s > _STATUS_INTERVAL_S:
                printed_s = self._node.host.now_s()
                print_status("world", f"waiting for {waiting_for()}")
        return True

    def process_until(self, wall_s: float) -> None:
        """Process messages until a time of the monotonic wall clock."""
        while (left := wall_s - self._node.host.now_s()) > 0:
            self.process_message(min(left, _POLL_S))

    def process_message(self, timeout_s: float) -> None:
        """Process one message, if one arrives in time, and the departure of processes."""
        self._polled_s = self._node.host.now_s()
        received = self._node.receive(timeout_s)
        self.arrived_s = self.arrived_s if received is None else received.arrived_s
        match received.message if received is not None else None:
            case ActuatorCommand() as command:
                self._apply_command(command)
            case RecorderAck() as ack:
                self._recorded_tick = max(self._recorded_tick, ack.tick)
            case Presence() as presence:
                if self._membership.update_presence(presence):
                    self._heartbeat.take(presence)
                elif presence.process == "world" and presence.instance != self._membership.instance:
                    self.take_other(presence)
            case LostMessage(tick=tick) if received is not None and tick == self._open.tick:
                # The chaser's actuators keep their last command.
                self._open.replied.add(int(received.place or 0))
            case Message() as message:
                self.take_other(message)
        if self._remove_departed():
            self._revise_tick()

    def _apply_command(self, command: ActuatorCommand) -> None:
        """Apply a command, or count why it is rejected."""
        # In real time a chaser may brake before its command arrives: a later reply replaces the
        # first.
        once = not self._membership.realtime
        taken = self._commands.take(command, self._open, self._now_s(), once)
        if taken.hand_over:
            self.publish_warning("hand-over", taken.hand_over)
        if taken.rejected:
            self._node.counts.rejected[f"actuators:{taken.rejected}"] += 1

    # -- processes ---------------------------------------------------------------------------------

    def _connected(self) -> set[str]:
        return self._membership.connected(self._heartbeat.heard())

    def _chasers_among(self, connected: set[str]) -> tuple[int, ...]:
        return tuple(i for i, name in enumerate(self._commands.names) if name in connected)

    def _now_s(self) -> float:
        """Return the wall time in real time, the simulated time in lock-step."""
        if self._membership.realtime:
            return self._node.host.now_s()
        return self._timing.tick_time_ns(max(self._open.tick, 0)) / 1e9

    def _remove_departed(self) -> bool:
        """Remove processes that were lost; return whether this changes whose reply the open tick
        expects.
        """
        changed = False
        for name in self._membership.take_departed():
            self._heartbeat.forget(name)
            self.publish_warning("process lost", name)
            if name == "recorder":
                self._recorder_expected = False
            elif name in self._commands.names:
                self._commands.stop(name)
            changed |= self._open.remove(name)
        return changed and self._open.tick >= 0

    def _revise_tick(self) -> None:
        """Publish the open tick again, as it has changed or was lost."""
        self._open.revision += 1
        self._publish_tick()

    def _publish_tick(self) -> None:
        self._node.publish(topics.TICK, self._open.message(self._timing))
