# SPDX-License-Identifier: Apache-2.0
"""A perception that fails costs a sighting, not its chaser."""

from __future__ import annotations

import threading
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from chaser_cases import deliver, odometry, tick_of, wrench
from chaserdock_agents.chaser import process
from chaserdock_agents.chaser.core import ChaserCore
from chaserdock_agents.chaser.perception import PerceptionResult, TargetPose, make_perception
from chaserdock_agents.chaser.sighting import apply_geometry
from chaserdock_agents.chaser.vision import Vision
from chaserdock_protocol import codec, plugins, topics
from chaserdock_protocol.failure_watch import FAILURES_TO_ERROR
from chaserdock_protocol.messages import Event, GeometryEstimate, Image, Sighting
from chaserdock_protocol.plugins import PluginError
from chaserdock_protocol.replay_node import ReplayNode, SilentHeartbeat
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.transport import ReceivedMessage
from chaserdock_protocol.transport.network import Machine

SCENARIO = Path(__file__).resolve().parents[2] / "scenarios" / "single.toml"


def result(position: Any = (0.0, 0.0, 2.0), covariance: Any = None, **changes: Any) -> Any:
    pose = TargetPose(
        np.array(position, dtype=float),
        changes.get("q", np.array([1.0, 0.0, 0.0, 0.0])),
        1e-4 * np.eye(6) if covariance is None else covariance,
        0.5,
    )
    return PerceptionResult(
        (pose,) * changes.get("times", 1), np.array([1]), np.zeros((1, 4, 2)), ()
    )


def raises(error: BaseException) -> Any:
    raise error


FAILURES: dict[str, Any] = {
    "None": lambda: None,
    "a dictionary": dict,
    "an error": lambda: raises(KeyError("boom")),
    "a ValueError": lambda: raises(ValueError("two\nlines")),
    "an error of OpenCV": lambda: raises(np.linalg.LinAlgError("singular")),
    "a long text": lambda: raises(RuntimeError("x" * 100_000)),
    "NaN": lambda: result((np.nan, 0.0, 2.0)),
    "infinity": lambda: result((np.inf, 0.0, 2.0)),
    "a negative variance": lambda: result(covariance=-np.eye(6)),
    "a covariance of another size": lambda: result(covariance=np.eye(3)),
    "a covariance that is None": lambda: PerceptionResult(
        (TargetPose(np.zeros(3), np.zeros(4), None, 0.5),),  # type: ignore[arg-type]
        np.array([1]),
        np.zeros((1, 4, 2)),
        (),
    ),
    "a quaternion of length 2": lambda: result(q=np.array([2.0, 0.0, 0.0, 0.0])),
    "too many solutions": lambda: result(times=9),
}


class Unreliable:
    """A perception whose results are given by ``outcome``, from image to image."""

    def __init__(self, outcome: Any) -> None:
        self.outcome = outcome

    def estimate(self, image: Any, predicted: Any = None) -> Any:
        return self.outcome()


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(SCENARIO, ("perception.name=statistical",))


def image(tick: int) -> Image:
    return Image(
        tick=tick,
        sim_time_ns=tick * 10**8,
        chaser=0,
        width_px=4,
        height_px=2,
        encoding="mono8",
        data=bytes(8),
    )


@pytest.mark.parametrize("kind", FAILURES)
def test_chaser_goes_on_without_a_sighting_when_its_perception_fails(
    scenario: Scenario, kind: str
) -> None:
    perception = Unreliable(FAILURES[kind])
    chaser = ChaserCore(scenario, 0, vision=Vision(perception))
    published: list[tuple[Any, Any]] = []
    rejected = []
    for tick in range(FAILURES_TO_ERROR + 2):
        out = chaser.step(ReceivedMessage(topics.IMAGE, "0", image(tick), 0))
        published += [(topic, message) for topic, _, message in out.messages]
        rejected.append(out.rejected)
    sightings = [m for t, m in published if t is topics.SIGHTING]
    assert [m.status for m in sightings] == ["nothing"] * (FAILURES_TO_ERROR + 2)
    assert all(m.detail and not m.solutions for m in sightings)
    for message in [m for _, m in published]:
        codec.decode(type(message), codec.encode(message))
    assert set(rejected) == {"image:perception failed"}
    events = [m for _, m in published if isinstance(m, Event)]
    assert [(m.level, m.what) for m in events] == [
        ("warning", "perception failed"),
        ("error", "perception failed"),
    ]
    assert all("'statistical'" in m.detail and "\n" not in m.detail for m in events)

    perception.outcome = result
    assert [m.status for _, m in deliver(chaser, topics.IMAGE, image(99))] == ["seen"]
    perception.outcome = FAILURES[kind]
    levels = [m.level for _, m in deliver(chaser, topics.IMAGE, image(100)) if isinstance(m, Event)]
    assert levels == ["warning"]


def test_late_perception_is_named_and_counted(scenario: Scenario) -> None:
    chaser = ChaserCore(scenario, 0, realtime=True, vision=Vision(Unreliable(result)))
    late = [chaser.note_duration(image(tick), 10.0) for tick in range(FAILURES_TO_ERROR)]
    events = [m for out in late for _, _, m in out.messages if isinstance(m, Event)]
    assert [(m.level, m.what) for m in events] == [
        ("warning", "perception late"),
        ("error", "perception late"),
    ]
    assert "10.00 s for an image" in events[0].detail
    assert {out.rejected for out in late} == {"image:perception late"}
    assert not chaser.note_duration(image(99), 0.01).messages


def test_correction_that_a_perception_cannot_use_is_refused() -> None:
    class Correctable(Unreliable):
        def correct_geometry(self, mean: Any, covariance: Any) -> None:
            raise KeyError("scale")

    estimate = GeometryEstimate(
        names=("scale",), values=(0.0,), sigmas=(1.0,), covariance=(1.0,), views=1, coverage=0.1
    )
    assert apply_geometry(Correctable(result), estimate) == "KeyError: 'scale'"


def fails(camera: Any, target: Any) -> None:
    raise RuntimeError("no weights")


@pytest.mark.parametrize(
    ("factory", "text"),
    [
        ("fails", "perception 'own' does not start: RuntimeError: no weights"),
        ("returns_nothing", "perception 'own' has no member estimate"),
    ],
)
def test_perception_that_does_not_start_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, factory: str, text: str
) -> None:
    group = "chaserdock.perceptions"
    entry = EntryPoint("own", f"{__name__}:{factory}", group)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])
    monkeypatch.setattr(EntryPoint, "load", lambda _: globals()[factory])
    with pytest.raises(PluginError, match=text):
        make_perception(load_scenario(SCENARIO, ("perception.name=own",)))


def returns_nothing(camera: Any, target: Any) -> None:
    return None


def test_sighting_of_a_working_perception_is_unchanged(scenario: Scenario) -> None:
    sighting = Vision(Unreliable(result)).look(image(0))
    assert isinstance(sighting, Sighting)
    assert (sighting.status, sighting.detail, sighting.solutions[0].position_m) == (
        "seen",
        "",
        (0.0, 0.0, 2.0),
    )


class Waiting:
    """A perception that begins an image when it gets one and ends it when it may."""

    def __init__(self) -> None:
        self.begun, self.may_end = threading.Event(), threading.Event()
        self.corrected: list[bool] = []

    def estimate(self, image: Any, predicted: Any = None) -> Any:
        self.begun.set()
        assert self.may_end.wait(60)
        return result()

    def correct_geometry(self, mean: Any, covariance: Any) -> None:
        self.corrected.append(self.may_end.is_set())
        if mean[0] < 0.0:
            raise ValueError("too small")


GEOMETRY = GeometryEstimate(
    names=("scale",), values=(0.0,), sigmas=(1.0,), covariance=(1.0,), views=1, coverage=0.1
)


class QuietNode(ReplayNode):
    """A node whose process needs no network."""

    def advertise(self, *_: Any) -> None: ...
    def subscribe(self, *_: Any, **__: Any) -> None: ...
    def on_close(self, stop: Any) -> None:
        self.stop = stop


@pytest.fixture
def realtime(scenario: Scenario, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, QuietNode, Waiting]:
    """A chaser's process in real time, its node and its perception."""
    monkeypatch.setattr(process, "Heartbeat", lambda *_: SilentHeartbeat())
    node, perception = QuietNode("chaser/0"), Waiting()
    core = ChaserCore(scenario, 0, realtime=True, vision=Vision(perception))
    return process.ChaserProcess(cast(Any, node), core), node, perception


def receive(chaser: Any, node: QuietNode, topic: Any, message: Any) -> None:
    place = str(chaser.core.number) if "{" in topic.key else None
    node.put(ReceivedMessage(topic, place, message, 0, node.host.now_s()))
    chaser.listen()


def test_commands_do_not_wait_for_a_slow_image_in_real_time(
    scenario: Scenario, realtime: tuple[Any, QuietNode, Waiting]
) -> None:
    chaser, node, perception = realtime
    receive(chaser, node, topics.TICK, tick_of(scenario, 0, (0,)))
    receive(chaser, node, topics.ODOMETRY, odometry(scenario, 0, 0))
    receive(chaser, node, topics.IMAGE, image(0))
    assert perception.begun.wait(60)
    for tick in (1, 2):  # of these images the newer one is looked at
        receive(chaser, node, topics.IMAGE, image(tick))
    node.take_published()
    receive(chaser, node, topics.WRENCH, wrench(scenario, 0))
    published = {t for t, _, _ in node.take_published()}
    assert topics.ACTUATORS in published
    assert topics.SIGHTING not in published

    perception.begun.clear()
    perception.may_end.set()
    assert perception.begun.wait(60)
    chaser._end_looking()
    sightings = [m for t, _, m in node.take_published() if t is topics.SIGHTING]
    assert [m.tick for m in sightings] == [0, 2]


def test_geometry_that_comes_during_an_image_is_used_after_it(
    scenario: Scenario, realtime: tuple[Any, QuietNode, Waiting]
) -> None:
    chaser, node, perception = realtime
    receive(chaser, node, topics.TICK, tick_of(scenario, 0, (0,)))
    receive(chaser, node, topics.ODOMETRY, odometry(scenario, 0, 0))
    receive(chaser, node, topics.IMAGE, image(0))
    assert perception.begun.wait(60)
    wrong = msgspec.structs.replace(GEOMETRY, values=(-1.0,))
    receive(chaser, node, topics.WRENCH, wrench(scenario, 0, geometry=wrong))
    assert perception.corrected == []
    perception.begun.clear()
    receive(chaser, node, topics.IMAGE, image(1))
    perception.may_end.set()
    assert perception.begun.wait(60)
    chaser._end_looking()
    assert perception.corrected == [True]
    events = [m for _, _, m in node.take_published() if isinstance(m, Event)]
    assert [(m.what, m.detail) for m in events] == [("geometry refused", "too small")]


def test_what_a_worker_raises_the_next_item_raises() -> None:
    called = threading.Event()

    def call(item: str) -> None:
        called.set()
        raise ValueError(item)

    put, end = Machine().worker(call)
    put("first")
    assert called.wait(60)
    end()
    with pytest.raises(ValueError, match="first"):
        put("second")
