# SPDX-License-Identifier: Apache-2.0
"""Errors of sightings by shape in flights, over their stated covariances: ``python
benchmarks/sighting_errors.py [--only PART] [--flights N] [--first SEED] [--set KEY=VALUE] [--quick]
[--json FILE]``.

Parts: ``docking``, ``capture`` and ``inspection``, the missions of ``markerless_missions.py``,
flown in one process with rendered images. ``--quick``: one flight of 30 s. Each sighting is
compared with the true pose of the target in the true camera, of position and rotation apart:

- squared error normalized by the stated covariance, 3 expected;
- correlation of the errors of one chaser at several lags, and of two chasers at one tick: mean
  products of errors, as ratios to their mean square. Errors are whitened by the stated covariance
  in the axes of TRF, and their mean is not subtracted.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Image, PoseSolution, Sighting
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.rendering.cameras import States
from chaserdock_world.sensors.errors import true_camera
from common import Figures, make_parser, run_parts, use_one_thread
from flights import load_shipped
from markerless_missions import QUICK, SCENARIOS

from chaserdock.analysis.pose_errors import pose_error
from chaserdock.experiments.in_process import InProcessMission
from chaserdock.experiments.perception import RenderedImages

LAGS_S = (0.0, 1.0, 5.0, 20.0)
"""Lags of the correlations; 0 stands for the next image."""
KINDS = {"position": slice(0, 3), "rotation": slice(3, 6)}


def whitened_error(true_position_m: Array, true_q: Array, solution: PoseSolution) -> Array:
    """Return the error (6,) of a solution over its stated covariance, in the axes of TRF; true pose
    in IRF.
    """
    q = np.array(solution.q_wxyz)
    error = pose_error(true_position_m, true_q, np.array(solution.position_m), q)
    axes = np.eye(6)
    axes[:3, :3] = rotations.to_matrix(q).T
    covariance = axes @ np.reshape(solution.covariance, (6, 6)) @ axes.T
    error = axes @ error
    return np.concatenate(
        [np.linalg.solve(np.linalg.cholesky(covariance[k, k]), error[k]) for k in KINDS.values()],
        dtype=np.float64,
    )


class JudgedImages(RenderedImages):
    """Rendered images and perceptions that keep the whitened errors (6,) of all images, by chaser;
    NaN without a pose.
    """

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        self._true_cameras = [true_camera(scenario, i) for i in range(len(scenario.chasers))]
        self._truth: dict[int, tuple[Array, Array]] = {}
        self.errors: list[list[Array]] = [[] for _ in scenario.chasers]

    def image(self, chaser: int, tick: int, time_ns: int, states: States) -> Image:
        own, target = states[f"chaser/{chaser}"], states[TARGET]
        eye, attitude = self._true_cameras[chaser].irf_pose_in_world(own.position_m, own.q_wxyz)
        q = rotations.multiply(rotations.conjugate(attitude), target.q_wxyz)
        self._truth[chaser] = rotations.rotate_inverse(attitude, target.position_m - eye), q
        return super().image(chaser, tick, time_ns, states)

    def see(self, chaser: int, image: Image) -> Sighting:
        sighting = super().see(chaser, image)
        single = len(sighting.solutions) == 1
        error = (
            whitened_error(*self._truth[chaser], sighting.solutions[0])
            if single
            else np.full(6, math.nan)
        )
        self.errors[chaser].append(error)
        return sighting


def correlation(a: Array, b: Array) -> float:
    """Return the correlation of errors (images, 3) without subtracting their means; of images in
    which both are known.
    """
    both = np.isfinite(a[:, 0]) & np.isfinite(b[:, 0])
    a, b = a[both], b[both]
    return float(np.sum(a * b) / math.sqrt(np.sum(a * a) * np.sum(b * b)))


def statistics(errors: Array, images_per_s: float) -> Figures:
    """Return the figures of the errors (chasers, images, 6) of one flight."""
    figures: Figures = {}
    for kind, part in KINDS.items():
        of_kind = errors[:, :, part]
        squares = np.sum(of_kind**2, axis=2)
        figures[f"{kind}_nees"] = float(np.nanmean(squares))
        for lag_s in LAGS_S:
            lag = max(1, round(lag_s * images_per_s))
            values = [correlation(e[:-lag], e[lag:]) for e in of_kind]
            figures[f"{kind}_correlation_{f'{lag_s:g}_s' if lag_s else 'next'}"] = float(
                np.mean(values)
            )
        pairs = [correlation(*pair) for pair in itertools.combinations(of_kind, 2)]
        figures[f"{kind}_correlation_cameras"] = float(np.mean(pairs))
    return figures


def fly(scenario: Scenario) -> Figures:
    """Fly one mission to its end and return the figures of its sightings."""
    images = JudgedImages(scenario)
    with InProcessMission(scenario, images) as flight:
        while flight.tick < scenario.ticks:
            flight.step()
    return statistics(
        np.array(images.errors), scenario.timing.rate_hz / scenario.timing.ticks_per_image
    )


def fly_part(part: str, seeds: range, changes: tuple[str, ...]) -> Figures:
    """Fly the seeds of a part; return the mean of each figure."""
    flights = []
    for seed in seeds:
        flights.append(fly(load_shipped(SCENARIOS[part], f"seed={seed}", *changes)))
        print(f"  {seed}: " + ", ".join(f"{k} {v:.2f}" for k, v in flights[-1].items()), flush=True)
    return {f"{part}_{name}": float(np.mean([f[name] for f in flights])) for name in flights[0]}


def main() -> None:
    parser = make_parser(__doc__, SCENARIOS)
    parser.add_argument("--flights", type=int, default=2, help="number of seeds")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="scenario override"
    )
    options = parser.parse_args()
    use_one_thread()
    flights = 1 if options.quick else options.flights
    seeds, changes = range(options.first, options.first + flights), tuple(options.set)
    changes += QUICK if options.quick else ()
    run_parts(
        options, {part: (lambda part=part: fly_part(part, seeds, changes)) for part in SCENARIOS}
    )


if __name__ == "__main__":
    main()
