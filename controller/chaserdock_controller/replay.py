"""The controller again, on what it received in a recorded flight: its process' own code, with a tape for a network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from typing import Any, cast

import msgspec
from chaserdock_protocol import topics
from chaserdock_protocol.replay_node import Published, ReplayNode, SilentHeartbeat, Stage
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.transport import Node, ReceivedMessage

from .core import ControllerCore, TickInputs, TickOutputs
from .process import Controller


class _FusionAlone:
    """A flight that estimates and commands nothing."""

    def __init__(self, flight: ControllerCore) -> None:
        self._flight = flight

    def step(self, inputs: TickInputs) -> TickOutputs:
        return TickOutputs(target=self._flight.fuse(inputs)[1])


def _flight_of(scenario: Scenario) -> ControllerCore:
    return ControllerCore(scenario, now_s=lambda: 0.0)


def _named_once(recorded: Iterable[ReceivedMessage]) -> Iterator[tuple[str, list[ReceivedMessage]]]:
    """Messages tick by tick, with who commanded at its end; a tick that was told again names that one from the start."""
    for _, group in groupby(recorded, key=lambda r: r.message.tick):
        came = list(group)
        told = [r.message for r in came if r.topic is topics.TICK]
        if not told:
            yield "", came
            continue
        last = max(told, key=lambda tick: tick.revision)
        names = {"term": last.term, "commander": last.commander, "instance": last.instance}
        yield (
            last.commander,
            [
                msgspec.structs.replace(r, message=msgspec.structs.replace(r.message, **names))
                if r.topic is topics.TICK
                else r
                for r in came
            ],
        )


def _play(
    scenario: Scenario, recorded: Iterable[ReceivedMessage], flight_of: Callable[[], Any]
) -> Iterator[Published]:
    """The answers of whoever commanded. One that takes over knows what the other knew; one started again does not."""
    tape, controller, last_seq, last_commander = ReplayNode("controller"), None, -1, ""
    for named, came in _named_once(recorded):
        commander = named or last_commander
        for received in came:
            is_target = received.topic is topics.TARGET
            anew = is_target and received.message.seq < last_seq and commander == last_commander
            if controller is None or anew:
                tape = ReplayNode("controller")
                controller = Controller(cast(Node, tape), scenario, flight_of(), replaying=True)
                controller.heartbeat = cast(Any, SilentHeartbeat())
            if is_target:
                last_seq = received.message.seq
            if received.topic is topics.OPERATED:
                controller.operate(received.message, lambda _: None)
            elif received.topic in _INPUTS:
                tape.put(received)
                controller.listen()
                # What a standby tells is on a branch of its own, which is not compared.
                yield from (
                    s for s in tape.take_published() if s[0] is not topics.EVENT or commander != "standby"
                )
        last_commander = commander


def play_controller(scenario: Scenario, recorded: Iterable[ReceivedMessage]) -> Iterator[Published]:
    """All that the controller publishes."""
    return _play(scenario, recorded, lambda: _flight_of(scenario))


def play_fusion(scenario: Scenario, recorded: Iterable[ReceivedMessage]) -> Iterator[Published]:
    """The target's estimate alone."""
    return _play(scenario, recorded, lambda: _FusionAlone(_flight_of(scenario)))


_INPUTS = (topics.TICK, topics.ODOMETRY, topics.SIGHTING, topics.THRUSTERS, topics.DOCKING)
FUSION = Stage("controller", _INPUTS, (topics.TARGET,), play_fusion)
CONTROLLER = Stage(
    "controller",
    (topics.OPERATED, *_INPUTS),
    (
        topics.TARGET,
        topics.WRENCH,
        topics.REFERENCE,
        topics.PLAN,
        topics.SOLVER,
        topics.COMMAND,
        topics.EVENT,
    ),
    play_controller,
)
