# SPDX-License-Identifier: Apache-2.0
"""The ONNX example: a perfect network gives the true pose, a file of `model_file` runs in the
command, errors are one line.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
from chaserdock_models import rotations
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.scenario import load_scenario
from harness import ROOT

from chaserdock.cli.main import app
from chaserdock.datasets.export import EXACT_CAMERA, export_dataset
from chaserdock.datasets.reading import read_dataset
from chaserdock.datasets.scores import pose_errors
from chaserdock.datasets.types import PoseLabel, read_grey
from chaserdock.datasets.views import ViewLimits

SETS = (
    'perception.name="model"', EXACT_CAMERA, "camera.width_px=320", "camera.height_px=180",
    'target.model="geo_servicer"',
)  # fmt: skip


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("onnx") / "d"
    scenario = load_scenario(ROOT / "scenarios/single.toml", SETS)
    export_dataset(scenario, folder, 3, ViewLimits((1.5, 3.0), 0.2, (0.0, 60.0)), ("speed+",), 1.0)
    return folder


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT / "examples/onnx_perception"))
    for name in ("onnx_perception", "model_file"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return SimpleNamespace(
        perception=importlib.import_module("onnx_perception"),
        files=importlib.import_module("model_file"),
    )


def written(example: Any, path: Path, landmarks: np.ndarray) -> None:
    """Write a network with random weights."""
    rng, weights = np.random.default_rng(1), []
    for side, inputs, outputs in example.files.FILTERS:
        weights.append((0.1 * rng.normal(size=(outputs, inputs, side, side)), np.zeros(outputs)))
    flat = (
        example.files.FILTERS[-1][2]
        * (example.perception.SIDE // 2 ** len(example.files.FILTERS)) ** 2
    )
    for inputs, outputs in (
        (flat, example.files.HIDDEN),
        (example.files.HIDDEN, 2 * len(landmarks)),
    ):
        weights.append((0.05 * rng.normal(size=(inputs, outputs)), np.zeros(outputs)))
    facts = {
        "landmarks_m": json.dumps(landmarks.tolist()), "sigma": json.dumps([0.01] * 6),
        "most_rms": "0.05",
    }  # fmt: skip
    onnx.save(example.files.network(weights, facts), str(path))


def corners(dataset: Path) -> np.ndarray:
    shape = read_dataset(dataset)[0].shape
    assert shape is not None
    return shape.points_m[np.linspace(0, len(shape.points_m) - 1, 12).astype(int)]


@pytest.mark.slow
def test_perfect_landmarks_give_the_true_pose(
    dataset: Path, example: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The crop's map, the distortion-free pixels and PnP: only the network is replaced."""
    landmarks = corners(dataset)
    written(example, tmp_path / "n.onnx", landmarks)
    monkeypatch.setenv("CHASERDOCK_ONNX", str(tmp_path / "n.onnx"))
    data, _ = read_dataset(dataset)
    perception = example.perception.OnnxPerception(data.camera, None)
    for item in data.images:
        image, label = read_grey(item.path, data.camera), item.label
        at = data.camera.project(
            rotations.rotate(label.q_irf_trf_wxyz, landmarks) + label.position_irf_m
        )
        region = example.perception.find_region(image)
        assert region is not None
        patch, to_image = example.perception.crop(image, *region)
        assert patch.shape == (64, 64)
        unit = (at - to_image[:, 2]) @ np.linalg.inv(to_image[:, :2]).T
        assert np.abs(unit).max() < 1.0  # the region contains the target
        perception.session = SimpleNamespace(run=lambda names, inputs, unit=unit: [unit[None]])
        (pose,) = perception.estimate(image).solutions
        errors = pose_errors(PoseLabel(pose.position_irf_m, pose.q_irf_trf_wxyz), label, None)
        assert errors.score_2019 < 1e-5


def test_network_file_runs_in_the_command(
    dataset: Path,
    example: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    written(example, tmp_path / "n.onnx", corners(dataset))
    monkeypatch.setenv("CHASERDOCK_ONNX", str(tmp_path / "n.onnx"))
    words = [
        "dataset",
        str(dataset),
        "--perception",
        "onnx_perception:OnnxPerception",
        "--json",
    ]
    app(words, standalone_mode=False)
    figures = json.loads(capsys.readouterr().out)
    assert figures["images"] == 3
    assert figures["speed_score_2019"] > 0.1  # its weights are random


@pytest.mark.parametrize("content", [None, b"no network"])
def test_missing_or_damaged_network_is_one_line(
    content: bytes | None,
    dataset: Path,
    example: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = tmp_path / "n.onnx"
    if content is not None:
        path.write_bytes(content)
    monkeypatch.setenv("CHASERDOCK_ONNX", str(path))
    words = [
        "dataset",
        str(dataset),
        "--perception",
        "onnx_perception:OnnxPerception",
    ]
    with pytest.raises(
        ChaserdockError, match=r"CHASERDOCK_ONNX .*n\.onnx: no network of train\.py"
    ) as caught:
        app(words, standalone_mode=False)
    assert len(str(caught.value).splitlines()) == 1
