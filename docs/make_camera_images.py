# SPDX-License-Identifier: Apache-2.0
"""Renders the images of docs/cameras.md: ``python docs/make_camera_images.py [FOLDER]`` (default:
docs/images).

One image for each effect and target: the view of chaser 0 of ``harsh-light`` at its start, with one
setting changed.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.scenario import load_scenario
from chaserdock_world.physics.simulation import TARGET, BodyState, prescribed_state
from chaserdock_world.rendering.cameras import Cameras

ROOT = Path(__file__).resolve().parents[1]
WITHOUT_EFFECTS = (
    "camera.effects.gain=1.0",
    "camera.effects.point_spread_px=0.0",
    "camera.effects.read_noise=0.0",
    "camera.effects.shot_noise=0.0",
    "camera.effects.exposure_s=0.0",
    "camera.effects.glare=0.0",
    "camera.intrinsics.distortion=[]",
    "camera.lamp=0.0",
    "camera.sun_direction=[-0.4, -0.5, 0.77]",
    "camera.ambient=0.35",
    "camera.earth={direction=[0.0, 0.0, -1.0], radius_deg=2.0}",
    "camera.eclipses=[]",
)
ECLIPSE = "camera.eclipses=[{from_s=0.0, to_s=9.0}]"
SUN = "camera.sun_direction=[1.0, -0.12, 0.22]"
IMAGES: dict[str, tuple[str, ...]] = {
    "camera-plain": (),
    "camera-paper": ("target.model='paper'",),
    "camera-distortion": ("camera.intrinsics.distortion=[-0.35, 0.12, 0.001, -0.001, 0.0]",),
    "camera-motion-blur": ("camera.effects.exposure_s=0.2",),
    "camera-noise": (
        "camera.effects.point_spread_px=1.5",
        "camera.effects.read_noise=8.0",
        "camera.effects.shot_noise=0.3",
    ),
    "camera-overexposed": ("camera.effects.gain=1.6",),
    "camera-jpeg": ("camera.effects.jpeg_quality=8",),
    "camera-sun": (SUN, "camera.ambient=0.15", "camera.effects.glare=2000.0"),
    "camera-earth": ("camera.earth={direction=[0.35, 0.4, -0.83], radius_deg=64.0}",),
    "camera-eclipse": (ECLIPSE, "camera.lamp=0.0"),
    "camera-eclipse-lamp": (ECLIPSE, "camera.lamp=60.0"),
    "camera-harsh-light": (),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "folder", nargs="?", type=Path, default=ROOT / "docs" / "images", metavar="FOLDER"
    )
    folder: Path = parser.parse_args().folder
    for name, changes in IMAGES.items():
        base = () if name == "camera-harsh-light" else WITHOUT_EFFECTS
        scenario = load_scenario(ROOT / "scenarios" / "harsh-light.toml", (*base, *changes))
        cameras = Cameras(scenario)
        states = {TARGET: prescribed_state(scenario, 0.0)}
        # An attitude that shows three faces, and a rate for the motion blur.
        q = rotations.exp([0.25, 0.35, 0.45])
        states[TARGET] = BodyState(
            states[TARGET].position_m, states[TARGET].velocity_m_s, q, np.array([0.1, 0.2, 0.3])
        )
        for i in range(len(scenario.chasers)):
            position, attitude = scenario.start_pose(i)
            states[f"chaser/{i}"] = BodyState(position, np.zeros(3), attitude, np.zeros(3))
        image = cameras.image(0, 0, 0, 0, states)
        decoded: Any = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        small = cv2.resize(decoded, (640, 360), interpolation=cv2.INTER_AREA)
        path = folder / f"{name}.jpg"
        cv2.imwrite(str(path), small, [cv2.IMWRITE_JPEG_QUALITY, 80])
        print(f"{path}  {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
