# SPDX-License-Identifier: Apache-2.0
"""A user's own mesh file flies as docs/howto-target.md describes: one chaser acquires it by its
shape and approaches it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from chaserdock_models.satellites import satellite
from harness import run, summary

from chaserdock import open_log
from chaserdock.analysis.dressed_bodies import target_body
from chaserdock.targets.mesh_writer import write_mesh


@pytest.mark.slow
def test_own_mesh_is_acquired_by_a_single_chaser_and_drawn(tmp_path: Path) -> None:
    write_mesh(satellite("geo_servicer", 2e-3), tmp_path / "own-servicer.glb")
    status, text = run(
        "single",
        tmp_path / "run",
        f'target.model="{tmp_path / "own-servicer.glb"}"',
        'perception.name="model"',
        "duration_s=8.0",
        "camera.width_px=640",
        "camera.height_px=360",
    )
    assert status == 0, text
    assert summary(tmp_path / "run")["events"][-1]["what"].endswith(
        "goto (from searching: the target is found)"
    )
    log = open_log(tmp_path / "run")
    assert list(log.messages("controller/target"))[-1].status == "tracking"
    shape = np.concatenate([p.vertices_m for p, _ in target_body(log.scenario).parts])
    np.testing.assert_allclose(
        shape.max(axis=0), satellite("geo_servicer").bounds_m()[1], atol=0.005
    )
