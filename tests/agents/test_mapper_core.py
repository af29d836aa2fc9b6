# SPDX-License-Identifier: Apache-2.0
"""The mapper without I/O: which images a map is made of, when, and in which frame."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from chaserdock_agents.mapper.core import HELP, MapperCore, TrackCollector, pose_at
from chaserdock_agents.mapper.frame import MapFrame
from chaserdock_agents.mapper.mapper import MapperTuning, TargetMap
from chaserdock_agents.mapper.ports import PortChooser, PortDecision
from chaserdock_agents.mapper.types import ConstantRates, ImageTracks
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol import codec, topics
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import (
    AGE_STEP_S,
    MAX_TRACKS,
    PX_STEP,
    Event,
    FeatureTracks,
    LandmarkMap,
    Message,
    PortRequest,
    Tick,
)
from chaserdock_protocol.scenario import FlightScenario, flight_scenario, parse_scenario
from unknown_cases import TRUE, UNKNOWN, Circle, PointTarget, circle_points, ellipse_row

CASE: dict[str, Any] = UNKNOWN | {"navigation": {"grade": "lab"}}


def scenario(**changes: Any) -> FlightScenario:
    return flight_scenario(parse_scenario(CASE | changes, "unknown"))


def tick_of(number: int, chasers: tuple[int, ...] = (0, 1), revision: int = 0) -> Tick:
    return Tick(
        tick=number,
        sim_time_ns=round(number / 15 * 1e9),
        revision=revision,
        images=number % 3 == 0,
        chasers=chasers,
    )


def tracks_of(tick: int, chaser: int, ids: tuple[int, ...] = ()) -> FeatureTracks:
    return FeatureTracks(
        tick=tick,
        sim_time_ns=round(tick / 15 * 1e9),
        chaser=chaser,
        status="seen",
        position_m=(0.0, 0.0, 0.0),
        q_wxyz=(1.0, 0.0, 0.0, 0.0),
        ids=ids,
        places=(0,) * (2 * len(ids)),
        ages=(0,) * len(ids),
    )


def ready(messages: list[Message]) -> list[tuple[int, int]]:
    collector = TrackCollector(scenario(), realtime=False)
    for message in messages:
        if isinstance(message, Tick):
            collector.add_tick(message)
        else:
            assert isinstance(message, FeatureTracks)
            collector.add(message)
    return [(t.tick, t.chaser) for t in collector.ready]


def test_the_order_of_arrival_does_not_matter() -> None:
    messages: list[Message] = [tick_of(3), tracks_of(3, 0), tracks_of(3, 1)]
    assert {tuple(ready([tick_of(0), *order])) for order in itertools.permutations(messages)} == {
        ()
    }
    first: list[Message] = [tick_of(0), tracks_of(0, 1), tracks_of(0, 0)]
    for order in itertools.permutations(messages):
        assert ready([*first, *order]) == [(0, 0), (0, 1), (3, 0), (3, 1)]


def test_a_chaser_that_is_lost_owes_no_tracks() -> None:
    before: list[Message] = [tick_of(0), tracks_of(0, 0)]
    assert ready(before) == []
    assert ready([*before, tick_of(0, (0,), revision=1)]) == [(0, 0)]
    assert ready([*before, tick_of(1, (0,))]) == [(0, 0)]


@pytest.mark.parametrize(
    "changes",
    [
        {"places": (0, 0, 0)},
        {"ages": (0,)},
        {"ids": (5, 5)},
        {"ids": (6, 5)},
        {"described": (5,)},
        {"described": (7,), "descriptions": bytes(128)},
        {"ellipses": (1.0,) * 5},
        {"ellipses": (400.0, 300.0, 20.0, 30.0, 0.5, 0.8)},
        {"ellipses": (400.0, 300.0, 30.0, 0.0, 0.5, 0.8)},
        {"ellipses": (400.0, 300.0, 30.0, 20.0, 0.5, 1.5)},
    ],
)
def test_tracks_whose_fields_do_not_fit_together_are_dropped(changes: dict[str, Any]) -> None:
    collector = TrackCollector(scenario(), realtime=False)
    collector.add_tick(tick_of(0))
    collector.add(msgspec.structs.replace(tracks_of(0, 0, (5, 6)), **changes))
    assert collector.stale == 1
    collector.add(tracks_of(0, 0, (5, 6)))
    collector.add(tracks_of(0, 1))
    assert (collector.stale, len(collector.ready)) == (1, 2)


def test_repeated_foreign_and_early_tracks_are_dropped() -> None:
    collector = TrackCollector(scenario(), realtime=False)
    collector.add_tick(tick_of(0))
    for message in (tracks_of(0, 0), tracks_of(0, 0), tracks_of(0, 7), tracks_of(30, 1)):
        collector.add(message)
    assert collector.stale == 3


def test_in_real_time_nothing_waits() -> None:
    collector = TrackCollector(scenario(), realtime=True)
    collector.add_tick(tick_of(0))
    collector.add(tracks_of(0, 1))
    assert [t.chaser for t in collector.ready] == [1]
    collector.add_tick(tick_of(2))
    assert collector.complete_tick == -1
    collector.add_tick(tick_of(4))
    assert collector.complete_tick == 0


def circle_seen(circle: Circle, seen: ImageTracks, camera: Camera) -> Array:
    """Return the row of the ellipse of a circle on the target in an image; empty from behind."""
    at, turned = TRUE.at([seen.time_s])
    place = turned[0].T @ (seen.position_w_m - at[0])
    towards = place - circle[0]
    if towards @ circle[1] < 0.3 * np.linalg.norm(towards):
        return np.zeros(0)
    inside = (circle_points(circle) - place) @ turned[0].T @ seen.rotation
    return ellipse_row(camera.project_ideal(inside))


def flown(
    until_s: float,
    chasers: int = 2,
    core: MapperCore | None = None,
    circle: Circle | None = None,
) -> tuple[list[LandmarkMap], list[Event]]:
    """Return maps and events from points on a sphere that two chasers see three times a second.
    ``circle``: on it, seen from its front.
    """
    changed = {"chasers": CASE["chasers"][:chasers], "time": {"rate_hz": 15, "image_hz": 5}}
    core = core or MapperCore(scenario(**changed), instance="m1")
    camera = core.scenario.camera_model()
    out: list[Message] = []
    target = PointTarget(3, chasers=chasers)
    for seen in target.images(until_s, 0.4):
        tick, centre = round(seen.time_s * 15), np.array([camera.cx_px, camera.cy_px])
        px = seen.rays * [camera.fx_px, camera.fy_px] + centre
        message = FeatureTracks(
            tick=tick,
            sim_time_ns=round(seen.time_s * 1e9),
            chaser=seen.chaser,
            status="seen",
            position_m=vector(seen.position_w_m),
            q_wxyz=vector(rotations.normalize(rotations.from_matrix(seen.rotation))),
            ids=tuple(np.sort(seen.ids).tolist()),
            places=tuple(np.rint(px[np.argsort(seen.ids)] / PX_STEP).astype(int).ravel().tolist()),
            ages=tuple(
                np.rint(seen.ages_s[np.argsort(seen.ids)] / AGE_STEP_S).astype(int).tolist()
            ),
        )
        if circle is not None:
            row = circle_seen(circle, seen, core.scenario.camera_model())
            message = msgspec.structs.replace(message, ellipses=tuple(row.tolist()))
        ticks = (tick_of(tick, tuple(range(chasers))),) if seen.chaser == 0 else ()
        images = msgspec.structs.replace(ticks[0], images=True) if ticks else None
        for received in (*((images,) if images else ()), message):
            if (due := core.step(received)) is not None:
                out += [m for _, _, m in core.map_target(due)]
    return (
        [m for m in out if isinstance(m, LandmarkMap)],
        [m for m in out if isinstance(m, Event)],
    )


@pytest.fixture(scope="module")
def maps() -> tuple[list[LandmarkMap], list[Event]]:
    return flown(20.0)


@pytest.mark.slow(0.1)
def test_maps_come_at_their_intervals_and_say_when_the_next_one_does(
    maps: tuple[list[LandmarkMap], list[Event]],
) -> None:
    found = maps[0]
    assert found[0].tick == 0
    assert found[0].status == "gathering"
    for before, after in itertools.pairwise(found):
        wanted = before.next_tick
        assert wanted <= after.tick < wanted + 6  # images of the case are 6 ticks apart
        assert before.next_tick - before.tick == (90 if before.motion else 15)
    assert found[-1].status == "mapped"
    assert all(m.instance == "m1" for m in found)


def test_a_map_holds_the_target_and_what_each_chaser_sees_of_it(
    maps: tuple[list[LandmarkMap], list[Event]],
) -> None:
    last = codec.decode(LandmarkMap, codec.encode(maps[0][-1]))
    assert last.motion is not None
    n = len(last.landmarks_m) // 3
    assert 40 < n <= MAX_TRACKS == MapperTuning().most_landmarks
    assert len(last.moments_m2) == 6 * n
    assert [t.chaser for t in last.tracks] == [0, 1]
    for tracks in last.tracks:
        assert len(tracks.ids) == len(tracks.landmarks) > 20
        assert max(tracks.landmarks) < n
    rate = rotations.rotate(last.motion.q_wxyz, last.motion.omega_rad_s)
    off = np.linalg.norm(rate - TRUE.omega_rad_s) / np.linalg.norm(TRUE.omega_rad_s)
    assert off < 0.02
    sphere = np.linalg.norm(np.reshape(last.landmarks_m, (-1, 3)), axis=1)
    assert np.median(sphere) < 0.6


def test_the_frame_of_a_map_stays_on_the_target(
    maps: tuple[list[LandmarkMap], list[Event]],
) -> None:
    """From map to map, the axes turn on the target by less than the rates have changed."""
    turns = []
    for m in maps[0]:
        if m.motion is not None:
            time_s = m.sim_time_ns / 1e9
            true = rotations.exp(TRUE.omega_rad_s * time_s)
            turns.append(rotations.multiply(rotations.conjugate(true), m.motion.q_wxyz))
    assert len(turns) >= 2
    for before, after in itertools.pairwise(turns):
        assert rotations.angle_between(before, after) < np.deg2rad(0.7)


@pytest.mark.slow(0.1)
def test_each_status_is_an_event_once_with_what_would_help() -> None:
    found, events = flown(10.0, chasers=1)
    assert {m.status for m in found} >= {"gathering", "scale unknown"}
    assert all(m.motion is None or m.status == "scale unknown" for m in found)
    assert events[0].what == "map of the target: gathering"
    assert HELP["scale unknown"] in events[-1].detail
    assert "a second chaser" in events[-1].detail
    assert events[-1].level == "warning"
    for before, after in itertools.pairwise(events):
        assert before.what != after.what


def test_frames_of_turned_maps_are_aligned_by_their_landmarks() -> None:
    rng = np.random.default_rng(4)
    keys, omega = np.arange(60), np.array([0.02, -0.05, 0.03])
    axis = omega / np.linalg.norm(omega)
    first = rng.normal(0.0, 0.4, (60, 3))
    turn = rotations.to_matrix(rotations.exp([0.02, 0.01, -0.03]))
    frame = MapFrame()
    placed = frame.align(keys, first, omega)
    # The origin is in the middle, but on the axis.
    assert np.allclose(np.cross(frame.origin_m, axis), 0.0)
    moved = (first + 0.07 * axis) @ turn.T
    again = frame.align(keys[5:], moved[5:], turn @ omega)
    assert np.abs(again - placed[5:]).max() < 1e-9


def test_the_covariance_of_a_motion_in_the_frame_follows_from_that_of_the_map() -> None:
    rng = np.random.default_rng(8)
    motion = ConstantRates(
        2.0,
        np.array([0.1, -0.2, 0.3]),
        np.array([0.01, 0.02, -0.01]),
        np.array([0.03, -0.05, 0.04]),
    )
    a = rng.normal(0.0, 1.0, (9, 9))
    covariance, frame, time_s = a.T @ a, MapFrame(), 14.0
    frame.turn = rotations.to_matrix(rotations.exp([0.5, -0.3, 0.8]))
    mean = frame.motion_at(motion, covariance, time_s)

    def state(step: Array) -> Array:
        m = frame.motion_at(motion.moved(step), covariance, time_s)
        turn = rotations.log(rotations.multiply(rotations.conjugate(mean.q_wxyz), m.q_wxyz))
        return np.concatenate([m.position_m, m.velocity_m_s, turn, m.omega_rad_s])

    by = np.array([(state(h) - state(-h)) / 2e-6 for h in 1e-6 * np.eye(9)]).T
    assert np.abs(by @ covariance @ by.T - mean.covariance).max() < 1e-6


def test_topics_of_the_mapper_are_its_own() -> None:
    assert [t.key for t in topics.TOPICS if t.writer == "mapper"] == ["mapper/map"]
    read = {t.key for t in topics.TOPICS if "mapper" in t.readers}
    assert read == {
        "world/tick", "world/end", "chaser/{chaser}/features", "{process}/presence",
    }  # fmt: skip


class ClosedLater(MapperCore):
    """A mapper whose loop closes at 10 s, and opens again at once."""

    def __init__(self, flight: FlightScenario) -> None:
        super().__init__(flight)
        update = self.mapper.update

        def closing(time_s: float) -> TargetMap:
            found = update(time_s)
            return replace(found, closed=found.motion is not None and 10.0 <= time_s < 15.0)

        self.mapper.update = closing


@pytest.mark.slow(0.1)
def test_a_port_waits_until_the_loop_has_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    rays: list[Any] = []

    def decide(self: PortChooser, chaser: int, where: Any, ray: Any) -> PortDecision:
        rays.append((chaser, where, ray))
        return PortDecision(False, "not flat")

    early = MapperCore(scenario())
    find = PortRequest(chaser=0, find="flat", operator="me")
    assert "no map of the target: gathering" in early.choose(find)[0].reason
    monkeypatch.setattr(PortChooser, "decide", decide)
    entry = {"at_s": 2.0, "command": "port", "chasers": [1], "port": {"find": "flat"}}
    core = ClosedLater(scenario(timeline=[entry], approach={"dock_distance_m": 0.6}))
    maps, events = flown(9.0, core=core)
    assert maps[-1].motion is not None
    reply, event = core.choose(find)
    assert (reply.accepted, reply.command, reply.operator) == (False, "port", "me")
    assert reply.reason.startswith("the loop of the map is open")
    assert event is not None
    assert (event.what, event.level) == ("port of chaser 0: refused", "warning")
    assert rays == []
    assert not any(e.what.startswith("port") for e in events)

    core = ClosedLater(core.scenario)
    maps, events = flown(20.0, core=core)
    closed = [m.closed for m in maps]
    assert closed == sorted(closed)  # it does not open again
    assert maps[-1].closed
    names = [e.what for e in events]
    assert names[-2:] == ["map of the target: its loop has closed", "port of chaser 1: refused"]
    assert [r[0] for r in rays] == [1]

    # A pixel on a landmark: the line of sight, in the frame of the map, leads through it.
    newest, image = maps[-1], core._images[1][-1]
    known = next(t for t in newest.tracks if t.chaser == 1)
    row = next(k for k, i in enumerate(image.ids) if i in known.ids)
    pixel = (image.places[2 * row] * PX_STEP, image.places[2 * row + 1] * PX_STEP)
    request = PortRequest(chaser=0, image=1, pixel=pixel)
    assert core.choose(request)[0].reason == "not flat"
    landmark = known.landmarks[known.ids.index(image.ids[row])]
    place = np.reshape(newest.landmarks_m, (-1, 3))[landmark]
    origin, towards = rays[-1][2]
    towards /= np.linalg.norm(towards)
    off = place - origin
    assert off @ towards > 1.0
    assert np.linalg.norm(off - (off @ towards) * towards) < 0.01
    two = PortRequest(chaser=0, image=1, pixel=pixel, find="flat")
    assert core.choose(two)[0].reason.startswith("needs either image and pixel")
    with_radii = PortRequest(chaser=0, find="flat", radii_m=(0.1, 0.2))
    assert core.choose(with_radii)[0].reason.startswith("needs either image and pixel")

    # Of an image that the operator saw, not of the newest one.
    earlier = core._images[1][-4]
    seen_then = msgspec.structs.replace(request, exposed_ns=earlier.sim_time_ns)
    core.choose(seen_then)
    place, q = pose_at(newest, earlier.sim_time_ns)
    expected = rotations.rotate_inverse(q, np.array(earlier.position_m) - place)
    assert np.allclose(rays[-1][2][0], expected)
    unknown = msgspec.structs.replace(request, exposed_ns=earlier.sim_time_ns + 1)
    assert core.choose(unknown)[0].reason == "no image of chaser 1 at that time, or it is too old"


@pytest.mark.slow(0.1)
def test_a_ring_is_found_by_the_ellipses_of_all_chasers() -> None:
    circle = (np.array([-0.45, -0.1, 0.05]), np.array([-0.96, -0.28, 0.0]), 0.12)
    core = ClosedLater(scenario(approach={"dock_distance_m": 0.6}))
    flown(20.0, core=core, circle=circle)
    answer = core.choose(PortRequest(chaser=0, find="ring"))[0].reason
    found = re.search(r"ring of radius (\S+) m about \(([^)]*)\) m", answer)
    assert found is not None, answer
    assert abs(float(found[1]) - 0.12) < 0.003
    # Its place on the target, in whichever frame the map has.
    centre = np.array([float(x) for x in found[2].split(",")])
    assert core._map is not None
    place, q = pose_at(core._map, core._map.sim_time_ns)
    at, turned = TRUE.at([core._map.sim_time_ns / 1e9])
    world = place + rotations.rotate(q, centre)
    assert np.linalg.norm(world - at[0] - turned[0] @ circle[0]) < 0.02
