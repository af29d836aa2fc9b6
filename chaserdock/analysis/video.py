# SPDX-License-Identifier: Apache-2.0
"""Video of a recorded flight: external view beside the camera images with their detections."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.errors import ChaserdockError, errors_of_writing
from chaserdock_protocol.output_files import replaced
from chaserdock_protocol.recording.log import LogError
from chaserdock_world.orbit import earth_disc, to_sun
from chaserdock_world.rendering.background import Background, Earth, Light

from chaserdock.verdict import Verdict, verdict_of

from .body_renderer import BodyRenderer
from .chase_camera import BgrImage, BodyPose, RenderedBodies, Viewpoint, draw, tint
from .flight import RecordedFlight, load_flight
from .images import Pair, columns_for, shots
from .motion import TARGET, Track
from .scene import scene_of
from .snapshot import annotated_image
from .summary import summary_of_run, tracking_errors
from .time_series import ActuatorHistory, load_traces

ENDINGS = (".mp4", ".webp", ".gif")
_CODECS = {".mp4": "libx264", ".webp": "libwebp_anim", ".gif": "gif"}
_AZIMUTH_RAD, _ELEVATION_RAD = math.radians(-52.0), math.radians(26.0)
_TRAIL_S = 25.0
"""Time (s) of the path drawn behind each chaser. Larger: more of the manoeuvre, more crossing
lines.
"""
_INK = (235, 235, 235)
"""Colour (BGR, 0 to 255) of text: light on dark images."""
_MARGIN_PX = 8
"""Distance (px) of insets from the edge of the image."""
_DIM = (120, 120, 120)
"""Colour (BGR, 0 to 255) of axes: darker than curves and text."""
_PLUME_M = 0.16
"""Length (m) of the drawn plume of a thruster that is always open; for display only, long enough to
be seen beside a chaser.
"""
_TITLE_SHARE = 0.12
"""Share of the video during which the description, and at the end the verdict, is shown."""
_CLOSE_PHASES = frozenset({"approach", "final", "contact", "latched", "docked"})


def write_video(
    log: Path,
    out: Path,
    speed: float = 1.0,
    fps: int = 15,
    width_px: int = 1280,
    height_px: int = 720,
    part_s: tuple[float, float] = (0.0, math.inf),
    quality: int = 60,
    report_progress: Callable[[float], None] = lambda time_s: None,
) -> int:
    """Write the video of a log (or run folder); return the number of frames.

    ``out``: file that ends in .mp4 (H.264, yuv420p), .webp or .gif. ``speed``: simulated seconds
    per second of video. ``part_s``: simulated times of the first and last frame. ``quality``: of
    .webp, 0 to 100. ``report_progress``: receives the simulated time of each frame. Raise LogError
    for an unreadable log or one without motion or image, ChaserdockError for an invalid size or
    file.
    """
    ending = out.suffix.lower()
    if ending not in _CODECS:
        raise ChaserdockError(f"{out}: must end in {', '.join(ENDINGS)}")
    if width_px % 2 or height_px % 2:
        raise ChaserdockError(
            f"{width_px} x {height_px} pixels: both must be even (required by H.264 with yuv420p)"
        )
    if not part_s[0] < part_s[1]:
        raise ChaserdockError(f"a video from {part_s[0]:g} s to {part_s[1]:g} s has no length")

    flight = load_flight(log)
    if TARGET not in flight.motion:
        raise LogError(f"{log}: holds no motion of the target; nothing to film")

    number = 0
    with errors_of_writing(out), replaced(out) as new, av.open(str(new), "w") as container:
        stream: Any = container.add_stream(_CODECS[ending], rate=fps)
        stream.width, stream.height = width_px, height_px
        stream.pix_fmt = {".mp4": "yuv420p", ".webp": "yuv420p", ".gif": "rgb8"}[ending]
        stream.time_base = Fraction(1, fps)
        if ending == ".mp4":
            stream.options = {"crf": "21", "preset": "medium", "movflags": "+faststart"}
        elif ending == ".webp":
            stream.options = {"quality": str(quality), "loop": "0", "compression_level": "6"}

        for time_s, frame in frames(log, flight, speed / fps, width_px, height_px, part_s):
            report_progress(time_s)
            image = av.VideoFrame.from_ndarray(frame, format="bgr24")
            image.pts = number
            container.mux(stream.encode(image))
            number += 1
        if not number:
            after = f" after {part_s[0]:g} s" if part_s[0] > 0.0 else ""
            raise LogError(f"{log}: holds no image{after}; nothing to film")
        container.mux(stream.encode())
    return number


def frames(
    log: Path,
    flight: RecordedFlight,
    every_s: float,
    width_px: int,
    height_px: int,
    part_s: tuple[float, float] = (0.0, math.inf),
) -> Iterator[tuple[float, BgrImage]]:
    """Yield simulated time (s) and video frame (height, width, 3), BGR, every ``every_s`` of
    simulated time within ``part_s``.
    """
    number = len(flight.scenario.chasers)
    camera = flight.scenario.camera_model()
    aspect = camera.width_px / camera.height_px
    columns, shot_px = columns_for(number, aspect, round(0.38 * width_px), height_px)
    rows, shot_height_px = math.ceil(number / columns), round(shot_px / aspect)
    side_px = columns * shot_px
    verdict = verdict_of(summary_of_run(flight, log))
    external = _ExternalView(
        flight, load_plumes(log, flight), width_px - side_px, height_px, part_s, verdict
    )
    for time_s, latest in shots(log, number, every_s, part_s[0]):
        if time_s > part_s[1] + 1e-9:
            return
        frame = np.zeros((height_px, width_px, 3), dtype=np.uint8)
        frame[:, : width_px - side_px] = external.draw(time_s)
        top = max(0, (height_px - rows * shot_height_px) // 2)
        for i in range(number):
            x = width_px - side_px + (i % columns) * shot_px
            y = top + (i // columns) * shot_height_px
            image = _camera(flight, i, latest.get(i), shot_px)
            h = min(len(image), height_px - y)
            frame[y : y + h, x : x + shot_px] = image[:h]
            cv2.rectangle(frame, (x + 1, y + 1), (x + shot_px - 2, y + h - 2), tint(i).tolist(), 2)
        yield time_s, frame


def _camera(flight: RecordedFlight, chaser: int, pair: Pair | None, width_px: int) -> BgrImage:
    camera = flight.scenario.camera_model()
    height = round(width_px * camera.height_px / camera.width_px)
    status = "no image yet"
    if pair is not None:
        try:
            return annotated_image(flight.scenario, *pair, width_px)
        except LogError:
            status = "unreadable image"
    empty = np.full((height, width_px, 3), 24, dtype=np.uint8)
    cv2.putText(
        empty,
        f"chaser {chaser}  {status}",
        (8, 18),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.5,
        _INK,
        1,
        cv2.LINE_AA,
    )
    return empty


class _ExternalView:
    """Draws the mission from a fixed direction, frame by frame."""

    def __init__(
        self,
        flight: RecordedFlight,
        plumes: dict[int, ActuatorHistory],
        width_px: int,
        height_px: int,
        part_s: tuple[float, float],
        verdict: Verdict,
    ) -> None:
        self.flight, self._plumes, self._verdict = flight, plumes, verdict
        self.size = (width_px, height_px)
        self.scene = scene_of(flight.scenario)
        sun = np.array(to_sun(flight.scenario))
        self.sun = sun / np.linalg.norm(sun)

        self.numbers = flight.shown
        self.target = target = flight.motion[TARGET]

        self._begin_s, self._end_s = part_s[0], min(float(target.time_s[-1]), part_s[1])
        self._span_s = max(self._end_s - self._begin_s, 1e-3)
        self._sky: BgrImage | None = None
        self._mesh = flight.scenario.target.nominal_mesh()
        self._renderers: dict[tuple[int, int], BodyRenderer] = {}
        self.chasers = {i: flight.motion[f"chaser/{i}"] for i in self.numbers}

        reach, distances, speeds = 0.3, {}, {}
        for i, own in self.chasers.items():
            time_s, away_m = own.distance_to(target)
            closing_m_s = -np.gradient(away_m, time_s) if len(time_s) > 2 else 0.0 * away_m
            inside = (time_s >= part_s[0]) & (time_s <= part_s[1])
            distances[i] = time_s[inside], away_m[inside]
            speeds[i] = time_s[inside], closing_m_s[inside] * 1e3
            reach = max(reach, float(away_m[inside].max(initial=0.0)))
        self._graphs = (_graph("distance / m", distances), _graph("closing / mm/s", speeds))
        # Distant chasers must not shrink all others.
        self.distance_m = 3.5 * min(reach, 3.0)

        self.errors = {i: tracking_errors(flight, i) for i in self.numbers}
        self.phases = {
            i: flight.references[i].phases if i in flight.references else [] for i in self.numbers
        }
        self.seen = {
            i: s.time_s[s.seen] for i in self.numbers if (s := flight.sightings.get(i)) is not None
        }

    def draw(self, time_s: float) -> BgrImage:
        """Draw the mission at a simulated time, with clock and phases."""
        chasers = {i: _pose(own, time_s) for i, own in self.chasers.items()}
        paths: dict[int | None, Any] = {None: _trail(self.target, time_s)}
        paths |= {i: _trail(own, time_s) for i, own in self.chasers.items()}
        at = _pose(self.target, time_s)
        look = Viewpoint(at[0], self.distance_m, _AZIMUTH_RAD, _ELEVATION_RAD, *self.size)
        at_s = _time_of(self.target, time_s)
        seeing = frozenset(i for i, seen_s in self.seen.items() if self._is_near(seen_s, at_s))
        plumes = {i: self._plumes_at(i, time_s) for i in chasers if i in self._plumes}
        rendered = self._rendered(look, at, chasers)
        background = self._background(look) if rendered is None else None
        image = draw(
            self.scene, look, self.sun, at, chasers, paths, seeing, plumes, background, rendered
        )
        self._close_up(image, at, chasers, plumes, seeing, time_s)
        self._draw_graph(image, time_s)
        self._write(image, time_s)
        return image

    def _is_near(self, seen_s: Array, time_s: float) -> bool:
        """Return whether one of the ascending times (K,) s is within half a tick of a time."""
        row = int(np.searchsorted(seen_s, time_s))
        half_s = 0.5 / self.flight.scenario.time.rate_hz
        return any(abs(t - time_s) < half_s for t in seen_s[max(0, row - 1) : row + 1])

    def _background(self, look: Viewpoint) -> BgrImage:
        """Return stars and Earth as the simulated cameras see them, in the direction of view."""
        if self._sky is None:
            disc = earth_disc(self.flight.scenario)
            space = Background(
                look.pinhole(), np.zeros(2), self.size, None if disc is None else Earth(*disc)
            )
            x, y, z = self.sun.tolist()
            grey = space.draw(look.attitude(), Light((x, y, z)))
            self._sky = np.repeat(grey[:, :, None], 3, axis=2)
        return self._sky

    def _rendered(
        self, look: Viewpoint, at: BodyPose, chasers: dict[int, BodyPose]
    ) -> RenderedBodies | None:
        """Return the rendered bodies; None for a target without a mesh, whose faces are drawn."""
        if self._mesh is None:
            return None
        size = (look.width_px, look.height_px)
        if size not in self._renderers:
            self._renderers[size] = BodyRenderer(self.flight.scenario, self._mesh, look)
        return self._renderers[size].render(look, at, chasers, tint)

    def _plumes_at(self, chaser: int, time_s: float) -> Array:
        """Return nozzles and plume ends (K, 2, 3), CRF, of a chaser's thrusters that are open at a
        time.
        """
        history, thrusters = self._plumes[chaser], self.flight.scenario.chaser.thrusters
        row = min(_row(history.edges_s, time_s), len(history.thruster_duty) - 1)
        lines = [
            (
                t.position_m,
                np.subtract(t.position_m, np.multiply(t.direction, _PLUME_M * (0.4 + 0.6 * duty))),
            )
            for t, duty in zip(thrusters, history.thruster_duty[row], strict=True)
            if duty > 0.02
        ]
        return np.array(lines).reshape(-1, 2, 3)

    def _close_up(
        self,
        image: BgrImage,
        at: BodyPose,
        chasers: dict[int, BodyPose],
        plumes: dict[int, Array],
        seeing: frozenset[int],
        time_s: float,
    ) -> None:
        """Draw an enlarged view of the gap between the target and a docking chaser into the upper
        right corner.
        """
        close = {
            i: position - at[0]
            for i, (position, _) in chasers.items()
            if _phase(self.phases[i], time_s) in _CLOSE_PHASES
        }
        width = round(0.38 * self.size[0])
        if not close or width < 120:
            return
        nearest = min(close, key=lambda i: float(np.linalg.norm(close[i])))
        away = close[nearest]
        # From the side, so that the gap between the bodies is visible.
        across_rad = math.atan2(away[1], away[0]) - math.pi / 2.0
        distance_m = 2.6 * float(np.linalg.norm(away))
        look = Viewpoint(
            at[0] + away / 2.0, distance_m, across_rad, _ELEVATION_RAD, width, round(0.75 * width)
        )
        rendered = self._rendered(look, at, chasers)
        view = draw(self.scene, look, self.sun, at, chasers, {}, seeing, plumes, rendered=rendered)
        h, w = view.shape[:2]
        x = self.size[0] - w - _MARGIN_PX
        image[_MARGIN_PX : _MARGIN_PX + h, x : x + w] = view
        cv2.rectangle(
            image,
            (x, _MARGIN_PX),
            (x + w - 1, _MARGIN_PX + h - 1),
            tint(nearest).tolist(),
            1,
            cv2.LINE_AA,
        )

    def _draw_graph(self, image: BgrImage, time_s: float) -> None:
        """Draw distances to the target and closing speeds since the start of the video into the
        lower right corner.
        """
        width, height = round(0.38 * self.size[0]), round(0.15 * self.size[1])
        if width < 160 or height < 40:
            return
        x0 = self.size[0] - width - _MARGIN_PX
        for place, graph in enumerate(self._graphs):
            y0 = self.size[1] - (2 - place) * (height + _MARGIN_PX)
            cv2.line(image, (x0, y0 + height), (x0 + width, y0 + height), _DIM, 1)
            label = f"{graph.label}, up to {graph.high:.3g}"
            cv2.putText(
                image,
                label,
                (x0 + 4, y0 + 10),
                cv2.FONT_HERSHEY_SIMPLEX,
                0.42,
                _INK,
                1,
                cv2.LINE_AA,
            )
            for i, (times_s, values) in graph.series.items():
                until = times_s <= time_s + 1e-6
                x = x0 + (times_s[until] - self._begin_s) / self._span_s * width
                share = np.clip((values[until] - graph.low) / (graph.high - graph.low), 0.0, 1.0)
                points = (
                    np.stack([x, y0 + height - share * (height - 14)], axis=1)
                    .round()
                    .astype(np.int32)
                )
                cv2.polylines(image, [points], False, tint(i).tolist(), 1, cv2.LINE_AA)

    def _write(self, image: BgrImage, time_s: float) -> None:
        def put(text: str, x: int, y: int, bgr: Any, size: float = 0.5) -> None:
            cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, bgr, 1, cv2.LINE_AA)

        put(f"{self.flight.scenario.name}", _MARGIN_PX + 4, 24, _INK, 0.6)
        put(f"t = {time_s:6.1f} s", _MARGIN_PX + 4, 48, _INK, 0.6)
        if time_s - self._begin_s < _TITLE_SHARE * self._span_s:
            for line, text in enumerate(
                wrapped(self.flight.scenario.description, self.size[0] - 3 * _MARGIN_PX, 0.5)
            ):
                put(text, _MARGIN_PX + 4, 72 + 20 * line, _INK, 0.5)
        if (
            self._end_s - time_s < _TITLE_SHARE * self._span_s
            and self._end_s >= float(self.target.time_s[-1]) - 1e-6
        ):
            put(self._verdict.headline, _MARGIN_PX + 4, 72, _INK, 0.8)
            lines = (
                part
                for text in self._verdict.lines()
                for part in wrapped(text, self.size[0] - 3 * _MARGIN_PX, 0.5)
            )
            for line, text in enumerate(lines):
                put(text, _MARGIN_PX + 4, 96 + 20 * line, _INK, 0.5)
        for line, i in enumerate(self.numbers):
            phase = _phase(self.phases[i], time_s)
            times, position, _ = self.errors[i]
            error = f"{1e3 * position[_row(times, time_s)]:7.2f} mm error" if len(times) else ""
            y = self.size[1] - 14 - 20 * (len(self.numbers) - 1 - line)
            put(f"chaser {i}  {phase:<9}", _MARGIN_PX + 4, y, tint(i).tolist())
            put(error, _MARGIN_PX + 180, y, _INK)


def wrapped(text: str, width_px: int, size: float) -> list[str]:
    """Return the text in lines of at most ``width_px`` as cv2.putText draws them. Longer words are
    not broken.
    """
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".lstrip()
        if (
            lines[-1]
            and cv2.getTextSize(longer, cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0] > width_px
        ):
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def _phase(phases: list[tuple[float, str]], time_s: float) -> str:
    return next((name for t, name in reversed(phases) if t <= time_s + 1e-9), "waiting")


def load_plumes(log: Path, flight: RecordedFlight) -> dict[int, ActuatorHistory]:
    """Return the actuator histories of the chasers that have thrusters."""
    if flight.scenario.chaser.actuation != "thrusters":
        return {}
    histories = load_traces(log, flight.scenario).inputs
    return {i: h for i, h in histories.items() if h.thruster_duty.shape[1]}


@dataclass(frozen=True)
class _Graph:
    """Values of each chaser over the shown part of the flight, and their scale. ``series``: times
    (K,) s and values (K,).
    """

    label: str
    series: dict[int, tuple[Array, Array]]
    low: float
    high: float


def _graph(label: str, series: dict[int, tuple[Array, Array]]) -> _Graph:
    """Return a graph whose scale excludes the extreme hundredths of the values."""
    known = np.concatenate(
        [values for _, values in series.values() if len(values)] or [np.zeros(1)]
    )
    low, high = min(0.0, float(np.percentile(known, 1))), max(1e-3, float(np.percentile(known, 99)))
    return _Graph(label, series, low, high)


def _row(times_s: Array, time_s: float) -> int:
    """Return the row of the last of the times (K,) up to ``time_s``; the first row if there is
    none.
    """
    return max(0, int(np.searchsorted(times_s, time_s + 1e-6)) - 1)


def _time_of(track: Track, time_s: float) -> float:
    return float(track.time_s[_row(track.time_s, time_s)])


def _pose(track: Track, time_s: float) -> BodyPose:
    """Return the pose at the last tick up to a time, as in an image of that time."""
    row = _row(track.time_s, time_s)
    return track.position_m[row], track.q_wxyz[row]


def _trail(track: Track, time_s: float) -> Any:
    first = int(np.searchsorted(track.time_s, time_s - _TRAIL_S))
    return track.position_m[first : _row(track.time_s, time_s) + 1 : 3]
