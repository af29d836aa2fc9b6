# SPDX-License-Identifier: Apache-2.0
"""Targets defined by a file: validation, rendering, detection."""

import json
from pathlib import Path

import numpy as np
import pytest
from chaserdock_agents.chaser.perception import Perception
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.targets import face_rotation
from chaserdock_protocol.scenario import load_scenario, scenario_from_json
from chaserdock_protocol.scenario.errors import ScenarioError
from chaserdock_protocol.scenario.files import find_target
from chaserdock_world.rendering.rasterizer import Renderer

from chaserdock.cli.main import app

TARGET = """
dictionary = "DICT_4X4_50"
white_margin_m = 0.01
[[cuboids]]
size_m = [0.2, 0.3, 0.25]
[[cuboids]]
size_m = [0.02, 0.4, 0.1]
position_m = [0.0, 0.35, 0.0]
[[markers]]
id = 0
side_m = 0.12
face = "-x"
at_m = [0.03, 0.02]
[[markers]]
id = 1
side_m = 0.06
face = "-x"
cuboid = 1
"""
SCENARIO = """
name = "own-target"
duration_s = 1.0
[target]
model = "mine.toml"
[[chasers]]
position_m = [-1.0, 0.0, 0.0]
q_wxyz = [1.0, 0.0, 0.0, 0.0]
"""
# The -X face upright before a camera that looks along z with y down.
FACING = rotations.from_matrix(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))


def test_target_file_is_embedded_in_the_scenario_and_detected(tmp_path):
    (tmp_path / "mine.toml").write_text(TARGET)
    (tmp_path / "s.toml").write_text(SCENARIO)
    scenario = load_scenario(tmp_path / "s.toml")
    (tmp_path / "mine.toml").unlink()
    model = scenario_from_json(scenario.model_dump_json(), "x").target_model()
    assert model == scenario.target_model()
    assert model.name == "mine"
    assert [m.id for m in model.markers] == [0, 1]
    assert model.markers[0].position_trf_m == pytest.approx((-0.1, -0.03, 0.02))
    camera = Camera.from_hfov(1280, 720, 1.0)
    position, q = (
        np.array([0.0, 0.0, 1.0]),
        rotations.multiply(FACING, rotations.exp([0.2, 0.1, 0.3])),
    )
    image = Renderer(camera, model).render(np.zeros(3), rotations.IDENTITY, position, q)
    sighting = Perception(camera, model).estimate(image)
    assert sorted(sighting.marker_ids.tolist()) == [0, 1]
    assert np.linalg.norm(sighting.solutions[0].position_irf_m - position) < 2e-3


POSE = f"position_m = [-0.11, 0.0, 0.0]\nq_wxyz = {face_rotation(1).tolist()}"
SECOND = '[[markers]]\nid = 1\nside_m = 0.06\nface = "-x"\ncuboid = 1\n'


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"DICT_4X4_50"', '"DICT_4X5_50"'), "unknown ArUco dictionary"),
        (("id = 1", "id = 50"), "markers 0 to 49"),
        (("id = 1", "id = 0"), "already used by"),
        (("cuboid = 1", "cuboid = 2"), "no cuboid 2"),
        (("at_m = [0.03, 0.02]", "at_m = [0.1, 0.02]"), "beyond its face"),
        (('face = "-x"\nat_m = [0.03, 0.02]', "side = 3"), "unknown key markers.0.side"),
        (("side_m = 0.06", "side_m = -1"), "greater than 0"),
        (("cuboid = 1", ""), "overlaps"),
        (('face = "-x"\nat_m = [0.03, 0.02]', "position_m = [0.0, 0.0, 0.0]"), "go together"),
        (('face = "-x"\nat_m = [0.03, 0.02]', POSE), "must lie on a face"),
    ],
)
def test_invalid_target_file_is_rejected(change, message, tmp_path):
    assert change[0] in TARGET
    (tmp_path / "mine.toml").write_text(TARGET.replace(*change))
    with pytest.raises(ScenarioError, match=message) as error:
        find_target(str(tmp_path / "mine.toml"))
    assert str(tmp_path / "mine.toml") in str(error.value)


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("servicer", "cuboids", 1),
        ("paper", "dictionary", "DICT_5X5_50"),
        ("chaser_body", "notes", []),
    ],
)
def test_command_states_what_becomes_of_a_target(
    name: str, key: str, value: object, capsys: pytest.CaptureFixture[str]
) -> None:
    app(["target", name, "--json"], standalone_mode=False)
    assert json.loads(capsys.readouterr().out)[key] == value
    app(["target", name], standalone_mode=False)
    assert capsys.readouterr().out.startswith(f"{name}: ")


def test_command_writes_a_mesh_that_it_can_read_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "body.glb"
    app(
        ["target", "chaser_body", "--mesh", str(path), "--tolerance-mm", "2"], standalone_mode=False
    )
    app(["target", str(path), "--json"], standalone_mode=False)
    written, _, read = capsys.readouterr().out.partition("\n")
    assert written.startswith(f"{path}: ")
    assert f"{json.loads(read)['triangles']} triangles" in written
