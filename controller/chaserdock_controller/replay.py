"""The controller again, on what it received in a recorded flight: its process' own code, with a tape for a network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, cast

from chaserdock_protocol import topics
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.tape import Said, SilentTeller, Stage, Tape
from chaserdock_protocol.transport import Node, Received

from .flight import Flight, Inputs, Outputs
from .process import Controller


class _FusionAlone:
    """A flight that estimates and commands nothing."""

    def __init__(self, flight: Flight) -> None:
        self._flight = flight

    def step(self, inputs: Inputs) -> Outputs:
        return Outputs(target=self._flight.fuse(inputs)[1])


def _flight_of(scenario: Scenario) -> Flight:
    return Flight(scenario, now_s=lambda: 0.0)


def _play(scenario: Scenario, recorded: Iterable[Received], flight_of: Callable[[], Any]) -> Iterator[Said]:
    tape, controller, last_seq = Tape("controller"), None, -1
    for received in recorded:
        is_target = received.topic is topics.TARGET
        if controller is None or (is_target and received.message.seq < last_seq):
            tape = Tape("controller")
            controller = Controller(cast(Node, tape), scenario, flight_of())
            controller.teller = cast(Any, SilentTeller())
        if is_target:
            last_seq = received.message.seq
        if received.topic is topics.OPERATED:
            controller.operate(received.message, lambda _: None)
        elif received.topic in _INPUTS:
            tape.put(received)
            controller.listen()
            yield from tape.said()


def play_controller(scenario: Scenario, recorded: Iterable[Received]) -> Iterator[Said]:
    """All that the controller publishes."""
    return _play(scenario, recorded, lambda: _flight_of(scenario))


def play_fusion(scenario: Scenario, recorded: Iterable[Received]) -> Iterator[Said]:
    """The target's estimate alone."""
    return _play(scenario, recorded, lambda: _FusionAlone(_flight_of(scenario)))


_INPUTS = (topics.TICK, topics.ODOMETRY, topics.SIGHTING, topics.JETS, topics.DOCKING)
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
