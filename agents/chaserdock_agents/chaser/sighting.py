"""From an image message to a sighting message. A pure function of image, prediction and parameters."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Image, PoseSolution, Sighting
from numpy.typing import NDArray

from .perception import Sees

Prediction = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Where the target may be: position (3,) in IRF and rotation (4,) TRF to IRF."""


class BadImage(Exception):
    """An image message that holds no image of the stated size."""


def decode_image(image: Image) -> NDArray[np.uint8]:
    """Grey image (height, width), uint8, of an image message; raises BadImage."""
    shape = (image.height_px, image.width_px)
    data = np.frombuffer(image.data, dtype=np.uint8)
    if image.encoding == "mono8":
        if data.size != shape[0] * shape[1]:
            raise BadImage(
                f"{data.size} bytes, a mono8 image of {shape[1]} x {shape[0]} has {shape[0] * shape[1]}"
            )
        return data.reshape(shape)
    # Asked first, as OpenCV would take the memory for whatever size the header claims, and other formats too.
    size = _jpeg_size(image.data)
    if size is None:
        raise BadImage(f"{data.size} bytes that are no JPEG")
    if size != shape:
        raise BadImage(f"a JPEG of {size[1]} x {size[0]}, stated as {shape[1]} x {shape[0]}")
    pixels: Any = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None or pixels.shape != shape:
        raise BadImage(f"{data.size} bytes of a damaged JPEG")
    return pixels


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Height and width in a JPEG's frame header (ITU-T T.81, B.2.2), None if there is none."""
    if data[:2] != b"\xff\xd8":
        return None
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF:  # a fill byte
            place += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # these three begin no frame
            head = data[place + 5 : place + 9]
            return int.from_bytes(head[:2], "big"), int.from_bytes(head[2:], "big")
        else:
            place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    return None


def look(perception: Sees, image: Image, predicted: Prediction | None) -> Sighting:
    """What is seen of the target in an image; ``wall_estimate_s`` is left for the caller."""
    header: dict[str, Any] = {"tick": image.tick, "sim_time_ns": image.sim_time_ns, "chaser": image.chaser}
    try:
        seen = perception.estimate(decode_image(image), predicted)
    except (BadImage, ValueError) as error:
        return Sighting(
            **header,
            status="bad_image",
            solutions=(),
            marker_ids=(),
            corners_px=(),
            rejected_ids=(),
            detail=str(error)[:500],
        )
    solutions = tuple(
        PoseSolution(
            position_m=vector(s.position_irf_m),
            q_wxyz=vector(s.q_irf_trf_wxyz),
            covariance=vector(s.covariance),
            reprojection_rms_px=float(s.reprojection_rms_px),
        )
        for s in seen.solutions
    )
    return Sighting(
        **header,
        status="seen" if solutions else "nothing",
        solutions=solutions,
        marker_ids=tuple(int(i) for i in seen.marker_ids),
        corners_px=vector(np.asarray(seen.corners_px, dtype=float)),
        rejected_ids=tuple(int(i) for i in seen.rejected_ids),
    )


def prediction_from(sighting: Sighting | None) -> Prediction | None:
    """Where to look first in the next image: where the target was last seen, if it was."""
    if sighting is None or not sighting.solutions:
        return None
    best = sighting.solutions[0]
    return np.array(best.position_m), np.array(best.q_wxyz)
