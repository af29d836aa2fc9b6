# SPDX-License-Identifier: Apache-2.0
"""Path-traced films and datasets: where bodies are, what is kept, what is said without mitsuba."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario
from chaserdock_world.rendering.background import Light
from numpy.typing import NDArray

from chaserdock.analysis.chase_camera import Shot, Viewpoint
from chaserdock.analysis.dressed_bodies import Coat
from chaserdock.analysis.video import FastBodies
from chaserdock.cli.main import app
from chaserdock.datasets.views import ViewLimits, ViewRenderer
from chaserdock.film import camera_images, frames
from chaserdock.film.path_tracer import require_mitsuba

needs_mitsuba = pytest.mark.skipif(
    importlib.util.find_spec("mitsuba") is None, reason="the extra film is not installed"
)
SCENARIO = load_scenario(find_scenario("demo"))
LOOK = Viewpoint(np.array([-0.3, 0.0, 0.0]), 2.0, -1.0, 0.4, 160, 90, (60.0, 50.0))


def shot(name: str, away_m: float) -> Shot:
    turned = rotations.exp(np.array([0.1, 0.2, 0.3]))
    chaser = (np.array([-away_m, 0.1, -0.05]), rotations.IDENTITY)
    return Shot(name, LOOK, (np.zeros(3), turned), {0: chaser})


@pytest.fixture(autouse=True)
def plain_variant(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (frames, camera_images):
        monkeypatch.setattr(module, "fastest_variant", lambda: "scalar_rgb")


@needs_mitsuba
def test_bodies_are_where_the_fast_renderer_draws_them_and_resuming_draws_what_is_missing(
    tmp_path: Path,
) -> None:
    shots = [shot("00000", 0.7), shot("00001", 0.6)]
    bodies = frames.PathTracedBodies(SCENARIO, tmp_path, shots, 4, 1)
    assert bodies.drawn == 2
    fast = FastBodies(SCENARIO)
    for one in shots:
        ours, known = bodies.render(one), fast.render(one)
        both, either = ours.covered & known.covered, ours.covered | known.covered
        # The reconstruction filter spreads edges by a pixel.
        assert both.sum() > 0.97 * known.covered.sum() > 500
        assert both.sum() > 0.85 * either.sum()
        assert np.array_equal(ours.behind, known.behind)
        bright = [image[both].mean() for image in (ours.bgr, known.bgr)]
        assert bright[0] == pytest.approx(bright[1], rel=0.25)

    first, second = ((tmp_path / f"0000{k}.png") for k in (0, 1))
    kept = first.stat().st_mtime_ns, second.read_bytes()
    second.unlink()
    assert frames.PathTracedBodies(SCENARIO, tmp_path, shots, 4, 1).drawn == 1
    assert first.stat().st_mtime_ns == kept[0]
    assert second.read_bytes() == kept[1]  # the same seed
    assert frames.PathTracedBodies(SCENARIO, tmp_path, shots, 4, 1).drawn == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["00000.png", "00001.png", frames.PLAN]
    # Of another film, nothing is kept.
    moved = [shot("00000", 0.8)]
    assert frames.PathTracedBodies(SCENARIO, tmp_path, moved, 4, 1).drawn == 1
    assert not second.exists()


def test_without_mitsuba_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ChaserdockError, match=r"needs? mitsuba.*pip install -e '\.\[film\]'"):
        require_mitsuba()
    with pytest.raises(ChaserdockError, match="mitsuba"):
        frames.PathTracedBodies(SCENARIO, tmp_path / "none", [], 4, 1)
    assert not (tmp_path / "none").exists()


@needs_mitsuba
@pytest.mark.slow
def test_pictures_of_another_mesh_in_the_same_file_are_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shots = [shot("00000", 0.7)]
    frames.PathTracedBodies(SCENARIO, tmp_path, shots, 1, 1)
    bodies = frames._bodies
    monkeypatch.setattr(frames, "_bodies", lambda *of: bodies(*of)[::-1])
    assert frames.PathTracedBodies(SCENARIO, tmp_path, shots, 1, 1).drawn == 1


CAMERA = (
    "camera.intrinsics={width_px=320, height_px=200, fx_px=290.0, fy_px=255.0, cx_px=171.0, "
    "cy_px=92.0, distortion=[-0.25, 0.08, 0.001, -0.0005, 0.0]}"
)
"""Pixels that are not square, an axis off the middle, a distorting lens."""
TARGETS = {"mesh": ("markerless-docking", 1.2), "boxes with markers": ("single", 0.4)}
"""Scenario, and distance (m) from which the target fills a quarter of the image."""


def outline_filled(image: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What the outer outlines of a mask enclose."""
    lines, _ = cv2.findContours(image.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros(image.shape, np.uint8)
    cv2.drawContours(filled, lines, -1, 1, cv2.FILLED)
    return filled > 0


@needs_mitsuba
@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_images_of_a_dataset_have_the_outline_of_the_labels(
    target: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of the outline within a pixel, and the mask as a whole within a tenth of one."""
    white = Coat((1.0, 1.0, 1.0))
    monkeypatch.setattr(camera_images, "grey_coat", lambda material: white)
    monkeypatch.setattr(camera_images, "_PAPER", white)
    monkeypatch.setattr(camera_images, "_INK", white)
    sets = ('navigation.grade="exact"', CAMERA, "camera.effects.point_spread_px=0.0")
    name, range_m = TARGETS[target]
    scenario = load_scenario(find_scenario(name), sets)
    views = ViewRenderer(scenario, ViewLimits((range_m, 1.5 * range_m), 0.4))
    traced = camera_images.path_tracing(scenario, 16, 1)(views.camera)
    even = Light(sun=0.0, ambient=1.0)
    for number in range(3):
        known = views.render(number)
        label, q = known.view.label, known.view.q_w_irf_wxyz
        at, q_w_trf = rotations.rotate(q, label.position_irf_m), label.q_irf_trf_wxyz
        q_w_trf = rotations.multiply(q, q_w_trf)
        image, space = (
            traced.render(np.zeros(3), q, place, q_w_trf, (), even).astype(float)
            for place in (at, -1e3 * at)
        )
        seen = outline_filled(image - space > 0.45 * (235.0 - space))
        mask = outline_filled(known.mask)
        wider, narrower = (
            change(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            for change in (cv2.dilate, cv2.erode)
        )
        moved = np.subtract(*(np.argwhere(m).mean(axis=0) for m in (seen, mask)))
        assert not np.any(narrower & ~seen)
        assert not np.any(seen & ~wider)
        assert mask.sum() > 2000
        assert np.abs(moved).max() < 0.1
        assert seen.sum() == pytest.approx(mask.sum(), rel=0.01)


@needs_mitsuba
@pytest.mark.slow
def test_path_tracing_changes_the_images_of_a_dataset_alone(tmp_path: Path) -> None:
    common = [
        "dataset",
        "single",
        "--images",
        "1",
        "--format",
        "speed+",
        "--quiet",
        "--set",
        CAMERA,
    ]
    files = {}
    for renderer, more in (("fast", []), ("path", ["--samples", "4", "--jobs", "2"])):
        for name in (renderer, renderer + " again"):
            out = tmp_path / name
            arguments = [*common, "--out", str(out), "--renderer", renderer, *more]
            app(arguments, standalone_mode=False)
            found = sorted(p for p in out.rglob("*") if p.is_file())
            files[name] = {str(p.relative_to(out)): p.read_bytes() for p in found}
    fast, path = files["fast"], files["path"]
    assert path == files["path again"]
    changed = {name for name in fast if fast[name] != path[name]}
    assert changed == {"dataset.json", "speedplus/synthetic/images/img000001.png"}
    stated = json.loads(path["dataset.json"])
    assert (stated["renderer"], stated["path_samples"]) == ("path", 4)


def test_a_dataset_without_mitsuba_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    out = tmp_path / "none"
    arguments = ["dataset", "single", "--images", "1", "--out", str(out), "--renderer", "path"]
    with pytest.raises(ChaserdockError, match=r"needs mitsuba.*pip install -e '\.\[film\]'"):
        app(arguments, standalone_mode=False)
    assert not out.exists()
