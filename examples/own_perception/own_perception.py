# SPDX-License-Identifier: Apache-2.0
"""A perception of twenty lines: OpenCV's markers, one PnP over all corners, a covariance from the
distance.
"""

import cv2
import numpy as np
from chaserdock_agents.chaser.perception import PerceptionResult, TargetPose
from chaserdock_models import rotations


class OwnPerception:
    def __init__(self, camera, target):
        self.camera, self.markers = camera, {m.id: m.corners_trf_m() for m in target.markers}
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
        self.detector = cv2.aruco.ArucoDetector(dictionary)
        settings = self.detector.getDetectorParameters()
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self.detector.setDetectorParameters(settings)

    def estimate(self, image, predicted=None):
        corners, ids, _ = self.detector.detectMarkers(image)
        found = [
            (int(i), c[0])
            for i, c in zip(ids if ids is not None else (), corners, strict=True)
            if int(i) in self.markers
        ]
        if not found:
            return PerceptionResult((), np.zeros(0, dtype=int), np.zeros((0, 4, 2)), ())
        px = np.array([c for _, c in found], dtype=float)
        points = np.concatenate([self.markers[i] for i, _ in found])
        ideal = self.camera.undistort(px).reshape(-1, 2)
        _, turn, position = cv2.solvePnP(
            points, ideal, self.camera.matrix(), None, flags=cv2.SOLVEPNP_SQPNP
        )
        q, z = rotations.exp(turn[:, 0]), float(position[2, 0])
        sigma = (
            np.array([0.001, 0.001, 0.004, 0.02, 0.02, 0.02]) * z
        )  # metres and radians at z metres
        pose = TargetPose(position[:, 0], q, np.diag(sigma**2), 0.5)
        return PerceptionResult((pose,), np.array([i for i, _ in found]), px, ())
