# SPDX-License-Identifier: Apache-2.0
"""A learned perception: an ONNX network finds landmarks of the target in a crop of the image, PnP
gives the pose.

The network file is that of the environment variable CHASERDOCK_ONNX, or ``landmarks.onnx`` in the
current folder; ``train.py`` writes it. Its metadata hold the landmarks in TRF and the errors that
it had on validation images.
"""

import json
import os

import cv2
import numpy as np
from chaserdock_agents.chaser.perception import PerceptionResult, TargetPose
from chaserdock_models import rotations
from chaserdock_protocol.errors import ChaserdockError, require_extra

SIDE = 64
"""Width and height of the network's input, pixels."""
_MIN_GREY, _MIN_PIXELS = 24, 60


def find_region(image):
    """Return centre (2,) and half side, pixels, of a square around the largest region brighter than
    space; None without one.
    """
    bright = cv2.morphologyEx(
        (image > _MIN_GREY).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9))
    )
    # The chaser's own probe reaches into the image from its lower border.
    _, labels, stats, _ = cv2.connectedComponentsWithStats(bright)
    touches = np.unique(labels[-1])
    sizes = stats[:, cv2.CC_STAT_AREA].copy()
    sizes[0] = 0
    if np.count_nonzero(sizes) > 1:
        sizes[touches] = 0
    best = int(np.argmax(sizes))
    if sizes[best] < _MIN_PIXELS:
        return None
    x, y, width, height = stats[best, :4].tolist()
    return np.array([x + 0.5 * (width - 1), y + 0.5 * (height - 1)]), 0.6 * max(width, height)


def crop(image, centre, half, turn_rad=0.0):
    """Return a square of an image as the network's input (SIDE, SIDE), float, and the affine map
    (2, 3) from -1 to 1 to pixels.
    """
    c, s = half * np.cos(turn_rad), half * np.sin(turn_rad)
    to_image = np.array([[c, -s, centre[0]], [s, c, centre[1]]])
    step = 2.0 / SIDE
    to_unit = np.array(
        [[step, 0.0, 0.5 * step - 1.0], [0.0, step, 0.5 * step - 1.0], [0.0, 0.0, 1.0]]
    )
    patch = cv2.warpAffine(
        image, to_image @ to_unit, (SIDE, SIDE), flags=cv2.INTER_AREA | cv2.WARP_INVERSE_MAP
    ).astype(np.float32)
    return (patch - patch.mean()) / (patch.std() + 1.0), to_image


class OnnxPerception:
    def __init__(self, camera, target):
        require_extra("onnxruntime", "onnx")
        import onnxruntime

        path = os.environ.get("CHASERDOCK_ONNX", "landmarks.onnx")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        try:
            self.session = onnxruntime.InferenceSession(
                path, options, providers=["CPUExecutionProvider"]
            )
            facts = self.session.get_modelmeta().custom_metadata_map
            self.landmarks = np.array(json.loads(facts["landmarks_m"]))
            self.sigma = np.array(json.loads(facts["sigma"]))  # m per m of range (3), rad (3)
            self.most_rms = float(facts["most_rms"])
        except Exception as error:  # ONNX Runtime raises classes of its own
            raise ChaserdockError(
                f"CHASERDOCK_ONNX {path}: no network of train.py: {error}"
            ) from error
        self.camera = camera

    def estimate(self, image, predicted=None):
        pose = self._pose(image)
        return PerceptionResult(
            (pose,) if pose else (), np.zeros(0, dtype=int), np.zeros((0, 4, 2)), ()
        )

    def _pose(self, image):
        region = find_region(image)
        if region is None:
            return None
        patch, to_image = crop(image, *region)
        found = self.session.run(None, {"image": patch[None, None]})[0].reshape(-1, 2)
        px = self.camera.undistort(found @ to_image[:, :2].T + to_image[:, 2])
        done, turn, position = cv2.solvePnP(
            self.landmarks, px, self.camera.matrix(), None, flags=cv2.SOLVEPNP_SQPNP
        )
        if not done or not position[2, 0] > 0.0:
            return None
        q, position = rotations.exp(turn[:, 0]), position[:, 0]
        error = self.camera.project_ideal(rotations.rotate(q, self.landmarks) + position) - px
        rms = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
        if not rms < self.most_rms * region[1]:
            return None
        range_m = float(np.linalg.norm(position))
        sigma = self.sigma * [range_m, range_m, range_m, 1.0, 1.0, 1.0]
        return TargetPose(position, q, np.diag(sigma**2), rms)
