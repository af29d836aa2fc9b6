# SPDX-License-Identifier: Apache-2.0
"""Path-traced films: where bodies are, what is drawn again, and what is said without mitsuba."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario

from chaserdock.analysis.chase_camera import Shot, Viewpoint
from chaserdock.analysis.video import FastBodies
from chaserdock.film import frames
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
    monkeypatch.setattr(frames, "fastest_variant", lambda: "scalar_rgb")


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
