# SPDX-License-Identifier: Apache-2.0
"""Convert an image message to a sighting message.

A pure function of image, prediction and parameters.
"""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
from chaserdock_protocol import codec
from chaserdock_protocol.codec import vector
from chaserdock_protocol.failure_watch import LONGEST_TEXT, text_of
from chaserdock_protocol.messages import (
    ExpectedPose,
    GeometryEstimate,
    GeometryMeasurement,
    Image,
    PoseSolution,
    RangeMeasurement,
    Sighting,
)
from chaserdock_protocol.pose_image import UnusableImage
from numpy.typing import NDArray

from .perception import (
    BearingError,
    BearingFinder,
    FarPerception,
    GeometryInformation,
    PerceptionMethod,
    RangedTarget,
    TargetPose,
)

Prediction = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Predicted pose of the target: position (3,) in IRF and rotation (4,) TRF to IRF."""

_EXPECTED_FOR_NS = 300_000_000
"""Age above which an expected pose is not used, ns: four images at 15 Hz, in which a target that
turns by 10 degrees/s has turned by 3, the reach of a start (``tracking``).
"""


class BadImage(Exception):
    """An image message without a valid image of the stated size."""


class PerceptionFailed(Exception):
    """A perception raised an error or returned something else than a result. The text says
    what.
    """


def decode_image(image: Image) -> NDArray[np.uint8]:
    """Return the grey image (height, width), uint8, of an image message; raises BadImage."""
    shape = (image.height_px, image.width_px)
    data = np.frombuffer(image.data, dtype=np.uint8)
    if image.encoding == "mono8":
        if data.size != shape[0] * shape[1]:
            raise BadImage(
                f"{data.size} bytes; a mono8 image of {shape[1]} x {shape[0]} has "
                f"{shape[0] * shape[1]}"
            )
        return data.reshape(shape)
    # Before decoding, as OpenCV allocates memory for any size that the header states, and accepts
    # other formats.
    size = _jpeg_size(image.data)
    if size is None:
        raise BadImage(f"{data.size} bytes that are not a JPEG")
    if size != shape:
        raise BadImage(f"a JPEG of {size[1]} x {size[0]}, stated as {shape[1]} x {shape[0]}")
    pixels: Any = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None or pixels.shape != shape:
        raise BadImage(f"{data.size} bytes of a damaged JPEG")
    return pixels


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Return height and width of a JPEG's frame header (ITU-T T.81, B.2.2), None without one."""
    if data[:2] != b"\xff\xd8":
        return None
    offset = 2
    while offset + 9 <= len(data) and data[offset] == 0xFF:
        marker = data[offset + 1]
        if marker == 0xFF:  # a fill byte
            offset += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (
            0xC4,
            0xC8,
            0xCC,
        ):  # these three are not frame headers
            head = data[offset + 5 : offset + 9]
            return int.from_bytes(head[:2], "big"), int.from_bytes(head[2:], "big")
        else:
            offset += 2 + int.from_bytes(data[offset + 2 : offset + 4], "big")
    return None


def look(perception: PerceptionMethod, image: Image, predicted: Prediction | None) -> Sighting:
    """Return the sighting of the target in an image.

    By markers or, where that is more accurate, by bearing and range. The caller sets
    ``wall_estimate_s``. Raises PerceptionFailed.
    """
    header = _header(image)
    try:
        pixels = decode_image(image)
        sighting = _measure(perception, pixels, image.ranging, predicted, header)
        codec.decode(Sighting, codec.encode(sighting))  # raises what a reader would refuse
    except (BadImage, UnusableImage) as error:
        return without_sighting(image, str(error), "bad_image")
    except Exception as error:  # an installed perception may raise or return anything
        raise PerceptionFailed(text_of(error)) from error
    return sighting


def without_sighting(
    image: Image, reason: str, status: Literal["nothing", "bad_image"] = "nothing"
) -> Sighting:
    """Return the sighting of an image that shows no pose, and why."""
    return Sighting(**_header(image), status=status, **_EMPTY, detail=reason[:LONGEST_TEXT])


_EMPTY: dict[str, Any] = {"solutions": (), "marker_ids": (), "corners_px": (), "rejected_ids": ()}


def _header(image: Image) -> dict[str, Any]:
    return {"tick": image.tick, "sim_time_ns": image.sim_time_ns, "chaser": image.chaser}


def _measure(
    perception: PerceptionMethod,
    pixels: NDArray[np.uint8],
    ranging: RangeMeasurement | None,
    predicted: Prediction | None,
    header: dict[str, Any],
) -> Sighting:
    """Return the sighting in a grey image (height, width)."""
    seen = perception.estimate(pixels, predicted)
    if not hasattr(seen, "solutions"):
        raise TypeError(f"estimate() returned {type(seen).__name__}, not a PerceptionResult")
    solutions, detail = tuple(pose_solution(pose) for pose in seen.solutions), ""
    rejected = tuple(int(i) for i in seen.rejected_ids)
    if ranging is not None and isinstance(perception, FarPerception):
        try:
            far = _by_bearing(perception.by_bearing, pixels, ranging, predicted)
            if not solutions or _variance(far) < _variance(solutions[0]):
                return _without_markers(header, far, rejected)
        except BearingError as error:
            detail = "" if solutions else str(error)

    return Sighting(
        **header,
        status="seen" if solutions else "nothing",
        solutions=solutions,
        marker_ids=tuple(np.asarray(seen.marker_ids).tolist()),
        corners_px=vector(np.asarray(seen.corners_px, dtype=float)),
        rejected_ids=rejected,
        detail=detail,
        geometry=None if seen.geometry is None else geometry_message(seen.geometry),
        acquiring=seen.acquiring,
    )


def _without_markers(
    header: dict[str, Any], pose: PoseSolution, rejected: tuple[int, ...]
) -> Sighting:
    return Sighting(
        **header,
        status="seen",
        solutions=(pose,),
        marker_ids=(),
        corners_px=(),
        rejected_ids=rejected,
    )


def _variance(pose: PoseSolution) -> float:
    """Return the sum of the variances of the position, m²."""
    return pose.covariance[0] + pose.covariance[7] + pose.covariance[14]


def pose_solution(pose: TargetPose) -> PoseSolution:
    """Convert a pose of the target to its part of a message."""
    return PoseSolution(
        position_m=vector(pose.position_irf_m),
        q_wxyz=vector(pose.q_irf_trf_wxyz),
        covariance=vector(pose.covariance),
        reprojection_rms_px=float(pose.reprojection_rms_px),
    )


def _by_bearing(
    finder: BearingFinder,
    pixels: NDArray[np.uint8],
    measured: RangeMeasurement,
    predicted: Prediction | None,
) -> PoseSolution:
    covariance = np.array(measured.attitude_covariance_rad2).reshape(3, 3)
    target = RangedTarget(
        measured.range_m, measured.range_sigma_m, np.array(measured.q_wxyz), covariance
    )
    return pose_solution(finder.find(pixels, target, None if predicted is None else predicted[0]))


def geometry_message(found: GeometryInformation) -> GeometryMeasurement:
    """Convert what an image tells about the errors of the geometry to its part of a message."""
    return GeometryMeasurement(
        information=vector(found.matrix),
        vector=vector(found.vector),
        position_m=vector(found.position_m),
        position_by_errors=vector(found.position_by_errors),
        position_covariance_m2=vector(found.position_covariance),
    )


def apply_geometry(
    perception: PerceptionMethod | None, estimate: GeometryEstimate | None
) -> str | None:
    """Correct what a perception knows of the target's geometry, if it uses that.

    Return why the correction was refused, or None.
    """
    correct = getattr(perception, "correct_geometry", None)
    if estimate is None or correct is None:
        return None
    k, sigmas = len(estimate.names), np.array(estimate.sigmas)
    if (
        {len(estimate.values), len(sigmas)} != {k}
        or len(estimate.covariance) != k * k
        or not (sigmas > 0.0).all()
    ):
        return (
            f"{k} names with {len(estimate.values)} values and {len(estimate.covariance)} "
            "covariances"
        )
    covariance = np.array(estimate.covariance).reshape(k, k) / np.outer(sigmas, sigmas)
    try:
        correct(np.array(estimate.values) / sigmas, covariance)
    except Exception as error:  # an installed perception may raise anything
        return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
    return None


def prediction_from(
    sighting: Sighting | None, expected: ExpectedPose | None = None, time_ns: int = 0
) -> Prediction | None:
    """Return the predicted pose of the target for an image of ``time_ns``, or None.

    The last measured pose, else the one that the controller expects.
    """
    if sighting is not None and sighting.solutions:
        best = sighting.solutions[0]
        return np.array(best.position_m), np.array(best.q_wxyz)
    if expected is None or time_ns - expected.sim_time_ns > _EXPECTED_FOR_NS:
        return None
    return np.array(expected.position_m), np.array(expected.q_wxyz)
