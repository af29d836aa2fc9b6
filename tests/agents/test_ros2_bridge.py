# SPDX-License-Identifier: Apache-2.0
"""The bridge to ROS 2, with zenoh-ros2-sdk, an independent implementation of rmw_zenoh's protocol,
as the peer.
"""

from __future__ import annotations

import re
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from chaserdock_agents.chaser.lease_grantor import LeaseGrantor
from chaserdock_agents.ros2 import conversion, process, services, wrench_control
from chaserdock_agents.ros2.rmw_zenoh import Attachment, endpoint_token, topic_key
from chaserdock_agents.ros2.types import (
    GOTO,
    INTERFACES,
    SELECT_THRUSTER,
    TRIGGER,
    TYPES,
    type_hash,
)
from chaserdock_protocol import topics
from chaserdock_protocol.lease_holder import PATIENCE_TICKS, LeaseHolder
from chaserdock_protocol.messages import (
    CommandReply,
    JoinReply,
    JoinRequest,
    MissionEnd,
    OperatorCommand,
    Tick,
)
from chaserdock_protocol.process import ProcessOptions, RosLink, StopSignal
from chaserdock_protocol.replay_node import ReplayNode, SilentHeartbeat
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.scenario.flight import flight_scenario_json
from chaserdock_protocol.transport import Link, Node
from chaserdock_protocol.transport.config import ReceivedMessage
from harness import ROOT, free_port
from message_samples import BY_TYPE
from msgspec.structs import replace
from zenoh_ros2_sdk import ROS2ServiceClient, ROS2Subscriber
from zenoh_ros2_sdk import utils as sdk
from zenoh_ros2_sdk.discovery import (
    get_service_names_and_types,
    get_topic_info,
    get_topic_names_and_types,
)
from zenoh_ros2_sdk.session import ZenohSession

DOMAIN, WAIT_S = 7, 60.0
TYPE_NAMES = sorted(set(conversion.topic_types(1).values()))


def definitions(type_name: str) -> dict[str, str]:
    """Return the definitions of a type and of those that it consists of, by name."""
    text, _ = TYPES.generate_msgdef(type_name, ros_version=2)
    first, *others = re.split(r"^=+\nMSG: (\S+)\n", text, flags=re.MULTILINE)
    names = [re.sub("/", "/msg/", n) if "/msg/" not in n else n for n in others[::2]]
    return {type_name: first, **dict(zip(names, others[1::2], strict=True))}


def wait_for(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.02)


# -- keys and hashes -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("type_name", "digits"),
    [
        # As ROS 2 installations with rmw_zenoh_cpp show them.
        ("std_msgs/msg/String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
        (
            "sensor_msgs/msg/Image",
            "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
        ),
        (
            "nav_msgs/msg/Odometry",
            "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
        ),
        (
            "tf2_msgs/msg/TFMessage",
            "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
        ),
        (TRIGGER, "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"),
    ],
)
def test_type_hash_is_that_of_installations(type_name: str, digits: str) -> None:
    assert type_hash(type_name) == f"RIHS01_{digits}"


@pytest.mark.parametrize("type_name", TYPE_NAMES)
def test_peer_computes_the_same_type_hash(type_name: str) -> None:
    parts = definitions(type_name)
    own = parts.pop(type_name)
    assert type_hash(type_name) == sdk.get_type_hash(type_name, own, parts)


@pytest.mark.parametrize("type_name", [GOTO, SELECT_THRUSTER])
def test_peer_computes_the_same_hash_of_services(type_name: str) -> None:
    text = (INTERFACES / f"srv/{type_name.rpartition('/')[2]}.srv").read_text()
    request, _, response = text.partition("---\n")
    assert type_hash(type_name) == sdk.compute_service_type_hash(type_name, request, response)


def test_keys_are_those_of_the_design_document() -> None:
    string = f"std_msgs::msg::dds_::String_/{type_hash('std_msgs/msg/String')}"
    assert topic_key(0, "/robot1/chatter", "std_msgs/msg/String") == f"0/robot1/chatter/{string}"
    assert (
        endpoint_token(2, "f9980ee0", "talker", 10, "MP", "/chatter", "std_msgs/msg/String")
        == f"@ros2_lv/2/f9980ee0/0/10/MP/%/%/talker/%chatter/{string}/::,10:,:,:,,"
    )


def test_attachment_is_inverse_and_damaged_ones_are_refused() -> None:
    attachment = Attachment(3, 5, bytes(range(16)))
    packed = attachment.pack()
    assert Attachment.unpack(packed) == attachment
    for damaged in (b"", packed[:-1], packed + b"\0", packed[:16] + b"\x08" + packed[17:]):
        with pytest.raises(ValueError, match="no attachment"):
            Attachment.unpack(damaged)


# -- on the network --------------------------------------------------------------------------------


@dataclass
class Mission:
    """A world and a controller that do nothing but reply, a bridge in a thread, and what the
    bridge's status was.
    """

    world: Node
    controller: Node
    ros_port: int
    thread: threading.Thread
    controller_link: Link
    commands: list[OperatorCommand] = field(default_factory=list)
    status: list[int] = field(default_factory=list)

    def subscribe(self, topic: str) -> list[Any]:
        """Return a list that grows by the messages which the peer reads from a topic."""
        read: list[Any] = []
        type_name = conversion.topic_types(2)[topic]
        text, _ = TYPES.generate_msgdef(type_name, ros_version=2)
        ROS2Subscriber(
            topic,
            type_name,
            read.append,
            text,
            domain_id=DOMAIN,
            router_port=self.ros_port,
            type_hash=type_hash(type_name),
        )
        return read


@pytest.fixture(scope="module")
def mission() -> Iterator[Mission]:
    port, ros_port = free_port(), free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    world = Node("world", "world", Link("ros", (), (endpoint,)))
    controller = Node("controller", "controller", Link("ros", (endpoint,)))
    scenario = flight_scenario_json(load_scenario(ROOT / "scenarios" / "two-chaser-tracking.toml"))
    mission = JoinReply(
        accepted=True,
        reason="",
        run_id="r",
        mode="lockstep",
        scenario_json=scenario,
        source=world.source,
    )
    world.declare_queryable(topics.JOIN_KEY, JoinRequest, lambda request, reply: reply(mission))
    options = ProcessOptions(
        link=Link("ros", (endpoint,)),
        ros=RosLink((), (f"tcp/127.0.0.1:{ros_port}",), DOMAIN),
        signals=False,
        patience_s=WAIT_S,
    )
    thread = threading.Thread(target=lambda: flown.status.append(process.main(options)))
    flown = Mission(world, controller, ros_port, thread, Link("ros", (endpoint,)))

    def operate(command: OperatorCommand, reply: Callable[[CommandReply], None]) -> None:
        flown.commands.append(command)
        accepted = command.command != "retreat"
        reply(
            CommandReply(
                command=command.command,
                chaser=command.chaser,
                accepted=accepted,
                reason="" if accepted else "docked",
            )
        )

    controller.declare_queryable(topics.OPERATE_KEY, OperatorCommand, operate)
    flown.thread.start()
    session = ZenohSession.get_instance("127.0.0.1", ros_port)
    wait_for(
        lambda: (
            len(get_service_names_and_types(DOMAIN, router_port=ros_port))
            >= len(list(services.services(2)))
        )
    )
    yield flown
    world.publish(topics.END, MissionEnd(reason="over", complete=True))
    flown.thread.join(WAIT_S)
    session.close()
    controller.close()
    world.close()
    assert flown.status == [0]


def test_peer_discovers_topics_services_and_hashes(mission: Mission) -> None:
    expected = conversion.topic_types(2)
    found = dict(get_topic_names_and_types(DOMAIN, router_port=mission.ros_port))
    assert {t: kinds for t, kinds in found.items() if t in expected} == {
        t: [kind] for t, kind in expected.items()
    }
    info = get_topic_info("/chaser_0/image", DOMAIN, router_port=mission.ros_port, verbose=True)
    assert info is not None
    assert [p.type_hash for p in info.publishers] == [type_hash("sensor_msgs/msg/Image")]
    assert [p.node_name for p in info.publishers] == ["chaserdock"]
    offered = dict(get_service_names_and_types(DOMAIN, router_port=mission.ros_port))
    assert offered == {name: [kind] for name, kind, _, _ in services.services(2)}
    assert get_topic_names_and_types(DOMAIN + 1, router_port=mission.ros_port) == []


def test_peer_reads_1000_images(mission: Mission) -> None:
    read = mission.subscribe("/chaser_1/image")
    sample: Any = replace(BY_TYPE[topics.IMAGE.kind], chaser=1)

    def knows_the_subscription() -> bool:
        mission.world.publish(topics.IMAGE, sample, 1)
        return bool(read)

    wait_for(knows_the_subscription)
    rng = np.random.default_rng(1)
    data = [rng.integers(0, 256, 48 * 32, np.uint8).tobytes() for _ in range(1000)]
    for k, pixels in enumerate(data):
        image = replace(
            sample,
            width_px=48,
            height_px=32,
            encoding="mono8",
            data=pixels,
            sim_time_ns=k,
        )
        mission.world.publish(topics.IMAGE, image, 1)

    def images() -> list[Any]:
        return [message for message in read if bytes(message.data) != sample.data]

    wait_for(lambda: len(images()) >= 1000)
    read = images()
    assert [bytes(message.data) for message in read] == data
    assert [message.header.stamp.nanosec for message in read] == list(range(1000))
    assert {(m.width, m.height, m.encoding, m.header.frame_id) for m in read} == {
        (48, 32, "mono8", "chaser_1_camera")
    }


def test_peer_reads_every_topic(mission: Mission) -> None:
    read = {topic: mission.subscribe(topic) for topic in conversion.topic_types(1)}
    expected: dict[str, list[Any]] = defaultdict(list)
    converter = conversion.Converter(load_scenario(ROOT / "scenarios" / "two-chaser-tracking.toml"))
    sent: list[tuple[Any, Any, int | None]] = []
    for topic in process.SOURCES:
        if topic is topics.END:
            continue
        message: Any = BY_TYPE[topic.kind]
        place = 0 if "{chaser}" in topic.key else None
        message = message if place is None else replace(message, chaser=0)
        for part in converter.convert(message):
            expected[part.topic].append(TYPES.serialize_cdr(part.message, part.type_name))
        sent.append((topic, message, place))
    assert set(expected) == set(read)

    def all_have_arrived() -> bool:
        """Publish again: the bridge may not have known the subscriptions."""
        for topic, message, place in sent:
            node = mission.world if topic.writer == "world" else mission.controller
            node.publish(topic, message, place)
        return all(len(read[topic]) >= len(items) for topic, items in expected.items())

    wait_for(all_have_arrived)
    for topic, items in expected.items():
        type_name = conversion.topic_types(1)[topic]
        again = [TYPES.serialize_cdr(message, type_name) for message in read[topic]]
        assert set(map(bytes, again)) == set(map(bytes, items)), topic


def call(mission: Mission, name: str, kind: str, request: str, **arguments: Any) -> Any:
    client = ROS2ServiceClient(
        name, kind, request, "bool success\nstring message\n", domain_id=DOMAIN,
        router_port=mission.ros_port,
        type_hash=type_hash(kind), timeout=WAIT_S,
    )  # fmt: skip
    try:
        return client.call(**arguments)
    finally:
        client.close()


@pytest.mark.parametrize(
    ("name", "kind", "request_text", "arguments", "command", "accepted"),
    [
        (
            "/chaser_0/approach",
            TRIGGER,
            "uint8 structure_needs_at_least_one_member",
            {"structure_needs_at_least_one_member": 0},
            OperatorCommand(command="approach", chaser=0, operator="ros2"),
            True,
        ),
        (
            "/chaser_1/retreat",
            TRIGGER,
            "uint8 structure_needs_at_least_one_member",
            {"structure_needs_at_least_one_member": 0},
            OperatorCommand(command="retreat", chaser=1, operator="ros2"),
            False,
        ),
        (
            "/chaser_1/goto",
            GOTO,
            "float64[3] offset_m",
            {"offset_m": np.array([1.0, -2.0, 0.5])},
            OperatorCommand(command="goto", chaser=1, offset_m=(1.0, -2.0, 0.5), operator="ros2"),
            True,
        ),
        (
            "/chaser_0/isolate",
            SELECT_THRUSTER,
            "uint8 thruster",
            {"thruster": 7},
            OperatorCommand(command="isolate", chaser=0, thruster=7, operator="ros2"),
            True,
        ),
    ],
    ids=["approach", "retreat", "goto", "isolate"],
)
def test_peer_calls_services(
    mission: Mission,
    name: str,
    kind: str,
    request_text: str,
    arguments: dict[str, Any],
    command: OperatorCommand,
    accepted: bool,
) -> None:
    mission.commands.clear()
    reply = call(mission, name, kind, request_text, **arguments)
    assert (reply.success, reply.message) == (accepted, "" if accepted else "docked")
    assert mission.commands == [command]


def test_number_that_is_not_finite_is_refused(mission: Mission) -> None:
    mission.commands.clear()
    reply = call(
        mission,
        "/chaser_0/goto",
        GOTO,
        "float64[3] offset_m",
        offset_m=np.array([np.nan, 0.0, 0.0]),
    )
    assert not reply.success
    assert "offset_m holds nan" in reply.message
    assert mission.commands == []


def test_bridge_sends_nothing_else_and_reads_no_truth() -> None:
    assert not any(topic.writer == "bridge" for topic in topics.TOPICS)
    assert not any(
        topics.may_read("bridge", t)
        for t in topics.TOPICS
        if t.key.startswith(("truth/", "reference/"))
    )
    assert (Path(process.__file__).read_text().count(".publish(")) == 1  # to ROS 2


# -- in place of the controller --------------------------------------------------------------------


def wrench(frame: str = "chaser_1", force: tuple[float, float, float] = (1.0, -2.0, 3.0)) -> Any:
    command: Any = replace(BY_TYPE[topics.WRENCH.kind], chaser=1, force_N=force)
    message = conversion.wrench(command)
    message.header.frame_id = frame
    return message


def test_wrench_becomes_a_command_of_the_newest_tick() -> None:
    timing = load_scenario(ROOT / "scenarios" / "two-chaser-tracking.toml").timing
    tick: Any = replace(BY_TYPE[topics.TICK.kind], tick=9, sim_time_ns=timing.tick_time_ns(9))
    command = wrench_control.wrench_command(wrench(), 1, tick, timing, 3, "i1")
    assert command.force_N == (1.0, -2.0, 3.0)
    assert command.torque_N_m == BY_TYPE[topics.WRENCH.kind].torque_N_m  # type: ignore[attr-defined]
    assert (command.tick, command.effective_time_ns) == (9, timing.effective_ns(9))
    assert (command.chaser, command.term, command.commander, command.instance) == (
        1,
        3,
        "controller",
        "i1",
    )


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (wrench(), None),
        (wrench(""), None),
        (wrench("world"), "frame 'world', must be 'chaser_1'"),
        (wrench(force=(0.0, float("inf"), 0.0)), "force or torque is not finite"),
    ],
    ids=["own", "empty", "world", "infinite"],
)
def test_wrench_in_another_frame_or_not_finite_is_refused(message: Any, reason: str | None) -> None:
    assert wrench_control.why_invalid(message, 1) == reason


class ControlledFlight:
    """``ros2 --control`` beside a standby, and the leases of three chasers, without a network."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        scenario = load_scenario(ROOT / "scenarios" / "two-chaser-tracking.toml")
        self.timing, self.node = scenario.timing, ReplayNode("controller")
        for name in ("advertise", "subscribe", "restart_numbering"):
            monkeypatch.setattr(self.node, name, lambda *_: None, raising=False)
        monkeypatch.setattr(wrench_control, "Heartbeat", lambda *_: SilentHeartbeat())
        mission: Any = SimpleNamespace(scenario_json=flight_scenario_json(scenario))
        ros: Any = SimpleNamespace(subscribe=lambda *_: None)
        self.control = wrench_control.WrenchControl(cast(Node, self.node), ros, mission, "c", 10.0)
        self.standby = LeaseHolder("standby", "s")
        self.grantors = [LeaseGrantor(i, self.timing.rate_hz) for i in range(3)]

    def fly(self, number: int, wrenches: tuple[int, ...]) -> list[tuple[int, str]]:
        """Fly a tick with wrenches for some chasers; return to which chasers what was sent."""
        tick = Tick(
            tick=number,
            sim_time_ns=self.timing.tick_time_ns(number),
            images=False,
            chasers=(0, 1, 2),
            controllers={"controller": "c", "standby": "s"},
        )
        self.control._take(tick)
        for grantor in self.grantors:
            self._state(grantor.update(tick))
        for chaser in wrenches:
            self.control._command(chaser, wrench(""))
        self.control._complete_tick()
        sent: list[Any] = [message for _, _, message in self.node.take_published()]
        for command in sent:
            grantor = self.grantors[command.chaser]
            if grantor.refusal(command) is None and command.mode == "yield":
                grantor.give_back(command)
            elif grantor.refusal(command) is None and command.mode != "wait":
                grantor.renew(command)
                self._state(grantor.stated(tick))
        assert not (sent and sent[0].mode in ("nmpc", "none") and self.standby.claim(tick))
        return [(command.chaser, command.mode) for command in sent]

    def _state(self, lease: Any) -> None:
        self.control._take(lease)
        self.standby.add(lease)


def test_wrenches_without_a_majority_of_leases_are_refused_and_the_leases_given_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = ControlledFlight(monkeypatch)
    for grantor in flight.grantors[1:]:
        grantor.holder, grantor.instance, grantor.term, grantor.until_tick = "standby", "s", 2, 1000
    sent = [flight.fly(number, (0, 1, 2)) for number in range(1, 6)]
    assert sent == [[(0, "wait")]] * PATIENCE_TICKS + [[(0, "yield")], []]
    assert [grantor.holder for grantor in flight.grantors] == ["standby"] * 3


def test_chasers_without_a_wrench_keep_their_leases_while_one_is_valid(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = ControlledFlight(monkeypatch)
    period = flight.timing.ticks_in(0.4)
    for number in range(5 * period):
        expected = [(0, "none"), (1, "none"), (2, "none")]
        if number % period == 0:
            expected = [(1, "nmpc"), (0, "none"), (2, "none")]
        assert flight.fly(number, (1,) if number % period == 0 else ()) == expected
    for number in range(5 * period, 8 * period):
        flight.fly(number, ())
    assert [grantor.holder for grantor in flight.grantors] == ["standby"] * 3


def test_replaced_process_ends_with_status_1_without_a_farewell(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = ControlledFlight(monkeypatch)
    tick = Tick(tick=1, images=False, chasers=(0, 1, 2), controllers={"controller": "another"})
    received = iter(
        [
            ReceivedMessage(topics.TICK, None, tick, 0),
            ReceivedMessage(topics.END, None, BY_TYPE[MissionEnd], 0),
        ]
    )
    monkeypatch.setattr(flight.node, "receive", lambda _: next(received), raising=False)
    monkeypatch.setattr(SilentHeartbeat, "is_replaced", lambda _, listed: listed != "c")
    monkeypatch.setattr(SilentHeartbeat, "world_is_gone", lambda _: False, raising=False)
    assert flight.control.run(StopSignal(watch_parent=False, signals=False)) == 1


def test_lock_step_mission_is_refused(mission: Mission, capsys: pytest.CaptureFixture[str]) -> None:
    endpoint = mission.controller_link.connect[0]
    options = ProcessOptions(
        link=Link("ros", (endpoint,)), ros=RosLink(control=True), signals=False, patience_s=WAIT_S
    )
    assert process.main(options) == 2
    assert "start the world with --mode realtime" in capsys.readouterr().err
