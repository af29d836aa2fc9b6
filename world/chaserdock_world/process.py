"""The world process: owns simulated time, flies the bodies, takes the images, knows the truth.

Lock-step: a tick ends when every expected answer to it has come; nothing depends on the order of arrival or
on the wall clock. Real time: a tick ends when the wall clock says so.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Mapping, Sequence

import cv2
from chaserdock_models.clock import Timing
from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.fault_injection import layer_of
from chaserdock_protocol.messages import JoinReply, JoinRequest, MissionEnd, ThrusterFaultCommand
from chaserdock_protocol.process import ProcessOptions, Stop, built, say
from chaserdock_protocol.scenario import Scenario, ScenarioError, load_scenario
from chaserdock_protocol.transport import Node, TransportError
from chaserdock_protocol.transport.session import Heartbeat, new_instance

from chaserdock_world.actuators.ideal import Actuators, fly_to
from chaserdock_world.actuators.operator_faults import ThrusterFaultHandler
from chaserdock_world.actuators.thrusters import actuators_of
from chaserdock_world.lockstep.membership import Membership
from chaserdock_world.lockstep.tick_barrier import Answers
from chaserdock_world.physics.simulation import Physics
from chaserdock_world.rendering.cameras import Cameras, States
from chaserdock_world.sensors.errors import Navigation
from chaserdock_world.sensors.publish import publish_docking, publish_odometry, publish_truth


def main(options: ProcessOptions) -> int:
    """Runs the world of ``options.scenario``; 0 when it was flown to its end, 1 when not, 2 for bad input."""
    # Other processes need the cores, and OpenCV's idle threads spin between an image's many short calls.
    cv2.setNumThreads(1)
    node: Node | None = None
    try:
        scenario = load_world_scenario(options)
        node = Node("world", "world", options.link)
        refuse_second_world(node)
        return fly(scenario, options, node, Stop(options.watch_parent))
    except ChaserdockError as error:
        say("world", str(error))
        return 2
    finally:
        if node is not None:
            node.close()


def load_world_scenario(options: ProcessOptions) -> Scenario:
    """The scenario of the options, with overrides and seed; raises ScenarioError."""
    if options.scenario is None:
        raise ScenarioError("the world needs a scenario file")
    overrides = options.overrides if options.seed is None else (*options.overrides, f"seed={options.seed}")
    return load_scenario(options.scenario, overrides)


def refuse_second_world(node: Node) -> None:
    """Raises TransportError if a world already answers in this namespace."""
    reply = node.ask(
        topics.JOIN_KEY, JoinRequest(process="world", instance=new_instance()), JoinReply, timeout_s=0.5
    )
    if reply is not None:
        raise TransportError(reply.reason)


def gather(
    scenario: Scenario,
    options: ProcessOptions,
    node: Node,
    actuators: Mapping[str, Actuators],
    physics: Physics,
) -> Answers:
    """Opens the world's ears and doors: from here on processes can join."""
    membership = Membership(
        chasers=len(scenario.chasers),
        run_id=uuid.uuid4().hex[:12],
        mode=options.mode,
        scenario_json=scenario.model_dump_json(),
        instance=new_instance(),
    )
    node.waits = options.mode == "lockstep"
    node.subscribe(topics.ACTUATORS)
    node.subscribe(topics.ACK)
    node.watch_liveliness(membership.alive_changed)
    node.answer(topics.JOIN_KEY, JoinRequest, lambda request, reply: reply(membership.admit(request)))
    for topic in (topics.TICK, topics.END, topics.TRUTH_WORLD):
        node.advertise(topic)
    for i in range(len(scenario.chasers)):
        node.advertise(topics.ODOMETRY, i)
        if f"chaser/{i}" in physics.latches:
            node.advertise(topics.DOCKING, i)
        node.advertise(topics.IMAGE, i)
    heartbeat = Heartbeat(node, membership.instance)
    node.announce()
    return Answers(
        node,
        membership,
        heartbeat,
        scenario.timing,
        actuators,
        lambda: physics.step_count,
        physics.command_latch,
        options.recorder_expected,
        scenario.controller.command_lifetime_s,
        scenario.controller.standby,
    )


Contacts = set[tuple[str, str]]


def expose(
    node: Node,
    cameras: Cameras,
    chasers: Sequence[int],
    tick: int,
    timing: Timing,
    states: States,
    *,
    at_once: bool,
) -> None:
    """Takes and sends the images of a tick: each when it is drawn, or all at once, as cameras do that expose at once."""
    exposure = (tick // timing.ticks_per_image, tick, timing.tick_time_ns(tick), states)
    one_by_one = (cameras.image(i, *exposure) for i in chasers)
    for image in cameras.images(chasers, *exposure) if at_once else one_by_one:
        node.publish(topics.IMAGE, image, image.chaser)


def pass_lockstep(
    tick: int, answers: Answers, stop: Stop, timing: Timing, fly_to_step: Callable[[int], Contacts]
) -> Contacts:
    """Flies a tick whose end waits for all answers; the pairs of bodies that touched."""
    end = timing.step_of_tick(tick + 1)
    # No answer to this tick can act before its latency has passed: fly that far while they think.
    contacts = fly_to_step(min(end, timing.step_of_tick(tick) + timing.latency_steps))
    if answers.wait(answers.complete, stop, answers.who_is_slow):
        contacts |= fly_to_step(end)
    return contacts


def pass_realtime(
    tick: int, begun_s: float, answers: Answers, timing: Timing, fly_to_step: Callable[[int], Contacts]
) -> Contacts:
    """Flies a tick at the pace of the wall clock, in slices, so that a command acts when it comes, not before."""
    contacts: Contacts = set()
    slices = max(1, timing.steps_per_tick // max(1, timing.physics_hz // 240))
    for k in range(1, slices + 1):
        step = timing.step_of_tick(tick) + timing.steps_per_tick * k // slices
        answers.listen_until(begun_s + step / timing.physics_hz)
        contacts |= fly_to_step(step)
    return contacts


def fly(scenario: Scenario, options: ProcessOptions, node: Node, stop: Stop) -> int:
    """Gathers the processes, flies all ticks, ends the mission; the process' status."""
    cameras, physics, timing = Cameras(scenario), Physics(scenario), scenario.timing
    navigation = Navigation(scenario)
    actuators = {f"chaser/{i}": actuators_of(scenario, i) for i in range(len(scenario.chasers))}
    node.faults = layer_of(scenario, "world", lockstep=options.mode == "lockstep")
    answers = gather(scenario, options, node, actuators, physics)
    faults = ThrusterFaultHandler(scenario, actuators)
    node.answer(topics.THRUSTER_FAULT_KEY, ThrusterFaultCommand, faults.ask)
    say("world", f"{scenario.name}, {options.mode}: waiting for {', '.join(answers.missing_at_start())}")
    started = answers.wait(
        lambda: not answers.missing_at_start(), stop, lambda: ", ".join(answers.missing_at_start())
    )
    answers.settle()
    built()
    reason = "flown to its end" if started else "stopped before the first tick"
    begun_s, tick = time.monotonic(), 0

    def fly_to_step(step: int) -> Contacts:
        return fly_to(step, physics, actuators, 1.0 / timing.physics_hz)

    contacts: Contacts = set()
    while started:
        states = {name: physics.state(name) for name in physics.bodies}
        publish_docking(node, physics.latches, tick, timing)  # before the truth, which takes the touches
        publish_truth(node, states, tick, timing, actuators, contacts, physics.latches)
        publish_odometry(node, states, tick, timing, navigation)
        if tick == scenario.ticks:
            break
        images = timing.has_images(tick)
        answers.open(tick, images)
        for what, detail in faults.decide(tick, timing):
            answers.warn(what, detail)
        if images:
            expose(node, cameras, answers.chasers, tick, timing, states, at_once=options.mode == "realtime")
        if options.mode == "lockstep":
            contacts = pass_lockstep(tick, answers, stop, timing, fly_to_step)
        else:
            contacts = pass_realtime(tick, begun_s, answers, timing, fly_to_step)
        if stop() or answers.abandoned(options.rejoin_s, stop):
            reason = "stopped" if stop() else "no chaser is left"
            break
        tick += 1
    complete = started and tick == scenario.ticks
    time_ns = timing.tick_time_ns(tick)
    node.publish(topics.END, MissionEnd(tick=tick, sim_time_ns=time_ns, reason=reason, complete=complete))
    answers.farewell(tick, time_ns)
    say("world", f"{reason} at {time_ns / 1e9:.2f} s")
    return 0 if complete else 1
