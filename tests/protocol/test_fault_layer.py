# SPDX-License-Identifier: Apache-2.0
"""What the fault layer does to messages: pure, by simulated time, drawn from the seed."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.clock import Timing
from chaserdock_protocol import codec, topics
from chaserdock_protocol.extrapolation import extrapolate
from chaserdock_protocol.fault_injection import FaultLayer, LostMessage, sender_of
from chaserdock_protocol.messages import Image, Odometry, Sighting, WrenchCommand
from chaserdock_protocol.scenario.faults import Fault
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport.network import Host, Machine
from message_samples import BY_TYPE

TIMING = Timing(physics_hz=100, rate_hz=10, image_hz=10, latency_steps=2)


def fault(**values: Any) -> Fault:
    return Fault.model_validate({"at_s": 1.0, **values})


def layer(
    name: str, *faults: Fault, lockstep: bool = True, seed: int = 0, host: Host | None = None
) -> FaultLayer:
    return FaultLayer(faults, name, TIMING, seed, lockstep, host or Machine())


class RecordingHost(Machine):
    """Notes what happens to its process."""

    def __init__(self) -> None:
        self.ends: list[str | float] = []

    def kill(self) -> None:
        self.ends.append("killed")

    def freeze(self, duration_s: float) -> None:
        self.ends.append(duration_s)


def message(kind: type[msgspec.Struct], tick: int, chaser: int = 0) -> Any:
    """The sample of a kind as one of a tick."""
    return msgspec.structs.replace(
        BY_TYPE[kind], tick=tick, sim_time_ns=TIMING.tick_time_ns(tick), chaser=chaser, seq=tick
    )


def heard(
    on: FaultLayer, topic: Topic, kind: type[msgspec.Struct], ticks: range, chaser: int = 0
) -> list[Any]:
    """Return the ticks of the messages that arrive, one sent a tick; a LostMessage as the negative
    tick.
    """
    out = []
    for tick in ticks:
        sent = message(kind, tick, chaser)
        for came in on.incoming(topic, str(chaser), sent, codec.encode(sent)):
            out.append(-came.tick if isinstance(came, LostMessage) else came.tick)
    return out


def test_drop_lasts_as_long_as_it_should() -> None:
    on = layer("chaser/0", fault(kind="drop", process="chaser/0", topic="wrench", duration_s=0.3))
    assert heard(on, topics.WRENCH, WrenchCommand, range(7, 16)) == [
        7,
        8,
        9,
        -10,
        -11,
        -12,
        13,
        14,
        15,
    ]
    assert on.count == {"drop": 3}


def test_in_real_time_nothing_stands_in_for_what_is_lost() -> None:
    drop = fault(kind="drop", process="chaser/0", topic="wrench", duration_s=0.3)
    on = layer("chaser/0", drop, lockstep=False)
    assert heard(on, topics.WRENCH, WrenchCommand, range(8, 15)) == [8, 9, 13, 14]


def test_other_topics_and_processes_are_left_alone() -> None:
    drop = fault(
        kind="drop", process="controller", topic="sighting", peer="chaser/1", duration_s=1.0
    )
    ticks = range(9, 13)
    assert heard(layer("controller", drop), topics.SIGHTING, Sighting, ticks, 1) == [
        9,
        -10,
        -11,
        -12,
    ]
    assert heard(layer("controller", drop), topics.SIGHTING, Sighting, ticks, 2) == list(ticks)
    assert heard(layer("controller", drop), topics.ODOMETRY, Odometry, ticks, 1) == list(ticks)
    assert heard(layer("chaser/1", drop), topics.WRENCH, WrenchCommand, ticks, 1) == list(ticks)


def test_delay_keeps_the_order_of_a_key() -> None:
    on = layer(
        "chaser/0",
        fault(kind="delay", process="chaser/0", topic="wrench", duration_s=0.3, delay_s=0.2),
    )
    assert heard(on, topics.WRENCH, WrenchCommand, range(9, 16)) == [
        9,
        -10,
        -11,
        10,
        -12,
        11,
        13,
        12,
        14,
        15,
    ]


def test_reorder_lets_one_overtake() -> None:
    on = layer(
        "controller", fault(kind="reorder", process="controller", topic="sighting", duration_s=0.1)
    )
    assert heard(on, topics.SIGHTING, Sighting, range(9, 13)) == [9, -10, 11, 10, 12]


def test_reorder_of_all_messages_swaps_pairs() -> None:
    """Each held until its successor arrives, which is held as well, none would arrive before the
    end of the fault.
    """
    on = layer(
        "controller", fault(kind="reorder", process="controller", topic="sighting", duration_s=0.5)
    )
    assert heard(on, topics.SIGHTING, Sighting, range(9, 15)) == [9, -10, 11, 10, -12, 13, 12, -14]


def test_duplicate() -> None:
    on = layer(
        "chaser/0", fault(kind="duplicate", process="chaser/0", topic="image", duration_s=0.2)
    )
    assert heard(on, topics.IMAGE, Image, range(9, 13)) == [9, 10, 10, 11, 11, 12]


def test_share_is_drawn_from_the_seed_and_the_tick_alone() -> None:
    drop = fault(kind="drop", process="chaser/0", topic="wrench", duration_s=100.0, share=0.3)
    ticks = range(10, 1010)
    one = heard(layer("chaser/0", drop), topics.WRENCH, WrenchCommand, ticks)
    assert one == heard(layer("chaser/0", drop), topics.WRENCH, WrenchCommand, ticks)
    assert one != heard(layer("chaser/0", drop, seed=1), topics.WRENCH, WrenchCommand, ticks)
    assert 240 < sum(tick < 0 for tick in one) < 360
    # Whatever came before: the same ticks are lost.
    assert one[500:] == heard(
        layer("chaser/0", drop), topics.WRENCH, WrenchCommand, range(510, 1010)
    )


def test_corrupt_gives_nothing_or_a_sound_message() -> None:
    on = layer(
        "chaser/0", fault(kind="corrupt", process="chaser/0", topic="wrench", duration_s=50.0)
    )
    lost = changed = 0
    for tick in range(10, 500):
        sent = message(WrenchCommand, tick)
        (came,) = on.incoming(topics.WRENCH, "0", sent, codec.encode(sent))
        if isinstance(came, LostMessage):
            lost += 1
        else:
            codec.check_numbers(came)
            assert (came.tick, came.chaser) == (tick, 0)
            changed += came != sent
    assert lost > 300
    assert changed > 0


def test_message_of_a_damaged_sender_is_lost_in_lockstep_only() -> None:
    """In real time the reader must refuse it; in lock-step the reader would wait for the true
    sender's.
    """
    corrupt = fault(kind="corrupt", process="chaser/0", topic="wrench", duration_s=500.0)
    senders = {}
    for lockstep in (True, False):
        on = layer("chaser/0", corrupt, lockstep=lockstep)
        senders[lockstep] = set()
        for tick in range(10, 2000):
            sent = msgspec.structs.replace(
                message(WrenchCommand, tick), commander="controller", instance="c"
            )
            for came in on.incoming(topics.WRENCH, "0", sent, codec.encode(sent)):
                if not isinstance(came, LostMessage):
                    senders[lockstep].add((came.commander, came.instance))
    assert senders[True] == {("controller", "c")}
    assert len(senders[False]) > 1


@pytest.mark.parametrize(
    ("receiver", "topic", "kind", "chaser", "hit"),
    [
        ("chaser/0", topics.WRENCH, WrenchCommand, 0, True),
        ("controller", topics.SIGHTING, Sighting, 0, True),
        ("controller", topics.ODOMETRY, Odometry, 0, True),  # the chaser's telemetry
        ("controller", topics.SIGHTING, Sighting, 1, False),
        ("chaser/1", topics.WRENCH, WrenchCommand, 1, False),
        ("chaser/0", topics.ODOMETRY, Odometry, 0, False),  # its own sensor, from the world
        ("chaser/0", topics.IMAGE, Image, 0, False),
    ],
)
def test_a_link_is_cut_at_both_ends(
    receiver: str, topic: Topic, kind: type[msgspec.Struct], chaser: int, hit: bool
) -> None:
    on = layer(receiver, fault(kind="cut", process="chaser/0", peer="controller", duration_s=0.1))
    assert heard(on, topic, kind, range(10, 11), chaser) == ([-10] if hit else [10])


def test_cut_off_from_everybody() -> None:
    cut = fault(kind="cut", process="chaser/0", duration_s=0.1)
    assert heard(layer("chaser/0", cut), topics.IMAGE, Image, range(10, 11)) == [-10]
    assert heard(layer("chaser/1", cut), topics.IMAGE, Image, range(10, 11), 1) == [10]


def test_messages_of_the_test_bed_are_never_faulty() -> None:
    on = layer("chaser/0", fault(kind="cut", process="chaser/0", duration_s=10.0))
    for topic, sample in ((topics.TICK, "Tick"), (topics.END, "MissionEnd")):
        sent = msgspec.structs.replace(
            next(s for k, s in BY_TYPE.items() if k.__name__ == sample), tick=12
        )
        assert on.incoming(topic, None, sent, codec.encode(sent)) == [sent]


def test_camera_off() -> None:
    on = layer("chaser/0", fault(kind="camera_off", process="chaser/0", duration_s=0.2))
    assert heard(on, topics.IMAGE, Image, range(9, 13)) == [9, -10, -11, 12]
    assert heard(on, topics.ODOMETRY, Odometry, range(9, 13)) == [9, 10, 11, 12]


# -- what a process says ---------------------------------------------------------------------------


def published(on: FaultLayer, topic: Topic, sent: Any) -> list[Any]:
    return on.outgoing(topic, sent.chaser, sent)


def test_lying_sensor() -> None:
    on = layer(
        "chaser/0",
        fault(
            kind="lying_sensor",
            process="chaser/0",
            duration_s=1.0,
            offset_m=[0.1, 0.0, 0.0],
            rotation_deg=[0, 0, 90],
        ),
    )
    sent = message(Sighting, 12)
    (lie,) = published(on, topics.SIGHTING, sent)
    for changed, true in zip(lie.solutions, sent.solutions, strict=True):
        assert np.allclose(np.subtract(changed.position_m, true.position_m), [0.1, 0.0, 0.0])
        assert math.isclose(
            float(rotations.angle_between(changed.q_wxyz, true.q_wxyz)), math.pi / 2, abs_tol=1e-9
        )
    codec.check_numbers(lie)
    assert published(on, topics.SIGHTING, message(Sighting, 20)) == [message(Sighting, 20)]
    assert published(on, topics.SIGHTING, message(Sighting, 9)) == [message(Sighting, 9)]


def test_odometry_lie_is_the_worlds_to_tell() -> None:
    lie = fault(kind="odometry_lie", process="chaser/1", duration_s=1.0, offset_m=[0.0, 0.0, 0.5])
    sent = message(Odometry, 12, 1)
    (changed,) = published(layer("world", lie), topics.ODOMETRY, sent)
    assert np.allclose(np.subtract(changed.position_m, sent.position_m), [0.0, 0.0, 0.5])
    assert published(layer("world", lie), topics.ODOMETRY, message(Odometry, 12, 0)) == [
        message(Odometry, 12, 0)
    ]


def test_clock_jump_moves_stamps_and_not_ticks() -> None:
    on = layer(
        "controller", fault(kind="clock_jump", process="controller", duration_s=1.0, offset_s=5.0)
    )
    sent = message(WrenchCommand, 12)
    (changed,) = published(on, topics.WRENCH, sent)
    assert changed.tick == 12
    assert (
        changed.effective_time_ns - sent.effective_time_ns
        == changed.expires_ns - sent.expires_ns
        == 5_000_000_000
    )
    back = layer(
        "controller", fault(kind="clock_jump", process="controller", duration_s=1.0, offset_s=-5.0)
    )
    assert published(back, topics.WRENCH, sent)[0].sim_time_ns == 0


def test_flood() -> None:
    on = layer(
        "chaser/0",
        fault(kind="flood", process="chaser/0", topic="sighting", duration_s=1.0, copies=50),
    )
    assert published(on, topics.SIGHTING, message(Sighting, 12)) == [message(Sighting, 12)] * 51


# -- what happens to the process itself ------------------------------------------------------------


def test_a_process_dies_once_before_anything_of_its_tick() -> None:
    host = RecordingHost()
    on = layer("controller", fault(kind="kill", process="controller"), host=host)
    for tick in range(8, 14):
        sent = message(Odometry, tick)
        on.incoming(topics.ODOMETRY, "0", sent, codec.encode(sent))
        assert host.ends == (["killed"] if tick >= 10 else [])


def test_restarted_process_ignores_a_past_kill() -> None:
    host = RecordingHost()
    on = layer("controller", fault(kind="kill", process="controller"), host=host)
    for tick in (10, 11, 12):
        on.apply_process_faults(tick)
    assert host.ends == []


def test_freeze_stops_for_so_long() -> None:
    host = RecordingHost()
    freezing = fault(kind="freeze", process="recorder", duration_s=1.5)
    on = layer("recorder", freezing, host=host)
    for tick in range(5, 30):
        on.apply_process_faults(tick)
    assert host.ends == [1.5]
    others = layer("controller", freezing, host=host)
    for tick in range(5, 30):
        others.apply_process_faults(tick)
    assert host.ends == [1.5]


def test_begin_and_end_are_reported() -> None:
    on = layer(
        "world", fault(kind="drop", process="chaser/0", topic="wrench", duration_s=0.3, share=0.5)
    )
    changed = {tick: on.transitions_at(tick) for tick in range(20) if on.transitions_at(tick)}
    assert changed == {
        10: [("fault begins", "drop chaser/0, duration_s 0.3, topic wrench, share 0.5")],
        13: [("fault ends", "drop chaser/0, duration_s 0.3, topic wrench, share 0.5")],
    }


def test_senders() -> None:
    assert sender_of(topics.ODOMETRY, "2", "controller") == "chaser/2"
    assert sender_of(topics.ODOMETRY, "2", "chaser/2") == "world"
    assert sender_of(topics.ACTUATORS, "1", "world") == "chaser/1"
    assert sender_of(topics.WRENCH, "1", "chaser/1") == "controller"


def test_extrapolation_matches_the_closed_form() -> None:
    """Against the closed form: straight on, and turned about the body's own axis."""
    still = Odometry(
        tick=3,
        sim_time_ns=1_000_000_000,
        chaser=1,
        position_m=(1.0, 2.0, 3.0),
        velocity_m_s=(0.5, 0.0, -1.0),
        q_wxyz=(1.0, 0.0, 0.0, 0.0),
        omega_rad_s=(0.0, 0.0, math.pi / 2),
    )
    later = extrapolate(still, 5, 2_000_000_000)
    assert (later.tick, later.sim_time_ns, later.chaser) == (5, 2_000_000_000, 1)
    assert later.position_m == (1.5, 2.0, 2.0)
    assert np.allclose(later.q_wxyz, [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])
    assert later.velocity_m_s == still.velocity_m_s
