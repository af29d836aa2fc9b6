# SPDX-License-Identifier: Apache-2.0
"""Public datasets as their authors publish them: domains of SPEED+ and SPEED, splits and scenes of
BOP.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from chaserdock.cli.main import app
from chaserdock.datasets.reading import read_dataset
from chaserdock.datasets.types import DatasetError, Selection

SIZE = (48, 30)
"""Width and height of the images, pixels."""
CAMERA = {
    "Nu": SIZE[0],
    "Nv": SIZE[1],
    "cameraMatrix": [[90.0, 0.0, 24.0], [0.0, 90.0, 15.0], [0.0, 0.0, 1.0]],
    "distCoeffs": [[-0.2, 0.5, 0.0, 0.0, -0.1]],
}
K = [90.0, 0.0, 24.0, 0.0, 90.0, 15.0, 0.0, 0.0, 1.0]
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""A quarter turn about the camera's axis."""
Q_TURN = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]


def picture(path: Path, size: tuple[int, int] = SIZE, kind: Any = np.uint8) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full(size[::-1], 60, kind))


def written(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def speed_labels(range_m: float, q_key: str = "q_vbs2tango_true") -> list[dict[str, Any]]:
    return [{"filename": "img000001.jpg", q_key: Q_TURN, "r_Vo2To_vbs_true": [0.1, 0.2, range_m]}]


def speed_plus(root: Path) -> None:
    written(root / "camera.json", CAMERA)
    files = {"synthetic": ("train", "validation"), "lightbox": ("test",), "sunlamp": ("test",)}
    for number, (domain, splits) in enumerate(files.items()):
        picture(root / domain / "images" / "img000001.jpg")
        for split in splits:
            written(root / domain / f"{split}.json", speed_labels(5.0 + number))


def speed_2019(root: Path) -> None:
    for name, range_m in (("train", 5.0), ("real", 6.0)):
        picture(root / "images" / name / "img000001.jpg", (1920, 1200))
        written(root / f"{name}.json", speed_labels(range_m, "q_vbs2tango"))
    written(root / "test.json", [{"filename": "img000002.jpg"}])  # without labels


def bop(root: Path) -> None:
    """Scenes of objects 1 and 2; in ``test`` object 2 twice; in ``train_pbr`` another camera."""
    written(root / "camera.json", {"width": 7, "height": 7, "fx": 1, "fy": 1, "cx": 3, "cy": 3})
    for domain, size, suffix, kind in (
        ("test", SIZE, "rgb/000000.png", np.uint8),
        ("val_primesense", SIZE, "gray/000000.tif", np.uint16),
        ("train_pbr", (64, 40), "rgb/000000.jpg", np.uint8),
    ):
        scene = root / domain / "000003"
        picture(scene / suffix, size, kind)
        matrix = [2.0 * v for v in K[:8]] + [1.0] if domain == "train_pbr" else K
        written(scene / "scene_camera.json", {"0": {"cam_K": matrix, "depth_scale": 1.0}})
        objects = [(1, 3000.0), (2, 4000.0)] + ([(2, 5000.0)] if domain == "test" else [])
        rows = [
            {"obj_id": n, "cam_R_m2c": TURN.ravel().tolist(), "cam_t_m2c": [100.0, 200.0, z]}
            for n, z in objects
        ]
        written(scene / "scene_gt.json", {"0": rows})
    for number in (1, 2):
        corners = f"{number}000 0 0\n0 100 0\n0 0 100\n-{number}000 0 0\n"
        head = "ply\nformat ascii 1.0\nelement vertex 4\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz")
        head += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        (root / "models").mkdir(exist_ok=True)
        ply = root / "models" / f"obj_{number:06d}.ply"
        ply.write_text(f"{head}{corners}3 0 1 2\n3 1 2 3\n")
    written(root / "models" / "models_info.json", {"1": {"diameter": 1.0}, "2": {"diameter": 2.0}})


def lightbox_alone(root: Path) -> None:
    speed_plus(root)
    for file in (root / "synthetic").glob("*.json"):
        file.unlink()
    for file in (root / "sunlamp").glob("*.json"):
        file.unlink()


SELECTED: dict[str, tuple[Callable[[Path], None], str, Selection, tuple[Any, ...]]] = {
    "SPEED+": (speed_plus, ".", Selection(split=None), ("synthetic", None, "validation", 5.0)),
    "SPEED+ lightbox": (
        speed_plus,
        ".",
        Selection("lightbox", split=None),
        ("lightbox", None, "validation", 6.0),
    ),
    "SPEED+ sunlamp": (
        speed_plus,
        ".",
        Selection("sunlamp", split=None),
        ("sunlamp", None, "validation", 7.0),
    ),
    "SPEED+ folder of a domain": (
        speed_plus,
        "sunlamp",
        Selection(split=None),
        ("sunlamp", None, "validation", 7.0),
    ),
    "SPEED+ one domain": (
        lightbox_alone,
        ".",
        Selection(split=None),
        ("lightbox", None, "validation", 6.0),
    ),
    "SPEED": (speed_2019, ".", Selection(split=None), ("synthetic", None, "train", 5.0)),
    "SPEED real": (speed_2019, ".", Selection("real"), ("real", None, "validation", 6.0)),
    "BOP object": (bop, ".", Selection("test", 1, None), ("test", 1, "validation", 3.0)),
    "BOP validation": (bop, ".", Selection(None, 1, "validation"), (None, 1, "validation", 3.0)),
    "BOP train_pbr": (bop, ".", Selection("train_pbr", 2, None), ("train_pbr", 2, "train", 4.0)),
    "BOP grey 16 bit": (
        bop,
        "val_primesense",
        Selection(None, 2, None),
        ("val_primesense", 2, "validation", 4.0),
    ),
}


@pytest.mark.parametrize("name", SELECTED)
def test_a_domain_an_object_and_a_split_are_read(name: str, tmp_path: Path) -> None:
    make, folder, wanted, (domain, number, split, range_m) = SELECTED[name]
    make(tmp_path)
    data, flight = read_dataset(tmp_path / folder, wanted)
    assert flight is None
    assert (data.domain, data.object) == (domain, number)
    assert {i.split for i in data.images} == {split}
    for image in data.images:
        assert image.path.is_file()
        np.testing.assert_allclose(image.label.position_irf_m, [0.1, 0.2, range_m])
        np.testing.assert_allclose(image.label.q_irf_trf_wxyz, Q_TURN, atol=1e-9)
    pixels = cv2.imread(str(data.images[0].path), cv2.IMREAD_GRAYSCALE)
    assert pixels is not None
    assert pixels.shape == (data.camera.height_px, data.camera.width_px)
    if make is bop:
        assert data.camera.fx_px == (180.0 if domain == "train_pbr" else 90.0)
        assert data.shape is not None
        assert data.shape.diameter_m == pytest.approx(2.0 * number)


def test_the_camera_of_speed_is_the_published_one(tmp_path: Path) -> None:
    speed_2019(tmp_path)
    camera = read_dataset(tmp_path)[0].camera
    assert camera.fx_px == camera.fy_px == pytest.approx(3003.413, abs=1e-3)
    assert (camera.cx_px, camera.cy_px, camera.distortion) == (960.0, 600.0, ())


REFUSED: dict[str, tuple[Callable[[Path], None], Selection, str]] = {
    "unknown domain": (
        speed_plus,
        Selection("moon"),
        "has no domain moon; give --domain: lightbox or sunlamp or synthetic",
    ),
    "object of SPEED+": (speed_plus, Selection(None, 1), "shows one target, without a number"),
    "no labels of the split": (
        speed_plus,
        Selection("lightbox", split="train"),
        "has no images in the split train; it has validation",
    ),
    "several objects": (bop, Selection("test"), "has several objects; give --object: 1, 2"),
    "unknown object": (
        bop,
        Selection("test", 7),
        "has no object 7 in its images; give --object: 1, 2",
    ),
    "unknown BOP domain": (
        bop,
        Selection("val"),
        "has no domain val; give --domain: test or train_pbr or val_primesense",
    ),
    "several cameras": (bop, Selection(None, 1), "a perception is made for one camera: give"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_a_dataset_does_not_have_is_one_line(name: str, tmp_path: Path) -> None:
    make, wanted, text = REFUSED[name]
    make(tmp_path)
    with pytest.raises(DatasetError) as caught:
        read_dataset(tmp_path, wanted)
    assert text in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_hidden_instances_do_not_count(tmp_path: Path) -> None:
    bop(tmp_path)
    shares = [{"visib_fract": share} for share in (0.05, 0.5, 0.05)]
    written(tmp_path / "test/000003/scene_gt_info.json", {"0": shares})
    with pytest.raises(DatasetError, match="has no object 1 in its images; give --object: 2"):
        read_dataset(tmp_path, Selection("test", 1))
    (image,) = read_dataset(tmp_path, Selection("test"))[0].images
    assert image.others == ()


@pytest.mark.parametrize(("range_m", "right"), [(4.0, 1.0), (5.0, 1.0), (3.0, 0.0)])
def test_any_instance_of_the_object_is_an_answer(
    range_m: float,
    right: float,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Object 2 is at 4 m and at 5 m; at 3 m there is another object."""
    bop(tmp_path)
    pose = SimpleNamespace(position_irf_m=(0.1, 0.2, range_m), q_irf_trf_wxyz=tuple(Q_TURN))
    seen = SimpleNamespace(estimate=lambda image: SimpleNamespace(solutions=[pose]))
    monkeypatch.setitem(sys.modules, "told", SimpleNamespace(Told=lambda camera, target: seen))
    words = "--scenario single --perception told:Told --domain test --object 2 --json"
    app(["dataset", str(tmp_path), *words.split()], standalone_mode=False)
    figures = json.loads(capsys.readouterr().out)
    assert (figures["format"], figures["domain"], figures["object"]) == ("bop", "test", 2)
    assert (figures["images"], figures["add_right_share"]) == (1, right)
