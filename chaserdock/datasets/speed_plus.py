# SPDX-License-Identifier: Apache-2.0
"""Layout of SPEED+ (T. H. Park et al., "SPEED+: Next-Generation Dataset for Spacecraft Pose
Estimation across Domain Gap", 2022).

``camera.json`` holds camera matrix and distortion as OpenCV defines them. A label names its image.
``q_vbs2tango_true``: rotation from the target's axes to the camera's (scalar first), with x_camera
= R(q) x_target + r. ``r_Vo2To_vbs_true``: the position r of the target's origin in the camera, m.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.meshes import TriangleMesh
from chaserdock_protocol.output_files import write_atomically

from chaserdock.images import write_image

from .json_files import numbers, read_list, read_object, write_json
from .model_files import read_models, write_models
from .types import DatasetError, LabelledDataset, LabelledImage, PoseLabel, Split, TargetShape
from .views import ViewImage

_DOMAIN = "synthetic"
_PIXEL_M = 5.86e-6
"""Pixel pitch in ``camera.json``, m: that of the SPEED+ camera. It only gives the focal length in
metres.
"""
_Q, _R = "q_vbs2tango_true", "r_Vo2To_vbs_true"
_SPLITS: tuple[Split, ...] = ("train", "validation")


class SpeedPlusWriter:
    """Writes a dataset into ``folder``: ``camera.json``, and ``synthetic/`` with images, masks and
    labels. For ADD it adds ``models`` as in BOP, which SPEED+ does not have. Raises OSError.
    """

    def __init__(
        self, folder: Path, camera: Camera, mesh: TriangleMesh, shape: TargetShape
    ) -> None:
        self._domain = folder / _DOMAIN
        for name in ("images", "masks"):
            (self._domain / name).mkdir(parents=True)
        write_models(mesh, shape, folder / "models")
        write_json(folder / "camera.json", _camera_values(camera))
        self._labels: dict[Split, list[dict[str, Any]]] = {"train": [], "validation": []}

    def add(self, number: int, split: Split, image: ViewImage) -> None:
        """Write image ``number``, from 0, with its mask, and keep its label."""
        name, label = f"img{number + 1:06d}.png", image.view.label
        write_image(self._domain / "images" / name, image.pixels)
        write_image(self._domain / "masks" / name, 255 * image.visible.astype(np.uint8))
        q = label.q_irf_trf_wxyz
        self._labels[split].append(
            {
                "filename": name,
                _Q: (q if q[0] >= 0.0 else -q).tolist(),
                _R: label.position_irf_m.tolist(),
            }
        )

    def close(self) -> None:
        """Write the labels."""
        for split, labels in self._labels.items():
            text = ",\n".join(json.dumps(label) for label in labels)
            write_atomically(self._domain / f"{split}.json", f"[\n{text}\n]\n")


def _camera_values(camera: Camera) -> dict[str, Any]:
    return {
        "Nu": camera.width_px,
        "Nv": camera.height_px,
        "ppx": _PIXEL_M,
        "ppy": _PIXEL_M,
        "fx": camera.fx_px * _PIXEL_M,
        "fy": camera.fy_px * _PIXEL_M,
        "ccx": camera.cx_px,
        "ccy": camera.cy_px,
        "cameraMatrix": camera.matrix().tolist(),
        "distCoeffs": list((*camera.distortion, *[0.0] * 5)[:5]),
    }


def read_speed_plus(folder: Path) -> LabelledDataset:
    """Return a dataset in the layout of SPEED+, with the labels of its synthetic images. Raises
    DatasetError.
    """
    camera = _read_camera(folder / "camera.json")
    domain = folder / _DOMAIN
    images: list[LabelledImage] = []
    for split in _SPLITS:
        file = domain / f"{split}.json"
        if file.is_file():
            images += [
                _labelled(file, domain, split, k, row) for k, row in enumerate(read_list(file))
            ]
    if not images:
        raise DatasetError(
            f"{domain}: has no labels; expected train.json or validation.json with labels"
        )
    models = folder / "models"
    shape = read_models(models) if models.is_dir() else None
    return LabelledDataset("speed+", camera, tuple(images), shape)


def _read_camera(file: Path) -> Camera:
    values = read_object(file)
    width, height = (int(numbers(file, values, key, ())) for key in ("Nu", "Nv"))
    matrix = numbers(file, values, "cameraMatrix", (3, 3))
    coefficients = (
        numbers(file, values, "distCoeffs", (5,)) if "distCoeffs" in values else np.zeros(5)
    )
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    distortion = tuple(coefficients.tolist()) if coefficients.any() else ()
    try:
        return Camera(width, height, fx, fy, cx, cy, distortion)
    except ValueError as error:
        raise DatasetError(f"{file}: {error}") from None


def _labelled(file: Path, domain: Path, split: Split, number: int, row: Any) -> LabelledImage:
    place = f"{file}: label {number}"
    if not isinstance(row, dict) or not isinstance(row.get("filename"), str):
        raise DatasetError(f"{place}: must be an object with filename, {_Q} and {_R}")
    q = numbers(place, row, _Q, (4,))
    if not abs(float(np.linalg.norm(q)) - 1.0) < 1e-3:
        raise DatasetError(
            f"{place}: {_Q} must be a unit quaternion, scalar first; its norm is "
            f"{np.linalg.norm(q):.4g}"
        )
    position = numbers(place, row, _R, (3,))
    return LabelledImage(
        domain / "images" / row["filename"], PoseLabel(position, rotations.normalize(q)), split
    )
