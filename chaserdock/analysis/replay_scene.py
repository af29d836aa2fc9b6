# SPDX-License-Identifier: Apache-2.0
"""Data of the report's 3-D replay: the decimated flight, bodies, and small camera images.

The replay is our own canvas script (page/replay.js, 15 kB) because the export of viser 1.1
(``StateSerializer.as_html``), although it opens offline from ``file://``, was measured to fit the
report less well. For docking-contact (70 s at 10 Hz) it adds 1.2 MB, 0.8 MB of it the client; our
data add 0.17 MB (camera images excluded), 0.05 MB of it the bodies. It needs WebAssembly and thus a
page policy with ``unsafe-eval``; with the policy of the report it does not start. It contains no
GUI elements: no table and camera images that follow the time line, and no seeking from the list of
events.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.recording.log import LogError
from chaserdock_world.orbit import to_sun
from numpy.typing import NDArray

from .camera_frustum import camera_frustum
from .charts import ArrayPool
from .columns import nanoseconds, rows_since
from .dressed_bodies import AMBIENT, GAMMA, DressedBody, chaser_body, target_body
from .flight import RecordedFlight
from .images import Pair, shots
from .motion import TARGET, Track
from .snapshot import annotated_image
from .summary import tracking_errors
from .time_series import Traces

_MOST_SAMPLES = 1200
"""Largest number of rows of a body in a report: ten a second for two minutes. Larger: smoother
replay, larger page.
"""
_MOST_SHOTS = 120
"""Largest number of images of a chaser in a report. Larger: images follow the replay more closely,
larger page.
"""
_SHOT_WIDTH_PX = 256
"""Width (px) of the images in a report. Larger: sharper images, larger page."""


_MOST_UNITS = 32_000
"""Largest coordinate of a body in units, within 16 bits: units of 0.03 mm for a body of 1 m, a
tenth of the distance between paint and surface.
"""


def _numbers(values: Array, digits: int) -> list[float]:
    # Adding 0.0 turns -0.0 into 0.0.
    return (np.round(np.asarray(values, dtype=float).ravel(), digits) + 0.0).tolist()


def _body(body: DressedBody, pool: ArrayPool) -> dict[str, Any]:
    """Return the triangles of a body's coats: corners in ``unit_m`` as 16-bit integers."""
    surfaces = body.surfaces()
    unit_m = max(float(np.abs(soup.corners_m).max()) for soup in surfaces.values()) / _MOST_UNITS
    return {
        "unit_m": unit_m,
        "coats": [
            {
                "rgb": coat.rgb,
                "specular": coat.specular,
                "exponent": coat.exponent,
                "corners": pool.add(np.round(soup.corners_m / unit_m), "<i2"),
            }
            for coat, soup in surfaces.items()
        ],
    }


def _rows_until_end(time_s: Array, at_s: Array) -> NDArray[np.intp]:
    """Return for each of the times ``at_s`` up to the end of ``time_s`` the row of the latter that
    is newest then, or the first.
    """
    until = at_s[at_s <= time_s[-1]] if len(time_s) else at_s[:0]
    return np.maximum(rows_since(nanoseconds(time_s), nanoseconds(until)), 0)


def _thinned(track: Track, rows: NDArray[Any]) -> dict[str, Any]:
    return {"p": _numbers(track.position_m[rows], 4), "q": _numbers(track.q_wxyz[rows], 4)}


def replay_data(flight: RecordedFlight, traces: Traces, images: dict[str, Any]) -> dict[str, Any]:
    """Return the replay as plain values for JSON: times (s), flat positions (m, WRF) and attitudes,
    phases, outcomes of images.

    The rows of the bodies belong to ``times``: evenly spaced, at most ``_MOST_SAMPLES``; fewer for
    a lost body.
    """
    target = flight.motion[TARGET]
    rows = np.arange(0, len(target.time_s), max(1, -(-len(target.time_s) // _MOST_SAMPLES)))
    if rows[-1] != len(target.time_s) - 1:
        rows = np.append(rows, len(target.time_s) - 1)

    chasers, reach_m = [], 0.3
    for i in flight.shown:
        own = flight.motion[f"chaser/{i}"]
        both_s, position, _ = tracking_errors(flight, i)
        mine = _rows_until_end(own.time_s, target.time_s[rows])
        errors = _rows_until_end(both_s, target.time_s[rows])
        _, distance = own.distance_to(target)
        # Distant chasers must not shrink all others.
        reach_m = max(reach_m, min(float(distance.max()), 3.0))

        outcomes = traces.image_outcomes.get(i)
        reference = flight.references.get(i)
        chasers.append(
            {
                "id": i,
                **_thinned(own, mine),
                "phase": [
                    [round(t, 3), name] for t, name in (reference.phases if reference else [])
                ],
                "outcome": [[round(t, 3), o] for t, _, o in outcomes.intervals()]
                if outcomes
                else [],
                "error_mm": [float(f"{1e3 * e:.3g}") for e in position[errors]],
            }
        )

    pool, frustum = ArrayPool(), camera_frustum(flight.scenario)
    target_shape = _body(target_body(flight.scenario), pool)
    for chaser in chasers:
        chaser["body"] = _body(chaser_body(flight.scenario, chaser["id"]), pool)
    return {
        "times": _numbers(target.time_s[rows], 3),
        "motion": flight.motion.describe().capitalize(),
        "reach_m": reach_m,
        "sun": list(to_sun(flight.scenario)),
        "ambient": AMBIENT,
        "gamma": GAMMA,
        "target": _thinned(target, rows) | {"body": target_shape},
        "chasers": chasers,
        "camera_origin": _numbers(frustum.origin_m, 4),
        "camera_corners": _numbers(frustum.corners_m, 4),
        "arrays": pool.arrays,
        "images": images,
    }


def small_images(log: Path, flight: RecordedFlight) -> dict[str, Any]:
    """Return camera images with detections as data URLs, at most ``_MOST_SHOTS`` per chaser:
    ``times`` (s) and ``chasers`` by number.

    A missing or unreadable image is an empty string.
    """
    number = len(flight.scenario.chasers)
    every_s = max(1.0, flight.scenario.duration_s / _MOST_SHOTS)
    times: list[float] = []
    out: dict[str, list[str]] = {str(i): [] for i in range(number)}
    for time_s, latest in shots(log, number, every_s):
        times.append(round(time_s, 3))
        for i in range(number):
            out[str(i)].append(_data_url(flight, latest[i]) if i in latest else "")
    return {"times": times, "chasers": {i: urls for i, urls in out.items() if any(urls)}}


def _data_url(flight: RecordedFlight, pair: Pair) -> str:
    try:
        image = annotated_image(flight.scenario, *pair, _SHOT_WIDTH_PX)
    except LogError:
        return ""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 72])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
