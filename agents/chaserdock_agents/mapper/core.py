# SPDX-License-Identifier: Apache-2.0
"""Collect the points that chasers follow, and map the target when that is due. No I/O.

In lock-step a map is made of all images up to its tick, by all chasers that take part in it, so
that nothing depends on the order of arrival.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import (
    AGE_STEP_S,
    DESCRIPTION_BYTES,
    MAX_COUNT,
    ONE_PLACE,
    PX_STEP,
    CommandReply,
    Event,
    FeatureTracks,
    KnownTracks,
    LandmarkMap,
    MappedMotion,
    MapStatus,
    Message,
    PortRequest,
    Tick,
)
from chaserdock_protocol.scenario import FlightScenario, PortChoice
from chaserdock_protocol.topics import Topic

from .frame import MapFrame
from .mapper import MAP_STATUS, Mapper, TargetMap
from .ports import MappedPoints, PortChooser, PortDecision
from .rings import circle_sights
from .surface import SightLines
from .types import CameraUncertainty, ImageTracks

HELP: dict[MapStatus, str] = {
    "gathering": "wait; views must span some seconds",
    "no texture": "too few points: a light, a nearer place, or another side may help",
    "does not turn": "the points hardly move: another view, or a longer inspection, may help",
    "ambiguous": "two motions explain the images alike: a longer inspection, or a second side",
    "inconsistent": "no motion explains the images: a longer inspection, or less glare",
    "scale unknown": "one camera tells no distances: a second chaser beside it would; no approach",
    "mapped": "",
}
"""What each status means for an operator."""

_AHEAD_TICKS = 8
"""Most ticks by which a chaser may know of a tick earlier than this process, as in the controller;
messages that claim more are dropped."""
_SEARCHED = 160
"""Images of a chaser with ellipses that are kept: 400 s of one in 2.6 s, a turn at 1 deg/s."""
_REMEMBERED = 256
"""Images of a chaser in which a place may be pointed at: 50 s of five a second."""
OPEN = "the loop of the map is open: no side of the target has returned yet"
"""Why nothing flies near, nor chooses a place there."""


@dataclass(frozen=True, eq=False)
class _SearchedImage:
    """Ellipses (k, 6) of an image, as in ``FeatureTracks``, and its camera's pose in WRF."""

    time_ns: int
    position_m: Array
    q_wxyz: Array
    ellipses: Array

    def seen_by(self, message: LandmarkMap) -> tuple[Array, Array, Array]:
        """Return optical centre (3,) and rotation (3, 3) in TRF of a map, and the ellipses."""
        place, q = pose_at(message, self.time_ns)
        to_trf = rotations.to_matrix(q).T
        return (
            to_trf @ (self.position_m - place),
            to_trf @ rotations.to_matrix(self.q_wxyz),
            self.ellipses,
        )


class TrackCollector:
    """Brings the tracks of all chasers into the order of time.

    ``ready``: tracks to map, in order; taken by the one who maps. ``stale``: messages dropped.
    """

    def __init__(self, scenario: FlightScenario, realtime: bool) -> None:
        self.ready: deque[FeatureTracks] = deque()
        self.stale = 0
        self.tick: Tick | None = None
        self._timing, self._realtime = scenario.timing, realtime
        self._chasers = len(scenario.chasers)
        self._open: dict[int, tuple[int, ...]] = {}
        self._early: dict[int, dict[int, FeatureTracks]] = {}
        self._newest: dict[int, int] = {}
        self.complete_tick = -1
        """Newest tick with images that is ready."""

    def add_tick(self, tick: Tick) -> None:
        """Take the begin of a tick, or a correction of who takes part in it."""
        known = self.tick
        if known is not None and (tick.tick, tick.revision) < (known.tick, known.revision):
            return
        self.tick = tick
        if not self._realtime:
            # Who has left owes no tracks of earlier images, either.
            self._open = {
                k: tuple(i for i in who if i in tick.chasers) for k, who in self._open.items()
            }
            if tick.images:
                self._open[tick.tick] = tick.chasers
            self._release()
            return
        # In real time an image counts that has arrived before the next one.
        before = tick.tick - self._timing.ticks_per_image
        self.complete_tick = max(self.complete_tick, before - before % self._timing.ticks_per_image)

    def add(self, tracks: FeatureTracks) -> None:
        """Take the tracks of one image."""
        tick, newest = -1 if self.tick is None else self.tick.tick, self._newest
        if (
            tracks.chaser >= self._chasers
            or not _is_whole(tracks)
            or tracks.tick <= newest.get(tracks.chaser, -1)
            or tracks.tick > tick + _AHEAD_TICKS
        ):
            self.stale += 1
            return
        newest[tracks.chaser] = tracks.tick
        if self._realtime:
            self.ready.append(tracks)
        elif tracks.tick <= self.complete_tick:
            self.stale += 1
        else:
            self._early.setdefault(tracks.tick, {})[tracks.chaser] = tracks
            self._release()

    def missing_keys(self) -> tuple[str, ...]:
        """Return the keys of the tracks that the oldest open image lacks; of the next tick if there
        is none.
        """
        for tick, chasers in sorted(self._open.items()):
            arrived = self._early.get(tick, {})
            return tuple(topics.FEATURES.key_of(i) for i in chasers if i not in arrived)
        return (topics.TICK.key_of(),)

    def _release(self) -> None:
        for tick in sorted(self._open):
            arrived = self._early.get(tick, {})
            if not all(i in arrived for i in self._open[tick]):
                return
            del self._open[tick]
            for early in sorted(k for k in self._early if k <= tick):
                found = self._early.pop(early)
                self.ready.extend(found[i] for i in sorted(found))
            self.complete_tick = tick


class MapperCore:
    """Map the target of a scenario. Equal messages give equal maps.

    ``instance``: of the process. `step` may run beside `map_target`, which one thread calls.
    """

    def __init__(
        self, scenario: FlightScenario, realtime: bool = False, instance: str = ""
    ) -> None:
        self.scenario, self.instance = scenario, instance
        self.collector = TrackCollector(scenario, realtime)
        camera, errors = scenario.camera_model(), scenario.navigation.errors()
        uncertainty = CameraUncertainty(
            errors.camera_turn_rad,
            errors.camera_shift_m,
            errors.camera_focal_share,
            errors.attitude_noise_rad,
            errors.position_noise_m,
        )
        self.mapper = Mapper([uncertainty] * len(scenario.chasers), camera.fx_px)
        self._camera, self._frame = camera, MapFrame()
        self._status: MapStatus | None = None
        self._next_tick = 0
        self._closed = False
        self._ports = PortChooser(scenario)
        self._map: LandmarkMap | None = None
        self._images: list[deque[FeatureTracks]] = [
            deque(maxlen=_REMEMBERED) for _ in scenario.chasers
        ]
        self._searched: list[deque[_SearchedImage]] = [
            deque(maxlen=_SEARCHED) for _ in scenario.chasers
        ]
        self._timeline = [
            (entry.at_s, chaser, entry.port)
            for entry in sorted(scenario.timeline, key=lambda entry: entry.at_s)
            if entry.port is not None
            for chaser in entry.chasers
        ]

    def step(self, message: Message) -> int | None:
        """Take a message; return the tick of a map that is due now, or None."""
        match message:
            case Tick():
                self.collector.add_tick(message)
            case FeatureTracks():
                stale = self.collector.stale
                self.collector.add(message)
                if self.collector.stale == stale and message.status != "bad_image":
                    self._images[message.chaser].append(message)
            case _:
                return None
        tick = self.collector.complete_tick
        if tick < 0 or tick < self._next_tick:
            return None
        self._next_tick = MAX_COUNT  # until the map is made
        return tick

    def map_target(self, tick: int) -> list[tuple[Topic, str | None, Message]]:
        """Return what to publish of a map from all tracks up to ``tick``."""
        ready, timing = self.collector.ready, self.scenario.timing
        while ready and ready[0].tick <= tick:
            self._add(ready.popleft())
        time_ns = timing.tick_time_ns(tick)
        found = self.mapper.update(time_ns / 1e9)
        mapped, section = found.status in MAP_STATUS, self.scenario.mapping
        period_s = section.period_s if mapped else section.first_period_s
        images = max(1, round(period_s * timing.image_hz))
        self._next_tick = tick + images * timing.ticks_per_image
        before, self._closed = self._closed, self._closed or found.closed
        message = self._message(found, tick, time_ns)
        events = [_event(message)] if found.status != self._status else []
        self._status = found.status
        if self._closed and not before:
            what = "map of the target: its loop has closed"
            events.append(_event_of(message, what, _known(message)))
        if message.motion is not None:
            self._map = message
            if self._closed:
                self._ports.follow(self._points(found, message))
                events += self._choose_due(message)
                message = msgspec.structs.replace(message, ports=self._ports.ports())
        out: list[tuple[Topic, str | None, Message]] = [(topics.MAP, None, message)]
        return [*out, *((topics.EVENT, "mapper", event) for event in events)]

    # -- ports -------------------------------------------------------------------------------------

    def choose(self, request: PortRequest) -> tuple[CommandReply, Event | None]:
        """Answer an operator who points at a place; any thread may ask. The port, if it becomes
        one, is in the next map.
        """
        newest = self._map
        if not request.says_one_place:
            decision = PortDecision(False, ONE_PLACE)
        elif newest is None:
            decision = PortDecision(False, f"no map of the target: {self._status or 'gathering'}")
        else:
            decision = self._decide(request.chaser, request, newest)
        head = newest or LandmarkMap(status="gathering", next_tick=0)
        reply = CommandReply(
            tick=head.tick,
            sim_time_ns=head.sim_time_ns,
            command="port",
            chaser=request.chaser,
            accepted=decision.accepted,
            reason=decision.answer[:_LONGEST],
            operator=request.operator,
        )
        return reply, None if newest is None else _port_event(newest, request.chaser, decision)

    def _choose_due(self, message: LandmarkMap) -> list[Event]:
        """Choose the ports that the timeline asks for."""
        events: list[Event] = []
        time_s = message.sim_time_ns / 1e9
        while self._timeline and self._timeline[0][0] <= time_s:
            _, chaser, choice = self._timeline.pop(0)
            events.append(_port_event(message, chaser, self._decide(chaser, choice, message)))
        return events

    def _decide(
        self, chaser: int, where: PortRequest | PortChoice, newest: LandmarkMap
    ) -> PortDecision:
        if newest.status != "mapped":
            return PortDecision(False, f"no distances in the map: {newest.status}")
        if not self._closed:
            return PortDecision(False, OPEN)
        if where.pixel is None:
            return self._ports.decide(chaser, where, None)
        image = self._image_for(where, newest)
        if image is None:
            return PortDecision(
                False, f"no image of chaser {where.image} at that time, or it is too old"
            )
        camera = self._camera
        x, y = camera.normalized(camera.undistort(np.array(where.pixel))).tolist()
        towards_w = rotations.rotate(image.q_wxyz, [x, y, 1.0])
        place, q = pose_at(newest, image.sim_time_ns)
        ray = (
            rotations.rotate_inverse(q, np.array(image.position_m) - place),
            rotations.rotate_inverse(q, towards_w),
        )
        return self._ports.decide(chaser, where, ray)

    def _image_for(
        self, where: PortRequest | PortChoice, newest: LandmarkMap
    ) -> FeatureTracks | None:
        """Return the image in which a pixel was pointed at: that of the stated exposure, or the
        newest one; of the timeline, the newest that the map has seen.
        """
        if where.image is None or where.image >= len(self._images):
            return None
        images = reversed(tuple(self._images[where.image]))
        if isinstance(where, PortChoice):
            return next((i for i in images if i.tick <= newest.tick), None)
        exposed_ns = where.exposed_ns
        return next((i for i in images if exposed_ns in (None, i.sim_time_ns)), None)

    def _points(self, found: TargetMap, message: LandmarkMap) -> MappedPoints:
        """Return the landmarks of a map in its frame, and from where they were seen."""
        numbers, cameras = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
        for chaser, views in enumerate(self.mapper.kept_views()):
            ids, rows = self.mapper.known_tracks(chaser)
            for view in views:
                seen = rows[np.isin(ids, view.ids)]
                place, q = pose_at(message, round(view.time_s * 1e9))
                camera = rotations.rotate_inverse(q, view.position_w_m - place)
                numbers.append(seen)
                cameras.append(np.tile(camera, (len(seen), 1)))
        sights = SightLines(np.concatenate(numbers), np.concatenate(cameras)).thinned()
        return MappedPoints(
            found.keys,
            np.reshape(message.landmarks_m, (-1, 3)),
            self._frame.moments(found.covariances_m2),
            sights,
            circle_sights(self._camera, [s.seen_by(message) for s in self._searched_images()]),
        )

    def _searched_images(self) -> list[_SearchedImage]:
        return [image for images in self._searched for image in images]

    # -- messages ----------------------------------------------------------------------------------

    def _add(self, message: FeatureTracks) -> None:
        px = np.array(message.places, dtype=float).reshape(-1, 2) * PX_STEP
        time_s, ids = message.sim_time_ns / 1e9, np.array(message.ids, dtype=np.int64)
        self.mapper.add(
            ImageTracks(
                message.chaser,
                time_s,
                np.array(message.position_m),
                rotations.to_matrix(message.q_wxyz),
                ids,
                self._camera.normalized(px),
                np.array(message.ages, dtype=float) * AGE_STEP_S,
            )
        )
        if message.ellipses:
            self._searched[message.chaser].append(
                _SearchedImage(
                    message.sim_time_ns,
                    np.array(message.position_m),
                    np.array(message.q_wxyz),
                    np.reshape(message.ellipses, (-1, 6)),
                )
            )
        if message.described:
            values = np.frombuffer(message.descriptions, dtype=np.uint8)
            self.mapper.describe(
                message.chaser,
                time_s,
                np.array(message.described, dtype=np.int64),
                values.reshape(-1, DESCRIPTION_BYTES),
            )

    def _message(self, found: TargetMap, tick: int, time_ns: int) -> LandmarkMap:
        message = LandmarkMap(
            tick=tick,
            sim_time_ns=time_ns,
            status=found.status,
            next_tick=self._next_tick,
            instance=self.instance,
        )
        if found.motion is None:
            return message
        landmarks = self._frame.align(found.keys, found.landmarks_m, found.motion.omega_rad_s)
        m = self._frame.motion_at(found.motion, found.covariance, time_ns / 1e9)
        moments = self._frame.moments(found.covariances_m2)
        return msgspec.structs.replace(
            message,
            motion=MappedMotion(
                position_m=vector(m.position_m),
                velocity_m_s=vector(m.velocity_m_s),
                q_wxyz=vector(m.q_wxyz),
                omega_rad_s=vector(m.omega_rad_s),
                covariance=vector(m.covariance),
            ),
            landmarks_m=vector(landmarks),
            moments_m2=vector(moments[:, (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]),
            tracks=tuple(self._tracks(i) for i in range(len(self.scenario.chasers))),
            scale_share=found.scale_share,
            residual_px=found.residual_px,
            merges=found.merges,
            closed=self._closed,
        )

    def _tracks(self, chaser: int) -> KnownTracks:
        ids, rows = (part[-_MOST_KNOWN:] for part in self.mapper.known_tracks(chaser))
        return KnownTracks(chaser=chaser, ids=tuple(ids.tolist()), landmarks=tuple(rows.tolist()))


_MOST_KNOWN = 10_000
"""Tracks of a chaser that a map names, the newest: the limit of ``KnownTracks``."""


def _is_whole(tracks: FeatureTracks) -> bool:
    """Return whether the fields of a message fit together."""
    n, ellipses = len(tracks.ids), np.array(tracks.ellipses)
    return (
        len(ellipses) % 6 == 0
        and _are_ellipses(ellipses.reshape(-1, 6))
        and len(tracks.places) == 2 * n
        and len(tracks.ages) == n
        and all(a < b for a, b in zip(tracks.ids, tracks.ids[1:], strict=False))
        and len(tracks.descriptions) == DESCRIPTION_BYTES * len(tracks.described)
        and set(tracks.described) <= set(tracks.ids)
    )


def _are_ellipses(rows: Array) -> bool:
    longer, shorter, coverage = rows[:, 2], rows[:, 3], rows[:, 5]
    return bool(
        np.isfinite(rows).all()
        and ((longer >= shorter) & (shorter > 0.0)).all()
        and ((coverage >= 0.0) & (coverage <= 1.0)).all()
    )


def pose_at(message: LandmarkMap, time_ns: int) -> tuple[Array, Array]:
    """Return position (3,), WRF, and attitude (4,), TRF to WRF, of a mapped target at a time."""
    motion = message.motion
    assert motion is not None
    elapsed_s = (time_ns - message.sim_time_ns) / 1e9
    q = rotations.integrate(np.array(motion.q_wxyz), np.array(motion.omega_rad_s), elapsed_s)
    return np.array(motion.position_m) + elapsed_s * np.array(motion.velocity_m_s), q


def _known(message: LandmarkMap) -> str:
    """Return what a map knows, for an operator."""
    assert message.motion is not None
    rate_deg_s = float(np.rad2deg(np.linalg.norm(message.motion.omega_rad_s)))
    return (
        f"{len(message.landmarks_m) // 3} landmarks, {rate_deg_s:.3f} deg/s, "
        f"scale {100.0 * message.scale_share:.2g} %"
    )


def _event(message: LandmarkMap) -> Event:
    """Return the event of a new status."""
    detail = HELP[message.status]
    if message.motion is not None:
        detail = f"{_known(message)}; {detail}" if detail else _known(message)
    calm = message.status in ("gathering", "mapped")
    return _event_of(message, f"map of the target: {message.status}", detail, calm)


def _port_event(message: LandmarkMap, chaser: int, decision: PortDecision) -> Event:
    what = f"port of chaser {chaser}: {'chosen' if decision.accepted else 'refused'}"
    return _event_of(message, what, decision.answer, decision.accepted)


def _event_of(message: LandmarkMap, what: str, detail: str, calm: bool = True) -> Event:
    """Return an event of the mapper at the time of a map."""
    return Event(
        tick=message.tick,
        sim_time_ns=message.sim_time_ns,
        process="mapper",
        level="info" if calm else "warning",
        what=what,
        detail=detail[:_LONGEST],
    )


_LONGEST = 1900
"""Characters of an answer, below the limit of ``Text``."""
