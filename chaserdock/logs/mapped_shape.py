# SPDX-License-Identifier: Apache-2.0
"""Write the surface of a target of unknown shape, from the last map in a log, as GLB."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from chaserdock_agents.mapper.core import pose_at
from chaserdock_agents.mapper.surface import MappedSurface, SightLines, surface_of
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.errors import errors_of_writing
from chaserdock_protocol.messages import FeatureTracks, LandmarkMap
from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.recording.log import LogError, LogSource

from .reader import open_log

FILE = "target.glb"
_SEEN, _UNSEEN = (190, 190, 190, 255), (200, 70, 60, 255)
"""Colours of faces that were seen from outside, and of others: grey and red."""


def write_shape(log: LogSource, folder: Path) -> dict[str, int]:
    """Write ``FILE`` into a folder: the surface in the frame of the map (TRF), m, as two parts:
    ``seen`` and, red, ``unseen``, which no camera has seen from outside. Returns the number of
    faces by file name.

    Raises LogError if the log has no map of a target, or the file cannot be written.
    """
    surface = shape_of(log)
    import trimesh
    from trimesh.exchange.gltf import export_glb

    scene = trimesh.Scene()
    for name, faces, colour in (
        ("seen", surface.seen, _SEEN),
        ("unseen", ~surface.seen, _UNSEEN),
    ):
        triangles = surface.triangles[faces]
        colours = np.tile(np.array(colour, dtype=np.uint8), (len(triangles), 1))
        part = trimesh.Trimesh(surface.vertices_m, triangles, face_colors=colours, process=False)
        if faces.any():
            scene.add_geometry(part, node_name=name, geom_name=name)
    with errors_of_writing(folder, LogError):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / FILE, export_glb(scene))
    return {FILE: len(surface.triangles)}


def shape_of(log: LogSource) -> MappedSurface:
    """Return the surface by the last map in a log. Raises LogError without a map, or with too few
    landmarks.
    """
    last: LandmarkMap | None = None
    images: list[FeatureTracks] = []
    for record in open_log(log).records(topics.MAP, topics.FEATURES):
        if isinstance(record.message, LandmarkMap):
            last = record.message
        else:
            images.append(record.message)
    if last is None or last.motion is None:
        why = "no mapper flew" if last is None else f"the last map's status is {last.status!r}"
        raise LogError(f"the log has no map of a target: {why}")
    landmarks = np.reshape(last.landmarks_m, (-1, 3))
    surface = surface_of(landmarks, _covariances(last), _sights(last, images))
    if surface is None:
        raise LogError(f"{len(landmarks)} landmarks make no surface")
    return surface


def _covariances(message: LandmarkMap) -> Array:
    """Return the covariances (n, 3, 3) of landmarks."""
    xx, yy, zz, xy, xz, yz = np.reshape(message.moments_m2, (-1, 6)).T
    return np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)


def _sights(message: LandmarkMap, images: list[FeatureTracks]) -> SightLines:
    """Return lines of sight to each landmark: at most ``MOST_SIGHTS``, spread over the images."""
    known = {t.chaser: (np.array(t.ids), np.array(t.landmarks)) for t in message.tracks}
    numbers, cameras = [], []
    for image in images:
        if image.chaser not in known or not image.ids:
            continue
        ids, landmarks = known[image.chaser]
        found = landmarks[np.isin(ids, image.ids)]
        numbers.append(found)
        place, q = pose_at(message, image.sim_time_ns)
        camera = rotations.rotate_inverse(q, np.array(image.position_m) - place)
        cameras.append(np.tile(camera, (len(found), 1)))
    if not numbers:
        return SightLines(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
    return SightLines(np.concatenate(numbers), np.concatenate(cameras)).thinned()
