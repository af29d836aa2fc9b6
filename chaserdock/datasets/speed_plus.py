# SPDX-License-Identifier: Apache-2.0
"""Layouts of SPEED+ (T. H. Park et al., "SPEED+: Next-Generation Dataset for Spacecraft Pose
Estimation across Domain Gap", 2022) and of SPEED (M. Kisantal et al., 2020), which is only read.

SPEED+ has a folder per domain: ``synthetic`` with labels for training and validation, ``lightbox``
and ``sunlamp`` with ``test.json``. SPEED has ``train.json`` and ``real.json`` beside ``images``.

``camera.json`` holds camera matrix and distortion as OpenCV defines them. A label names its image.
``q_vbs2tango_true`` (SPEED: ``q_vbs2tango``): rotation from the target's axes to the camera's
(scalar first), with x_camera = R(q) x_target + r. ``r_Vo2To_vbs_true``: the position r of the
target's origin in the camera, m.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.camera import Camera, focal_and_centre
from chaserdock_models.meshes import TriangleMesh
from chaserdock_protocol.output_files import write_atomically

from chaserdock.images import write_image

from .json_files import numbers, read_list, read_object, write_json
from .model_files import read_models, write_models
from .types import (
    DatasetError,
    LabelledDataset,
    LabelledImage,
    PoseLabel,
    Selection,
    Split,
    TargetShape,
)
from .views import ViewImage

_DOMAIN = "synthetic"
_PIXEL_M = 5.86e-6
"""Pixel pitch in ``camera.json``, m: that of the SPEED+ camera. It only gives the focal length in
metres.
"""
_Q, _R = "q_vbs2tango_true", "r_Vo2To_vbs_true"
_IMAGES = "images"
_LABEL_FILES: dict[str, Split] = {
    "train": "train",
    "validation": "validation",
    "test": "validation",
}
_SPEED_Q = "q_vbs2tango"
_SPEED_DOMAINS: dict[str, tuple[str, Split]] = {
    "synthetic": ("train", "train"),
    "real": ("real", "validation"),
}
"""Domain of SPEED: name of its labels and of its folder in ``images``, and split. The labels of
``test`` and ``real_test`` were not published."""
_SPEED_CAMERA = Camera(1920, 1200, 0.0176 / _PIXEL_M, 0.0176 / _PIXEL_M, 960.0, 600.0)
"""SPEED's camera: a focal length of 17.6 mm, no distortion (M. Kisantal et al., table I)."""
EVERYTHING = Selection()


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
        "distCoeffs": camera.ros_distortion()[1],
    }


def domains_of(folder: Path) -> list[str]:
    """Return the domains of a dataset in the layout of SPEED+: folders with images and labels."""
    return sorted(
        {
            file.parent.name
            for name in _LABEL_FILES
            for file in folder.glob(f"*/{name}.json")
            if (file.parent / _IMAGES).is_dir()
        }
    )


def read_speed_plus(folder: Path, wanted: Selection = EVERYTHING) -> LabelledDataset:
    """Return the images of a domain, by default the synthetic ones, of a dataset in the layout of
    SPEED+. Raises DatasetError.
    """
    domains = domains_of(folder)
    domain = _domain(folder, wanted, domains)
    camera = _read_camera(folder / "camera.json")
    images: list[LabelledImage] = []
    for name, split in _LABEL_FILES.items():
        file = folder / domain / f"{name}.json"
        if file.is_file():
            images += _read_labels(file, folder / domain / _IMAGES, split, (_Q, _R))
    models = folder / "models"
    shape = read_models(models) if models.is_dir() else None
    chosen = tuple(wanted.of_split(images, folder / domain))
    return LabelledDataset("speed+", camera, chosen, shape, domain)


def is_speed(folder: Path) -> bool:
    """Return whether a folder has the layout of SPEED."""
    return (folder / _IMAGES).is_dir() and any(
        (folder / f"{name}.json").is_file() for name, _ in _SPEED_DOMAINS.values()
    )


def read_speed(folder: Path, wanted: Selection = EVERYTHING) -> LabelledDataset:
    """Return the images of a domain, by default the synthetic ones, of a dataset in the layout of
    SPEED. Raises DatasetError.

    The camera is that of ``camera.json``, or else the published one.
    """
    domains = [d for d, (name, _) in _SPEED_DOMAINS.items() if (folder / f"{name}.json").is_file()]
    domain = _domain(folder, wanted, domains)
    name, split = _SPEED_DOMAINS[domain]
    stated = folder / "camera.json"
    camera = _read_camera(stated) if stated.is_file() else _SPEED_CAMERA
    keys = (_SPEED_Q, _R)
    images = _read_labels(folder / f"{name}.json", folder / _IMAGES / name, split, keys)
    chosen = tuple(wanted.of_split(images, folder))
    return LabelledDataset("speed", camera, chosen, None, domain)


def _domain(folder: Path, selection: Selection, domains: list[str]) -> str:
    """Return the domain to read. Raises DatasetError."""
    if selection.object is not None:
        raise DatasetError(f"{folder}: shows one target, without a number; leave out --object")
    wanted = selection.domain
    if wanted is None and (len(domains) == 1 or _DOMAIN in domains):
        return _DOMAIN if _DOMAIN in domains else domains[0]
    if wanted not in domains:
        given = "" if wanted is None else f"has no domain {wanted}; "
        raise DatasetError(f"{folder}: {given}give --domain: {' or '.join(domains)}")
    return wanted


def _read_camera(file: Path) -> Camera:
    values = read_object(file)
    width, height = (int(numbers(file, values, key, ())) for key in ("Nu", "Nv"))
    matrix = numbers(file, values, "cameraMatrix", (3, 3))
    coefficients = (
        numbers(file, values, "distCoeffs", (5,)) if "distCoeffs" in values else np.zeros(5)
    )
    distortion = tuple(coefficients.tolist()) if coefficients.any() else ()
    try:
        fx, fy, cx, cy = focal_and_centre(matrix)
        return Camera(width, height, fx, fy, cx, cy, distortion)
    except ValueError as error:
        raise DatasetError(f"{file}: {error}") from None


def _read_labels(
    file: Path, images: Path, split: Split, keys: tuple[str, str]
) -> list[LabelledImage]:
    """Read labels; ``keys``: those of attitude and position."""
    rows = enumerate(read_list(file))
    return [_labelled(f"{file}: label {k}", images, split, row, keys) for k, row in rows]


def _labelled(
    place: str, images: Path, split: Split, row: Any, keys: tuple[str, str]
) -> LabelledImage:
    q_key, r_key = keys
    if not isinstance(row, dict) or not isinstance(row.get("filename"), str):
        raise DatasetError(f"{place}: must be an object with filename, {q_key} and {r_key}")
    q = numbers(place, row, q_key, (4,))
    if not abs(float(np.linalg.norm(q)) - 1.0) < 1e-3:
        raise DatasetError(
            f"{place}: {q_key} must be a unit quaternion, scalar first; its norm is "
            f"{np.linalg.norm(q):.4g}"
        )
    position = numbers(place, row, r_key, (3,))
    return LabelledImage(
        images / row["filename"], PoseLabel(position, rotations.normalize(q)), split
    )
