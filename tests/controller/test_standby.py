# SPDX-License-Identifier: Apache-2.0
"""A controller in another's shadow: what it waits for, what it takes over, and that it then knows
the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.guidance.phases import Phase
from chaserdock_controller.guidance.trajectories import Glide, Move, stay
from chaserdock_controller.ingest.latency_compensation import CommandHistory
from chaserdock_controller.process import ControllerProcess
from chaserdock_controller.redundancy.checkpoint import (
    OWN_ARRAYS,
    Checkpoint,
    CheckpointError,
    ControllerCheckpoint,
)
from chaserdock_controller.redundancy.serialization import decode, encode
from chaserdock_controller.redundancy.shapes import ARRAYS
from chaserdock_controller.redundancy.standby import HotStandby
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.codec import without_wall_time
from chaserdock_protocol.messages import (
    CommandedWrench,
    ControllerState,
    Lease,
    OperatorCommand,
    Tick,
)
from chaserdock_protocol.recording.log import read_log, read_scenario
from chaserdock_protocol.replay_node import ReplayNode, SilentHeartbeat
from chaserdock_protocol.scenario import Scenario, scenario_from_json
from chaserdock_protocol.transport import Node, ReceivedMessage

LOG = Path(__file__).parents[1] / "golden" / "two-chasers.mcap"
INPUTS = (topics.TICK, topics.ODOMETRY, topics.SIGHTING)


BOTH = {"controller": "c", "standby": "s"}


def granted(tick: Tick, chaser: int, holder: str, term: int) -> ReceivedMessage:
    """A chaser's lease in a tick."""
    lease = Lease(
        tick=tick.tick,
        revision=tick.revision,
        chaser=chaser,
        holder=holder,
        instance=BOTH[holder],
        term=term,
        from_tick=0,
        until_tick=tick.tick + 1,
    )
    return ReceivedMessage(topics.LEASE, str(chaser), lease, 0)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return scenario_from_json(read_scenario(LOG)[0], "golden log")


@pytest.fixture(scope="module")
def ticks() -> dict[int, list[ReceivedMessage]]:
    """The golden flight's inputs, by tick, as a standby would get them."""
    out: dict[int, list[ReceivedMessage]] = {}
    for r in read_log(LOG):
        if r.topic in INPUTS:
            message = r.message
            if isinstance(message, Tick):
                message = msgspec.structs.replace(message, controllers=BOTH)
                for i in message.chasers:
                    out.setdefault(message.tick, []).append(granted(message, i, "controller", 1))
            out.setdefault(message.tick, []).append(ReceivedMessage(r.topic, r.place, message, 0))
    last = max(
        tick for tick, messages in out.items() if any(r.topic is topics.TICK for r in messages)
    )
    return {tick: messages for tick, messages in sorted(out.items()) if tick <= last}


def member(
    scenario: Scenario, name: str, instance: str, realtime: bool = False
) -> ControllerProcess:
    core = ControllerCore(scenario, lambda: 0.0)
    process = ControllerProcess(cast(Node, ReplayNode(name)), scenario, core, realtime)
    process.heartbeat = cast(Any, SilentHeartbeat())
    process.standby.join(instance)
    return process


def deliver(process: ControllerProcess, *messages: ReceivedMessage) -> list[tuple[Any, Any]]:
    """Deliver messages to a controller; return what it publishes, without wall times."""
    node = cast(ReplayNode, process.node)
    for message in messages:
        node.put(message)
    before = None
    while node._pending or before != (
        process.done_tick,
        len(process.standby._held),
        process.standby.leads,
    ):
        before = process.done_tick, len(process.standby._held), process.standby.leads
        process.listen()
    return [(t, m) for t, _, m in node.take_published()]


def state_messages(published: list[tuple[Any, Any]]) -> list[ReceivedMessage]:
    return [ReceivedMessage(t, None, m, 0) for t, m in published if t is topics.STATE]


def outputs(published: list[tuple[Any, Any]]) -> list[Any]:
    """Return the commands and estimates without their commander."""
    out = []
    for topic, message in published:
        if topic in (topics.WRENCH, topics.TARGET, topics.PLAN, topics.REFERENCE):
            fields = without_wall_time(message)
            out.append({k: v for k, v in fields.items() if k not in ("term", "commander")})
    return out


def reassigned(
    messages: list[ReceivedMessage], holder: str, term: int, revision: int = 1
) -> list[ReceivedMessage]:
    """Return a repeated tick, for which all chasers have granted their leases to the remaining
    controller.
    """
    tick = next(r.message for r in messages if r.topic is topics.TICK)
    tick = msgspec.structs.replace(tick, revision=revision, controllers={holder: BOTH[holder]})
    again = ReceivedMessage(topics.TICK, None, tick, 0)
    return [again, *(granted(tick, i, holder, term) for i in tick.chasers)]


def commanded_by(messages: list[ReceivedMessage], holder: str, term: int) -> list[ReceivedMessage]:
    """Return the messages of a tick in which another controller commands."""
    return [
        *reassigned(messages, holder, term, 0),
        *(r for r in messages if r.topic not in (topics.TICK, topics.LEASE)),
    ]


def test_standby_is_silent_and_then_publishes_the_same(scenario: Scenario, ticks: Any) -> None:
    """Take over before a tick was processed, and after the standby had processed it."""
    for received_state in (False, True):
        first, second = member(scenario, "controller", "c"), member(scenario, "standby", "s")
        published: list[tuple[Any, Any]] = []
        for tick in list(ticks)[:12]:
            published = deliver(first, *ticks[tick])
            assert outputs(published)
            standby_output = deliver(
                second,
                *ticks[tick],
                *(state_messages(published) if tick < 11 or received_state else []),
            )
            assert not outputs(standby_output)
        published_second = deliver(second, *reassigned(ticks[11], "standby", 2))
        assert outputs(published_second) == outputs(published)
        commands = [m for t, m in published_second if t is topics.WRENCH]
        assert {(m.term, m.commander, m.instance) for m in commands} == {(2, "standby", "s")}
        assert not outputs(deliver(first, *reassigned(ticks[11], "standby", 2)))
        for tick in list(ticks)[12:15]:
            again = commanded_by(ticks[tick], "standby", 2)
            assert not outputs(deliver(first, *again))
            assert outputs(deliver(second, *again))


def test_in_lockstep_a_standby_waits_for_state_messages_and_keeps_the_order_of_ticks(
    scenario: Scenario, ticks: Any
) -> None:
    first, second = member(scenario, "controller", "c"), member(scenario, "standby", "s")
    published = {tick: deliver(first, *ticks[tick]) for tick in range(6)}
    for tick in range(6):  # before any state message of the commander
        deliver(second, *ticks[tick])
    assert second.done_tick == -1
    for tick in range(6):
        deliver(second, *[w for w in state_messages(published[tick]) if not w.message.state])
        assert second.done_tick == tick
    before, after = (
        outputs(deliver(c, *ticks[6], *reassigned(ticks[6], c.name, 2))) for c in (first, second)
    )
    assert before == after


def test_late_standby_restores_the_state_and_publishes_the_same(
    scenario: Scenario, ticks: Any
) -> None:
    first, late = member(scenario, "controller", "c"), member(scenario, "standby", "s")
    state = None
    for tick in list(ticks)[:14]:
        if tick == 10:
            first.standby._state_sent_to = {}  # the standby has just joined
        published = deliver(first, *ticks[tick])
        if tick >= 9:
            deliver(late, *ticks[tick], *state_messages(published))
        full = [w for w in state_messages(published) if w.message.state]
        state = full[-1] if full else state
    assert state is not None
    assert late.done_tick == 13
    tick = list(ticks)[14]
    before = outputs(deliver(first, *ticks[tick]))
    deliver(late, *ticks[tick])
    assert outputs(deliver(late, *reassigned(ticks[tick], "standby", 2))) == before
    for tick in list(ticks)[15:18]:
        changed = commanded_by(ticks[tick], "standby", 2)
        assert outputs(deliver(late, *changed)) == outputs(deliver(first, *ticks[tick]))


def test_standby_that_takes_over_without_state_reports_it_and_reinitializes(
    scenario: Scenario, ticks: Any
) -> None:
    late = member(scenario, "standby", "s")
    assert not outputs(deliver(late, *ticks[9]))
    published = deliver(late, *reassigned(ticks[9], "standby", 2))
    assert any(
        t is topics.EVENT and m.what.startswith("takes over without any state")
        for t, m in published
    )
    assert [m.tick for t, m in published if t is topics.WRENCH] == [9, 9]


def test_standby_follows_the_operator_commands_of_the_commander(
    scenario: Scenario, ticks: Any
) -> None:
    first, second = member(scenario, "controller", "c"), member(scenario, "standby", "s")
    answers: list[Any] = []
    for tick in list(ticks)[:14]:
        if tick == 10:
            first.operate(
                OperatorCommand(command="goto", chaser=0, offset_m=(-1.2, 0.0, 0.0)), answers.append
            )
        published = deliver(first, *ticks[tick])
        deliver(second, *ticks[tick], *state_messages(published))
    assert [a.accepted for a in answers] == [True]
    assert second.core.guidance.chasers[0].phase == first.core.guidance.chasers[0].phase == "goto"


def held_by(messages: list[ReceivedMessage], holder: str, term: int) -> list[ReceivedMessage]:
    """Return the messages of a tick in which both controllers take part and one holds all
    leases.
    """
    tick = next(r.message for r in messages if r.topic is topics.TICK)
    leases = [granted(tick, i, holder, term) for i in tick.chasers]
    return leases + [r for r in messages if r.topic is not topics.LEASE]


def operated_by(instance: str, term: int, tick: int) -> ReceivedMessage:
    """Return the message by which a start of ``controller`` reports that it executed an operator's
    command.
    """
    command = OperatorCommand(command="goto", chaser=0, offset_m=(-1.2, 0.0, 0.0))
    state = ControllerState(
        process="controller", instance=instance, term=term, tick=tick, operated=(command,)
    )
    return ReceivedMessage(topics.STATE, None, state, 0)


def test_operator_command_of_a_deposed_controller_is_ignored(
    scenario: Scenario, ticks: Any
) -> None:
    """The commander freezes with tick 4 open, and continues with it when the standby has taken
    over.
    """
    second = member(scenario, "standby", "s", realtime=True)
    phases = second.core.guidance.chasers
    for tick in range(10):
        deliver(second, *held_by(ticks[tick], *(("controller", 1) if tick < 5 else ("standby", 2))))
        if tick == 6:
            assert second.standby.leads
            deliver(second, operated_by("c", 1, 4))
    for tick in range(10, 13):
        deliver(second, *held_by(ticks[tick], "controller", 3))
        assert phases[0].phase != "goto"
    deliver(second, operated_by("replaced", 1, 12), *held_by(ticks[13], "controller", 3))
    assert phases[0].phase != "goto"
    deliver(second, operated_by("c", 3, 13), *held_by(ticks[14], "controller", 3))
    assert phases[0].phase == "goto"


def test_standby_that_takes_over_executes_the_last_operator_command_of_the_commander(
    scenario: Scenario, ticks: Any
) -> None:
    second = member(scenario, "standby", "s", realtime=True)
    for tick in range(10):
        deliver(second, *held_by(ticks[tick], "controller", 1))
    deliver(second, operated_by("c", 1, 9))
    published = deliver(second, *held_by(ticks[10], "standby", 2))
    assert second.core.guidance.chasers[0].phase == "goto"
    assert not any(m.operated for t, m in published if t is topics.STATE)


def test_operator_request_waits_for_the_first_tick_of_a_new_commander(
    scenario: Scenario, ticks: Any
) -> None:
    second = member(scenario, "standby", "s")
    answers: list[Any] = []
    for tick in range(4):  # without state messages of the commander
        deliver(second, *ticks[tick])
    second.operate(OperatorCommand(command="hold", chaser=0), answers.append)
    deliver(second, *reassigned(ticks[3], "standby", 2))
    assert [(a.tick, a.accepted) for a in answers] == [(3, True)]


def test_operator_request_to_a_standby_is_refused(scenario: Scenario, ticks: Any) -> None:
    second = member(scenario, "standby", "s", realtime=True)
    answers: list[Any] = []
    second.operate(OperatorCommand(command="hold", chaser=0), answers.append)
    deliver(second, *ticks[0])
    assert [(a.accepted, a.reason) for a in answers] == [
        (False, "controller commands now: repeat the command")
    ]


# -- the state -------------------------------------------------------------------------------------


def memory(scenario: Scenario) -> tuple[ControllerProcess, Checkpoint]:
    one = member(scenario, "controller", "c")
    return one, one.checkpoint


def test_a_restored_checkpoint_is_bounded_and_equals_the_saved_one(
    scenario: Scenario, ticks: Any
) -> None:
    one, saved = memory(scenario)
    other, restored = memory(scenario)
    for tick in list(ticks)[:20]:
        deliver(one, *ticks[tick])
    state = saved.save()
    assert 1000 < len(state) < 200_000
    restored.restore(state)
    assert msgspec.msgpack.decode(restored.save()) == msgspec.msgpack.decode(state)
    assert isinstance(other.core.guidance.chasers[0].phase, Phase)
    one.core.guidance.chasers[0].state = other.core.guidance.chasers[1].state
    assert saved.save() != state


@pytest.mark.parametrize(
    "spoil", ["bytes", "unknown", "missing", "chasers", "type", "nan", "nan array", "shape"]
)
def test_an_invalid_checkpoint_is_refused_completely(
    scenario: Scenario, ticks: Any, spoil: str
) -> None:
    one, saved = memory(scenario)
    for tick in list(ticks)[:5]:
        deliver(one, *ticks[tick])
    state = saved.save()
    values = msgspec.msgpack.decode(state)
    array = values["composite"]["body"]["inertia_kg_m2"]
    match spoil:
        case "unknown":
            values["planning"]["Popen"] = {"args": "true"}
        case "missing":
            del values["chasers"][0]["sent"]
        case "chasers":
            values["chasers"].pop()
        case "type":
            values["chasers"][0]["machine"]["interrupted"] = "abc"
        case "nan":
            values["fleet"]["_seen_s"] = np.nan
        case "nan array":
            array[2] = np.full(9, np.nan).tobytes()
        case "shape":
            array[1] = [4, 3]
    bad = state[: len(state) // 2] if spoil == "bytes" else msgspec.msgpack.encode(values)
    with pytest.raises(CheckpointError):
        saved.restore(bad)
    assert msgspec.msgpack.decode(saved.save()) == msgspec.msgpack.decode(state)


def encoded_arrays(value: Any) -> Iterator[list[Any]]:
    """Yield the arrays in a decoded checkpoint: kind, shape, content."""
    if isinstance(value, list) and [type(item) for item in value] == [str, list, bytes]:
        yield value
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from encoded_arrays(item)


_ONE = {"f": np.ones(1).tobytes(), "i": np.ones(1, dtype=int).tobytes(), "b": b"\1"}


@pytest.fixture(scope="module")
def saved_state(scenario: Scenario, ticks: Any) -> bytes:
    """The checkpoint after twelve ticks."""
    one, saved = memory(scenario)
    for tick in list(ticks)[:12]:
        deliver(one, *ticks[tick])
    return saved.save()


@pytest.mark.parametrize("shape", ["empty", "one", "more", "flat", "large"])
def test_a_checkpoint_with_an_array_of_a_wrong_shape_is_refused_completely(
    scenario: Scenario, saved_state: bytes, shape: str
) -> None:
    """Each array is replaced in turn. Only an array without elements may be empty."""
    saved, state = memory(scenario)[1], saved_state
    saved.restore(state)
    values = msgspec.msgpack.decode(state)
    accepted = 0
    for array in encoded_arrays(values):
        before = list(array)
        dimensions = len(array[1])
        match shape:
            case "empty":
                array[1:] = [0] * dimensions, b""
            case "one":
                array[1:] = [1] * dimensions, _ONE[array[0]]
            case "more":
                array[1:] = (
                    [array[1][0] + 1, *array[1][1:]],
                    array[2] + bytes(len(array[2]) // max(1, array[1][0])),
                )
            case "flat":
                array[1] = [1, *array[1]]
            case _ if array[0] == "f":
                array[2] = np.full(len(array[2]) // 8, 1e200).tobytes()
        if array != before:
            try:
                saved.restore(msgspec.msgpack.encode(values))
                accepted += 1
            except CheckpointError:
                pass
        array[:] = before
    assert accepted == 0
    assert msgspec.msgpack.decode(saved.save()) == msgspec.msgpack.decode(state)


def array_fields(kind: Any, owner: tuple[type, str], found: set[tuple[type, str]]) -> None:
    """Collect the fields with arrays in a type and all types that it contains."""
    if get_origin(kind) is np.ndarray:
        found.add(owner)
    for inner in get_args(kind):
        array_fields(inner, owner, found)
    names = getattr(kind, "__struct_fields__", None) or getattr(kind, "__dataclass_fields__", ())
    if isinstance(kind, type) and (kind, "") not in found:
        found.add((kind, ""))
        hints = get_type_hints(kind)
        for name in names or getattr(kind, "_fields", ()):
            array_fields(hints[name], (kind, name), found)


def test_every_array_that_a_checkpoint_may_contain_has_a_declared_shape() -> None:
    found: set[tuple[type, str]] = set()
    array_fields(ControllerCheckpoint, (ControllerCheckpoint, ""), found)
    declared = {(k, name) for k, each in {**ARRAYS, **OWN_ARRAYS}.items() for name in each}
    assert {(k, name) for k, name in found if name} == declared


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("chasers", 0, "machine", "state", "move", "parts"), []),
        (("estimator", "_buffer", "records", 0, "chasers"), []),
        (("estimator", "_buffer", "records", 0, "state", "hypotheses"), []),
        (("estimator", "_buffer", "records", 0, "chasers", 0, "chaser"), 7),
        (("estimator", "target", "body_covariance"), [[1.0]]),
    ],
)
def test_a_checkpoint_with_a_list_or_number_that_does_not_fit_is_refused(
    scenario: Scenario, saved_state: bytes, path: tuple[Any, ...], value: Any
) -> None:
    saved = memory(scenario)[1]
    values = part = msgspec.msgpack.decode(saved_state)
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    with pytest.raises(CheckpointError, match=f"{path[-1]}|chaser 7"):
        saved.restore(msgspec.msgpack.encode(values))


class Sample(msgspec.Struct, forbid_unknown_fields=True):
    """A value of every kind that a checkpoint has."""

    array: Array
    phase: Phase
    by_pair: dict[tuple[int, int], OperatorCommand]
    motions: list[Move | Glide]
    numbers: frozenset[int] = frozenset()


@pytest.mark.parametrize(
    "array", [np.arange(6.0).reshape(2, 3), np.zeros((0, 3)), np.array([np.pi])]
)
def test_decoding_returns_the_encoded_values(array: Array) -> None:
    glide = Glide(1.0, np.zeros(3), np.array([1.0, 0.0, 0.0]), (0.1,), (2.0,), (1.0, 1.0))
    command = OperatorCommand(command="hold", chaser=1)
    sample = Sample(
        array, Phase.FINAL, {(1, 2): command}, [stay([1.0, 2.0, 3.0], 4.0), glide], frozenset({3})
    )
    again = decode(encode(sample), Sample)
    assert again.array.dtype == array.dtype
    np.testing.assert_array_equal(again.array, array)
    assert again.phase is Phase.FINAL
    assert (again.by_pair, again.numbers) == (sample.by_pair, sample.numbers)
    np.testing.assert_array_equal(again.motions[0].goal_m, [1.0, 2.0, 3.0])
    assert isinstance(again.motions[1], Glide)


@pytest.mark.parametrize(
    "value",
    [object(), Path("x"), {1: object()}, np.array(["text"])],
    ids=["object", "path", "nested", "array"],
)
def test_only_data_can_be_encoded(value: Any) -> None:
    with pytest.raises(TypeError):
        encode(value)


# -- whom it listens to ----------------------------------------------------------------------------


def take(
    standby: HotStandby, number: int, holder: str, revision: int = 0, instance: str = ""
) -> None:
    """Let a controller know a tick and that the only chaser has granted its lease."""
    controllers = BOTH | ({holder: instance} if instance else {})
    tick = Tick(tick=number, revision=revision, images=False, chasers=(0,), controllers=controllers)
    lease = granted(tick, 0, holder, 1 if holder == "controller" else 2).message
    standby.update(tick)
    standby.leases.add(msgspec.structs.replace(lease, instance=controllers[holder]))
    standby.decide()


def test_the_command_is_of_the_very_start_that_holds_the_lease() -> None:
    standby = HotStandby("standby")
    standby.join("s2")
    take(standby, 0, "standby", instance="s1")
    assert not standby.leads
    take(standby, 0, "standby", 1, instance="s2")
    assert standby.leads
    assert standby.leads_at(0)
    take(standby, 0, "controller")  # late: it is of before
    assert standby.leads
    take(standby, 1, "controller")
    assert not standby.leads_at(0)


def test_missed_ticks_make_a_follower_ask_for_the_state() -> None:
    for realtime, missed in ((False, 1), (True, 11)):
        standby = HotStandby("standby", realtime=realtime)
        standby.join("s")
        for number in range(3):
            take(standby, number, "controller")
        assert not standby.needs_state(2, 2)
        take(standby, 3 + missed, "controller")
        assert standby.needs_state(3 + missed, 2)
        standby.state_restored(3 + missed)
        assert not standby.needs_state(4 + missed, 3 + missed)


def test_state_messages_cover_one_tick_in_lockstep_and_all_in_real_time() -> None:
    hold = OperatorCommand(command="hold", chaser=0)
    for realtime, expected in ((False, ()), (True, (hold,))):
        standby = HotStandby("standby", realtime=realtime)
        standby.leader_commands = {3: (hold,), 4: ()}
        assert standby.take_leader_commands(4) == expected
        assert not standby.take_leader_commands(5)


def test_a_follower_takes_the_commands_of_the_commander_for_what_acts_on_the_chasers() -> None:
    state = ControllerState(
        tick=7,
        process="controller",
        instance="c",
        term=3,
        commanded=(
            CommandedWrench(chaser=1, force_N=(0.1, -0.2, 0.3), torque_N_m=(0.01, 0.02, -0.03)),
        ),
    )
    standby = HotStandby("standby", realtime=True)
    standby.add_leader_commands(state)
    assert standby.take_commanded(6) == {}
    assert standby.take_commanded(8) == {7: state.commanded}
    assert standby.take_commanded(8) == {}
    history = CommandHistory()
    for time_ns, force in ((100, 1.0), (200, 2.0), (300, 3.0)):
        history.add(time_ns, np.full(6, force))
    history.replace(200, np.full(6, -5.0))
    history.replace(250, np.full(6, 4.0))
    acting = [(begin, wrench[0]) for begin, _, wrench in history.segments(100, 400)]
    assert acting == [(100, 1.0), (200, -5.0), (250, 4.0), (300, 3.0)]


def test_state_message_is_encoded_like_any_other() -> None:
    assert topics.may_read("controller", topics.STATE)
    assert not topics.may_read("chaser", topics.STATE)
    assert topics.STATE.kind is ControllerState
