# SPDX-License-Identifier: Apache-2.0
"""Replay of the controller process on the inputs recorded in a log."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from typing import Any, cast

import numpy as np
from chaserdock_protocol import topics
from chaserdock_protocol.lease_holder import Commander
from chaserdock_protocol.messages import WrenchCommand
from chaserdock_protocol.replay_node import Published, ReplayNode, SilentHeartbeat, Stage
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.transport import Node, ReceivedMessage

from .core import ControllerCore
from .interfaces import TickInputs, TickOutputs
from .process import ControllerProcess


class _EstimationOnly:
    """Processes ticks by ingest and estimation alone."""

    def __init__(self, core: ControllerCore) -> None:
        self._core = core

    def step(self, inputs: TickInputs) -> TickOutputs:
        """Return outputs with the target's estimate and nothing else."""
        target = self._core.estimate(inputs)
        for sent in self._core.output.sent:
            sent.forget_before(inputs.time_ns)
        return TickOutputs(target=target)

    def failed_parts(self) -> tuple[str, ...]:
        """See ``ControllerCore.failed_parts``."""
        return self._core.failed_parts()

    def doubts(self, chaser: int) -> bool:
        """See ``ControllerCore.doubts``."""
        return self._core.doubts(chaser)

    def add_command(self, command: WrenchCommand) -> None:
        """Add a recorded command, which the estimator takes into account."""
        wrench = np.array([*command.force_N, *command.torque_N_m])
        self._core.output.sent[command.chaser].add(command.effective_time_ns, wrench)


def _core_of(scenario: FlightScenario) -> ControllerCore:
    return ControllerCore(scenario, now_s=lambda: 0.0)


def _with_leader(
    recorded: Iterable[ReceivedMessage],
) -> Iterator[tuple[Commander | None, list[ReceivedMessage]]]:
    """Return the messages of each tick with the controller that commanded it last; None if none
    did.
    """
    for _, group in groupby(recorded, key=lambda r: r.message.tick):
        received = list(group)
        commands = [r.message for r in received if r.topic is topics.WRENCH]
        commands = [c for c in commands if c.mode not in ("wait", "yield")]
        last = max(commands, key=lambda c: c.term, default=None)
        yield (
            None if last is None else Commander(last.commander, last.instance, last.term),
            received,
        )


def _play(
    scenario: FlightScenario, recorded: Iterable[ReceivedMessage], core_of: Callable[[], Any]
) -> Iterator[Published]:
    """Return the outputs of the leader. A new leader inherits the state of the previous one; a
    restarted process does not.
    """
    node, controller, last_seq = ReplayNode("controller"), None, -1
    last_leader = authority = Commander("controller", "", 0)
    for commander, messages in _with_leader(recorded):
        authority = commander or authority
        leader = authority.name
        for received in messages:
            is_target = received.topic is topics.TARGET
            restarted = is_target and received.message.seq < last_seq and leader == last_leader.name
            if controller is None or restarted:
                node = ReplayNode("controller")
                controller = ControllerProcess(
                    cast(Node, node), scenario, core_of(), replaying=True
                )
                controller.heartbeat = cast(Any, SilentHeartbeat())
            controller.standby.replayed = authority
            if is_target:
                last_seq = received.message.seq
            if received.topic is topics.WRENCH:
                if isinstance(controller.core, _EstimationOnly):
                    controller.core.add_command(received.message)
            elif received.topic is topics.OPERATED:
                controller.operate(received.message, lambda _: None)
            elif received.topic in _INPUTS:
                node.put(received)
                controller.listen()
                # Events of a standby are published on its own branch, which is not compared.
                yield from (
                    s
                    for s in node.take_published()
                    if s[0] is not topics.EVENT or leader != "standby"
                )
        last_leader = authority


def play_controller(
    scenario: FlightScenario, recorded: Iterable[ReceivedMessage]
) -> Iterator[Published]:
    """Return everything that the controller publishes."""
    return _play(scenario, recorded, lambda: _core_of(scenario))


def play_fusion(
    scenario: FlightScenario, recorded: Iterable[ReceivedMessage]
) -> Iterator[Published]:
    """Return the target's estimates only."""
    return _play(scenario, recorded, lambda: _EstimationOnly(_core_of(scenario)))


_INPUTS = (topics.TICK, topics.ODOMETRY, topics.SIGHTING, topics.THRUSTERS, topics.DOCKING)
FUSION = Stage("controller", (*_INPUTS, topics.WRENCH), (topics.TARGET,), play_fusion)
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
