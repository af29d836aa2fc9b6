"""The world's ear: whom it expects an answer from in a tick, and what has come."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from chaserdock_models.clock import Timing
from chaserdock_protocol import topics
from chaserdock_protocol.fault_injection import Lost
from chaserdock_protocol.messages import ActuatorCommand, Event, Latch, Presence, RecorderAck, Tick
from chaserdock_protocol.process import say
from chaserdock_protocol.transport import Node
from chaserdock_protocol.transport.session import Heartbeat, health_of

from chaserdock_world.actuators.ideal import Actuators

from .leader_election import Terms, lease_s
from .membership import Membership

RECORDER_WINDOW_TICKS = 8
"""How far the flight may be ahead of what the recorder has confirmed: bounds what lies in the network."""
_IMPATIENT_S = 5.0
_GREATEST_SHIFT_NS = 1_000_000_000
"""A command that is to act so much earlier or later than its tick's has a wrong clock behind it."""


class Answers:
    """Collects the answers to the open tick. ``chasers``: ids expected; ``terms``: which controller commands."""

    def __init__(
        self,
        node: Node,
        membership: Membership,
        heartbeat: Heartbeat,
        timing: Timing,
        actuators: Mapping[str, Actuators],
        step_now: Callable[[], int],
        command_latch: Callable[[int, Latch, int], None],
        recorder_expected: bool,
        watchdog_s: float = 0.5,
        standby_expected: bool = False,
    ) -> None:
        self.chasers: tuple[int, ...] = ()
        self.terms = Terms(lease_s(timing.rate_hz))
        self._oldest_term = 0
        self._controllers: dict[str, str] = {}
        self._standby_expected = standby_expected
        self._node = node
        self._membership = membership
        self._teller = heartbeat
        self._timing = timing
        self._actuators = actuators
        self._step_now = step_now
        self._command_latch = command_latch
        self._recorder_expected = self._recorder_wanted = recorder_expected
        self._recorded_tick = -1
        self._tick = -1
        self._revision = 0
        # At least two ticks: a command lives until the next tick's has come.
        self._watchdog_ns = round(max(watchdog_s, 2.0 / timing.rate_hz) * 1e9)
        self._commanded_ns: dict[str, int] = {}
        self._answered: set[int] = set()
        self._warned_s = time.monotonic()
        self._alone_s: float | None = None

    def missing_at_start(self) -> list[str]:
        """Processes that are not joined up yet."""
        wanted = [*self._actuators, "controller", *(["standby"] if self._standby_expected else [])]
        wanted += ["recorder"] if self._recorder_expected else []
        linked = self._membership.linked(self._teller.heard())
        return [name for name in wanted if name not in linked]

    def open(self, tick: int, images: bool) -> None:
        """Opens a tick: tells everyone who is expected to answer it."""
        self._take_leave()
        linked = self._membership.linked(self._teller.heard())
        self.chasers = self._chasers_among(linked)
        self._controllers = {
            name: self._membership.instance_of(name) for name in topics.CONTROLLERS if name in linked
        }
        # One that was lost and is back: the flight is again held to what it has recorded.
        self._recorder_expected |= self._recorder_wanted and "recorder" in linked
        self._tick, self._images, self._revision = tick, images, 0
        self._answered.clear()
        self._review_terms()
        self._oldest_term = self.terms.term.number
        if self._node.faults is not None:
            for what, which in self._node.faults.told_at(tick):
                self.warn(what, which)
        self._watch_actuators()
        self._tell()
        if tick > 0 and tick % self._timing.rate_hz == 0:
            health = health_of(self._node, tick, self._timing.tick_time_ns(tick))
            self._node.publish(topics.HEALTH, health, "world")

    def _now_s(self) -> float:
        """What a silent commander's lease is counted in: simulated time where the wall clock decides nothing."""
        if self._membership.realtime:
            return time.monotonic()
        return self._timing.tick_time_ns(max(self._tick, 0)) / 1e9

    def _review_terms(self) -> bool:
        """Gives the command to another controller where that is due; whether it has."""
        before = self.terms.term
        why = self.terms.review(self._controllers, self._now_s())
        if why and before.number:
            self.warn("hand-over", why)
        return bool(why)

    def _watch_actuators(self) -> None:
        """Actuators that get no commands any more stop by themselves, as a valve driver's watchdog has it."""
        now_ns = self._timing.tick_time_ns(self._tick)
        for name in [n for n, since in self._commanded_ns.items() if now_ns - since > self._watchdog_ns]:
            self._actuators[name].stop(self._step_now())
            del self._commanded_ns[name]
            self.warn("actuators stopped", f"{name}: no command for {self._watchdog_ns / 1e9:g} s")

    def _chasers_among(self, linked: set[str]) -> tuple[int, ...]:
        return tuple(i for i in range(len(self._actuators)) if f"chaser/{i}" in linked)

    def _tell(self) -> None:
        term = self.terms.term
        message = Tick(
            tick=self._tick,
            sim_time_ns=self._timing.tick_time_ns(self._tick),
            revision=self._revision,
            images=self._images,
            chasers=self.chasers,
            controller=bool(term.commander),
            term=term.number,
            commander=term.commander,
            instance=term.instance,
            standing_by={n: i for n, i in self._controllers.items() if n != term.commander},
        )
        self._node.publish(topics.TICK, message)

    def listen(self, timeout_s: float) -> None:
        """Takes in one message, if one comes in time, and notes who left."""
        received = self._node.receive(timeout_s)
        match received.message if received is not None else None:
            case ActuatorCommand() as command:
                self._take_command(command)
            case RecorderAck() as ack:
                self._recorded_tick = max(self._recorded_tick, ack.tick)
            case Presence() as presence:
                if self._membership.presence_told(presence):
                    self._teller.take(presence)
                    self.terms.lives(presence.instance)
            case Lost(tick=tick) if received is not None and tick == self._tick:
                self._answered.add(int(received.place or 0))  # what its actuators do now, they go on doing
        changed = self._take_leave()
        if self._tick >= 0 and self._membership.realtime and self._review_terms():
            self._oldest_term, changed = self.terms.term.number, True
        if changed:
            self._revision += 1
            self._tell()

    def _take_command(self, command: ActuatorCommand) -> None:
        actuators = self._actuators.get(f"chaser/{command.chaser}")
        if actuators is None or command.tick > self._tick:
            self._node.counts.rejected["actuators:unexpected"] += 1
            return
        if command.source == "command":
            # In lock-step, what a commander that was lost in this tick had said of it still counts.
            if command.term < self._oldest_term:
                self._node.counts.rejected["actuators:stale term"] += 1
                return
            self.terms.flown(command.term, self._now_s())
        if command.tick == self._tick:
            # In real time a chaser may brake first and then still get its command: the later one counts.
            if command.chaser in self._answered and not self._membership.realtime:
                self._node.counts.rejected["actuators:twice"] += 1
                return
            self._answered.add(command.chaser)
        due_ns = self._timing.effective_ns(command.tick)
        if abs(command.effective_time_ns - due_ns) > _GREATEST_SHIFT_NS:
            self._node.counts.rejected["actuators:time"] += 1
            return
        name = f"chaser/{command.chaser}"
        self._commanded_ns[name] = max(
            self._timing.tick_time_ns(command.tick), self._commanded_ns.get(name, 0)
        )
        effective = self._timing.step_of_time(command.effective_time_ns)
        actuators.command(command, effective, self._step_now())
        self._command_latch(command.chaser, command.latch, effective)

    def _take_leave(self) -> bool:
        """Notes processes that are gone; True when that changes who is expected in the open tick."""
        changed = False
        for name in self._membership.who_left():
            self._teller.forget(name)
            self.warn("process lost", name)
            if name == "recorder":
                self._recorder_expected = False
            elif name in self._controllers:
                del self._controllers[name]
                changed |= self._review_terms() or self._tick >= 0
            elif name in self._actuators:
                self._actuators[name].stop(self._step_now())
                self._commanded_ns.pop(name, None)
                changed |= any(f"chaser/{i}" == name for i in self.chasers)
                self.chasers = tuple(i for i in self.chasers if f"chaser/{i}" != name)
        return changed and self._tick >= 0

    def complete(self) -> bool:
        """Whether all who are expected have answered the open tick and the recorder keeps up."""
        kept_up = not self._recorder_expected or self._recorded_tick >= self._tick - RECORDER_WINDOW_TICKS
        return kept_up and self._answered.issuperset(self.chasers)

    def warn(self, what: str, detail: str) -> None:
        """Tells an event to the log and to people."""
        time_ns = self._timing.tick_time_ns(max(self._tick, 0))
        event = Event(
            tick=self._tick, sim_time_ns=time_ns, process="world", level="warning", what=what, detail=detail
        )
        self._node.publish(topics.EVENT, event, "world")
        say("world", f"{time_ns / 1e9:.2f} s: {what}: {detail}")

    def wait(
        self, done: Callable[[], bool], stopped: Callable[[], bool], waiting_for: Callable[[], str]
    ) -> bool:
        """Listens until ``done``; False when ``stopped`` first. Says now and then what it waits for."""
        self._warned_s = time.monotonic()
        while not done():
            if stopped():
                return False
            self.listen(0.02)
            if time.monotonic() - self._warned_s > _IMPATIENT_S:
                self._warned_s = time.monotonic()
                say("world", f"waiting for {waiting_for()}")
        return True

    def abandoned(self, rejoin_s: float, stopped: Callable[[], bool]) -> bool:
        """Whether no chaser is left, and none comes back within ``rejoin_s`` of wall time.

        Everybody is lost at once when the router starts again, or the world is cut off. In lock-step simulated time
        then stands still until all are back, or the wait is over; in real time it goes on.
        """
        now_s = time.monotonic()
        if self.chasers or rejoin_s <= 0.0:
            self._alone_s = None
            return not self.chasers
        if self._alone_s is None:
            self._alone_s = now_s
            self.warn("all chasers lost", f"waiting for them for {rejoin_s:g} s")
        if self._membership.realtime:
            return now_s - self._alone_s > rejoin_s
        self._recorder_expected = self._recorder_wanted
        self.wait(
            lambda: not self.missing_at_start() or time.monotonic() - now_s > rejoin_s,
            stopped,
            lambda: ", ".join(self.missing_at_start()),
        )
        still_away = self.missing_at_start()
        self._recorder_expected &= "recorder" not in still_away
        self.warn("waited for the lost", f"still away: {', '.join(still_away) or 'none'}")
        self._alone_s = None
        return not self._chasers_among(self._membership.linked(self._teller.heard()))

    def listen_until(self, wall_s: float) -> None:
        """Listens until a time of the monotonic wall clock."""
        while (left := wall_s - time.monotonic()) > 0:
            self.listen(min(left, 0.02))

    def settle(self) -> None:
        """All are there, the flight begins: presence is told less often, and who joins from now on holds up nobody."""
        self._membership.flying = True
        self._teller.settled.set()

    def farewell(self, tick: int, time_ns: int) -> None:
        """The world's last messages."""
        self._teller.farewell(tick, time_ns)

    def who_is_slow(self) -> str:
        """Names those whose answer to the open tick has not come."""
        late = [f"chaser/{i}" for i in self.chasers if i not in self._answered]
        return ", ".join(late) or "recorder"
