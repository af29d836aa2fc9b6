# SPDX-License-Identifier: Apache-2.0
"""Model check of command authority: ``python tests/lease_model.py --steps 1000000``.

Random walks through the state machines that fly (``LeaseGrantor`` of each chaser, ``LeaseHolder``
of each controller) with the worst network there is: messages come in any order, late, twice or
never; processes restart without memory, some while their predecessor still runs; the world takes
living processes for lost. Checked after every step: no tick has two commanders, unless a controller
is lost in it; a chaser flies the holder of its lease only, and no two controllers in one tick; what
is flown was commanded with authority; ticks and terms that a chaser states never fall. At the end
of a walk the network recovers, and within ``UNITED_TICKS`` one controller must command all chasers,
for good.
"""

from __future__ import annotations

import argparse
import itertools
import random
import sys
from dataclasses import dataclass, field

from chaserdock_agents.chaser.lease_grantor import LeaseGrantor
from chaserdock_protocol.lease_holder import LeaseHolder
from chaserdock_protocol.messages import Lease, Tick, WrenchCommand
from chaserdock_protocol.topics import CONTROLLERS

RATE_HZ = 10
WALK_STEPS = 2000
RECOVERY_TICKS = 40
"""Length of the undisturbed end of a walk."""
UNITED_TICKS = 6
"""Ticks without a loss after which one controller commands all chasers."""
_MOST_IN_FLIGHT = 60
ZERO = (0.0, 0.0, 0.0)

Stamp = tuple[int, int]


class TwoCommanders(AssertionError):
    """A property of the leases does not hold."""


@dataclass
class Controller:
    """One start of a controller, with the ticks that it may still process."""

    leases: LeaseHolder
    ticks: list[Tick] = field(default_factory=list)


@dataclass
class Chaser:
    """One start of a chaser. ``executed``: the newest tick whose command it has flown; ``stated``:
    tick, revision and term of its last lease."""

    leases: LeaseGrantor
    tick: Tick | None = None
    executed: int = -1
    stated: tuple[int, int, int] = (-1, -1, 0)


class Model:
    """World, network, chasers and controllers; ``steps`` counts what has happened.

    ``claims``: who commands, by tick and the number of its controllers, negative so that later
    claims are greater.
    """

    def __init__(self, seed: int) -> None:
        self.draw = random.Random(seed)
        self.n = self.draw.randint(1, 5)
        self.loss = self.draw.choice([0.0, 0.02, 0.2])
        self.chaos = self.draw.choice([0.0, 0.02, 0.1])
        self.steps = self.starts = self.united = 0
        self.chasers = [Chaser(LeaseGrantor(i, RATE_HZ)) for i in range(self.n)]
        self.controllers = {name: self._started(name) for name in CONTROLLERS}
        self.replaced: list[Controller] = []
        self.tick, self.revision = -1, 0
        self.taking_part: dict[str, int] = {}
        self.away: set[str] = set()
        self.in_flight: list[tuple[object, object]] = []
        self.claims: dict[Stamp, tuple[str, str]] = {}
        self.claimed_ticks: set[tuple[int, str, str]] = set()
        self.flown: dict[tuple[int, int], tuple[str, str]] = {}

    def _started(self, name: str) -> Controller:
        self.starts += 1
        return Controller(LeaseHolder(name, f"i{self.starts}"))

    # -- the world ---------------------------------------------------------------------------------

    def open_tick(self) -> None:
        """Open a tick for all processes that are not away."""
        self.tick, self.revision = self.tick + 1, 0
        names = [f"chaser/{i}" for i in range(self.n)] + list(CONTROLLERS)
        self.taking_part = {
            n: self.taking_part.get(n, self.tick) for n in names if n not in self.away
        }
        self.away = {n for n in sorted(self.away) if self.draw.random() < 0.7}
        self._publish_tick()

    def lose(self, name: str) -> None:
        """Take a process for lost, which it may be or not."""
        self.away.add(name)
        if self.taking_part.pop(name, None) is not None:
            self.revision += 1
            self._publish_tick()

    def restart(self, name: str) -> None:
        """Start a process again, without memory. What was on its way to it is lost, unless it is a
        controller that still runs.
        """
        if self.tick < 0:
            return
        self.lose(name)
        if name in CONTROLLERS:
            gone: object = self.controllers[name]
            if self.draw.random() < 0.5:  # cut off from the world only: it goes on
                self.replaced.append(self.controllers[name])
                gone = None
            self.controllers[name] = self._started(name)
        else:
            number = int(name.partition("/")[2])
            gone = self.chasers[number]
            self.chasers[number] = Chaser(LeaseGrantor(number, RATE_HZ))
        self.in_flight = [(to, message) for to, message in self.in_flight if to is not gone]

    def _publish_tick(self) -> None:
        instances = {
            n: c.leases.instance for n, c in self.controllers.items() if n in self.taking_part
        }
        message = Tick(
            tick=self.tick,
            revision=self.revision,
            images=False,
            chasers=tuple(i for i in range(self.n) if f"chaser/{i}" in self.taking_part),
            controllers=instances,
            since=dict(self.taking_part),
        )
        for process in (*self.chasers, *self.all_controllers()):
            self.send(process, message)

    def all_controllers(self) -> list[Controller]:
        """Return the controllers, with those that were replaced and still run."""
        return [*self.controllers.values(), *self.replaced]

    # -- the processes -----------------------------------------------------------------------------

    def send(self, to: object, message: object) -> None:
        """Put a message on its way."""
        if self.draw.random() >= self.loss:
            self.in_flight.append((to, message))
        if len(self.in_flight) > _MOST_IN_FLIGHT:
            del self.in_flight[self.draw.randrange(len(self.in_flight))]

    def deliver(self, position: int, again: bool = False) -> None:
        """Deliver the message at a position of those on their way."""
        to, message = self.in_flight[position] if again else self.in_flight.pop(position)
        match to, message:
            case Chaser(), Tick():
                self._chaser_tick(to, message)
            case Chaser(), WrenchCommand():
                self._chaser_command(to, message)
            case Controller(), Tick():
                to.ticks = [*to.ticks[-3:], message]
                to.leases.add_tick(message)
            case Controller(), Lease():
                to.leases.add(message)
            case _:
                raise TypeError(f"{message} to {to}")

    def _chaser_tick(self, chaser: Chaser, tick: Tick) -> None:
        if chaser.tick is not None and (tick.tick, tick.revision) < (
            chaser.tick.tick,
            chaser.tick.revision,
        ):
            return
        chaser.tick = tick
        if (lease := chaser.leases.update(tick)) is not None:
            self._state(chaser, lease)

    def _chaser_command(self, chaser: Chaser, command: WrenchCommand) -> None:
        if chaser.leases.refusal(command) is not None:
            return
        if command.mode == "yield":
            chaser.leases.give_back(command)
        elif command.mode != "wait":
            chaser.leases.renew(command)
            if chaser.tick is not None:
                self._state(chaser, chaser.leases.stated(chaser.tick))
            self._fly(chaser, command)

    def _fly(self, chaser: Chaser, command: WrenchCommand) -> None:
        if command.tick <= chaser.executed:
            return
        chaser.executed = command.tick
        sender, number = (command.commander, command.instance), chaser.leases.chaser
        if sender != (holder := (chaser.leases.holder, chaser.leases.instance)):
            raise TwoCommanders(f"chaser {number} flies {sender}, but {holder} holds its lease")
        if self.flown.setdefault((command.tick, number), sender) != sender:
            raise TwoCommanders(f"chaser {number} flies two controllers in tick {command.tick}")
        if (command.tick, *sender) not in self.claimed_ticks:
            raise TwoCommanders(
                f"chaser {number} flies {sender} in tick {command.tick}, which it did not command"
            )

    def _state(self, chaser: Chaser, lease: Lease) -> None:
        stated = (lease.tick, lease.revision, lease.term)
        if lease.term < chaser.stated[2] or stated[:2] < chaser.stated[:2]:
            raise TwoCommanders(
                f"chaser {lease.chaser} states (tick, revision, term) {stated} after "
                f"{chaser.stated}"
            )
        chaser.stated = stated
        for controller in self.all_controllers():
            self.send(controller, lease)

    def act(self, controller: Controller) -> None:
        """Let a controller process one of its last ticks: command it, or leave the leases that it
        cannot use.
        """
        if not controller.ticks:
            return
        tick = self.draw.choice(controller.ticks)
        me, term = (controller.leases.name, controller.leases.instance), 0
        if controller.leases.claim(tick):
            stamp, term = (tick.tick, -len(tick.controllers)), controller.leases.term
            if self.claims.setdefault(stamp, me) != me:
                raise TwoCommanders(f"tick {tick.tick}: {self.claims[stamp]} and {me} command it")
            self.claimed_ticks.add((tick.tick, *me))
            for i in tick.chasers:
                self.send(self.chasers[i], command_of(tick, i, "nmpc", me, term))
        elif tick is controller.ticks[-1]:
            for i, (idle_term, gives_back) in controller.leases.take_idle(tick).items():
                mode = "yield" if gives_back else "wait"
                self.send(self.chasers[i], command_of(tick, i, mode, me, idle_term))

    # -- the walk ----------------------------------------------------------------------------------

    def step(self) -> None:
        """Let one random thing happen."""
        self.steps += 1
        drawn = self.draw.random()
        if drawn < 0.02 * self.chaos:
            self.restart(self.draw.choice([*CONTROLLERS, *(f"chaser/{i}" for i in range(self.n))]))
        elif drawn < 0.05 * self.chaos:
            if self.tick >= 0:
                self.lose(self.draw.choice([*CONTROLLERS, *(f"chaser/{i}" for i in range(self.n))]))
        elif drawn < 0.06 or not self.in_flight:
            self.open_tick()
        elif drawn < 0.2:
            self.act(self.draw.choice(self.all_controllers()))
        else:
            again = self.draw.random() < 0.02
            newest_last = self.draw.random() < 0.8
            self.deliver(0 if newest_last else self.draw.randrange(len(self.in_flight)), again)

    def recover(self) -> None:
        """Let all processes take part and all messages arrive; check that one controller soon
        commands all chasers, for good.

        ``united``: ticks until then.
        """
        self.loss, self.away = 0.0, set()
        self.replaced.clear()
        for k in range(RECOVERY_TICKS):
            self.away = set()
            self.open_tick()
            for _ in range(2):
                while self.in_flight:
                    self.steps += 1
                    self.deliver(0)
                for controller in self.controllers.values():
                    controller.ticks = controller.ticks[-1:]
                    self.act(controller)
            flown = {self.flown.get((self.tick, i)) for i in range(self.n)}
            if len(flown) != 1 or None in flown:
                self.united = k + 1
                if k >= UNITED_TICKS:
                    raise TwoCommanders(f"{k} ticks after the last loss the chasers fly {flown}")


def command_of(
    tick: Tick, chaser: int, mode: str, sender: tuple[str, str], term: int
) -> WrenchCommand:
    """Return a command without content."""
    return WrenchCommand(
        tick=tick.tick,
        chaser=chaser,
        effective_time_ns=0,
        expires_ns=0,
        mode=mode,  # type: ignore[arg-type]
        force_N=ZERO,
        torque_N_m=ZERO,
        term=term,
        commander=sender[0],
        instance=sender[1],
    )


def walk(seed: int, steps: int = WALK_STEPS) -> Model:
    """Walk through one random model; raises TwoCommanders."""
    model = Model(seed)
    for _ in range(steps):
        model.step()
    model.recover()
    return model


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    arguments = parser.parse_args()
    steps = commanded = handovers = 0
    seed = arguments.first
    while steps < arguments.steps:
        try:
            model = walk(seed)
        except TwoCommanders as error:
            print(f"seed {seed}: {error}")
            return 1
        steps += model.steps
        commanded += len(model.claims)
        order = [model.claims[stamp] for stamp in sorted(model.claims)]
        handovers += sum(a != b for a, b in itertools.pairwise(order))
        seed += 1
    print(
        f"{seed - arguments.first} walks, {steps} steps, {commanded} commanded ticks, {handovers} "
        "changes of commander: "
        "never two commanders"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
