# SPDX-License-Identifier: Apache-2.0
"""Open a mission, wait for its processes, and end it: what the world and a gateway share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from chaserdock_protocol import topics
from chaserdock_protocol.fault_injection import create_fault_layer
from chaserdock_protocol.messages import (
    JoinReply,
    JoinRequest,
    MissionEnd,
    ScenarioReply,
    ScenarioRequest,
)
from chaserdock_protocol.process import ProcessOptions, StopSignal, print_status
from chaserdock_protocol.scenario import (
    Scenario,
    ScenarioError,
    flight_scenario_json,
    load_scenario,
)
from chaserdock_protocol.scenario.faults import faults_of
from chaserdock_protocol.stall import StallTimer
from chaserdock_protocol.transport import Node, TransportError
from chaserdock_protocol.transport.session import Heartbeat, ask_as_world

from .command_intake import CommandIntake
from .membership import Membership
from .tick_barrier import TickBarrier


def open_world_node(options: ProcessOptions) -> Node:
    """Open the node of the process that owns a mission. Raises TransportError, also if the
    namespace has such a process.
    """
    node = Node("world", "world", options.link)
    reply = ask_as_world(node)
    if reply is not None:
        node.close()
        raise TransportError(reply.reason)
    return node


@dataclass(frozen=True)
class MissionHost:
    """A mission of ``scenario`` that processes can join, as ``run_id``. ``barrier``: opens its
    ticks.
    """

    scenario: Scenario
    options: ProcessOptions
    node: Node
    barrier: TickBarrier
    run_id: str

    def wait_for_processes(self, stop: StopSignal) -> str:
        """Wait until all expected processes are connected; return why they are not, empty if they
        are.

        ``ProcessOptions.patience_s`` limits the time in which no process connects.
        """
        barrier, patience_s = self.barrier, self.options.patience_s or math.inf
        timer, missing = StallTimer(self.node.host.now_s), barrier.missing_processes()

        def over() -> bool:
            nonlocal missing
            before, missing = missing, barrier.missing_processes()
            if missing != before:
                timer.reset()
            return not missing or timer.update() >= patience_s

        def missing_names() -> str:
            return ", ".join(missing)

        print_status(
            "world", f"{self.scenario.name}, {self.options.mode}: waiting for {missing_names()}"
        )
        if not barrier.wait_until(over, stop, missing_names):
            return "stopped before the first tick"
        barrier.start_flight()
        if missing:
            return f"not connected within {patience_s:g} s: {missing_names()}"
        self.node.host.finish_startup()
        return ""

    def end(self, tick: int, reason: str, complete: bool) -> int:
        """Publish the end of the mission; return the exit status."""
        time_ns = self.scenario.timing.tick_time_ns(tick)
        self.node.publish(
            topics.END, MissionEnd(tick=tick, sim_time_ns=time_ns, reason=reason, complete=complete)
        )
        self.barrier.publish_farewell(tick, time_ns)
        print_status("world", f"{reason} at {time_ns / 1e9:.2f} s")
        return 0 if complete else 1


def open_mission(
    scenario: Scenario,
    options: ProcessOptions,
    node: Node,
    commands: CommandIntake,
    run_id: str | None = None,
) -> MissionHost:
    """Serve the queries of a mission and announce it. Call it after all other subscriptions and
    advertisements of the node (see ``Heartbeat``). ``run_id``: of a mission that goes on.
    """
    membership = Membership(
        chasers=len(scenario.chasers),
        run_id=run_id or node.host.unique_id(),
        mode=options.mode,
        scenario_json=flight_scenario_json(scenario),
        faults_of=lambda process: faults_of(scenario, process).model_dump_json(),
        instance=node.host.unique_id(),
        source=node.source,
        now_s=node.host.now_s,
        resumed=run_id is not None,
    )
    realtime = options.mode == "realtime"
    faults = create_fault_layer(
        faults_of(scenario, "world"), "world", scenario.timing, not realtime, node.host
    )
    node.message_filter = faults
    node.blocking = not realtime
    node.subscribe(topics.ACTUATORS)
    node.subscribe(topics.ACK)
    node.watch_liveliness(membership.set_alive)
    full = ScenarioReply(run_id=membership.run_id, scenario_json=scenario.model_dump_json())
    node.declare_queryable(topics.SCENARIO_KEY, ScenarioRequest, lambda _, reply: reply(full))

    def join(request: JoinRequest, reply: Callable[[JoinReply], None]) -> None:
        if (answer := membership.admit(request)) is not None:
            reply(answer)

    node.declare_queryable(topics.JOIN_KEY, JoinRequest, join)
    for topic in (topics.TICK, topics.END):
        node.advertise(topic)
    heartbeat = Heartbeat(node, membership.instance)
    node.declare_liveliness()
    barrier = TickBarrier(
        node,
        membership,
        heartbeat,
        scenario.timing,
        commands,
        options.recorder_expected,
        scenario.controller.standby,
        scenario.maps_target,
    )
    barrier.faults = faults
    return MissionHost(scenario, options, node, barrier, membership.run_id)


def load_mission_scenario(options: ProcessOptions) -> Scenario:
    """Return the scenario of the options, with overrides and seed. Raises ScenarioError."""
    if options.scenario is None:
        raise ScenarioError("the world needs a scenario file")
    seed = () if options.seed is None else (f"seed={options.seed}",)
    return load_scenario(options.scenario, (*options.overrides, *seed))
