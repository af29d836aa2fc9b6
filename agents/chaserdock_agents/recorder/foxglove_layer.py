# SPDX-License-Identifier: Apache-2.0
"""Viewer layer of a log: Foxglove messages in addition to the verbatim ones, for Rerun, Foxglove
and Lichtblick.

Channels (all under ``/viewer/``); times are simulated:

- ``tf``: true (or measured) frames ``target`` and ``chaser/N`` in ``world`` (WRF),
  ``chaser/N/camera`` (IRF) on each chaser, and ``target/estimate``, the fused estimate while
  available
- ``chaser/N/image``, ``chaser/N/calibration``, ``chaser/N/detections``: image, camera, used corners
- ``chaser/N/measurement`` (in the camera's frame), ``chaser/N/reference``, ``target/estimate`` (in
  WRF): poses
- ``scene``: the bodies as boxes in their true frames; ``events``: events of all processes
- ``target/points``, ``chaser/N/points``: the same bodies as points on their edges or mesh, and
  ``chaser/N/corners``: the used corners as points in the camera's frame, at the measured distance,
  where they cover those of the image. Rerun maps neither ``SceneUpdate`` nor ``ImageAnnotations``,
  but point clouds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import foxglove.messages as fox
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.meshes import TriangleMesh
from chaserdock_models.satellites import satellite
from chaserdock_models.targets import Box, cuboid_corners
from chaserdock_protocol import topics
from chaserdock_protocol.messages import (
    BodyReference,
    BodyTruth,
    Event,
    Image,
    Quaternion,
    Reference,
    Sighting,
    TargetEstimate,
    Vector3,
)
from chaserdock_protocol.recording.scan import VIEWER_PREFIX
from chaserdock_protocol.scenario import FlightScenario

Write = Callable[[str, tuple[str, str, bytes], bytes, int], None]
"""Signature of ``LogWriter.write_view``: topic, schema, payload, simulated time in ns."""

SHOWN = frozenset(
    {
        topics.IMAGE,
        topics.TRUTH_BODY,
        topics.BODY_REFERENCE,
        topics.SIGHTING,
        topics.TARGET,
        topics.REFERENCE,
        topics.EVENT,
    }
)
"""Topics from which the layer is made."""

_LATEST_NS = (2**32 - 1) * 1_000_000_000  # maximum of a viewer's time stamp

_LEVELS = {"info": fox.LogLevel.Info, "warning": fox.LogLevel.Warning, "error": fox.LogLevel.Error}
# Colours of the viewer layer, chosen to be told apart on dark ground.
_CAMERA_COLOUR = fox.Color(r=0.35, g=0.86, b=0.35, a=1.0)
_TARGET_COLOUR = fox.Color(r=0.85, g=0.65, b=0.25, a=0.9)
_CHASER_COLOUR = fox.Color(r=0.35, g=0.55, b=0.85, a=0.6)
_SPACING_M = 0.01
"""Distance of the points on the edges of a body."""
# Layout of a point cloud's points.
_POINT_FIELDS = [
    fox.PackedElementField(name=name, offset=4 * k, type=fox.PackedElementFieldNumericType.Float32)
    for k, name in enumerate("xyz")
]


class ViewerLayer:
    """Converts messages to the viewer layer of one file; every file of a rotated log has its
    own.
    """

    def __init__(self, scenario: FlightScenario, write: Write) -> None:
        self._write = write
        self._scenario = scenario
        self._schemas: dict[type, tuple[str, str, bytes]] = {}
        camera = scenario.camera_model()
        self._camera_pose = (camera.position_crf_m, camera.q_crf_irf_wxyz)
        matrix = [float(x) for x in camera.matrix().ravel()]
        self._inverse_matrix = np.linalg.inv(camera.matrix())
        model, coefficients = camera.ros_distortion()
        self._calibration: dict[str, Any] = {
            "width": camera.width_px,
            "height": camera.height_px,
            "distortion_model": "kannala_brandt" if model == "equidistant" else model,
            "D": coefficients,
            "K": matrix,
            "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            "P": [*matrix[0:3], 0.0, *matrix[3:6], 0.0, *matrix[6:9], 0.0],
        }
        self._started = False

    def write(self, message: Any) -> None:
        """Write the view of a message; nothing for topics that are not ``SHOWN``."""
        time_ns = getattr(message, "sim_time_ns", 0)
        if time_ns > _LATEST_NS:
            return
        if not self._started:
            self._started = True
            self._write_static(time_ns)
        for name, view in self._views(message, _time(time_ns)):
            self._put(name, view, time_ns)

    def _put(self, name: str, view: Any, time_ns: int) -> None:
        kind = type(view)
        if kind not in self._schemas:
            schema = kind.get_schema()
            self._schemas[kind] = (schema.name, schema.encoding, schema.data)
        self._write(VIEWER_PREFIX + name, self._schemas[kind], view.encode(), time_ns)

    def _write_static(self, time_ns: int) -> None:
        """Write the static content: camera frames and the shapes of the bodies."""
        stamp = _time(time_ns)
        model = self._scenario.target_model()  # an unknown target has no boxes
        shapes = [("target", model.size_m, _TARGET_COLOUR)] if model.boxes else []
        for i in range(len(self._scenario.chasers)):
            self._put(
                "tf",
                _frame(stamp, f"chaser/{i}", f"chaser/{i}/camera", *self._camera_pose),
                time_ns,
            )
            shapes.append((f"chaser/{i}", self._scenario.chaser.size_m, _CHASER_COLOUR))

        entities = [
            fox.SceneEntity(
                timestamp=stamp,
                frame_id=frame,
                id=frame,
                frame_locked=True,
                cubes=[fox.CubePrimitive(pose=_NO_POSE, size=_vector(size_m), color=colour)],
            )
            for frame, size_m, colour in shapes
        ]
        self._put("scene", fox.SceneUpdate(entities=entities), time_ns)

        body = self._scenario.chaser
        chaser = (
            _mesh_points(satellite(body.mesh, _SPACING_M))
            if body.mesh
            else _outline([Box(body.size_m)])
        )
        mesh = self._scenario.target.nominal_mesh(_SPACING_M)
        target = _outline(model.boxes) if mesh is None else _mesh_points(mesh)
        self._put("target/points", _cloud(stamp, "target", target), time_ns)
        for i in range(len(self._scenario.chasers)):
            self._put(f"chaser/{i}/points", _cloud(stamp, f"chaser/{i}", chaser), time_ns)

    def _views(self, message: Any, stamp: fox.Timestamp) -> Iterator[tuple[str, Any]]:
        match message:
            case Image():
                yield f"chaser/{message.chaser}/image", _image(message, stamp)
                frame = f"chaser/{message.chaser}/camera"
                calibration = fox.CameraCalibration(
                    timestamp=stamp, frame_id=frame, **self._calibration
                )
                yield f"chaser/{message.chaser}/calibration", calibration
            case BodyTruth() | BodyReference():
                yield "tf", _frame(stamp, "world", message.body, message.position_m, message.q_wxyz)
            case TargetEstimate() if message.is_known:
                where = (message.position_m, message.q_wxyz)
                yield "tf", _frame(stamp, "world", "target/estimate", *where)
                yield "target/estimate", _pose_in(stamp, "world", *where)
            case Sighting():
                yield f"chaser/{message.chaser}/detections", _detections(message, stamp)
                for best in message.solutions[:1]:
                    frame = f"chaser/{message.chaser}/camera"
                    measured = _pose_in(stamp, frame, best.position_m, best.q_wxyz)
                    yield f"chaser/{message.chaser}/measurement", measured
                    corners = self._corners(message.corners_px, best.position_m[2])
                    yield f"chaser/{message.chaser}/corners", _cloud(stamp, frame, corners)
            case Reference():
                reference = _pose_in(stamp, "world", message.position_m, message.q_wxyz)
                yield f"chaser/{message.chaser}/reference", reference
            case Event():
                text = f"{message.what}: {message.detail}" if message.detail else message.what
                level = _LEVELS[message.level]
                yield (
                    "events",
                    fox.Log(timestamp=stamp, level=level, message=text, name=message.process),
                )

    def _corners(self, corners_px: Sequence[float], depth_m: float) -> Array:
        """Return corners as points (N, 3) at one depth in the camera's frame (IRF); a viewer draws
        no lens distortion.
        """
        pixels = np.reshape(corners_px, (-1, 2))
        return depth_m * np.column_stack([pixels, np.ones(len(pixels))]) @ self._inverse_matrix.T


def _outline(boxes: Iterable[Box]) -> Array:
    """Return points (N, 3) on the edges of boxes, in the axes of their body."""
    points = [np.zeros((0, 3))]
    for box in boxes:
        corners = cuboid_corners(box.size_m)
        pairs = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b).bit_count() == 1]
        for begin, end in ((corners[a], corners[b]) for a, b in pairs):
            count = 2 + int(np.linalg.norm(end - begin) / _SPACING_M)
            along = np.linspace(begin, end, count)
            points.append(rotations.rotate(box.q_wxyz, along) + box.position_m)
    return np.concatenate(points)


def _mesh_points(mesh: TriangleMesh) -> Array:
    """Return points (N, 3) along the edges of the triangles of a mesh."""
    corners = np.concatenate([part.vertices_m[part.triangles] for part in mesh.parts])
    ends = np.roll(corners, -1, axis=1)
    shares = np.linspace(0.0, 1.0, 6)[:-1, None, None, None]
    points = ((1.0 - shares) * corners + shares * ends).reshape(-1, 3)
    return np.unique(np.round(points, 4), axis=0)


def _cloud(stamp: fox.Timestamp, frame: str, points: Array) -> fox.PointCloud:
    return fox.PointCloud(
        timestamp=stamp,
        frame_id=frame,
        pose=_NO_POSE,
        point_stride=12,
        fields=_POINT_FIELDS,
        data=points.astype("<f4").tobytes(),
    )


def _time(time_ns: int) -> fox.Timestamp:
    return fox.Timestamp(sec=time_ns // 1_000_000_000, nsec=time_ns % 1_000_000_000)


def _vector(v: Vector3) -> fox.Vector3:
    return fox.Vector3(x=v[0], y=v[1], z=v[2])


def _quaternion(q_wxyz: Quaternion) -> fox.Quaternion:
    w, x, y, z = q_wxyz
    return fox.Quaternion(x=x, y=y, z=z, w=w)


_NO_POSE = fox.Pose(
    position=_vector((0.0, 0.0, 0.0)), orientation=_quaternion((1.0, 0.0, 0.0, 0.0))
)


def _frame(
    stamp: fox.Timestamp, parent: str, child: str, p: Vector3, q: Quaternion
) -> fox.FrameTransform:
    return fox.FrameTransform(
        timestamp=stamp,
        parent_frame_id=parent,
        child_frame_id=child,
        translation=_vector(p),
        rotation=_quaternion(q),
    )


def _pose_in(stamp: fox.Timestamp, frame: str, p: Vector3, q: Quaternion) -> fox.PoseInFrame:
    pose = fox.Pose(position=_vector(p), orientation=_quaternion(q))
    return fox.PoseInFrame(timestamp=stamp, frame_id=frame, pose=pose)


def _image(image: Image, stamp: fox.Timestamp) -> fox.CompressedImage | fox.RawImage:
    frame = f"chaser/{image.chaser}/camera"
    if image.encoding == "jpeg":
        return fox.CompressedImage(timestamp=stamp, frame_id=frame, data=image.data, format="jpeg")
    return fox.RawImage(
        timestamp=stamp,
        frame_id=frame,
        width=image.width_px,
        height=image.height_px,
        encoding="mono8",
        step=image.width_px,
        data=image.data,
    )


def _detections(sighting: Sighting, stamp: fox.Timestamp) -> fox.ImageAnnotations:
    """Return the outlines of the used markers.

    A viewer's pixel origin is a corner of the first pixel, not its centre.
    """
    u, v = sighting.corners_px[0::2], sighting.corners_px[1::2]
    corners = [fox.Point2(x=a + 0.5, y=b + 0.5) for a, b in zip(u, v, strict=False)]
    outlines = [
        fox.PointsAnnotation(
            timestamp=stamp,
            type=fox.PointsAnnotationType.LineLoop,
            points=corners[k : k + 4],
            outline_color=_CAMERA_COLOUR,
            thickness=2.0,
        )
        for k in range(0, len(corners), 4)
    ]
    return fox.ImageAnnotations(timestamp=stamp, points=outlines)
