# SPDX-License-Identifier: Apache-2.0
"""Flights beside a target of which the flight software knows nothing, in virtual time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from chaserdock_agents.chaser import feature_vision
from chaserdock_models import rotations
from chaserdock_models.targets import cuboid_corners
from chaserdock_protocol import topics
from chaserdock_protocol.messages import (
    PX_STEP,
    BodyTruth,
    CommandReply,
    Event,
    FeatureTracks,
    LandmarkMap,
    Message,
    MissionEnd,
    PortRequest,
    Reference,
    Sighting,
    TargetEstimate,
    Tick,
)
from chaserdock_protocol.process import ProcessOptions
from chaserdock_protocol.recording.log import LogError, read_log
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.transport import Node
from source_tree import ROOT

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.report import report_of
from chaserdock.analysis.summary import summary_of
from chaserdock.logs.mapped_shape import write_shape
from chaserdock.simulation.mission import SimulatedFlight, simulate
from chaserdock.summary import Summary

PATH = ROOT / "scenarios/unknown-inspection.toml"
SHORTER = ("duration_s=14.0", "settling_s=11.0")


def flown(folder: Path, *more: str) -> SimulatedFlight:
    return simulate(PATH, folder, (*SHORTER, *more))


def messages(flight: SimulatedFlight) -> Iterator[Message]:
    for record in read_log(flight.folder):
        yield record.message


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> SimulatedFlight:
    return flown(tmp_path_factory.mktemp("unknown") / "run")


@pytest.mark.slow
def test_the_report_of_a_survey_leaves_out_what_needs_a_reference(flight: SimulatedFlight) -> None:
    page = report_of(flight.folder)
    assert "Trajectories" in page
    assert "no chaser was led relative to the target" in page


@pytest.mark.slow
def test_the_surface_of_the_last_map_is_exported(flight: SimulatedFlight, tmp_path: Path) -> None:
    written = write_shape(flight.folder, tmp_path / "shape")
    assert written["target.glb"] > 200
    scene = trimesh.load_scene(tmp_path / "shape" / "target.glb")
    # The satellite is 1.28 m wide; in 14 s a third of it has been seen.
    assert 0.8 < float(np.max(scene.extents)) < 1.6
    assert set(scene.geometry) == {"seen", "unseen"}


def test_a_log_without_a_map_has_no_surface(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no map of a target: no mapper flew"):
        write_shape(ROOT / "tests/golden/two-chasers.mcap", tmp_path)


@pytest.mark.slow(0.1)
def test_the_target_is_mapped_and_then_seen_by_the_map(flight: SimulatedFlight) -> None:
    assert not flight.crashes
    assert not flight.stalled
    assert set(flight.statuses.values()) == {0}
    maps = [m for m in messages(flight) if isinstance(m, LandmarkMap)]
    first = next(m for m in maps if m.status == "mapped")
    assert first.tick <= 15 * 8
    # A map counts four seconds after its images, and not before.
    for m in messages(flight):
        if isinstance(m, Sighting):
            counts = m.tick >= first.tick + 60
            assert bool(m.solutions) == counts or (counts and m.detail)
            assert counts or m.detail.startswith("no map of the target: ")
    shown = [m for m in messages(flight) if isinstance(m, Sighting) and m.solutions]
    assert len(shown) > 20
    last = [m for m in messages(flight) if isinstance(m, TargetEstimate)][-1]
    assert last.status == "tracking"


@pytest.mark.slow(0.1)
def test_messages_of_the_mapper_are_bounded(flight: SimulatedFlight) -> None:
    tracks = [m for m in messages(flight) if isinstance(m, FeatureTracks)]
    assert len(tracks) == 2 * 14 * 5
    assert max(len(m.ids) for m in tracks) <= 400


@pytest.mark.slow(0.1)
def test_its_figures_are_judged(flight: SimulatedFlight) -> None:
    result = summary_of(load_flight(flight.folder))
    assert Summary.from_dict(result).mapping is not None
    mapping = result["mapping"]
    assert mapping["status"] == "mapped"
    assert 0.0 < mapping["rate_error_share"] < 0.05
    assert mapping["landmarks"] > 50
    rows = {row["name"]: row for row in result["criteria"]}
    assert rows["first map at"]["outcome"] == "met"
    assert rows["rate error of the last map"]["unit"] == "%"
    estimate = result["target_estimate"]
    assert estimate["position_rms_m"] < 0.05
    # The survey is no motion relative to the target.
    assert result["chasers"]["0"]["steady"]["position_mse_m2"] is None


@pytest.mark.slow(0.5)
def test_equal_flights_are_equal(flight: SimulatedFlight, tmp_path: Path) -> None:
    one, other = load_flight(flight.folder), load_flight(flown(tmp_path / "run").folder)
    assert one.digest == other.digest


@pytest.mark.slow(0.5)
def test_a_flight_goes_on_without_its_mapper(tmp_path: Path) -> None:
    kill = 'fault=[{kind = "kill", process = "mapper", at_s = 6.0}]'
    without = flown(tmp_path / "run", kill)
    assert not without.stalled
    assert without.statuses["mapper"] is None
    found = list(messages(without))
    assert any(isinstance(m, Event) and m.what == "process lost" for m in found)
    ticks = [m for m in found if isinstance(m, Tick)]
    assert ticks[0].mapper
    assert not ticks[-1].mapper
    assert ticks[-1].tick == 14 * 15 - 1
    # The last map counts on.
    assert any(isinstance(m, Sighting) and m.solutions and m.tick > 190 for m in found)


@pytest.mark.slow(0.1)
def test_the_mapper_answers_an_operator_who_chooses_a_port(tmp_path: Path) -> None:
    replies: list[CommandReply] = []

    def ask(options: ProcessOptions) -> int:
        node = Node("operator", "operator", options.link)
        node.subscribe(topics.TICK)
        node.subscribe(topics.END)
        try:
            while not replies:
                received = node.receive(0.5)
                message = None if received is None else received.message
                if isinstance(message, MissionEnd):
                    return 1
                if isinstance(message, Tick) and message.tick >= 100:
                    request = PortRequest(chaser=0, find="flat", operator="me")
                    reply = node.query(topics.PORT_KEY, request, CommandReply, 5.0)
                    replies.extend([] if reply is None else [reply])
            return 0
        finally:
            node.close()

    asked = simulate(PATH, tmp_path / "run", SHORTER, others={"operator": ask})
    assert asked.statuses["operator"] == 0
    (reply,) = replies
    assert (reply.command, reply.accepted, reply.operator) == ("port", False, "me")
    assert reply.reason.startswith("the loop of the map is open")
    logged = [m for m in messages(asked) if isinstance(m, Event) and m.process == "mapper"]
    assert logged[-1].what == "port of chaser 0: refused"


CROSSING = (
    "duration_s=22.0",
    "settling_s=20.0",
    "chasers=[{position_m=[-2.0, 0.0, 0.0], look_at='target'}, "
    "{position_m=[-1.0, -1.732, 0.0], look_at='target'}, "
    "{position_m=[-1.0, 0.4, 0.2], look_at='target'}]",
    "timeline=[{at_s=10.0, command='goto', chasers=[2], offset_m=[-1.0, -0.5, 0.2]}]",
    "success={}",
)
"""Chaser 2 flies between chaser 0 and the target."""


def points_on_another(flight: SimulatedFlight, seen_by: int, other: int) -> tuple[int, int]:
    """Return how many points in a chaser's images from 12 s on are on another chaser, by its true
    pose, and in how many images it is among the points.
    """
    scenario = load_scenario(PATH)
    camera = scenario.camera_model()
    truth = {(m.body, m.tick): m for m in messages(flight) if isinstance(m, BodyTruth)}
    on_it = images = 0
    for m in messages(flight):
        if not isinstance(m, FeatureTracks) or m.chaser != seen_by or m.sim_time_ns < 12e9:
            continue
        own, body = truth[f"chaser/{seen_by}", m.tick], truth[f"chaser/{other}", m.tick]
        lens, q = camera.irf_pose_in_world(own.position_m, own.q_wxyz)
        corners = np.concatenate(
            [cuboid_corners(b.size_m) + b.position_m for b in scenario.chaser.boxes()]
        )
        world = np.array(body.position_m) + rotations.rotate(body.q_wxyz, corners)
        outline = camera.project(rotations.rotate_inverse(q, world - lens)).astype(np.float32)
        hull = cv2.convexHull(outline)
        points = np.reshape(m.places, (-1, 2)) * PX_STEP
        inside = [cv2.pointPolygonTest(hull, (float(x), float(y)), False) >= 0 for x, y in points]
        on_it += sum(inside)
        low, high = points.min(axis=0), points.max(axis=0)
        images += bool(((outline > low) & (outline < high)).all(axis=1).any())
    return on_it, images


@pytest.mark.slow
@pytest.mark.parametrize("left_out", [True, False])
def test_another_chaser_before_the_target_is_no_part_of_it(
    left_out: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not left_out:
        monkeypatch.setattr(feature_vision, "chaser_discs", lambda *_: ())
    crossed = simulate(PATH, tmp_path / "run", CROSSING)
    assert not crossed.crashes
    on_it, images = points_on_another(crossed, 0, 2)
    print(f"{on_it} points on chaser 2, which is among those of the target in {images} images")
    assert images > 20
    assert on_it == 0 if left_out else on_it > 100


@pytest.mark.slow
def test_two_chasers_dock_where_the_map_is_flat(tmp_path: Path) -> None:
    docked = simulate(ROOT / "scenarios/unknown-docking.toml", tmp_path / "run")
    assert not docked.crashes
    result = summary_of(load_flight(docked.folder))
    assert all(result["chasers"][i]["docked"] for i in ("0", "1")), result["failures"]
    assert result["collisions"] == 0
    what = [m.what for m in messages(docked) if isinstance(m, Event)]
    assert what.index("map of the target: its loop has closed") < what.index(
        "port of chaser 0: chosen"
    )
    # Nothing leaves its survey before the map with the ports counts.
    ports = next(m for m in messages(docked) if isinstance(m, LandmarkMap) and m.ports)
    left = next(m for m in messages(docked) if isinstance(m, Reference) and m.phase != "survey")
    assert left.tick >= ports.tick + 60
