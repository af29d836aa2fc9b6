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
"""Layouts that are written."""
SequenceLayout = Literal["euroc", "colmap"]
"""Layouts of the images of a flight."""
_COEFFICIENTS: dict[str, tuple[int, ...]] = {
    "speed+": (0, 4, 5),
    "bop": (0,),
    "euroc": (0, 4),
    "colmap": (0, 4, 5, 8),
}
"""Coefficients of a perspective lens that a layout can state."""
_OTHER = {"speed+": "bop", "bop": "speed+", "euroc": "colmap", "colmap": "euroc"}
_FISHEYES = ("euroc", "colmap")
"""Layouts that can state an equidistant lens."""


class DatasetError(ChaserdockError):
    """A dataset that cannot be written, read or scored. The text is one line: file, fault, what is
    valid.
    """


def check_new(folder: Path) -> None:
    """Raise DatasetError for a folder that has content, or is a file."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DatasetError(f"{folder}: exists already; give a new folder")


def check_camera(camera: Camera, layout: Layout | SequenceLayout) -> None:
    """Raise DatasetError for a lens that a layout cannot state."""
    if camera.lens_model == "equidistant" and layout in _FISHEYES:
        return
    able, number = _COEFFICIENTS[layout], len(camera.distortion)
    if camera.lens_model == "perspective" and number in able:
        return
    fisheye = ", or an equidistant lens" if layout in _FISHEYES else ""
    hint = f"; use --format {_OTHER[layout]}" if number in _COEFFICIENTS[_OTHER[layout]] else ""
    raise DatasetError(
        f"camera.intrinsics.distortion: the layout {layout} has 0 to {able[-1]} coefficients of a "
        f"perspective lens{fisheye}; this one is {camera.lens_model} with {number}{hint}"
    )


@dataclass(frozen=True, eq=False)
class PoseLabel:
    """Pose of the target in the camera: position (3,), m, in IRF and rotation (4,), TRF to IRF."""

    position_irf_m: Array
    q_irf_trf_wxyz: Array


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """An image file and its label. ``others``: labels of further instances of the same object."""

    path: Path
    label: PoseLabel
    split: Split
    others: tuple[PoseLabel, ...] = ()


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


@dataclass(frozen=True)
class Selection:
    """What to read of a dataset. ``domain``: kind of images, such as ``lightbox`` or ``train_pbr``,
    None for the usual one; ``object``: number of the target, None for the only one; ``split``: None
    for validation, or for training where there is nothing else.
    """

    domain: str | None = None
    object: int | None = None
    split: Split | Literal["all"] | None = "all"

    def of_split(self, images: list[LabelledImage], folder: Path) -> list[LabelledImage]:
        """Return the images of the selected split. Raises DatasetError if there are none."""
        if not images:
            raise DatasetError(f"{folder}: has no labelled images")
        splits = sorted({i.split for i in images})
        wanted = self.split
        if wanted is None:
            wanted = "validation" if "validation" in splits else "train"
        chosen = [i for i in images if wanted in ("all", i.split)]
        if not chosen:
            raise DatasetError(
                f"{folder}: has no images in the split {wanted}; it has {' and '.join(splits)}"
            )
        return chosen


@dataclass(frozen=True, eq=False)
class LabelledDataset:
    """What was selected of a dataset: camera, images, and the target's shape if the dataset has
    it. ``domain``: the kind of images, ``object``: number of the target, where the layout has them.
    """

    layout: Layout | Literal["speed"]
    camera: Camera
    images: tuple[LabelledImage, ...]
    shape: TargetShape | None
    domain: str | None = None
    object: int | None = None

    def of_split(self, split: Split | None) -> tuple[LabelledImage, ...]:
        """Return the images of a split; None for all images."""
        return tuple(i for i in self.images if split in (None, i.split))


def read_pixels(path: Path) -> NDArray[np.uint8]:
    """Return the grey image (h, w) of a file. Raises DatasetError if it cannot be read."""
    pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if pixels is None:
        reason = "no such file" if not path.is_file() else "not an image"
        raise DatasetError(f"{path}: {reason}")
    return np.asarray(pixels, dtype=np.uint8)


def read_grey(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Return the grey image (h, w) of a file. Raises DatasetError if it cannot be read or is not of
    the camera's size.
    """
    pixels = read_pixels(path)
    height, width = pixels.shape
    if (width, height) != (camera.width_px, camera.height_px):
        raise DatasetError(
            f"{path}: {width} x {height} pixels; the camera of the dataset has {camera.width_px} "
            f"x {camera.height_px}"
        )
    return pixels
