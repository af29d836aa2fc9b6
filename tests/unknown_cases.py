# SPDX-License-Identifier: Apache-2.0
"""Points of a turning target in general position, as two chasers that hold beside it see them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from chaserdock_agents.mapper.types import CameraUncertainty, ConstantRates, ImageTracks
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from numpy.typing import NDArray

UNKNOWN: dict[str, Any] = {
    "name": "unknown",
    "duration_s": 60.0,
    "time": {"rate_hz": 15, "image_hz": 5},
    "perception": {"name": "features"},
    "target": {"model": "geo_servicer"},
    "camera": {"width_px": 960, "height_px": 540},
    "chasers": [
        {"position_m": [-1.9, 0.1, 0.2], "look_at": "target"},
        {"position_m": [-0.8, -1.7, -0.1], "look_at": "target"},
    ],
}
"""Two chasers beside a satellite that nobody described."""
FOCAL_PX = 830.0
LAB = CameraUncertainty(np.deg2rad(0.05), 0.0005, 0.0005, np.deg2rad(0.05), 0.0005)
TRUE = ConstantRates(
    0.0, np.array([0.03, -0.02, 0.05]), np.array([0.01, -0.004, 0.006]),
    np.array([0.021, 0.044, -0.029]),
)  # fmt: skip
PLACES = np.array([[-1.9, 0.1, 0.2], [-0.8, -1.7, -0.1]])
NOISE_PX = 0.3


def looking(place: Array) -> Array:
    """Return the rotation (3, 3), IRF to WRF, of a camera that looks at the origin, Z of WRF up."""
    z = -place / np.linalg.norm(place)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


@dataclass(frozen=True)
class PointTarget:
    """Points on a sphere of 0.5 m, each seen from its side; a new track begins whenever it comes
    into view.
    """

    seed: int
    points: int = 240
    chasers: int = 2
    motion: ConstantRates = TRUE
    noise_px: float = NOISE_PX

    def images(self, until_s: float, period_s: float = 0.4) -> Iterator[ImageTracks]:
        """Yield what the chasers see, with errors of grade `lab`."""
        rng = np.random.default_rng(self.seed)
        normals = rng.standard_normal((self.points, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        at = normals * rng.uniform(0.3, 0.5, (self.points, 1))
        turn = rng.normal(0.0, LAB.turn_rad, (self.chasers, 3))
        shift = rng.normal(0.0, LAB.shift_m, (self.chasers, 3))
        focal = 1.0 + rng.normal(0.0, LAB.focal_share, self.chasers)
        tracks = np.full((self.chasers, self.points), -1)
        seen_before = np.zeros((self.chasers, self.points), dtype=bool)
        following = 0
        for time_s in np.arange(0.0, until_s, period_s).tolist():
            p, r = self.motion.at([time_s])
            world = at @ r[0].T + p[0]
            for i in range(self.chasers):
                place = PLACES[i] + self.motion.velocity_m_s * time_s
                rotation = looking(PLACES[i])
                true = rotation @ rotations.to_matrix(rotations.exp(turn[i]))
                inside = (world - place - rotation @ shift[i]) @ true
                seen = np.einsum("ki,ki->k", place - world, normals @ r[0].T) > 0.5
                px = focal[i] * inside[:, :2] / inside[:, 2:]
                px = px + rng.normal(0.0, self.noise_px, px.shape) / FOCAL_PX
                new = seen & ~seen_before[i]
                tracks[i, new] = following + np.arange(int(new.sum()))
                following += int(new.sum())
                seen_before[i] = seen
                noise = rotations.exp(rng.normal(0.0, LAB.attitude_noise_rad, 3))
                order = np.argsort(tracks[i, seen])
                yield ImageTracks(
                    i, time_s, place + rng.normal(0.0, LAB.position_noise_m, 3),
                    rotation @ rotations.to_matrix(noise), tracks[i, seen][order],
                    px[seen][order], np.zeros(int(seen.sum())),
                )  # fmt: skip


Circle = tuple[Array, Array, float]
"""Centre (3,), unit normal (3,) and radius, TRF."""


def circle_points(circle: Circle) -> Array:
    """Return points (60, 3) of a circle."""
    centre, normal, radius = circle
    turn = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    one, other = np.linalg.svd(normal[None])[2][1:]
    return centre + radius * (np.cos(turn)[:, None] * one + np.sin(turn)[:, None] * other)


def ellipse_row(px: Array) -> Array:
    """Return the six numbers of the ellipse through pixels (n, 2), as in ``FeatureTracks``."""
    (x, y), (w, h), degrees = cv2.fitEllipseDirect(px.astype(np.float32))
    angle = np.deg2rad(degrees)
    longer, shorter, angle = (w, h, angle) if w >= h else (h, w, angle + np.pi / 2.0)
    return np.array([x, y, longer / 2.0, shorter / 2.0, angle % np.pi, 0.85])


def foil(seed: int = 3) -> NDArray[np.float64]:
    """Return a crinkled grey image (540, 960)."""
    rng = np.random.default_rng(seed)
    grain = cv2.GaussianBlur(rng.normal(size=(540, 960)), (0, 0), 4.0)
    return 110.0 + 18.0 * grain / grain.std()


def ring_image(background: NDArray[np.float64], grey: float = 30.0) -> NDArray[np.uint8]:
    """Return an image with a ring, a third of which something hides."""
    ring = np.zeros((1080, 1920), np.uint8)
    cv2.ellipse(ring, ((960.0, 540.0), (240.0, 150.0), 30.0), 255, 16, cv2.LINE_AA)
    share = cv2.resize(ring, (960, 540), interpolation=cv2.INTER_AREA) / 255.0
    image = np.asarray(background * (1.0 - share) + grey * share, dtype=np.float64)
    cv2.rectangle(image, (455, 295), (500, 360), 60.0, -1)
    return np.clip(image + np.random.default_rng(1).normal(0.0, 1.0, image.shape), 0, 255).astype(
        np.uint8
    )
