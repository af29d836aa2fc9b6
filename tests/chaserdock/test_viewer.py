# SPDX-License-Identifier: Apache-2.0
"""Viewer without a browser: state, history, plots, shapes, logs, admission of connections."""

from __future__ import annotations

import signal
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from subprocess import PIPE, STDOUT
from typing import Any

import msgspec
import numpy as np
import pytest
import viser
from chaserdock_models import rotations
from chaserdock_protocol import topics
from chaserdock_protocol.messages import (
    ActuatorCommand,
    BodyTruth,
    CommandReply,
    DockingStatus,
    Event,
    Image,
    LandmarkMap,
    MissionEnd,
    Odometry,
    Reference,
    Sighting,
    Tick,
)
from chaserdock_protocol.recording.log import LogError
from chaserdock_protocol.scenario import flight_scenario, load_scenario
from chaserdock_protocol.transport import Link, Node
from chaserdock_world.orbit import earth_disc
from harness import ROOT, chaserdock, finished
from hypothesis import given, settings
from hypothesis import strategies as st
from message_samples import BY_TYPE
from mission_keys import client, make_keys, router_with_rights
from websockets.frames import Frame, Opcode

from chaserdock.analysis.dressed_bodies import chaser_body, target_body
from chaserdock.cli.run import announce_viewer
from chaserdock.launch.launcher import free_port as unused_port
from chaserdock.viewer import plots, shapes
from chaserdock.viewer import text as words
from chaserdock.viewer.address import (
    DEFAULT_HOST,
    TOKEN_VARIABLE,
    ViewError,
    free_port,
    is_own_origin,
    page_token,
    url_of,
)
from chaserdock.viewer.history import History, Line, Series
from chaserdock.viewer.live import past_lines
from chaserdock.viewer.logged import LoggedMission
from chaserdock.viewer.page import Timeline, with_age
from chaserdock.viewer.player import advance
from chaserdock.viewer.report_page import ReportPage
from chaserdock.viewer.scene import VIEWS, SceneView, ViewFrom
from chaserdock.viewer.server import page_server
from chaserdock.viewer.snapshot import MissionState

TOKEN = "0123456789abcdefghijkl"
GOLDEN = ROOT / "tests" / "golden" / "two-chasers.mcap"
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
quick = settings(derandomize=True, deadline=None, max_examples=60)


@pytest.fixture(scope="module")
def mission() -> LoggedMission:
    return LoggedMission(GOLDEN)


# -- the present -----------------------------------------------------------------------------------


def test_tracking_error_compares_messages_of_one_tick(mission: LoggedMission) -> None:
    """Odometry arrives before the reference of its tick."""
    state = MissionState.empty(1)
    for tick, x in enumerate((0.0, 1.0, 2.0)):
        at = Odometry(
            tick=tick,
            chaser=0,
            position_m=(x, 0, 0),
            velocity_m_s=(0, 0, 0),
            q_wxyz=UPRIGHT,
            omega_rad_s=(0, 0, 0),
        )
        state.update(topics.ODOMETRY, at)
    assert state.chasers[0].error() is None
    there = Reference(
        tick=1, chaser=0, phase="hold", phase_time_s=0.0, position_m=(1.0, 0.25, 0.0),
        q_wxyz=UPRIGHT,
        offset_m=(0, 0, 0), min_distance_target_m=0.5,
    )  # fmt: skip
    state.update(topics.REFERENCE, there)
    assert state.chasers[0].error() == pytest.approx((0.25, 0.0))
    assert state.keep_out_m(0.1) == 0.5
    assert MissionState.empty(1).keep_out_m(0.1) == 0.1


def test_images_are_of_one_moment() -> None:
    """While images arrive one by one, the newest exposure that all chasers have is shown; who is
    silent does not hold others up.
    """
    state = MissionState.empty(3)

    def image(chaser: int, time_s: float, seen: bool = True) -> None:
        at: dict[str, Any] = {"chaser": chaser, "sim_time_ns": round(time_s * 1e9)}
        state.update(
            topics.IMAGE, Image(width_px=1, height_px=1, encoding="mono8", data=b"0", **at)
        )
        if seen:
            state.update(
                topics.SIGHTING,
                Sighting(
                    status="nothing",
                    solutions=(),
                    marker_ids=(),
                    corners_px=(),
                    rejected_ids=(),
                    **at,
                ),
            )

    def shown() -> list[float | None]:
        return [
            i.sim_time_ns / 1e9 if i is not None else None for i in state.images_of_one_moment()
        ]

    assert shown() == [None, None, None]
    for chaser in range(3):
        image(chaser, 1.0)
    image(0, 1.5)
    image(1, 1.5)
    assert shown() == [1.0, 1.0, 1.0]
    image(2, 1.5, seen=False)
    assert shown() == [1.0, 1.0, 1.0]
    for chaser in range(3):
        image(chaser, 2.0, seen=chaser != 1)
    assert shown() == [1.0, 1.0, 1.0]
    for time_s in (2.5, 3.0, 3.5, 4.0, 4.5):
        image(0, time_s)
        image(1, time_s)
    assert shown() == [4.5, 4.5, 2.0]
    # A slow page takes one image of each chaser in turn: an exposure that all have may be long ago.
    image(2, 4.5)
    for k in range(3):
        image(k, 6.0 + 0.1 * k)
    assert shown() == [6.0, 6.1, 6.2]
    image(0, 6.3, seen=False)
    assert shown() == [6.0, 6.1, 6.2]
    assert MissionState.empty(1).images_of_one_moment() == [None]


def test_messages_of_unknown_chasers_are_ignored() -> None:
    state, history = MissionState.empty(1), History(1)
    stray = Odometry(
        chaser=7,
        position_m=(0, 0, 0),
        velocity_m_s=(0, 0, 0),
        q_wxyz=UPRIGHT,
        omega_rad_s=(0, 0, 0),
    )
    state.update(topics.ODOMETRY, stray)
    history.update(topics.ODOMETRY, stray, 0)
    assert state.chasers[0].odometry is None


def test_faults_are_listed(mission: LoggedMission) -> None:
    state, history = mission.at(1.0), mission.history
    assert words.faults(state, history, set()) == "none"
    assert "**chaser/1** has disappeared" in words.faults(state, history, {"chaser/1"})
    state.update(topics.TICK, Tick(tick=20, images=True, chasers=(0,)))
    brake = ActuatorCommand(
        chaser=0, effective_time_ns=0, source="brake", force_N=(0, 0, 0), torque_N_m=(0, 0, 0)
    )
    state.update(topics.ACTUATORS, brake)
    listed = words.faults(state, history, set())
    for text in (
        "chaser 1 does not participate",
        "the controller does not participate",
        "chaser 0: fallback (brake)",
    ):
        assert text in listed


def test_coasting_is_a_fault_except_at_a_port(mission: LoggedMission) -> None:
    state = mission.at(1.0)
    assert state.chasers[0].wrench is not None
    coast = msgspec.structs.replace(state.chasers[0].wrench, mode="coast")
    state.update(topics.WRENCH, coast)
    assert "commands coast" in words.faults(state, mission.history, set())
    at_port = DockingStatus(chaser=0, contact=True, armed=True, latched=True)
    state.update(topics.DOCKING, at_port)
    assert words.faults(state, mission.history, set()) == "none"


# -- the past --------------------------------------------------------------------------------------


@quick
@given(st.lists(st.floats(0, 1e4), max_size=300), st.integers(4, 50))
def test_series_is_ordered_and_bounded(times: list[float], most: int) -> None:
    series = Series(most)
    for t in times:
        series.add(t, t)
    kept, values = series.until(1e9)
    assert len(kept) <= most
    assert np.all(np.diff(kept) > 0)
    assert np.array_equal(kept, values)
    if times:
        assert set(kept) <= set(times)


@quick
@given(st.lists(st.tuples(st.floats(0.0, 60.0), st.floats(-1e3, 1e3)), min_size=1, max_size=2000))
def test_plots_keep_peaks_and_fill_gaps(samples: list[tuple[float, float]]) -> None:
    history = History(2)
    kept = {}
    for t, v in sorted(samples):
        history.series["latency_ms", 0].add(t, v)
        kept.setdefault(t, v)
    history.series["latency_ms", 1].add(30.0, 5.0)
    plot = next(p for p in plots.plots_of(2, False) if p.curves[0][2] == "latency_ms")
    x, first, second = plots.points_of(plot, history, 0.0, 60.0)
    assert len(x) == len(first) == len(second) <= plots.POINTS
    assert np.isfinite(first).all()
    assert np.isfinite(second).all()
    assert np.max(first) == max(kept.values())
    assert set(second) == {5.0}


def test_plot_without_data_can_be_drawn() -> None:
    for plot in plots.plots_of(3, True):
        points = plots.points_of(plot, History(3), 0.0, 10.0)
        assert [len(p) for p in points] == [2] * (len(plot.curves) + 1)
        assert plot.least is None or min(map(min, points[1:])) > 0.0  # has a logarithm


def test_a_millimetre_shows_beside_a_start_from_afar() -> None:
    """The scale of the position error is logarithmic: a tick without error does not break it."""
    history = History(1)
    for time_s, error_mm in ((1.0, 400.0), (2.0, 1.0), (3.0, 0.0)):
        history.series["position_error_mm", 0].add(time_s, error_mm)
    plot = next(p for p in plots.plots_of(1, False) if p.curves[0][2] == "position_error_mm")
    assert plot.least is not None
    values = plots.points_of(plot, history, 0.0, 4.0)[1]
    assert values.tolist() == [400.0, 1.0, plot.least]


def test_an_old_image_says_how_old_it_is() -> None:
    """It is dimmed, and its lower edge bears the age in the colour of warnings."""
    old = with_age(np.full((120, 200, 3), 200, np.uint8), 3.2)
    assert old[:60].max() == 100
    lettered = (old[60:] == (255, 176, 0)).all(axis=2)
    assert lettered.sum() > 50


def test_events_before_the_viewer_joined_are_added_from_the_log(mission: LoggedMission) -> None:
    """From a log that is being written, as soon as it reaches the tick at which it joined."""
    late = History(2)
    late.begins_s = 1.0
    late.add_line(1.1, "info", "a later one")
    assert past_lines(GOLDEN, 2, 1e3) is None
    assert "those before 1.0 s" in words.events(late.lines_until(9.0, 9), 9, late.begins_s)
    for _ in range(2):  # what is known is not repeated
        late.add_past(past_lines(GOLDEN, 2, 1.0) or [])
    listed = words.events(late.lines_until(9.0, 99), 99, late.begins_s)
    assert "approach chaser 0: accepted" in listed
    assert listed.count("a later one") == 1
    assert len(late.lines) == 1 + len(mission.history.lines_until(1.0, 99))
    assert "before" not in listed


def test_events_are_listed_newest_first_without_repetition() -> None:
    history = History(1)
    history.update(
        topics.EVENT, Event(sim_time_ns=10**9, process="world", level="warning", what="late"), 0
    )
    reply = CommandReply(
        sim_time_ns=2 * 10**9, command="approach", chaser=0, accepted=False, reason="why not"
    )
    for _ in range(3):
        history.update(topics.COMMAND, reply, 0)
    history.update(
        topics.END, MissionEnd(sim_time_ns=3 * 10**9, reason="all flown", complete=True), 0
    )
    texts = [line.text for line in history.lines_until(2.5, 10)]
    assert texts == ["approach chaser 0: refused, why not", "world: late"]
    assert history.lines_until(9.0, 1)[0].text == "the mission has ended: all flown"


def test_latency_is_measured_from_image_to_command_of_its_tick(mission: LoggedMission) -> None:
    history = History(1)
    history.add_exposure(0, 5, 1_000_000_000)
    command = ActuatorCommand(
        tick=5,
        sim_time_ns=1,
        chaser=0,
        effective_time_ns=0,
        source="command",
        force_N=(0, 0, 0),
        torque_N_m=(0, 0, 0),
    )
    history.update(topics.ACTUATORS, command, 1_025_000_000)
    assert history.series["latency_ms", 0].until(1.0)[1].tolist() == [25.0]
    assert len(mission.history.series["latency_ms", 1]) >= 17


# -- a log -----------------------------------------------------------------------------------------


def test_log_is_accessible_at_any_time(mission: LoggedMission) -> None:
    assert mission.truth
    assert mission.end_s == pytest.approx(17 / 15, abs=1e-6)
    for tick in (7, 17):
        state = mission.at(tick / 15)
        assert state.tick is not None
        assert state.tick.tick == tick
        for i, chaser in enumerate(state.chasers):
            of_it = (
                chaser.odometry,
                chaser.reference,
                chaser.image,
                chaser.sighting,
                chaser.actuators,
            )
            assert [(m.chaser, m.tick) for m in of_it if m is not None] == [(i, tick)] * 5
            assert chaser.image is not None
            assert chaser.sighting_in(chaser.image) is chaser.sighting
            assert chaser.error() is not None
        assert set(state.truth) == {"target", "chaser/0", "chaser/1"}
        assert state.ended is None or tick == 17
    assert all(len(mission.history.series["position_error_mm", i]) >= 17 for i in (0, 1))
    assert len(mission.history.series["estimate_error_mm", None]) >= 17
    assert "approach chaser 0: accepted, phase approach" in words.events(
        mission.history.lines_until(9.0, 99)
    )
    table = words.chasers(mission.at(1.0), mission.history)
    assert table.count("| 1 |") == 2
    assert "| approach |" in table
    assert "| hold |" in table


def test_repeated_warnings_are_one_line_with_their_count() -> None:
    repeated = [
        Line(10.0 - 0.1 * k, "warning", f"chaser 1: force of {k}.5 N exceeds 2 N")
        for k in range(30)
    ]
    other = [
        Line(5.0, "warning", "chaser 2: force of 3.5 N exceeds 2 N"),
        Line(1.0, "info", "started"),
    ]
    shown = words.events([*repeated, *other], most=12).splitlines()
    assert len(shown) == 3
    assert "0.5 N exceeds 2 N (30 times since 7.10 s)" in shown[0]
    assert "chaser 2" in shown[1]
    assert "times" not in shown[2]


def test_viewer_is_announced_once_it_answers(capsys: pytest.CaptureFixture[str]) -> None:
    port = free_port(DEFAULT_HOST, None)
    thread = announce_viewer(port, "http://somewhere/")
    time.sleep(0.3)
    assert capsys.readouterr().err == ""
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        server.bind((DEFAULT_HOST, port))
        server.listen()
        thread.join(timeout=30.0)
    assert capsys.readouterr().err == "the viewer is at http://somewhere/\n"


def test_truncated_log_is_shown_up_to_its_end(tmp_path: Path) -> None:
    whole = GOLDEN.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: int(0.8 * len(whole))])
    mission = LoggedMission(cut)
    assert 0.0 < mission.end_s <= 17 / 15 + 1e-6
    assert mission.at(mission.end_s).tick is not None


@pytest.mark.slow
def test_invalid_log_prints_a_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"no log at all")
    with pytest.raises(LogError, match="no MCAP log"):
        LoggedMission(tmp_path / "x.mcap")
    status, said = finished("view", str(tmp_path))
    assert status == 2
    assert said.strip().splitlines() == [
        f"chaserdock: {tmp_path}: holds no log (mission.mcap, or mission-0000.mcap and so on)"
    ]


def test_time_line_plays_to_its_end_and_follows_the_slider() -> None:
    line = Timeline(10.0, speed=2.0)
    advance(line, 1.0)
    assert line.at_s == 2.0
    line.at_s, line.moved = 9.5, True
    advance(line, 1.0)
    assert (line.at_s, line.moved) == (9.5, False)
    advance(line, 1.0)
    assert line.at_s == 10.0
    advance(line, 1.0)
    assert not line.playing


@pytest.mark.parametrize("view", VIEWS)
def test_labels_move_with_the_picture_that_shows_their_bodies(
    mission: LoggedMission, view: ViewFrom
) -> None:
    """No label has a parent that moves: viser would draw it where the parent was in the picture
    before.
    """
    with page_server(DEFAULT_HOST, None, TOKEN) as server:
        scene = SceneView(server, mission.scenario)
        scene.view, state = view, mission.at(1.0)
        scene.draw(state, mission.history, slow=True)
        numbers = [server.scene.get_handle_by_name(f"/number_{i}") for i in (0, 1)]
        target = state.true_target()
        assert target is not None
        for i in (0, 1):
            chaser = state.chaser(i)
            assert chaser is not None
            up = np.array([0.0, 0.0, 0.75 * mission.scenario.chaser.size_m[2]])
            above = chaser.position_m + rotations.rotate(chaser.q_wxyz, up)
            beside = above - target.position_m
            expected = {
                "the world": above,
                "beside the target": beside,
                "on the target": rotations.rotate_inverse(target.q_wxyz, beside),
            }[view]
            label = numbers[i]
            assert label is not None
            assert label.visible
            assert label.position == pytest.approx(expected)
        radius = server.scene.get_handle_by_name("/radius_1")
        assert radius is not None
        assert radius.visible
        scene.show_scale(False)
        scene.draw(state, mission.history, slow=True)
        assert not radius.visible


# -- shapes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["four-chaser-docking", "docking-contact"])
def test_mesh_normals_point_outwards(name: str) -> None:
    """And chasers have colours of their own, those of the film."""
    scenario = load_scenario(ROOT / "scenarios" / f"{name}.toml")
    one, two = (shapes.mesh_of(chaser_body(scenario, i)) for i in (0, 1))
    assert {tuple(c) for c in one.colours.tolist()} != {tuple(c) for c in two.colours.tolist()}
    for mesh in (one, shapes.mesh_of(target_body(scenario))):
        assert mesh.triangles.max() == len(mesh.vertices_m) - 1
        a, b, c = (mesh.vertices_m[mesh.triangles[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        assert np.all(np.linalg.norm(normals, axis=1) > 0.0)
        assert mesh.normals is not None
        corners = mesh.normals[mesh.triangles]
        assert np.all(np.einsum("ij,ikj->ik", normals, corners) > 0.0)


def test_scale_is_a_round_number_within_the_scene() -> None:
    assert shapes.scale_of(1.0) == (0.5, 1.0)
    assert shapes.scale_of(0.85) == (0.25, 0.5)
    assert shapes.scale_of(950.0) == (250.0, 500.0)
    assert np.linalg.norm(shapes.ring(0.5), axis=2) == pytest.approx(0.5)


def test_the_earth_fills_its_disc_outside_the_scene() -> None:
    """Seen from the scene's middle it has the angular radius of the images, is lit where the sun
    is, and its triangles face the viewer.
    """
    axis, radius_rad, reach_m = np.array([0.0, 0.6, -0.8]), 1.1, 40.0
    mesh = shapes.earth(3.0 * axis, radius_rad, -axis, reach_m)
    rays = mesh.vertices_m / np.linalg.norm(mesh.vertices_m, axis=1, keepdims=True)
    assert np.arccos(rays @ axis).max() == pytest.approx(radius_rad)
    assert np.linalg.norm(mesh.vertices_m, axis=1).min() == pytest.approx(2.0 * reach_m)
    three = mesh.vertices_m[mesh.triangles]
    normals = np.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0])
    assert np.all(np.einsum("ij,ij->i", normals, three[:, 0]) <= 1e-9)
    night = shapes.earth(axis, radius_rad, axis, reach_m)
    assert mesh.colours.mean() > 5.0 * night.colours.mean() > 0.0


@pytest.mark.parametrize("name", ["v-bar", "low-orbit", "harsh-light", "markerless-docking"])
def test_the_first_view_shows_the_edge_of_the_earth(name: str) -> None:
    """With stars and Earth within its range, and the stars outside the scene."""
    scenario = load_scenario(ROOT / "scenarios" / f"{name}.toml")
    disc = earth_disc(scenario)
    assert disc is not None
    towards, radius_rad = disc
    with page_server(DEFAULT_HOST, None, TOKEN) as server:
        SceneView(server, scenario)
        camera = server.initial_camera
        stars = server.scene.get_handle_by_name("/scene/stars")
        assert isinstance(stars, viser.PointCloudHandle)
        stars_m = np.linalg.norm(stars.points, axis=1)
    ahead = -camera.position / np.linalg.norm(camera.position)
    reach_m = max(float(np.linalg.norm(c.position_m)) for c in scenario.chasers)
    earth = shapes.earth(np.array(towards), radius_rad, np.array(towards), reach_m)
    earth_m = np.linalg.norm(earth.vertices_m, axis=1)
    from_edge_rad = np.arccos(ahead @ towards / np.linalg.norm(towards)) - radius_rad
    assert 0.1 < from_edge_rad < 0.4
    assert stars_m.min() > 5.0 * np.linalg.norm(camera.position)
    assert camera.far > 1.2 * max(stars_m.max(), earth_m.max())


def test_a_target_of_unknown_shape_is_shown_by_its_landmarks_and_ports() -> None:
    """In flight nobody knows its body."""
    scenario = flight_scenario(load_scenario(ROOT / "scenarios" / "unknown-inspection.toml"))
    known = BY_TYPE[LandmarkMap]
    assert isinstance(known, LandmarkMap)
    assert known.ports
    state = MissionState.empty(2)
    with page_server(DEFAULT_HOST, None, TOKEN) as server:
        scene = SceneView(server, scenario)
        scene.draw(state, History(2), slow=True)
        assert server.scene.get_handle_by_name("/scene/estimate/landmarks") is None
        state.update(topics.MAP, known)
        scene.draw(state, History(2), slow=True)
        landmarks = server.scene.get_handle_by_name("/scene/estimate/landmarks")
        assert isinstance(landmarks, viser.PointCloudHandle)
        assert np.allclose(landmarks.points, np.reshape(known.landmarks_m, (-1, 3)))
        port = server.scene.get_handle_by_name("/scene/estimate/port_1")
        assert isinstance(port, viser.LineSegmentsHandle)
        assert np.allclose(port.points[0, 0], known.ports[0].position_m)


def test_corridor_covers_the_allowed_region() -> None:
    held = load_scenario(ROOT / "scenarios" / "four-chaser-docking.toml")
    line = shapes.corridor_of(held, 0)
    assert line is not None
    axis = np.array(held.chasers[0].position_m)
    along = line @ (axis / np.linalg.norm(axis))
    assert (along.min(), along.max()) == pytest.approx(
        (held.approach.dock_distance_m, 1.0), abs=1e-6
    )
    captured = load_scenario(ROOT / "scenarios" / "docking-contact.toml")
    tube = shapes.corridor_of(captured, 0)
    assert tube is not None
    port = captured.docking.ports[0]
    off = tube - np.array(port.position_m, dtype=np.float32)
    gaps = off @ np.array(port.axis, dtype=np.float32) - captured.chaser.probe_reach_m
    assert (gaps.min(), gaps.max()) == pytest.approx((0.0, captured.docking.entry_m), abs=1e-5)


# -- the server and the network --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("origins", "requested_hosts", "host", "allowed"),
    [
        (["http://127.0.0.1:8080"], ["127.0.0.1:8080"], "127.0.0.1", True),
        (["http://localhost:8080"], ["localhost:8080"], "127.0.0.1", True),
        (["http://[::1]:8080"], ["[::1]:8080"], "::1", True),
        ([], ["127.0.0.1:8080"], "127.0.0.1", True),
        (["https://evil.example"], ["127.0.0.1:8080"], "127.0.0.1", False),
        (["http://127.0.0.1:9999"], ["127.0.0.1:8080"], "127.0.0.1", False),
        (["http://evil.example:8080"], ["evil.example:8080"], "127.0.0.1", False),
        (["null"], ["127.0.0.1:8080"], "127.0.0.1", False),
        (["http://lab-7:8080"], ["lab-7:8080"], "0.0.0.0", True),
        (["https://evil.example"], ["lab-7:8080"], "0.0.0.0", False),
        (["http://lab-7:8080", "https://evil.example"], ["lab-7:8080"], "0.0.0.0", False),
        (["http://lab-7:8080"], ["lab-7:8080", "evil.example"], "0.0.0.0", False),
        ([], [], "0.0.0.0", False),
        ([], ["[::1"], "127.0.0.1", False),
        (["http://[::1"], ["lab-7:8080"], "0.0.0.0", False),
    ],
)
def test_only_our_own_page_may_connect(
    origins: list[str], requested_hosts: list[str], host: str, allowed: bool
) -> None:
    assert is_own_origin(origins, requested_hosts, host) is allowed


def address(server: viser.ViserServer) -> str:
    return f"http://127.0.0.1:{server.get_port()}"


CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": UPRIGHT,
    "position": (3.0, 0.0, 0.0),
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
    "image_height": 480,
    "image_width": 640,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}
"""First message of a page: viser ignores clicks before it."""


@contextmanager
def sent_clicks(
    server: viser.ViserServer, path: str, origin: str, button: viser.GuiButtonHandle
) -> Iterator[bytes]:
    """Open a web socket and send 16 clicks at once; yield the first line of the response."""
    click = {"type": "GuiUpdateMessage", "uuid": button._impl.uuid, "updates": {"value": True}}
    head = (
        f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{server.get_port()}\r\nOrigin: {origin}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Protocol: "
        f"viser-v{viser.__version__}\r\n\r\n"
    )
    frames = [
        Frame(Opcode.BINARY, msgspec.msgpack.encode(message)).serialize(mask=True)
        for message in (CAMERA, *[click] * 16)
    ]
    with socket.create_connection(("127.0.0.1", server.get_port())) as connection:
        connection.sendall(head.encode())
        with connection.makefile("rb") as response:
            status = response.readline()
            with suppress(ConnectionError):  # closed after a rejection
                connection.sendall(b"".join(frames))
            yield status


def test_rejected_web_socket_executes_no_buffered_message() -> None:
    """Clicks sent directly behind the handshake are executed for the page with its token only."""
    clicked: list[str] = []
    with page_server("127.0.0.1", None, TOKEN) as server:

        def button(name: str) -> viser.GuiButtonHandle:
            handle = server.gui.add_button(name)
            handle.on_click(lambda _: clicked.append(name))
            return handle

        own, foreign = address(server), "https://evil.example"
        for name, path, origin in (
            ("foreign page", f"/{TOKEN}", foreign),
            ("program without token", "/", own),
            ("program with another token", f"/{TOKEN[::-1]}", own),
            ("two origins", f"/{TOKEN}", f"{own}\r\nOrigin: {foreign}"),
            ("malformed origin", f"/{TOKEN}", "http://[::1"),
        ):
            with sent_clicks(server, path, origin, button(name)) as status:
                assert status == b"HTTP/1.1 403 Forbidden\r\n", name
        with sent_clicks(server, f"/{TOKEN}", own, button("page")) as status:
            assert b" 101 " in status
            deadline = time.monotonic() + 60.0
            while clicked.count("page") < 16 and time.monotonic() < deadline:
                time.sleep(0.01)
    assert clicked == ["page"] * 16


def test_page_is_served_below_its_token_only() -> None:
    with page_server("127.0.0.1", None, TOKEN) as server:
        with urllib.request.urlopen(f"{address(server)}/{TOKEN}/?darkMode") as response:
            assert b"<html" in response.read()
        with pytest.raises(urllib.error.HTTPError, match="403") as rejected:
            urllib.request.urlopen(f"{address(server)}/?darkMode")
        assert b"open the one that chaserdock has printed" in rejected.value.read()
        rejected.value.close()


def test_report_is_made_when_it_is_asked_for_and_served_below_the_token() -> None:
    """Until it is ready, a page that asks again stands for it."""
    report = ReportPage()
    assert report()[0] == 404
    report.log = GOLDEN
    with page_server("127.0.0.1", None, TOKEN, {"report.html": report}) as server:
        with pytest.raises(urllib.error.HTTPError, match="404") as rejected:
            urllib.request.urlopen(f"{address(server)}/report.html")
        rejected.value.close()
        with urllib.request.urlopen(f"{address(server)}/{TOKEN}/report.html") as response:
            assert b'http-equiv="refresh"' in response.read()
        report.wait()
        with urllib.request.urlopen(f"{address(server)}/{TOKEN}/report.html") as response:
            page = response.read().decode()
    assert 'http-equiv="refresh"' not in page
    assert 'id="figures"' in page
    broken = ReportPage(GOLDEN.with_name("none.mcap"))
    broken()
    broken.wait()
    assert broken()[0] == 500


def test_token_is_random_or_that_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    assert page_token() != page_token()
    monkeypatch.setenv(TOKEN_VARIABLE, TOKEN)
    assert page_token() == TOKEN
    monkeypatch.setenv(TOKEN_VARIABLE, "short/")
    with pytest.raises(ViewError, match=f"{TOKEN_VARIABLE}: give at least 16 letters"):
        page_token()


@pytest.mark.slow
def test_viewer_without_a_router_reports_it_and_can_be_stopped() -> None:
    endpoint = f"tcp/127.0.0.1:{unused_port()}"
    process = chaserdock(
        "view", "-m", "client", "-e", endpoint, stdout=PIPE, stderr=STDOUT, text=True
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline().endswith("shows the mission; Ctrl-C ends this\n")
        line = (
            f"viewer: no router at {endpoint} accepts the connection; is it running? The viewer "
            "waits for it.\n"
        )
        assert process.stdout.readline() == line
        process.send_signal(signal.SIGTERM)
        assert process.stdout.read() == ""
        assert process.wait(timeout=60) == 130
    finally:
        process.kill()


def test_occupied_port_is_reported_or_skipped() -> None:
    with page_server("127.0.0.1", None, TOKEN) as first:
        with pytest.raises(
            ViewError, match=f"port {first.get_port()} of 127.0.0.1: .*; choose another with --port"
        ):
            page_server("127.0.0.1", first.get_port(), TOKEN).__enter__()
        with page_server("127.0.0.1", None, TOKEN) as second:
            assert second.get_port() != first.get_port()
            assert url_of("127.0.0.1", second.get_port(), TOKEN) == f"{address(second)}/{TOKEN}/"
    with pytest.raises(ViewError, match=r"--host 203\.0\.113\.7"):
        page_server("203.0.113.7", None, TOKEN).__enter__()


def test_access_rights_give_ground_truth_to_viewers_only(tmp_path: Path) -> None:
    keys = make_keys(tmp_path / "keys")
    with router_with_rights(keys) as endpoint:
        world = Node("world", "world", client(keys, "world", endpoint))
        nodes = {
            who: Node("viewer", "viewer", client(keys, who, endpoint))
            for who in ("viewer", "operator")
        }
        try:
            takers = {
                (who, topic.key): node.subscribe_newest(
                    topic, 4, "target" if topic is topics.TRUTH_BODY else None
                )
                for who, node in nodes.items()
                for topic in (topics.TICK, topics.TRUTH_BODY, topics.EVENT)
            }
            truth = BodyTruth(
                body="target",
                position_m=(0, 0, 0),
                velocity_m_s=(0, 0, 0),
                q_wxyz=UPRIGHT,
                omega_rad_s=(0, 0, 0),
            )
            wanted = {key for key in takers if key != ("operator", topics.TRUTH_BODY.key)}
            got: set[tuple[str, str]] = set()
            deadline = time.monotonic() + 60.0
            while got != wanted and time.monotonic() < deadline:
                world.publish(topics.TICK, Tick(images=False, chasers=()))
                world.publish(topics.TRUTH_BODY, truth, "target")
                world.publish(topics.EVENT, Event(process="world", level="info", what="x"), "world")
                time.sleep(0.1)
                got |= {key for key, take in takers.items() if take()}
            assert got == wanted
        finally:
            for node in (world, *nodes.values()):
                node.close()


def test_subscriber_gets_the_newest_and_never_blocks_the_publisher() -> None:
    """Of 5,000 unread messages the last four are kept; the publisher is not delayed."""
    endpoint = f"tcp/127.0.0.1:{free_port(DEFAULT_HOST, None)}"
    link = Link("follow", (), (endpoint,))
    world, looker = Node("world", "world", link), None
    try:
        looker = Node("viewer", "viewer", Link("follow", (endpoint,), ()))
        take = looker.subscribe_newest(topics.TICK, 4)
        world.advertise(topics.TICK)
        deadline, got = time.monotonic() + 60.0, []
        while not got and time.monotonic() < deadline:  # until they know each other
            world.publish(topics.TICK, Tick(tick=0, images=False, chasers=()))
            time.sleep(0.05)
            got = take()
        assert got
        for tick in range(1, 5001):
            world.publish(topics.TICK, Tick(tick=tick, images=False, chasers=()))
        last: list[int] = []
        while last[-1:] != [5000] and time.monotonic() < deadline:
            time.sleep(0.2)
            last = [received.message.tick for received in take()] or last
        assert last == [4997, 4998, 4999, 5000]
        assert looker.counts.lost.total() == 0
    finally:
        world.close()
        if looker is not None:
            looker.close()
