# SPDX-License-Identifier: Apache-2.0
"""Images of a flight as sequences: markers are where poses and cameras of each layout say, and the
true motion is that of the log.
"""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import BodyTruth
from harness import ROOT
from numpy.typing import NDArray

from chaserdock.cli.main import app
from chaserdock.datasets.sequences import colmap_camera, export_sequence
from chaserdock.datasets.types import DatasetError, check_camera
from chaserdock.logs import open_log

LOG = ROOT / "tests/golden/two-chasers.mcap"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sequences") / "made"
    assert export_sequence(LOG, folder, ("euroc", "colmap")) == {0: 18, 1: 18}
    return folder


def marker_errors_px(
    file: Path, k: NDArray[Any], q: NDArray[Any], t: NDArray[Any]
) -> list[NDArray[Any]]:
    """Return by how far the centres (2,) of the markers that OpenCV finds in an image are off, for
    a camera matrix ``k`` and a pose x_camera = R(q) x_target + t. Pixel coordinates begin at the
    corner of the image.
    """
    target = open_log(LOG).scenario.target_model()
    pixels = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    assert pixels is not None
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    found, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(pixels)
    by_id = {m.id: m for m in target.markers}
    errors = []
    for corners, number in zip(found, [] if ids is None else map(int, ids.ravel()), strict=True):
        points = rotations.rotate(q, by_id[number].corners_trf_m()) + t
        image = points @ k.T
        where = image[:, :2] / image[:, 2:] - 0.5
        errors.append((where - corners[0]).mean(axis=0))
    return errors


def assert_small(errors_px: list[NDArray[Any]]) -> None:
    """Half a pixel, by which the conventions of layouts differ, would be seen."""
    assert len(errors_px) > 30
    assert np.abs(np.median(errors_px, axis=0)).max() < 0.25
    assert np.linalg.norm(errors_px, axis=1).max() < 0.6


def test_colmap_poses_put_the_markers_where_they_are(exported: Path) -> None:
    sparse = exported / "colmap" / "sparse" / "0"
    cameras = {}
    for line in (sparse / "cameras.txt").read_text().splitlines()[1:]:
        number, model, _, _, fx, fy, cx, cy = line.split()
        assert model == "PINHOLE"
        cameras[number] = np.array(
            [[float(fx), 0.0, float(cx)], [0.0, float(fy), float(cy)], [0.0, 0.0, 1.0]]
        )
    rows = [r.split() for r in (sparse / "images.txt").read_text().splitlines()[1:] if r]
    assert [int(r[0]) for r in rows] == list(range(1, 37))
    errors = []
    for row in rows:
        pose = np.array([float(x) for x in row[1:8]])
        file = exported / "colmap" / "images" / row[9]
        errors += marker_errors_px(file, cameras[row[8]], pose[:4], pose[4:])
    assert_small(errors)


def test_euroc_poses_put_the_markers_where_they_are(exported: Path) -> None:
    errors = []
    for mav in sorted((exported / "euroc").glob("chaser-*/mav0")):
        text = (mav / "cam0" / "sensor.yaml").read_text()
        numbers = {
            key: json.loads(re.search(rf"{key}: (\[.*\])", text)[1])  # type: ignore[index]
            for key in ("data", "intrinsics", "distortion_coefficients")
        }
        assert numbers["distortion_coefficients"] == [0.0] * 4
        fx, fy, cx, cy = numbers["intrinsics"]
        k = np.array([[fx, 0.0, cx + 0.5], [0.0, fy, cy + 0.5], [0.0, 0.0, 1.0]])
        mounting = np.reshape(numbers["data"], (4, 4))
        with (mav / "state_groundtruth_estimate0" / "data.csv").open() as file:
            states = {row[0]: [float(x) for x in row[1:]] for row in list(csv.reader(file))[1:]}
        with (mav / "cam0" / "data.csv").open() as file:
            images = list(csv.reader(file))[1:]
        assert len(images) == len(states) == 18
        for time_ns, name in images:
            body = np.eye(4)
            body[:3, :3] = rotations.to_matrix(states[time_ns][3:7])
            body[:3, 3] = states[time_ns][:3]
            into = np.linalg.inv(body @ mounting)
            q = rotations.from_matrix(into[:3, :3])
            errors += marker_errors_px(mav / "cam0" / "data" / name, k, q, into[:3, 3])
    assert_small(errors)


def test_velocities_are_those_seen_from_the_rotating_target(exported: Path) -> None:
    truth = exported / "euroc" / "chaser-1" / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    rows = np.loadtxt(truth, delimiter=",", comments="#")
    times_s = rows[:, 0] / 1e9
    moved = (rows[2:, 1:4] - rows[:-2, 1:4]) / (times_s[2:] - times_s[:-2])[:, None]
    stated = rows[1:-1, 8:11]
    assert np.abs(stated).max() > 0.02
    assert np.abs(moved - stated).max() < 5e-4
    assert not rows[:, 11:].any()


def test_positions_are_those_of_the_log(exported: Path) -> None:
    truth = exported / "euroc" / "chaser-0" / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    rows = np.loadtxt(truth, delimiter=",", comments="#")
    states = {(m.body, m.sim_time_ns): m for m in open_log(LOG).messages(BodyTruth)}
    for row in rows:
        own, target = states["chaser/0", int(row[0])], states["target", int(row[0])]
        apart = np.linalg.norm(np.subtract(own.position_m, target.position_m))
        assert np.linalg.norm(row[1:4]) == pytest.approx(apart, abs=1e-12)


def test_lenses_that_a_layout_cannot_state_are_refused() -> None:
    camera = Camera(64, 48, 50.0, 51.0, 31.0, 24.0, (-0.2, 0.05, 1e-3, 2e-3))
    fisheye = replace(camera, lens_model="equidistant")
    rational = replace(camera, distortion=(-0.2, 0.05, 1e-3, 2e-3, 0.01, 0.1, 0.02, 0.001))
    for layout in ("euroc", "colmap"):
        check_camera(camera, layout)
        check_camera(fisheye, layout)
    check_camera(rational, "colmap")
    with pytest.raises(DatasetError, match=r"euroc has 0 to 4 .*with 8; use --format colmap"):
        check_camera(rational, "euroc")
    prism = replace(rational, distortion=(*rational.distortion, 0.0, 0.0, 0.0, 1e-3))
    with pytest.raises(DatasetError, match=r"colmap has 0 to 8 .*with 12$"):
        check_camera(prism, "colmap")
    assert colmap_camera(camera) == "OPENCV 64 48 50.0 51.0 31.5 24.5 -0.2 0.05 0.001 0.002"
    assert colmap_camera(fisheye).startswith("OPENCV_FISHEYE 64 48 50.0 51.0 31.5 24.5 -0.2 ")
    assert colmap_camera(rational).split()[-4:] == ["0.01", "0.1", "0.02", "0.001"]
    five = replace(camera, distortion=(*camera.distortion, 0.01))
    assert colmap_camera(five).split()[-4:] == ["0.01", "0.0", "0.0", "0.0"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--format", "bop"], "not for a flight; give euroc or colmap"),
        (["--images", "3"], "not for a flight"),
    ],
)
def test_options_of_drawn_images_are_refused(
    arguments: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        app(["dataset", str(LOG), "--out", str(tmp_path / "made"), *arguments])
    assert ended.value.code == 2 or ended.value.code == 1
    assert text in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "made").exists()


def test_sequences_need_a_flight_and_a_new_folder(
    exported: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(DatasetError, match="exists already; give a new folder"):
        export_sequence(LOG, exported, ("euroc",))
    with pytest.raises(SystemExit):
        app(["dataset", "single", "--out", "never", "--images", "2", "--format", "euroc"])
    assert "--format euroc: only for a flight" in " ".join(capsys.readouterr().err.split())
