# SPDX-License-Identifier: Apache-2.0
"""What the chasers see of the target in an in-process mission: rendered images, or a statistical
measurement model.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from chaserdock_agents.chaser.perception import make_perception
from chaserdock_agents.chaser.sighting import apply_geometry, look, prediction_from
from chaserdock_models import rotations
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import ExpectedPose, Image, PoseSolution, Sighting, WrenchCommand
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.rendering.cameras import States
from chaserdock_world.rendering.pose_cameras import make_cameras
from chaserdock_world.sensors.errors import true_camera

PerceptionModel = Callable[[int, int, int, States], Sighting]
"""Maps chaser, tick, time (ns) and the true states of all bodies to the chaser's sighting."""

_LEAST_SIGMA = 1e-4
"""m and rad: the covariance of a measurement without noise must be positive definite, too."""


class RenderedImages:
    """Render each chaser's image, with the scenario's camera errors and effects, and run its
    perception on it.

    With statistical perception no image is rendered. ``on_image`` sees every image, and returns the
    one that perception gets.
    """

    def __init__(
        self, scenario: Scenario, on_image: Callable[[Image], Image] = lambda image: image
    ) -> None:
        self._ticks_per_image = scenario.timing.ticks_per_image
        self._cameras = make_cameras(scenario)
        self._perceptions = [make_perception(scenario) for _ in scenario.chasers]
        self._last: dict[int, Sighting] = {}
        self._expected: dict[int, ExpectedPose | None] = {}
        self._on_image = on_image

    def __call__(self, chaser: int, tick: int, time_ns: int, states: States) -> Sighting:
        return self.see(chaser, self.image(chaser, tick, time_ns, states))

    def image(self, chaser: int, tick: int, time_ns: int, states: States) -> Image:
        """Return a chaser's image."""
        return self._cameras.image(chaser, tick // self._ticks_per_image, tick, time_ns, states)

    def see(self, chaser: int, image: Image) -> Sighting:
        """Return the sighting in a chaser's image."""
        predicted = prediction_from(
            self._last.get(chaser), self._expected.get(chaser), image.sim_time_ns
        )
        self._last[chaser] = look(self._perceptions[chaser], self._on_image(image), predicted)
        return self._last[chaser]

    def inform(self, chaser: int, command: WrenchCommand) -> None:
        """Pass on what a command tells about the target, as the chaser's process does.

        Raises RuntimeError for geometry that the perception refuses.
        """
        self._expected[chaser] = command.expected
        if refused := apply_geometry(self._perceptions[chaser], command.geometry):
            raise RuntimeError(refused)


def measurement_model(
    scenario: Scenario,
    seed: int,
    position_sigma_m: float = 0.0,
    attitude_sigma_rad: float = 0.0,
    dropout: float = 0.0,
) -> PerceptionModel:
    """Return a perception that measures the target's true pose with white noise of these sigmas per
    axis.

    ``dropout``: the share of images without a detection. Each camera has the errors that the world
    gives it.
    """
    rng = np.random.default_rng([seed, 0xE1E])
    nominal = scenario.camera_model()
    cameras = [true_camera(scenario, i) for i in range(len(scenario.chasers))]
    sigmas = [max(position_sigma_m, _LEAST_SIGMA)] * 3 + [max(attitude_sigma_rad, _LEAST_SIGMA)] * 3
    covariance = vector(np.diag(np.square(sigmas)))

    def measure(chaser: int, tick: int, time_ns: int, states: States) -> Sighting:
        own, target = states[f"chaser/{chaser}"], states[TARGET]
        camera = cameras[chaser]
        eye, attitude = camera.irf_pose_in_world(own.position_m, own.q_wxyz)
        position = rotations.rotate_inverse(attitude, target.position_m - eye)
        # With a longer focal length than calibrated, the target seems nearer.
        position = position * [1.0, 1.0, nominal.fx_px / camera.fx_px]
        position = position + rng.normal(0.0, position_sigma_m, 3)
        q_world = rotations.multiply(
            target.q_wxyz, rotations.exp(rng.normal(0.0, attitude_sigma_rad, 3))
        )
        solution = PoseSolution(
            position_m=vector(position),
            q_wxyz=vector(rotations.multiply(rotations.conjugate(attitude), q_world)),
            covariance=covariance,
            reprojection_rms_px=0.1,
        )
        missed = rng.random() < dropout
        return Sighting(
            tick=tick,
            sim_time_ns=time_ns,
            chaser=chaser,
            status="nothing" if missed else "seen",
            solutions=() if missed else (solution,),
            marker_ids=() if missed else (0, 1, 2, 3),
            corners_px=(),
            rejected_ids=(),
        )

    return measure
