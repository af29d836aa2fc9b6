# SPDX-License-Identifier: Apache-2.0
"""Datasets in memory: labelled images, the target's points, and the errors of reading and writing
them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.errors import ChaserdockError
from numpy.typing import NDArray

Split = Literal["train", "validation"]
Layout = Literal["speed+", "bop"]


class DatasetError(ChaserdockError):
    """A dataset that cannot be written, read or scored. The text is one line: file, fault, what is
    valid.
    """


@dataclass(frozen=True, eq=False)
class PoseLabel:
    """Pose of the target in the camera: position (3,), m, in IRF and rotation (4,), TRF to IRF."""

    position_irf_m: Array
    q_irf_trf_wxyz: Array


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """An image file and its label."""

    path: Path
    label: PoseLabel
    split: Split


@dataclass(frozen=True, eq=False)
class TargetShape:
    """Shape of the target as in the images.

    Vertices (n, 3), m, TRF; diameter, m; rotations (k, 3, 3), identity excluded, that leave it
    unchanged. ``continuous``: it also has an axis of rotational symmetry.
    """

    points_m: Array
    diameter_m: float
    symmetries: Array
    continuous: bool = False

    @property
    def symmetric(self) -> bool:
        return self.continuous or len(self.symmetries) > 0


@dataclass(frozen=True, eq=False)
class LabelledDataset:
    """A dataset: camera, images, and the target's shape if the dataset has it."""

    layout: Layout
    camera: Camera
    images: tuple[LabelledImage, ...]
    shape: TargetShape | None

    def of_split(self, split: Split | None) -> tuple[LabelledImage, ...]:
        """Return the images of a split; None for all images."""
        return tuple(i for i in self.images if split in (None, i.split))


def read_grey(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Return the grey image (h, w) of a file. Raises DatasetError if it cannot be read or is not of
    the camera's size.
    """
    pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if pixels is None:
        reason = "no such file" if not path.is_file() else "not an image"
        raise DatasetError(f"{path}: {reason}")
    height, width = pixels.shape
    if (width, height) != (camera.width_px, camera.height_px):
        raise DatasetError(
            f"{path}: {width} x {height} pixels; the camera of the dataset has {camera.width_px} "
            f"x {camera.height_px}"
        )
    return np.asarray(pixels, dtype=np.uint8)
