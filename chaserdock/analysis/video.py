# SPDX-License-Identifier: Apache-2.0
"""Video of a recorded flight: an outside view that follows the docking, with the camera images and
their detections, slow motion at contact, and the verdict as last card.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol, cast

import av
import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.errors import ChaserdockError, errors_of_writing
from chaserdock_protocol.output_files import replaced
from chaserdock_protocol.recording.log import LogError
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.orbit import earth_disc, to_sun

from chaserdock.criterion import table_rows
from chaserdock.verdict import Verdict, verdict_of

from .body_renderer import BodyRenderer
from .camera_frustum import camera_frustum
from .chase_camera import (
    BgrImage,
    RenderedBodies,
    Shot,
    Viewpoint,
    draw,
    interpolated,
    tint,
)
from .chase_path import ChasePath, FilmClock, approaches
from .flight import RecordedFlight, load_flight
from .images import Pair, columns_for, latest_images, pairs
from .motion import TARGET, Track
from .snapshot import annotated_image
from .summary import summary_of_run, tracking_errors
from .time_series import ActuatorHistory, load_traces

ENDINGS = (".mp4", ".webp", ".gif")
_CODECS = {".mp4": "libx264", ".webp": "libwebp_anim", ".gif": "gif"}
_TRAIL_S = 25.0
"""Time (s) of the path drawn behind each chaser. Larger: more of the manoeuvre, more crossing
lines.
"""
_INK = (240, 240, 240)
"""Colour (BGR, 0 to 255) of text, which has a dark outline: it is read on space and on clouds."""
_OUTLINE = (12, 12, 12)
"""Colour (BGR, 0 to 255) of the outline: almost black."""
_MARGIN_PX = 8
"""Distance (px) of insets from the edge of the image."""
_PLUME_M = 0.16
"""Length (m) of the drawn plume of a thruster that is always open; for display only, long enough to
be seen beside a chaser.
"""
_COLUMN_SHARE = 0.28
"""Share of the width that camera images and close-up take: markers in them are still seen."""
_TITLE_S = 4.0
"""Time (s) of the film during which the description is shown: two lines are read in it."""
_CARD_S = 4.0
"""Time (s) of the last card: a dozen rows of a table are looked over."""
_CARD_DIM = 0.22
"""Brightness of the last picture behind the card: seen, but text is read."""
_RATE_S = 0.4
"""Time (s) over which the closing speed is averaged: six ticks, without the noise of pulses."""

RendererName = Literal["fast", "path"]
_BGR = {"met": (140, 200, 130), "not met": (90, 90, 240), "not judged": (110, 200, 240)}
"""Colours (BGR) of the outcomes of criteria."""


class Bodies(Protocol):
    """Renders the bodies of a film."""

    def render(self, shot: Shot) -> RenderedBodies:
        """Return the picture of a shot."""
        ...


class FastBodies:
    """Renders by rasterizing, as the simulated cameras do."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._renderers: dict[tuple[Any, ...], BodyRenderer] = {}

    def render(self, shot: Shot) -> RenderedBodies:
        """Return the picture of a shot."""
        look, chasers = shot.look, tuple(shot.chasers)
        key = (look.width_px, look.height_px, look.middle_px, chasers)
        if key not in self._renderers:
            self._renderers[key] = BodyRenderer(self._scenario, chasers, look)
        return self._renderers[key].render(look, shot.target, shot.chasers)


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
    renderer: RendererName = "fast",
    samples: int = 16,
    jobs: int = 1,
) -> int:
    """Write the video of a log (or run folder); return the number of frames.

    ``out``: file that ends in .mp4 (H.264, yuv420p), .webp or .gif. ``speed``: simulated seconds
    per second of video, away from contact. ``part_s``: simulated times of the first and last frame.
    ``quality``: of .webp, 0 to 100. ``report_progress``: receives the simulated time of each frame.
    ``renderer``: ``path`` traces ``samples`` paths of light a pixel in ``jobs`` processes, by the
    extra ``film``. Raise LogError for an unreadable log or one without motion or image,
    ChaserdockError for an invalid size or file.
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
    film = film_of(log, load_flight(log), speed, fps, width_px, height_px, part_s)
    if renderer == "path":
        from chaserdock.film.frames import PathTracedBodies

        folder = out.with_name(out.stem + "-frames")
        film.bodies = PathTracedBodies(
            film.flight.scenario, folder, list(film.shots()), samples, jobs
        )

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

        for time_s, frame in film.frames():
            report_progress(time_s)
            image = av.VideoFrame.from_ndarray(frame, format="bgr24")
            image.pts = number
            container.mux(stream.encode(image))
            number += 1
        container.mux(stream.encode())
    return number


def film_of(
    log: Path,
    flight: RecordedFlight,
    speed: float = 1.0,
    fps: int = 15,
    width_px: int = 1280,
    height_px: int = 720,
    part_s: tuple[float, float] = (0.0, math.inf),
) -> Film:
    """Return the film of a flight, its frames not yet drawn. Raise LogError for a log without
    motion or image.
    """
    if TARGET not in flight.motion:
        raise LogError(f"{log}: holds no motion of the target; nothing to film")
    first = next(pairs(log, len(flight.scenario.chasers)), None)
    end_s = min(float(flight.motion[TARGET].time_s[-1]), part_s[1])
    if first is None or end_s < part_s[0]:
        after = f" after {part_s[0]:g} s" if part_s[0] > 0.0 else ""
        raise LogError(f"{log}: holds no image{after}; nothing to film")
    begin_s = max(part_s[0], float(flight.motion[TARGET].time_s[0]))
    verdict = verdict_of(summary_of_run(flight, log))
    plumes = load_plumes(log, flight)
    size = (width_px, height_px)
    return Film(log, flight, plumes, size, (begin_s, end_s), verdict, speed, fps)


@dataclass(frozen=True)
class Inset:
    """A place in the frame, px."""

    x: int
    y: int
    width: int
    height: int


class FrameLayout:
    """Places in the frame, px: text above and below the scene at the left, a column of insets at
    the right. ``free_px``: left, top, right and bottom of the part for the scene.
    """

    def __init__(
        self, size_px: tuple[int, int], cameras: int, camera_aspect: float, closes_up: bool
    ) -> None:
        width, height = size_px
        column = round(_COLUMN_SHARE * width)
        left = width - column - _MARGIN_PX
        self.scale = min(max(height / 720.0, 0.7), 2.0, left / 560.0)
        self.text_px = left - 3 * _MARGIN_PX
        self.line_px = min(round(26 * self.scale), height // 4 // max(cameras, 1))
        foot = round(70 * self.scale) + self.line_px * cameras
        self.free_px = _MARGIN_PX, round(56 * self.scale), left - _MARGIN_PX, height - foot
        below = round(0.62 * column) + 2 * _MARGIN_PX if closes_up else _MARGIN_PX
        self.close_up = Inset(left, _MARGIN_PX, column, round(0.62 * column))
        columns, shot = columns_for(
            max(cameras, 1), camera_aspect, column, height - below - _MARGIN_PX
        )
        tall = round(shot / camera_aspect)
        self.cameras = tuple(
            Inset(left + (i % columns) * shot, below + (i // columns) * tall, shot, tall)
            for i in range(cameras)
        )


class Film:
    """A film of a flight; its frames are drawn one after the other."""

    def __init__(
        self,
        log: Path,
        flight: RecordedFlight,
        plumes: dict[int, ActuatorHistory],
        size: tuple[int, int],
        part_s: tuple[float, float],
        verdict: Verdict,
        speed: float = 1.0,
        fps: int = 15,
    ) -> None:
        self.flight, self.bodies = flight, cast(Bodies, FastBodies(flight.scenario))
        self._log, self._plumes, self._verdict, self._fps = log, plumes, verdict, fps
        self.size, self._part_s, self._speed = size, part_s, speed
        self._frustum = camera_frustum(flight.scenario)
        self.numbers = flight.shown
        self._target = flight.motion[TARGET]
        self._chasers = {i: flight.motion[f"chaser/{i}"] for i in self.numbers}
        self._errors = {i: tracking_errors(flight, i) for i in self.numbers}
        self._phases = {
            i: flight.references[i].phases if i in flight.references else [] for i in self.numbers
        }
        self._seen = {
            i: s.time_s[s.seen] for i in self.numbers if (s := flight.sightings.get(i)) is not None
        }
        found = approaches(flight.scenario, self._phases, float(self._target.time_s[-1]))
        camera = flight.scenario.camera_model()
        self.layout = FrameLayout(
            size, len(flight.scenario.chasers), camera.width_px / camera.height_px, bool(found)
        )
        sun, disc = np.array(to_sun(flight.scenario)), earth_disc(flight.scenario)
        earth = None if disc is None else np.array(disc[0]) / np.linalg.norm(disc[0])
        self.path = ChasePath(
            flight.scenario,
            self._target,
            self._chasers,
            found,
            size,
            self.layout.free_px,
            sun / np.linalg.norm(sun),
            earth,
        )
        contacts = [a.contact_s for a in found if math.isfinite(a.contact_s)]
        self.clock = FilmClock(*part_s, contacts, speed)

    @cached_property
    def times(self) -> list[tuple[float, float]]:
        """Times (s) in film and flight of all frames before the last card."""
        number = math.floor(self.clock.duration_s * self._fps + 1e-6) + 1
        return [(k / self._fps, self.clock.flight_time(k / self._fps)) for k in range(number)]

    def shots(self) -> Iterator[Shot]:
        """Yield all pictures of bodies that the frames need."""
        for k, (_, time_s) in enumerate(self.times):
            yield self._shot(f"{k:05d}", self.path.viewpoint(time_s), time_s)
            close = self._close_look(time_s)
            if close is not None:
                yield self._shot(f"{k:05d}-close", close, time_s)

    def frames(self) -> Iterator[tuple[float, BgrImage]]:
        """Yield simulated time (s) and frame (height, width, 3), BGR; at the end of the flight the
        last card.
        """
        frame: BgrImage | None = None
        chasers = len(self.flight.scenario.chasers)
        shown_s = [time_s for _, time_s in self.times]
        for k, (time_s, latest) in enumerate(latest_images(self._log, chasers, shown_s)):
            frame = self.draw(k)
            for i, place in enumerate(self.layout.cameras):
                view = _camera(self.flight, i, latest.get(i), place.width)
                _put_inset(frame, place, view, tint(i).tolist())
            yield time_s, frame
        if frame is not None and self._part_s[1] >= float(self._target.time_s[-1]) - 1e-6:
            card = self._card(frame)
            for _ in range(round(_CARD_S * self._fps)):
                yield self._part_s[1], card

    def draw(self, number: int) -> BgrImage:
        """Draw the frame of a number without the camera images."""
        film_s, time_s = self.times[number]
        shot = self._shot(f"{number:05d}", self.path.viewpoint(time_s), time_s)
        focus = self.path.focus(time_s)
        paths: dict[int | None, Any] = {None: _trail(self._target, time_s)}
        paths |= {i: _trail(own, time_s) for i, own in self._chasers.items()}
        at_s = float(self._target.time_s[_row(self._target.time_s, time_s)])
        cameras = {
            i: i in self._seen and self._is_near(self._seen[i], at_s)
            for i in self.numbers
            if focus is None or focus.chaser != i  # its frustum would cover the gap
        }
        plumes = {i: self._plumes_at(i, time_s) for i in shot.chasers if i in self._plumes}
        image = draw(
            self._frustum,
            shot.look,
            self.bodies.render(shot),
            shot.chasers,
            paths,
            cameras,
            plumes,
        )
        close = self._close_look(time_s)
        if close is not None and focus is not None:
            near = self._shot(f"{number:05d}-close", close, time_s)
            view = draw(
                self._frustum, close, self.bodies.render(near), near.chasers, {}, {}, plumes
            )
            _put_inset(image, self.layout.close_up, view, tint(focus.chaser).tolist())
        self._write(image, film_s, time_s)
        return image

    def _shot(self, name: str, look: Viewpoint, time_s: float) -> Shot:
        chasers = {i: interpolated(own, time_s) for i, own in self._chasers.items()}
        return Shot(name, look, interpolated(self._target, time_s), chasers)

    def _close_look(self, time_s: float) -> Viewpoint | None:
        place = self.layout.close_up
        return self.path.close_up(time_s, place.width, place.height)

    def _is_near(self, seen_s: Array, time_s: float) -> bool:
        """Return whether one of the ascending times (K,) s is within half a tick of a time."""
        row = int(np.searchsorted(seen_s, time_s))
        half_s = 0.5 / self.flight.scenario.time.rate_hz
        return any(abs(t - time_s) < half_s for t in seen_s[max(0, row - 1) : row + 1])

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

    def _range(self, chaser: int, time_s: float) -> float:
        """Return the distance, m, from a chaser's probe to its port; from its centre to the
        target's without a port.
        """
        for approach in self.path.approaches:
            if approach.chaser == chaser and approach.port_m is not None:
                port, tip, _ = self.path.gap(approach, time_s)
                return float(np.linalg.norm(tip - port))
        own, at = (interpolated(t, time_s) for t in (self._chasers[chaser], self._target))
        return float(np.linalg.norm(own[0] - at[0]))

    def _write(self, image: BgrImage, film_s: float, time_s: float) -> None:
        """Write clock, range and closing speed, phases and errors into the free part."""
        scale, width, x = self.layout.scale, self.layout.text_px, _MARGIN_PX + 4
        line_px = round(26 * scale)
        write(image, self.flight.scenario.name, x, line_px, 0.75 * scale)
        clock = f"{time_s:6.1f} s"
        slower = self.clock.slowdown(film_s)
        if slower > 1.05:
            clock += f"   slowed {slower:.1f} x"
        elif self._speed != 1.0:
            clock += f"   {self._speed:g} x"
        write(image, clock, x, 2 * line_px, 0.75 * scale)
        if film_s < _TITLE_S:
            lines = wrapped(self.flight.scenario.description, width, 0.6 * scale)
            for line, text in enumerate(lines):
                write(image, text, x, round((3.2 + line) * line_px), 0.6 * scale)

        step_px = self.layout.line_px
        size = min(0.6 * scale, step_px / 36.0)
        last = self.size[1] - 12
        for line, i in enumerate(reversed(self.numbers)):
            times, position, _ = self._errors[i]
            row = _row(times, time_s)
            error = f"   {1e3 * position[row]:.1f} mm error" if len(times) else ""
            text = f"chaser {i}  {_phase(self._phases[i], time_s)}"
            y = last - line * step_px
            write(image, text, x, y, size, _light(i))
            if error:
                write(image, error, x + round(330 * size), y, size)
        self._write_range(image, x, last - len(self.numbers) * step_px - round(6 * scale), time_s)

    def _write_range(self, image: BgrImage, x: int, y: int, time_s: float) -> None:
        """Write range and closing speed of the chaser in the picture's focus, large."""
        if not self.numbers:
            return
        focus, scale = self.path.focus(time_s), self.layout.scale
        chaser = min(self.numbers, key=lambda i: self._range(i, time_s))
        chaser = chaser if focus is None else focus.chaser
        away_m = self._range(chaser, time_s)
        before_s = max(time_s - _RATE_S, float(self._target.time_s[0]))
        span_s = time_s - before_s
        closing = (self._range(chaser, before_s) - away_m) / span_s if span_s > 1e-6 else 0.0
        has_port = self.flight.scenario.docking.port_of(chaser) is not None
        values = (
            (f"{1e3 * away_m:.0f} mm" if away_m < 1.0 else f"{away_m:.2f} m",
             "probe to port" if has_port else "to the target"),
            (f"{1e3 * closing + 0.0:.1f} mm/s".replace("-0.0 ", "0.0 "), "closing"),
        )  # fmt: skip
        for k, (value, label) in enumerate(values):
            place = x + round(k * 210 * scale)
            write(image, label, place, y - round(38 * scale), 0.5 * scale, _light(chaser))
            write(image, value, place, y, 1.25 * scale, thickness=2)

    def _card(self, frame: BgrImage) -> BgrImage:
        """Return the last card: the verdict and its criteria over the last frame."""
        card = np.asarray((_CARD_DIM * frame).astype(np.uint8))
        scale, height = self.layout.scale, self.size[1]
        x, width = round(0.06 * self.size[0]), round(0.88 * self.size[0])
        colour = {"good": "met", "bad": "not met", "partial": "not judged"}[self._verdict.level]
        size = 1.6 * scale
        length_px = _length_px(self._verdict.headline, size)
        size *= min(1.0, width / max(length_px, 1))
        y = round(90 * scale)
        write(card, self._verdict.headline, x, y, size, _BGR[colour], thickness=2)
        rows = table_rows(self._verdict.criteria)
        lines = [part for text in self._verdict.lines() for part in wrapped(text, width, 0.6)]
        room = max(height - y - round(30 * scale), 40)
        step_px = min(round(32 * scale), room // max(len(rows) + len(lines) + 1, 1))
        size = min(0.65 * scale, step_px / 32.0)
        columns = (0.0, 0.14, 0.46, 0.62, 0.82)
        for row in rows:
            y += step_px
            c = row.criterion
            cells = (c.outcome, c.name, f"chaser {row.who}" if row.who else "", *c.cells[:2])
            for share, cell in zip(columns, cells, strict=True):
                ink = _BGR[c.outcome] if share == 0.0 else _INK
                # Without signs that the font does not have.
                plain = cell.replace("≥", "at least").replace("≤", "at most").replace("\u2013", "-")
                write(card, plain, x + round(share * width), y, size, ink)
        y += round(0.5 * step_px)
        for text in lines:
            y += step_px
            write(card, text, x, y, size)
        return card


def write(
    image: BgrImage,
    text: str,
    x: int,
    y: int,
    size: float,
    bgr: Sequence[float] = _INK,
    thickness: int = 1,
) -> None:
    """Write text with a dark outline; ``x``, ``y``: left end of its base line."""
    # Thicker letters would be wider: the outline is the same letters around.
    for dx, dy, ink in (*((dx, dy, _OUTLINE) for dx in (-1, 1) for dy in (-1, 1)), (0, 0, bgr)):
        place = (x + dx, y + dy)
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, ink, thickness, cv2.LINE_AA)


def _light(chaser: int) -> list[float]:
    """Return a chaser's colour, BGR, half way to white: read on the blue Earth, too."""
    return (0.5 * (tint(chaser) + 255.0)).tolist()


def _put_inset(image: BgrImage, place: Inset, view: BgrImage, bgr: Sequence[float]) -> None:
    """Put a picture into its place, with a frame in a chaser's colour."""
    h, w = min(len(view), image.shape[0] - place.y), min(view.shape[1], image.shape[1] - place.x)
    if h < 4 or w < 4:
        return
    image[place.y : place.y + h, place.x : place.x + w] = view[:h, :w]
    corner = (place.x + w - 1, place.y + h - 1)
    cv2.rectangle(image, (place.x, place.y), corner, bgr, 2, cv2.LINE_AA)


def _length_px(text: str, size: float) -> int:
    return cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0]


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


def _row(times_s: Array, time_s: float) -> int:
    """Return the row of the last of the times (K,) up to ``time_s``; the first row if there is
    none.
    """
    return max(0, int(np.searchsorted(times_s, time_s + 1e-6)) - 1)


def _trail(track: Track, time_s: float) -> Any:
    first = int(np.searchsorted(track.time_s, time_s - _TRAIL_S))
    return track.position_m[first : _row(track.time_s, time_s) + 1 : 3]
