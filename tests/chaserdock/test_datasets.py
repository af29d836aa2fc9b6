# SPDX-License-Identifier: Apache-2.0
"""Datasets: labels agree with images and masks, layouts as published, scores, and one line for
invalid input.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from chaserdock_models import rotations
from chaserdock_models.meshes import Material, TriangleMesh
from chaserdock_models.satellites import box, satellite
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.scenario import Scenario, load_scenario
from harness import ROOT
from numpy.typing import NDArray

from chaserdock.cli.main import app
from chaserdock.datasets.export import EXACT_CAMERA, export_dataset
from chaserdock.datasets.reading import read_dataset
from chaserdock.datasets.scores import MISSED, add_m, pose_errors, summarize
from chaserdock.datasets.shapes import shape_of
from chaserdock.datasets.types import DatasetError, PoseLabel, TargetShape
from chaserdock.datasets.views import ViewLimits, ViewRenderer

SETS = (
    'perception.name="model"',
    EXACT_CAMERA,
    "camera.width_px=480",
    "camera.height_px=270",
    'target.model="geo_servicer"',
)
DISTORTED = (
    "camera.intrinsics={width_px=480, height_px=270, fx_px=415.0, fy_px=416.0, "
    "cx_px=240.5, cy_px=133.0, "
    "distortion=[-0.25, 0.08, 0.001, -0.0005, 0.0]}"
)
LIMITS = ViewLimits((1.0, 3.0), 0.5, (20.0, 100.0))


def scenario(*sets: str) -> Scenario:
    return load_scenario(ROOT / "scenarios/single.toml", (*SETS, *sets))


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("datasets") / "made"
    export_dataset(scenario("seed=5"), folder, 4, LIMITS, ("bop", "speed+"), 0.25)
    return folder


def drawn(
    vertices: NDArray[Any], triangles: NDArray[Any], shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """The mask of projected triangles, filled by OpenCV with subpixel corners."""
    mask = np.zeros(shape, np.uint8)
    for corners in np.rint(vertices[triangles] * 256.0).astype(np.int32):
        cv2.fillConvexPoly(mask, corners, 1, cv2.LINE_8, 8)
    return mask > 0


def grey(path: str) -> NDArray[np.uint8]:
    pixels = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
    assert pixels is not None
    return np.asarray(pixels, dtype=np.uint8)


def overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.slow
def test_bop_layout_read_by_other_code_agrees_with_its_masks(exported: Path) -> None:
    """Files as in the documentation of BOP, read with json, OpenCV and trimesh alone; the model
    projected by OpenCV.
    """
    root = exported / "bop"
    info = json.loads((root / "models/models_info.json").read_text())["1"]
    model = trimesh.load_mesh(str(root / "models/obj_000001.ply"))
    extent = np.ptp(model.vertices, axis=0)
    np.testing.assert_allclose([info[f"size_{a}"] for a in "xyz"], extent, atol=1e-3)
    assert 1000.0 < info["diameter"] < np.linalg.norm(extent)
    assert sorted(p.name for p in root.iterdir()) == [
        "camera.json",
        "models",
        "models_eval",
        "train",
        "val",
    ]
    for split, numbers in (("train", ["0", "1", "2"]), ("val", ["3"])):
        scene = root / split / "000000"
        gt = json.loads((scene / "scene_gt.json").read_text())
        assert list(gt) == numbers
        for number, (label,) in gt.items():
            k = np.reshape(
                json.loads((scene / "scene_camera.json").read_text())[number]["cam_K"], (3, 3)
            )
            turn, at = np.reshape(label["cam_R_m2c"], (3, 3)), np.array(label["cam_t_m2c"])
            px, _ = cv2.projectPoints(model.vertices, cv2.Rodrigues(turn)[0], at, k, None)
            mask = grey(str(scene / f"mask/{int(number):06d}_000000.png")) > 0
            assert overlap(drawn(px[:, 0], model.faces, mask.shape), mask) > 0.97
            visible = grey(str(scene / f"mask_visib/{int(number):06d}_000000.png")) > 0
            (gt_info,) = json.loads((scene / "scene_gt_info.json").read_text())[number]
            assert gt_info["px_count_visib"] == visible.sum() <= gt_info["px_count_all"]
            assert not np.any(visible & ~mask)
            left, top, width, height = gt_info["bbox_obj"]
            reach = np.array([px[:, 0].min(axis=0), px[:, 0].max(axis=0)])
            np.testing.assert_allclose(
                [[left, top], [left + width, top + height]], reach + 0.5, atol=1.6
            )


def test_both_layouts_hold_the_same_images_and_labels(exported: Path) -> None:
    bop, flight = read_dataset(exported / "bop")
    speed, _ = read_dataset(exported / "speedplus")
    assert flight is not None
    assert flight.target.model == "geo_servicer"
    assert bop.camera == speed.camera
    assert [i.split for i in speed.images] == ["train"] * 3 + ["validation"]
    for a, b in zip(bop.images, speed.images, strict=True):
        assert np.array_equal(grey(str(a.path)), grey(str(b.path)))
        np.testing.assert_allclose(a.label.position_irf_m, b.label.position_irf_m, atol=1e-12)
        assert rotations.angle_between(a.label.q_irf_trf_wxyz, b.label.q_irf_trf_wxyz) < 1e-7


@pytest.mark.slow
def test_speed_plus_labels_and_distortion_agree_with_the_mask(tmp_path: Path) -> None:
    """The convention of SPEED+: x_camera = R(q) x_target + r, then OpenCV's distortion."""
    export_dataset(scenario(DISTORTED), tmp_path / "d", 2, LIMITS, ("speed+",), 0.0)
    root = tmp_path / "d" / "speedplus"
    camera = json.loads((root / "camera.json").read_text())
    model = trimesh.load_mesh(str(root / "models/obj_000001.ply"))
    for label in json.loads((root / "synthetic/train.json").read_text()):
        w, *xyz = label["q_vbs2tango_true"]
        turn = 2.0 * np.arctan2(np.linalg.norm(xyz), w) * np.array(xyz) / np.linalg.norm(xyz)
        px, _ = cv2.projectPoints(
            1e-3 * model.vertices, turn, np.array(label["r_Vo2To_vbs_true"]),
            np.array(camera["cameraMatrix"]), np.array(camera["distCoeffs"]),
        )  # fmt: skip
        mask = grey(str(root / "synthetic/masks" / label["filename"])) > 0
        assert overlap(drawn(px[:, 0], model.faces, mask.shape), mask) > 0.95
        image = grey(str(root / "synthetic/images" / label["filename"]))
        assert image[mask].mean() > 3.0 * image[~mask].mean()


@pytest.mark.slow
def test_equal_arguments_make_equal_datasets_and_another_seed_another(
    exported: Path, tmp_path: Path
) -> None:
    export_dataset(scenario("seed=5"), tmp_path / "a", 1, LIMITS, ("speed+",), 0.0)
    export_dataset(scenario("seed=6"), tmp_path / "b", 1, LIMITS, ("speed+",), 0.0)
    name = "speedplus/synthetic/images/img000001.png"
    first = (exported / name).read_bytes()
    assert (
        tmp_path / "a" / name
    ).read_bytes() == first  # the views of a shorter dataset are those of a longer one
    assert (tmp_path / "b" / name).read_bytes() != first


def test_views_keep_their_limits() -> None:
    renderer = ViewRenderer(scenario(), LIMITS)
    to_sun = np.array(renderer._cameras.light_at(0.0).direction_w)
    ranges, phases, offsets = [], [], []
    for number in range(100):
        view = renderer.view(number)
        at = view.label.position_irf_m
        ranges.append(np.linalg.norm(at))
        sun = rotations.rotate_inverse(view.q_w_irf_wxyz, to_sun)
        phases.append(np.degrees(np.arccos(-at @ sun / ranges[-1])))
        middle = np.array([479.0, 269.0]) / 2.0
        offsets.append(np.abs(renderer.camera.project(at) - middle) / [240.0, 135.0])
    for values, low, high in ((ranges, 1.0, 3.0), (phases, 20.0, 100.0), (offsets, 0.0, 0.5)):
        assert low - 1e-9 <= np.min(values) < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < np.max(values) <= high + 1e-9


def test_speed_scores_are_those_of_the_challenges() -> None:
    truth = PoseLabel(np.array([0.0, 0.0, 2.0]), rotations.IDENTITY)

    def errors(angle_deg: float, shift_m: float) -> Any:
        q = rotations.exp(np.array([0.0, np.radians(angle_deg), 0.0]))
        return pose_errors(PoseLabel(np.array([shift_m, 0.0, 2.0]), -q), truth, None)

    small, large = errors(0.16, 0.004), errors(0.18, 0.005)
    assert small.score_2019 == pytest.approx(np.radians(0.16) + 0.002)
    assert small.score_2021 == 0.0
    assert large.score_2021 == large.score_2019 == pytest.approx(np.radians(0.18) + 0.0025)
    assert errors(0.16, 0.005).score_2021 == pytest.approx(0.0025)
    figures = summarize([small, None], None)
    assert figures["speed_score_2019"] == pytest.approx((small.score_2019 + MISSED) / 2.0)
    assert figures["with_pose"] == 1


def test_add_of_a_symmetric_target_ignores_what_cannot_be_seen() -> None:
    plain = box("box", Material("paint"), (0.3, 0.2, 0.1), (0.0, 0.0, 0.0))
    centred = shape_of(TriangleMesh("box", (plain,), {}))
    assert len(centred.symmetries) == 3  # half turns about the axes of a cuboid
    assert len(shape_of(satellite("geo_servicer", 0.001)).symmetries) == 0
    still = PoseLabel(np.array([0.0, 0.0, 2.0]), rotations.IDENTITY)
    flipped = PoseLabel(still.position_irf_m, np.array([0.0, 1.0, 0.0, 0.0]))
    assert add_m(flipped, still, centred) < 1e-9
    unlike = TargetShape(centred.points_m, centred.diameter_m, np.zeros((0, 3, 3)))
    assert add_m(flipped, still, unlike) > 0.1 * unlike.diameter_m
    moved = PoseLabel(still.position_irf_m + np.array([0.0, 0.003, 0.004]), still.q_irf_trf_wxyz)
    assert add_m(moved, still, unlike) == pytest.approx(0.005)


@pytest.mark.slow
def test_evaluate_scores_markers_in_both_layouts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = tmp_path / "m"
    words = (
        "--images 4 --range 0.8 1.0 --phase 0 60 --validation 0.75 --seed 2 --set "
        "camera.width_px=960 --set camera.height_px=540"
    )
    app(
        [
            "dataset",
            "single",
            *words.split(),
            "--out",
            str(made),
            "--set",
            'target.model="servicer"',
        ],
        standalone_mode=False,
    )
    assert "4 images of servicer, bop and speed+, seed 2" in capsys.readouterr().out
    for folder in (made / "bop", made / "speedplus"):
        app(["dataset", str(folder), "--json"], standalone_mode=False)
        figures = json.loads(capsys.readouterr().out)
        assert (figures["images"], figures["with_pose"]) == (3, 3)
        assert figures["perception"] == "default"
        assert figures["speed_score_2019"] < 0.01
        assert figures["add_m_p95"] < 0.005
        assert figures["add_right_share"] == 1.0
    app(["dataset", str(made), "--quiet"], standalone_mode=False)
    assert "images 3, with a pose 3 (100.0%)" in capsys.readouterr().out


@pytest.mark.slow
def test_evaluate_scores_shapes_without_memory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An acquisition, which a flight spreads over several images, ends in the image in which it
    begins.
    """
    folder = tmp_path / "made"
    export_dataset(
        scenario("seed=1"), folder, 3, ViewLimits((1.0, 2.0), 0.2, (20.0, 60.0)), ("speed+",), 1.0
    )
    app(["dataset", str(folder), "--json"], standalone_mode=False)
    figures = json.loads(capsys.readouterr().out)
    assert figures["perception"] == "model"
    assert (figures["images"], figures["with_pose"]) == (3, 3)
    assert figures["attitude_rad_p95"] < np.deg2rad(1.0)
    assert figures["position_share_p95"] < 0.01


BROKEN = {
    "no folder": (lambda d: shutil.rmtree(d), "no such folder"),
    "no labels": (lambda d: shutil.rmtree(d / "synthetic"), "no dataset; expected"),
    "no camera": (lambda d: (d / "camera.json").unlink(), "camera.json: cannot be read"),
    "camera without matrix": (
        lambda d: edited(d / "camera.json", "cameraMatrix", None),
        "cameraMatrix is missing",
    ),
    "negative focal length": (
        lambda d: edited(d / "camera.json", "cameraMatrix", [[-1, 0, 1], [0, 1, 1], [0, 0, 1]]),
        "focal lengths must be positive",
    ),
    "not JSON": (
        lambda d: (d / "synthetic/validation.json").write_text("{"),
        "validation.json: not JSON",
    ),
    "no list": (
        lambda d: (d / "synthetic/validation.json").write_text("{}"),
        "must contain a list",
    ),
    "quaternion": (
        lambda d: relabelled(d, "q_vbs2tango_true", [1, 1, 0, 0]),
        "must be a unit quaternion",
    ),
    "position": (
        lambda d: relabelled(d, "r_Vo2To_vbs_true", [0, "x", 1]),
        "must be 3 finite numbers",
    ),
    "missing image": (
        lambda d: (d / "synthetic/images/img000004.png").unlink(),
        "img000004.png: no such file",
    ),
    "no image": (
        lambda d: (d / "synthetic/images/img000004.png").write_text("x"),
        "img000004.png: not an image",
    ),
    "size": (
        lambda d: cv2.imwrite(
            str(d / "synthetic/images/img000004.png"), np.zeros((9, 9), np.uint8)
        ),
        "9 x 9 pixels; the camera of the dataset has 480 x 270",
    ),
    "model": (lambda d: (d / "models/obj_000001.ply").write_text("ply"), "not a PLY model"),
}


def edited(file: Path, key: str, value: Any) -> None:
    values = json.loads(file.read_text())
    values[key] = value
    file.write_text(json.dumps({k: v for k, v in values.items() if v is not None}))


def relabelled(root: Path, key: str, value: Any) -> None:
    file = root / "synthetic/validation.json"
    rows = json.loads(file.read_text())
    rows[0][key] = value
    file.write_text(json.dumps(rows))


@pytest.mark.parametrize("fault", BROKEN)
def test_bad_dataset_is_one_line(
    fault: str,
    exported: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    root = tmp_path / "speedplus"
    shutil.copytree(exported / "speedplus", root)
    shutil.copy(exported / "dataset.json", tmp_path)
    change, text = BROKEN[fault]
    change(root)
    blind = SimpleNamespace(
        Blind=lambda camera, target: SimpleNamespace(estimate=lambda image: None)
    )
    monkeypatch.setitem(sys.modules, "blind", blind)
    with pytest.raises(ChaserdockError) as caught:
        app(
            ["dataset", str(root), "--perception", "blind:Blind"],
            standalone_mode=False,
        )
    assert text in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    assert capsys.readouterr().out == ""


def test_export_refuses_what_it_cannot_label(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="use --format speed"):
        export_dataset(scenario(DISTORTED), tmp_path / "a", 1, LIMITS, ("bop",))
    assert not (tmp_path / "a").exists()
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "x").touch()
    with pytest.raises(DatasetError, match="exists already"):
        export_dataset(scenario(), tmp_path / "b", 1, LIMITS, ("bop",))
    with pytest.raises(DatasetError, match="remove the errors of the camera"):
        export_dataset(scenario('navigation.grade="lab"'), tmp_path / "c", 1, LIMITS, ("bop",))
    wrongs: tuple[dict[str, Any], ...] = (
        {"range_m": (2.0, 1.0)},
        {"phase_deg": (0.0, 181.0)},
        {"offset_share": 1.5},
    )
    for wrong in wrongs:
        with pytest.raises(DatasetError, match="must be"):
            ViewLimits(**wrong)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("default", "needs markers; the target 'geo_servicer' has none"),
        ("statistical", "needs no images"),
        ("nowhere", "perception 'nowhere' is unknown; built in:"),
        ("no_module:X", "cannot be made: ModuleNotFoundError: No module named 'no_module'"),
        ("json:Missing", "cannot be made: AttributeError"),
    ],
)
def test_unusable_perception_is_one_line(name: str, text: str, exported: Path) -> None:
    with pytest.raises(ChaserdockError) as caught:
        app(["dataset", str(exported), "--perception", name], standalone_mode=False)
    assert text in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
