# SPDX-License-Identifier: Apache-2.0
"""`chaserdock track`: files, video, page, output and errors, on photographs of a printed sheet."""

from __future__ import annotations

import csv
import json
import re
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from chaserdock_agents.gateway.cameras import (
    Captured,
    CapturedImage,
    ImageSourceError,
    UnreadableImage,
)
from chaserdock_models.targets import target_model
from sheet_views import Lens, Photograph, printed, rotation_of
from typer.testing import CliRunner

import chaserdock as cd
from chaserdock.cli.main import app
from chaserdock.tracking.live_page import LivePage
from chaserdock.tracking.run import HEADER, TrackStep, track_source

LENS = Lens(320, 240, 300.0, 300.0, 160.4, 119.1, (), samples=2)
MARKERS = ["--marker", "0=90", "--dictionary", "DICT_5X5_50"]
FIRST_NS = 1732718400_000000000


def photograph(number: int) -> np.ndarray:
    """The sheet of the paper's markers, 0 in the middle of the image, as it moves away."""
    position = np.array([0.045, 0.085, 0.45 + 0.004 * number])
    rotation = rotation_of([0.3, 0.2, 0.1]) @ np.diag([1.0, -1.0, -1.0])
    sheet = printed(target_model("paper"))
    rng = np.random.default_rng(number)
    return Photograph(LENS).of(sheet, position, rotation, rng)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four images at 20 Hz, the third without the target, and a damaged one; and a calibration."""
    top = tmp_path_factory.mktemp("track")
    (top / "images").mkdir()
    for k in range(4):
        image = photograph(k) if k != 2 else np.full((240, 320), 80, np.uint8)
        cv2.imwrite(str(top / "images" / f"{FIRST_NS + k * 50_000_000}.png"), image)
    (top / "images" / f"{FIRST_NS + 200_000_000}.png").write_bytes(b"damaged")
    write_calibration(top / "cal.yaml", LENS)
    return top


def write_calibration(path: Path, lens: Lens) -> None:
    matrix = [lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0]
    path.write_text(
        f"image_width: {lens.width}\nimage_height: {lens.height}\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {matrix}}}\n"
    )


def run(folder: Path, *arguments: str, camera: str = "cal.yaml") -> Any:
    source = [] if arguments and not arguments[0].startswith("-") else [str(folder / "images")]
    return CliRunner().invoke(app, ["track", *source, *arguments, "--camera", str(folder / camera)])


def test_poses_are_written_as_parquet_csv_tum_and_video(folder: Path, tmp_path: Path) -> None:
    names = ("p.parquet", "p.csv", "p.tum")
    outs = [part for name in names for part in ("--out", str(tmp_path / name))]
    said = run(folder, *MARKERS, *outs, "--video", str(tmp_path / "o.mp4"))
    assert said.exit_code == 0, said.stderr
    assert re.match(
        r"4 images, 3 with a pose, [\d.]+ images/s; 1 unreadable, the first: ", said.stderr
    )
    table = pq.read_table(tmp_path / "p.parquet")
    rows = table.to_pylist()
    with (tmp_path / "p.csv").open() as file:
        texts = list(csv.DictReader(file))
    assert [r["status"] for r in rows] == ["tracked", "tracked", "lost", "tracked"]
    assert [r["time_ns"] - FIRST_NS for r in rows] == [0, 50_000_000, 100_000_000, 150_000_000]
    assert rows[2]["position_m_x"] is None
    assert rows[3]["position_m_z"] > rows[0]["position_m_z"] + 0.008
    assert np.linalg.eigvalsh(np.reshape(rows[0]["covariance"], (6, 6)))[0] > 0.0
    assert list(texts[0]) == table.column_names
    assert float(texts[0]["q_w"]) == rows[0]["q_w"]
    lines = [line.split() for line in (tmp_path / "p.tum").read_text().splitlines()]
    assert [line[0] for line in lines] == [
        "1732718400.000000000", "1732718400.050000000", "1732718400.150000000"
    ]  # fmt: skip
    assert float(lines[0][7]) == rows[0]["q_w"]
    assert float(lines[0][3]) == rows[0]["position_m_z"]
    with av.open(str(tmp_path / "o.mp4")) as container:
        frames = list(container.decode(container.streams.video[0]))
    assert [round(float(frame.time or 0.0), 3) for frame in frames] == [0.0, 0.05, 0.1, 0.15]
    drawn = frames[0].to_ndarray(format="bgr24").astype(int)
    assert np.abs(drawn[..., 1] - drawn[..., 0]).max() > 60  # colour in a grey image
    printed_lines = said.stdout.splitlines()
    assert printed_lines[0] == HEADER
    assert printed_lines[3] == "1732718400.100000000 marker-0 lost"
    assert len(printed_lines[1].split()) == len(HEADER.split()) - 1


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "give one of --target, --mesh and --marker"),
        ([*MARKERS, "--target", "paper"], "give one of --target, --mesh and --marker"),
        (["--marker", "x"], "--marker x: must be ID=SIZE_MM"),
        (["--target", "paper", "--margin-mm", "3"], "only with --marker"),
        (["--target", "paper", "--scale", "3"], "only with --mesh"),
        ([*MARKERS, "--out", "p.txt"], "--out p.txt: must end in .parquet, .csv, .tum"),
        ([*MARKERS, "--marker", "1=90", "--out", "p.tum"], "a TUM file has one trajectory"),
        ([*MARKERS, "--video", "p.avi"], "--video p.avi: must end in .mp4"),
        ([*MARKERS, "--show"], "has no windows"),
        (["/dev/video97", *MARKERS], "/dev/video97: no such device"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(
    folder: Path, arguments: list[str], text: str
) -> None:
    said = run(folder, *arguments)
    assert said.exit_code == 2 or isinstance(said.exception, cd.ChaserdockError)
    line = said.stderr or str(said.exception)
    assert text in line
    assert len(line.strip().splitlines()) == 1


def test_a_calibration_of_another_resolution_ends_the_run(folder: Path, tmp_path: Path) -> None:
    write_calibration(folder / "large.yaml", Lens(1280, 720))
    out = tmp_path / "p.csv"
    said = run(folder, *MARKERS, "--out", str(out), camera="large.yaml")
    assert isinstance(said.exception, cd.ChaserdockError)
    assert "320 x 240 pixels" in str(said.exception)
    assert "is calibrated for 1280 x 720: calibrate at the resolution in use" in str(said.exception)
    assert not out.exists()


def test_a_target_that_no_image_shows_is_status_one(folder: Path) -> None:
    said = run(folder, "--marker", "9=90", "--dictionary", "DICT_5X5_50", "--quiet")
    assert said.exit_code == 1
    assert said.stdout == ""
    assert said.stderr.startswith("4 images, 0 with a pose")


# -- Ends ------------------------------------------------------------------------------------------


class Scripted:
    """A source that delivers items and raises those that are errors."""

    name, live = "scripted", True

    def __init__(self, items: list[Any]) -> None:
        self.items, self.closed = items, False

    def frames(self) -> Iterator[Captured]:
        for item in self.items:
            if isinstance(item, BaseException):
                raise item
            yield item

    def close(self) -> None:
        self.closed = True


def shot(number: int) -> CapturedImage:
    return CapturedImage(photograph(number), 50_000_000 * number, "exposure", None, number)


@pytest.fixture(scope="module")
def tracker() -> cd.Tracker:
    return cd.Tracker(LENS.camera(), {0: 0.09}, dictionary="DICT_5X5_50")


def test_a_signal_and_a_lost_camera_keep_what_was_tracked(tracker: cd.Tracker) -> None:
    for end in (KeyboardInterrupt(), BrokenPipeError(), ImageSourceError("0: has ended")):
        source, steps = Scripted([shot(0), UnreadableImage(1, "x"), shot(2), end]), []
        counts = track_source(source, tracker, [steps.append])
        assert (counts.images, counts.with_pose, counts.unreadable) == (2, 2, 1)
        assert counts.stopped == (not isinstance(end, ImageSourceError))
        assert counts.fault == ("0: has ended" if isinstance(end, ImageSourceError) else "")
        assert len(steps) == 2
        assert source.closed


def test_a_camera_that_never_delivers_is_an_error(tracker: cd.Tracker) -> None:
    source = Scripted([ImageSourceError("0: is mute")])
    with pytest.raises(ImageSourceError, match="is mute"):
        track_source(source, tracker, [])
    assert source.closed


def test_the_speed_is_that_of_the_last_images(tracker: cd.Tracker) -> None:
    steps: list[TrackStep] = []
    times = iter([0.0, 1.0, 1.5, 2.0, 9.0])
    counts = track_source(
        Scripted([shot(0), shot(1), shot(2)]), tracker, [steps.append], now_s=lambda: next(times)
    )
    assert [s.per_second for s in steps] == [1.0, 2 / 1.5, 1.5]
    assert counts.wall_s == 9.0


@pytest.mark.slow(1)
def test_ctrl_c_leaves_complete_files(folder: Path, tmp_path: Path) -> None:
    """While a run waits for the images of a slow pipe of a video."""
    many = tmp_path / "many"
    many.mkdir()
    for k in range(3000):
        (many / f"{FIRST_NS + k * 50_000_000}.png").symlink_to(
            folder / "images" / f"{FIRST_NS}.png"
        )
    out, film = tmp_path / "p.parquet", tmp_path / "o.mp4"
    process = subprocess.Popen(
        [
            sys.executable, "-m", "chaserdock", "track", str(many), "--camera",
            str(folder / "cal.yaml"), *MARKERS, "--out", str(out), "--video", str(film),
        ],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    for _ in range(5):
        process.stdout.readline()
    process.send_signal(signal.SIGINT)
    threading.Thread(target=process.stdout.read, daemon=True).start()
    assert process.stderr is not None
    error = process.stderr.read()
    assert process.wait() == 130, error
    assert "Traceback" not in error
    rows = pq.read_table(out).num_rows
    assert 4 <= rows < 3000
    with av.open(str(film)) as container:
        assert len(list(container.decode(container.streams.video[0]))) == rows


# -- Page ------------------------------------------------------------------------------------------


@pytest.fixture
def page() -> Iterator[LivePage]:
    opened = LivePage()
    yield opened
    opened.close()


def test_the_page_shows_the_newest_image_and_its_figures(page: LivePage) -> None:
    def fetched(path: str) -> bytes:
        with urllib.request.urlopen(page.url + path, timeout=30) as answer:
            return answer.read()

    assert b"chaserdock track" in fetched("")
    assert json.loads(fetched("status")) == []
    image = np.full((24, 32, 3), 77, np.uint8)
    page.show(image, ["marker-0: tracked"])
    assert json.loads(fetched("status")) == ["marker-0: tracked"]
    with urllib.request.urlopen(page.url + "stream", timeout=30) as stream:
        head = b"".join(stream.readline() for _ in range(4))
        length = int(re.findall(rb"Content-Length: (\d+)", head)[0])
        shown = cv2.imdecode(np.frombuffer(stream.read(length), np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert np.abs(shown.astype(int) - image).max() <= 2


def test_the_page_needs_its_token(page: LivePage) -> None:
    base = page.url.rsplit("/", 2)[0]
    for path in ("/", "/stream", "/status"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(base + path, timeout=30)
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(page.url + "other", timeout=30)
