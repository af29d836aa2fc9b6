"""From a picture message to a sighting message. A pure function of picture, prediction and parameters."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Image, PoseSolution, Sighting
from numpy.typing import NDArray

from chaserdock_agents.perception import Perception

Prediction = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Where the target may be: position (3,) in IRF and rotation (4,) TRF to IRF."""


class BadPicture(Exception):
    """An image message that holds no picture of the stated size."""


def decode_picture(image: Image) -> NDArray[np.uint8]:
    """Grey picture (height, width), uint8, of an image message; raises BadPicture."""
    shape = (image.height_px, image.width_px)
    data = np.frombuffer(image.data, dtype=np.uint8)
    if image.encoding == "mono8":
        if data.size != shape[0] * shape[1]:
            raise BadPicture(
                f"{data.size} bytes, a mono8 picture of {shape[1]} x {shape[0]} has {shape[0] * shape[1]}"
            )
        return data.reshape(shape)
    picture: Any = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    if picture is None:
        raise BadPicture(f"{data.size} bytes that are no JPEG")
    if picture.shape != shape:
        raise BadPicture(
            f"a JPEG of {picture.shape[1]} x {picture.shape[0]}, stated as {shape[1]} x {shape[0]}"
        )
    return picture


def look(perception: Perception, image: Image, predicted: Prediction | None) -> Sighting:
    """What is seen of the target in a picture; ``wall_estimate_s`` is left for the caller."""
    header: dict[str, Any] = {"tick": image.tick, "sim_time_ns": image.sim_time_ns, "chaser": image.chaser}
    try:
        seen = perception.estimate(decode_picture(image), predicted)
    except (BadPicture, ValueError) as error:
        return Sighting(
            **header,
            status="bad_picture",
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
    """Where to look first in the next picture: where the target was last seen, if it was."""
    if sighting is None or not sighting.solutions:
        return None
    best = sighting.solutions[0]
    return np.array(best.position_m), np.array(best.q_wxyz)
