# SPDX-License-Identifier: Apache-2.0
"""Exports the images of a flight with the true motion of each camera about the target, so that
programs for structure from motion and SLAM can run on them.

The target is the world of such programs: poses are relative to TRF, which stays at rest. Layouts:

- EuRoC (M. Burri et al., "The EuRoC micro aerial vehicle datasets", 2016): for each chaser a folder
  ``mav0`` with images, ``sensor.yaml`` and ``state_groundtruth_estimate0``, without an IMU.
- COLMAP (https://colmap.github.io/format.html): the images of all chasers, and the true poses as a
  sparse model without points.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np
from chaserdock_agents.chaser.sighting import BadImage, decode_image
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol import topics
from chaserdock_protocol.errors import errors_of_writing
from chaserdock_protocol.messages import Image
from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.recording.log import LogSource
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.sensors.errors import true_camera
from numpy.typing import NDArray

from chaserdock.analysis.motion import TARGET, KnownMotion, MotionCollector
from chaserdock.images import write_image
from chaserdock.logs.reader import Log, open_log

from .export import DESCRIPTION
from .model_files import write_models
from .shapes import shape_of
from .types import DatasetError, SequenceLayout, check_camera, check_new
from .views import target_mesh

_HALF_PX = 0.5
"""What COLMAP's pixel coordinates are larger by: its origin is the corner of the image, ours the
centre of the first pixel."""
_COLMAP_MODELS = {0: "PINHOLE", 4: "OPENCV", 5: "FULL_OPENCV", 8: "FULL_OPENCV"}
"""COLMAP's camera model by the number of coefficients of a perspective lens."""
_COLMAP_COEFFICIENTS = 8
"""Distortion of FULL_OPENCV; those that a lens does not have are zero."""


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Motion of a chaser's body relative to TRF at its images: times (n,) ns; position (n, 3) and
    velocity (n, 3) as seen from the target; attitude (n, 4), CRF to TRF. Velocities are NaN where
    the source of the motion has none.
    """

    time_ns: NDArray[np.int64]
    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array


def export_sequence(
    log: LogSource, folder: Path, layouts: Sequence[SequenceLayout]
) -> dict[int, int]:
    """Write the images of a log, with the true or measured motion, into a new folder. Return the
    number of images by chaser. Images at times at which the motion is not known are left out.

    Raises DatasetError for a folder that is not empty or cannot be written, a lens that a layout
    cannot state, and a log without images or motion; LogError for a damaged log.
    """
    check_new(folder)
    opened = open_log(log)
    scenario, camera = opened.scenario, opened.scenario.camera_model()
    for layout in layouts:
        check_camera(camera, layout)
    motion, times_ns = _motion_and_images(opened)
    if not times_ns:
        raise DatasetError(f"{log}: has no images")
    paths = {i: _path_of(motion, i, sorted(times)) for i, times in sorted(times_ns.items())}
    if not any(len(path.time_ns) for path in paths.values()):
        raise DatasetError(f"{log}: states neither true nor measured motion of the bodies")
    # Of cameras in a laboratory only the calibration is known.
    cameras = {i: true_camera(scenario, i) if motion.source == "truth" else camera for i in paths}
    with errors_of_writing(folder, DatasetError):
        folder.mkdir(parents=True, exist_ok=True)
        kinds = {"euroc": EurocWriter, "colmap": ColmapWriter}
        writers = [kinds[k](folder / k, scenario, paths, cameras) for k in layouts]
        for image in opened.messages(Image):
            row = _row_at(paths[image.chaser], image.sim_time_ns)
            if row is None:
                continue
            pixels = _pixels(image)
            for writer in writers:
                writer.add(image, pixels, row)
        for writer in writers:
            writer.close()
        mesh = target_mesh(scenario)
        write_models(mesh, shape_of(mesh), folder / "models")
        counts = {i: len(path.time_ns) for i, path in paths.items()}
        facts = {
            "format": 1,
            "chaserdock": version("chaserdock"),
            "scenario": scenario.name,
            "run": opened.run,
            "images": {f"chaser-{i}": count for i, count in counts.items()},
            "motion": motion.describe(),
        }
        write_atomically(folder / DESCRIPTION, json.dumps(facts, indent=1) + "\n")
    return counts


def _motion_and_images(log: Log) -> tuple[KnownMotion, dict[int, list[int]]]:
    """Return the motion of the bodies, and the times of the images by chaser, ns."""
    collector, times_ns = MotionCollector(), defaultdict[int, list[int]](list)
    for record in log.records(topics.TRUTH_BODY, topics.BODY_REFERENCE, topics.IMAGE):
        if isinstance(record.message, Image):
            times_ns[record.message.chaser].append(record.message.sim_time_ns)
        else:
            collector.add(record.message)
    return collector.finish(np.zeros(0)), times_ns


def _path_of(motion: KnownMotion, chaser: int, times_ns: list[int]) -> CameraPath:
    """Return the motion of a chaser about the target at those of the times at which it is known."""
    times_s = np.array(times_ns) / 1e9
    known = np.zeros(0, dtype=np.intp)
    name = f"chaser/{chaser}"
    if TARGET in motion and name in motion:
        own_rows, own = motion.at(name, times_s)
        target_rows, target = motion.at(TARGET, times_s[own_rows])
        own, known = own.rows(target_rows), own_rows[target_rows]
        position = rotations.rotate_inverse(target.q_wxyz, own.position_m - target.position_m)
        velocity = rotations.rotate_inverse(target.q_wxyz, own.velocity_m_s - target.velocity_m_s)
        q = rotations.multiply(rotations.conjugate(target.q_wxyz), own.q_wxyz)
        return CameraPath(
            np.array(times_ns)[known],
            position,
            velocity - np.cross(target.omega_rad_s, position),
            np.where(q[:, :1] < 0.0, -q, q),
        )
    return CameraPath(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)))


def _row_at(path: CameraPath, time_ns: int) -> int | None:
    row = int(np.searchsorted(path.time_ns, time_ns))
    return row if row < len(path.time_ns) and path.time_ns[row] == time_ns else None


def _pixels(image: Image) -> NDArray[np.uint8]:
    try:
        return decode_image(image)
    except BadImage as error:
        raise DatasetError(
            f"image of chaser {image.chaser} at {image.sim_time_ns / 1e9:.3f} s: {error}"
        ) from None


@dataclass
class EurocWriter:
    """Writes sequences in EuRoC's layout into ``folder``, one a chaser. Raises OSError."""

    folder: Path
    scenario: Scenario
    paths: dict[int, CameraPath]
    cameras: dict[int, Camera]
    _names: dict[int, list[str]] = field(default_factory=lambda: defaultdict(list))

    def add(self, image: Image, pixels: NDArray[np.uint8], row: int) -> None:
        """Write an image; its pose is in a row of the chaser's path."""
        name = f"{image.sim_time_ns}.png"
        data = self._of(image.chaser) / "cam0" / "data"
        data.mkdir(parents=True, exist_ok=True)
        write_image(data / name, pixels)
        self._names[image.chaser].append(f"{image.sim_time_ns},{name}")

    def close(self) -> None:
        """Write calibration, list of images and ground truth of each chaser."""
        for i, names in self._names.items():
            mav = self._of(i)
            _write_csv(mav / "cam0" / "data.csv", "#timestamp [ns],filename", names)
            write_atomically(
                mav / "cam0" / "sensor.yaml", _sensor_yaml(self.scenario, self.cameras[i])
            )
            write_atomically(mav / "body.yaml", f"%YAML:1.0\ncomment: chaser {i} (CRF)\n")
            truth = mav / "state_groundtruth_estimate0"
            truth.mkdir()
            _write_csv(truth / "data.csv", _EUROC_STATE, _state_rows(self.paths[i]))
            write_atomically(truth / "sensor.yaml", _TRUTH_YAML)

    def _of(self, chaser: int) -> Path:
        return self.folder / f"chaser-{chaser}" / "mav0"


_EUROC_STATE = "#timestamp," + ",".join(
    [
        *(f" p_RS_R_{k} [m]" for k in "xyz"),
        *(f" q_RS_{k} []" for k in "wxyz"),
        *(f" v_RS_R_{k} [m s^-1]" for k in "xyz"),
        *(f" b_w_RS_S_{k} [rad s^-1]" for k in "xyz"),
        *(f" b_a_RS_S_{k} [m s^-2]" for k in "xyz"),
    ]
)
_TRUTH_YAML = """%YAML:1.0
sensor_type: visual-inertial
comment: body (CRF) of the chaser in the frame of the target (TRF); there is no IMU, biases are 0
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
"""


def _state_rows(path: CameraPath) -> Iterator[str]:
    """Yield the rows of EuRoC's ground truth."""
    states = np.hstack([path.position_m, path.q_wxyz, path.velocity_m_s])
    for time_ns, state in zip(path.time_ns.tolist(), states.tolist(), strict=True):
        yield ",".join([str(time_ns), *map(repr, state), *["0.0"] * 6])


def _sensor_yaml(scenario: Scenario, true: Camera) -> str:
    """Return EuRoC's description of a camera: intrinsics as calibrated, mounting as it is."""
    camera = scenario.camera_model()
    mounting = np.eye(4)
    mounting[:3, :3] = rotations.to_matrix(true.q_crf_irf_wxyz)
    mounting[:3, 3] = true.position_crf_m
    kind = "equidistant" if camera.lens_model == "equidistant" else "radial-tangential"
    coefficients = list(camera.distortion) or [0.0] * 4
    return (
        "%YAML:1.0\nsensor_type: camera\ncomment: chaser's camera\n"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: {mounting.reshape(-1).tolist()}\n"
        f"rate_hz: {scenario.time.image_hz}\n"
        f"resolution: [{camera.width_px}, {camera.height_px}]\n"
        "camera_model: pinhole\n"
        f"intrinsics: {[camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]}\n"
        f"distortion_model: {kind}\ndistortion_coefficients: {coefficients}\n"
    )


@dataclass
class ColmapWriter:
    """Writes images and a sparse model with true poses in COLMAP's layout into ``folder``. Raises
    OSError.
    """

    folder: Path
    scenario: Scenario
    paths: dict[int, CameraPath]
    cameras: dict[int, Camera]
    _rows: list[str] = field(default_factory=list)

    def add(self, image: Image, pixels: NDArray[np.uint8], row: int) -> None:
        """Write an image, and keep its pose: TRF to camera."""
        path, true = self.paths[image.chaser], self.cameras[image.chaser]
        suffix = "jpg" if image.encoding == "jpeg" else "png"
        name = f"chaser-{image.chaser}/{image.sim_time_ns:015d}.{suffix}"
        file = self.folder / "images" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if image.encoding == "jpeg":
            write_atomically(file, image.data)
        else:
            write_image(file, pixels)
        q_camera = rotations.multiply(path.q_wxyz[row], true.q_crf_irf_wxyz)
        eye = path.position_m[row] + rotations.rotate(path.q_wxyz[row], true.position_crf_m)
        into = rotations.conjugate(q_camera)
        pose = [*into.tolist(), *(-rotations.rotate(into, eye)).tolist()]
        numbers = " ".join(map(repr, pose))
        self._rows.append(f"{len(self._rows) + 1} {numbers} {image.chaser + 1} {name}\n")

    def close(self) -> None:
        """Write the model."""
        sparse = self.folder / "sparse" / "0"
        sparse.mkdir(parents=True)
        cameras = [
            f"{i + 1} {colmap_camera(self.scenario.camera_model())}"
            for i, path in self.paths.items()
            if len(path.time_ns)
        ]
        head = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        write_atomically(sparse / "cameras.txt", head + "\n".join(cameras) + "\n")
        head = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; no points\n"
        write_atomically(sparse / "images.txt", head + "\n".join(self._rows) + "\n")
        write_atomically(sparse / "points3D.txt", "# no points\n")


def colmap_camera(camera: Camera) -> str:
    """Return model, size and parameters of a camera, as calibrated."""
    given = list(camera.distortion)
    if camera.lens_model == "equidistant":
        model = "OPENCV_FISHEYE"
    else:
        model = _COLMAP_MODELS[len(given)]
        if model == "FULL_OPENCV":
            given += [0.0] * (_COLMAP_COEFFICIENTS - len(given))
    centre = [camera.cx_px + _HALF_PX, camera.cy_px + _HALF_PX]
    parameters = " ".join(map(repr, [camera.fx_px, camera.fy_px, *centre, *given]))
    return f"{model} {camera.width_px} {camera.height_px} {parameters}"


def _write_csv(path: Path, head: str, rows: Iterable[str]) -> None:
    write_atomically(path, "\n".join([head, *rows]) + "\n")
