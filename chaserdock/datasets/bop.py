# SPDX-License-Identifier: Apache-2.0
"""The layout of BOP datasets (T. Hodan et al., "BOP: Benchmark for 6D Object Pose Estimation",
2018; docs of bop_toolkit).

Lengths are in millimetres, rotations row-wise from the model to the camera. Written: one grey scene
per split with one object, no depth images. Read: any scenes, of which one object is selected.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera, focal_and_centre
from chaserdock_models.meshes import TriangleMesh
from numpy.typing import NDArray

from chaserdock.images import write_image

from .json_files import numbers, read_object, write_json
from .model_files import OBJECT, read_models, write_models
from .types import (
    DatasetError,
    LabelledDataset,
    LabelledImage,
    PoseLabel,
    Selection,
    Split,
    TargetShape,
    check_camera,
    read_pixels,
)
from .views import ViewImage

_SCENE = "000000"
_FOLDERS: dict[Split, str] = {"train": "train", "validation": "val"}
_SPLITS: dict[str, Split] = {"train": "train", "val": "validation", "test": "validation"}
_LABELS = "scene_gt.json"
_IMAGE_FOLDERS = ("gray", "rgb")
_MODEL_FOLDERS = ("models", "models_eval", "models_cad", "models_reconst")
_LEAST_VISIBLE_SHARE = 0.1  # of an instance; the BOP challenges score none that shows less
_EVERYTHING = Selection()


class BopWriter:
    """Writes a dataset into ``folder``: ``camera.json``, ``models``, ``models_eval``, ``train`` and
    ``val``.

    Raises OSError, and DatasetError for a camera with lens distortion, which the format does not
    support.
    """

    def __init__(
        self, folder: Path, camera: Camera, mesh: TriangleMesh, shape: TargetShape
    ) -> None:
        check_camera(camera, "bop")
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


def domains_of(folder: Path) -> list[str]:
    """Return the domains of a dataset in the layout of BOP: folders of scenes with labels, such as
    ``test`` or ``train_pbr``.
    """
    return sorted(
        {
            file.parent.parent.name
            for file in folder.glob(f"*/[0-9]*/{_LABELS}")
            if _split_of(file.parent.parent.name) is not None
        }
    )


def _split_of(domain: str) -> Split | None:
    """Return the split of a domain, by the first part of its name; None for another folder."""
    return _SPLITS.get(domain.partition("_")[0])


def read_bop(folder: Path, wanted: Selection = _EVERYTHING) -> LabelledDataset:
    """Return the images of a BOP dataset that show the wanted object. Raises DatasetError.

    Without a domain, all those of the wanted split are read; ``val`` and ``test`` count as
    validation. Images of one camera and size are needed. An image with several instances of the
    object is kept once. As in BOP, an instance of which less than a tenth is visible does not
    count.
    """
    domains = domains_of(folder)
    if wanted.domain is not None and wanted.domain not in domains:
        raise DatasetError(
            f"{folder}: has no domain {wanted.domain}; give --domain: {' or '.join(domains)}"
        )
    found: list[_Instance] = []
    for domain in _chosen_domains(domains, wanted):
        for scene in sorted(p.parent for p in (folder / domain).glob(f"[0-9]*/{_LABELS}")):
            found += _read_scene(scene)
    number = _object(folder, wanted.object, found)
    images: dict[Path, list[_Instance]] = {}
    for instance in found:
        if instance.object == number:
            images.setdefault(instance.path, []).append(instance)
    labelled = [
        LabelledImage(path, first.label, first.split, tuple(i.label for i in others))
        for path, (first, *others) in images.items()
    ]
    chosen = wanted.of_split(labelled, folder)
    camera = _camera(folder, {i.path: i.matrix for i in found if i.object == number})
    models = next((folder / m for m in _MODEL_FOLDERS if (folder / m).is_dir()), None)
    shape = None if models is None else read_models(models, number)
    return LabelledDataset("bop", camera, tuple(chosen), shape, wanted.domain, number)


def _chosen_domains(domains: list[str], wanted: Selection) -> list[str]:
    """Return the domains to read: of large ones, only those that are needed."""
    if wanted.domain is not None:
        return [wanted.domain]
    validation = [d for d in domains if _split_of(d) == "validation"]
    if wanted.split == "validation" or (wanted.split is None and validation):
        return validation or domains
    train = [d for d in domains if _split_of(d) == "train"]
    return train or domains if wanted.split == "train" else domains


def _object(folder: Path, wanted: int | None, found: list[_Instance]) -> int:
    objects = sorted({instance.object for instance in found})
    if not objects:
        raise DatasetError(
            f"{folder}: has no labelled images; expected train/000000/scene_gt.json or the like"
        )
    if wanted is None and len(objects) == 1:
        return objects[0]
    if wanted not in objects:
        given = "several objects" if wanted is None else f"no object {wanted} in its images"
        raise DatasetError(
            f"{folder}: has {given}; give --object: {', '.join(str(n) for n in objects)}"
        )
    return wanted


def _camera(folder: Path, matrices: dict[Path, Array]) -> Camera:
    """Return the camera of images: its matrix by their labels, its size by the first image."""
    path, first = next(iter(matrices.items()))
    other = next((p for p, m in matrices.items() if not _same(m, first)), None)
    if other is not None:
        raise DatasetError(
            f"{folder}: cam_K differs between images, {path} and {other}; a perception is made for "
            "one camera: give --domain, or the images of one camera"
        )
    height, width = read_pixels(path).shape
    try:
        fx, fy, cx, cy = focal_and_centre(first)
        return Camera(width, height, fx, fy, cx, cy)
    except ValueError as error:
        raise DatasetError(f"{path.parents[1] / 'scene_camera.json'}: {error}") from None


def _same(a: Array, b: Array) -> bool:
    return bool(np.allclose(a, b, rtol=1e-9, atol=1e-9))


@dataclass(frozen=True, eq=False)
class _Instance:
    """An object in an image, and the image's camera matrix (3, 3)."""

    object: int
    path: Path
    label: PoseLabel
    split: Split
    matrix: Array


def _read_scene(scene: Path) -> list[_Instance]:
    split = _split_of(scene.parent.name)
    assert split is not None
    cameras, labels = read_object(scene / "scene_camera.json"), read_object(scene / _LABELS)
    info_file = scene / "scene_gt_info.json"
    info = read_object(info_file) if info_file.is_file() else {}
    found: list[_Instance] = []
    for key, rows in labels.items():
        place = f"{scene / _LABELS}: image {key}"
        if not key.isdigit() or not isinstance(rows, list):
            raise DatasetError(f"{place}: must have a list of objects")
        camera = cameras.get(key)
        if not isinstance(camera, dict):
            raise DatasetError(f"{scene / 'scene_camera.json'}: image {key} is missing")
        matrix = numbers(f"{scene / 'scene_camera.json'}: image {key}", camera, "cam_K", (3, 3))
        path = _image_file(scene, int(key))
        for row, visible in zip(rows, _visible_shares(info.get(key), len(rows)), strict=True):
            number, label = _parse_row(place, row)
            if visible >= _LEAST_VISIBLE_SHARE:
                found.append(_Instance(number, path, label, split, matrix))
    return found


def _visible_shares(rows: Any, count: int) -> list[float]:
    """Return the visible share of each object of an image; 1 where nothing states it."""
    if not isinstance(rows, list) or len(rows) != count:
        return [1.0] * count
    shares = [row.get("visib_fract") if isinstance(row, dict) else None for row in rows]
    return [float(s) if isinstance(s, int | float) else 1.0 for s in shares]


def _parse_row(place: str, row: Any) -> tuple[int, PoseLabel]:
    if not isinstance(row, dict) or type(row.get("obj_id")) is not int:
        raise DatasetError(f"{place}: an object must have cam_R_m2c, cam_t_m2c and obj_id")
    rotation = numbers(place, row, "cam_R_m2c", (3, 3))
    if (
        not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
        or np.linalg.det(rotation) < 0.0
    ):
        raise DatasetError(f"{place}: cam_R_m2c must be a rotation, row-wise")
    position = 1e-3 * numbers(place, row, "cam_t_m2c", (3,))
    return row["obj_id"], PoseLabel(position, rotations.from_matrix(rotation))


def _image_file(scene: Path, number: int) -> Path:
    """Return the image file of a number; a grey PNG that does not exist if there is none."""
    for folder in _IMAGE_FOLDERS:
        for path in sorted((scene / folder).glob(f"{number:06d}.*")):
            return path
    return scene / _IMAGE_FOLDERS[0] / f"{number:06d}.png"
