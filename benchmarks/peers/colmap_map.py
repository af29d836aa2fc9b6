# SPDX-License-Identifier: Apache-2.0
"""COLMAP on images of an unknown target, for comparison: structure from motion over all images at
once, by the wheel `pycolmap` (``pip install pycolmap``).

SIFT, all pairs, incremental mapping and bundle adjustment with the calibrated camera, as COLMAP
does by default. It gets no odometry, so that its scale is free, and no order of images.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap  # type: ignore[import-not-found]
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera

from chaserdock.datasets.sequences import colmap_camera


@dataclass(frozen=True, eq=False)
class ColmapMap:
    """The largest model: names of the images in it; rotation (n, 3, 3) and translation (n, 3) from
    its frame to the cameras; points (m, 3). Its unit of length is free.
    """

    names: tuple[str, ...]
    turns: Array
    translations: Array
    points: Array


def map_images(
    images: Path, masks: Path, names: list[str], camera: Camera, work: Path
) -> ColmapMap | None:
    """Return the largest model of images by their names in a folder; None if COLMAP finds none.

    ``masks``: folder of images, black where features do not count, by the images' names with
    ``.png`` added. ``work``: an empty folder.
    """
    database = work / "database.db"
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, _, _, *numbers = colmap_camera(camera).split()
    reader.mask_path, reader.camera_params = masks, ",".join(numbers)
    pycolmap.extract_features(
        database,
        images,
        image_names=names,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        device=pycolmap.Device.cpu,
    )
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.random_seed = 0
    models = pycolmap.incremental_mapping(database, images, work / "model", options)
    if not models:
        return None
    largest = max(models.values(), key=lambda model: model.num_reg_images())
    seen = sorted(
        (image for image in largest.images.values() if image.has_pose), key=lambda i: i.name
    )
    poses = [image.cam_from_world().matrix() for image in seen]
    return ColmapMap(
        tuple(image.name for image in seen),
        np.array([pose[:, :3] for pose in poses]),
        np.array([pose[:, 3] for pose in poses]),
        np.array([point.xyz for point in largest.points3D.values()]).reshape(-1, 3),
    )
