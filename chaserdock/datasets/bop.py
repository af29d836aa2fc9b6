# SPDX-License-Identifier: Apache-2.0
"""Layout of BOP datasets (T. Hodan et al., "BOP: Benchmark for 6D Object Pose Estimation", 2018;
docs of bop_toolkit), grey.

Lengths are in millimetres; rotations, from the model to the camera, row-wise. Each split is a
scene. There are no depth images.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.meshes import TriangleMesh
from numpy.typing import NDArray

from chaserdock.images import write_image

from .json_files import numbers, read_object, write_json
from .model_files import OBJECT, read_models, write_models
from .types import DatasetError, LabelledDataset, LabelledImage, PoseLabel, Split, TargetShape
from .views import ViewImage

_SCENE = "000000"
_FOLDERS: dict[Split, str] = {"train": "train", "validation": "val"}
_IMAGE_FOLDERS = ("gray", "rgb")


class BopWriter:
    """Writes a dataset into ``folder``: ``camera.json``, ``models``, ``models_eval``, ``train`` and
    ``val``.

    Raises OSError, and DatasetError for a camera with lens distortion, which the format does not
    support.
    """

    def __init__(
        self, folder: Path, camera: Camera, mesh: TriangleMesh, shape: TargetShape
    ) -> None:
        check_camera(camera)
        self._folder, self._camera = folder, camera
        write_models(mesh, shape, folder / "models")
        shutil.copytree(folder / "models", folder / "models_eval")
        c = camera
        values = {
            "width": c.width_px,
            "height": c.height_px,
            "fx": c.fx_px,
            "fy": c.fy_px,
            "cx": c.cx_px,
            "cy": c.cy_px,
        }
        write_json(folder / "camera.json", values | {"depth_scale": 1.0})
        self._scenes: dict[Split, dict[str, dict[str, Any]]] = {}

    def add(self, number: int, split: Split, image: ViewImage) -> None:
        """Write image ``number``, from 0, with its masks, and keep its label."""
        scene = self._folder / _FOLDERS[split] / _SCENE
        if split not in self._scenes:
            self._scenes[split] = {"scene_camera": {}, "scene_gt": {}, "scene_gt_info": {}}
            for name in ("gray", "mask", "mask_visib"):
                (scene / name).mkdir(parents=True)
        write_image(scene / "gray" / f"{number:06d}.png", image.pixels)
        for name, mask in (("mask", image.mask), ("mask_visib", image.visible)):
            write_image(scene / name / f"{number:06d}_000000.png", 255 * mask.astype(np.uint8))
        key, rows, label = str(number), self._scenes[split], image.view.label
        rows["scene_camera"][key] = {
            "cam_K": self._camera.matrix().ravel().tolist(),
            "depth_scale": 1.0,
        }
        rows["scene_gt"][key] = [
            {
                "cam_R_m2c": rotations.to_matrix(label.q_irf_trf_wxyz).ravel().tolist(),
                "cam_t_m2c": (1e3 * label.position_irf_m).tolist(),
                "obj_id": OBJECT,
            }
        ]
        rows["scene_gt_info"][key] = [_info(image)]

    def close(self) -> None:
        """Write the labels."""
        for split, files in self._scenes.items():
            for name, rows in files.items():
                write_json(self._folder / _FOLDERS[split] / _SCENE / f"{name}.json", rows)


def check_camera(camera: Camera) -> None:
    """Raise DatasetError for a camera with lens distortion."""
    if camera.distortion:
        raise DatasetError(
            "camera.intrinsics.distortion: the BOP format has no lens distortion; use --format "
            "speed+, or a camera without it"
        )


def _info(image: ViewImage) -> dict[str, Any]:
    everything, visible = int(image.silhouette.sum()), int(image.visible.sum())
    return {
        "bbox_obj": _box(image.silhouette, image.margin_px),
        "bbox_visib": _box(image.visible, (0, 0)),
        "px_count_all": everything,
        "px_count_valid": 0,
        "px_count_visib": visible,
        "visib_fract": visible / everything if everything else 0.0,
    }


def _box(mask: NDArray[np.bool_], margin_px: tuple[int, int]) -> list[int]:
    """Return left, top, width and height of a mask on a canvas with a margin around the image; -1
    for an empty one.
    """
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if not len(columns):
        return [-1, -1, -1, -1]
    left, top = int(columns[0]) - margin_px[0], int(rows[0]) - margin_px[1]
    return [left, top, int(columns[-1] - columns[0]) + 1, int(rows[-1] - rows[0]) + 1]


def read_bop(folder: Path) -> LabelledDataset:
    """Return a BOP dataset with one instance of one object per image. Raises DatasetError.

    ``val`` and ``test`` count as validation. All images must have one camera.
    """
    models = folder / "models"
    shape = read_models(models) if models.is_dir() else None
    general = read_object(folder / "camera.json")
    size = tuple(
        int(numbers(folder / "camera.json", general, key, ())) for key in ("width", "height")
    )
    images: list[LabelledImage] = []
    matrices: list[Array] = []
    for name in ("train", "val", "test"):
        for scene in sorted(p for p in (folder / name).glob("[0-9]*") if p.is_dir()):
            split: Split = "train" if name == "train" else "validation"
            found = _read_scene(scene, split)
            images += [image for image, _ in found]
            matrices += [matrix for _, matrix in found]
    if not images:
        raise DatasetError(
            f"{folder}: has no labelled images; expected train/000000/scene_gt.json or the like"
        )
    first = matrices[0]
    if any(not np.allclose(m, first, rtol=1e-9, atol=1e-9) for m in matrices):
        raise DatasetError(
            f"{folder}: cam_K differs between images; a perception is made for one camera"
        )
    fx, fy, cx, cy = (float(first[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    try:
        camera = Camera(size[0], size[1], fx, fy, cx, cy)
    except ValueError as error:
        raise DatasetError(f"{folder / 'camera.json'}: {error}") from None
    return LabelledDataset("bop", camera, tuple(images), shape)


def _read_scene(scene: Path, split: Split) -> list[tuple[LabelledImage, Array]]:
    cameras, labels = read_object(scene / "scene_camera.json"), read_object(scene / "scene_gt.json")
    found = []
    for key, rows in labels.items():
        place = f"{scene / 'scene_gt.json'}: image {key}"
        if (
            not key.isdigit()
            or not isinstance(rows, list)
            or len(rows) != 1
            or not isinstance(rows[0], dict)
        ):
            raise DatasetError(
                f"{place}: must have one object with cam_R_m2c, cam_t_m2c and obj_id"
            )
        rotation = numbers(place, rows[0], "cam_R_m2c", (3, 3))
        if (
            not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
            or np.linalg.det(rotation) < 0.0
        ):
            raise DatasetError(f"{place}: cam_R_m2c must be a rotation, row-wise")
        position = 1e-3 * numbers(place, rows[0], "cam_t_m2c", (3,))
        camera = cameras.get(key)
        if not isinstance(camera, dict):
            raise DatasetError(f"{scene / 'scene_camera.json'}: image {key} is missing")
        matrix = numbers(f"{scene / 'scene_camera.json'}: image {key}", camera, "cam_K", (3, 3))
        label = PoseLabel(position, rotations.from_matrix(rotation))
        found.append((LabelledImage(_image_file(scene, int(key)), label, split), matrix))
    return found


def _image_file(scene: Path, number: int) -> Path:
    """Return the image file of a number; a grey PNG that does not exist if there is none."""
    for folder in _IMAGE_FOLDERS:
        for path in sorted((scene / folder).glob(f"{number:06d}.*")):
            return path
    return scene / _IMAGE_FOLDERS[0] / f"{number:06d}.png"
