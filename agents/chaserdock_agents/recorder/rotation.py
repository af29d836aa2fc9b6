# SPDX-License-Identifier: Apache-2.0
"""Write the files of one recording: verbatim and viewer layer, with rotation by size or time."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from chaserdock_protocol.messages import JoinReply
from chaserdock_protocol.process import Rotation
from chaserdock_protocol.recording.log import SCENARIO_KIND, LogError, LogWriter
from chaserdock_protocol.recording.scan import LOG_NAME, part_name
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.transport import RawSample

from .foxglove_layer import ViewerLayer


class Recording:
    """Write a mission's log to ``folder``, which is created.

    Every file is self-contained and holds the scenario ``scenario_json``; ``kind``: full, or that
    of flight software. Without ``scenario`` there is no viewer layer. Raises LogError if a file
    cannot be created or written.
    """

    def __init__(
        self,
        folder: Path,
        mission: JoinReply,
        scenario_json: str,
        kind: str,
        rotation: Rotation,
        scenario: FlightScenario | None,
        now_s: Callable[[], float] = time.monotonic,
        compressed: bool = True,
    ) -> None:
        self._compressed = compressed
        self._folder, self._mission, self._rotation, self._scenario = (
            folder,
            mission,
            rotation,
            scenario,
        )
        self._scenario_json, self._kind = scenario_json, kind
        self._rotates = rotation.wanted
        self._now_s, self._part = now_s, 0
        self._from_ns: int | None = None
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise LogError(f"{folder}: cannot be created: {error.strerror or error}") from None
        if any(folder.glob("mission*.mcap")):
            raise LogError(f"{folder}: contains a log already; a log is never overwritten")
        self._open()

    @property
    def shows(self) -> bool:
        """Return whether there is a viewer layer."""
        return self._scenario is not None

    @property
    def path(self) -> Path:
        """The file being written."""
        return self._writer.path

    def _open(self) -> None:
        run = {
            "run_id": self._mission.run_id,
            "mode": self._mission.mode,
            SCENARIO_KIND: self._kind,
        }
        name = LOG_NAME
        if self._rotates:
            name, run["part"] = part_name(self._part), str(self._part)
        self._writer = LogWriter(self._folder / name, self._now_s, self._compressed)
        self._writer.describe(self._scenario_json, run)
        self._viewer = (
            ViewerLayer(self._scenario, self._writer.write_view) if self._scenario else None
        )
        self._from_ns = None

    def write(self, raw: RawSample, message: Any) -> None:
        """Append a sample; ``message``: the decoded sample, None if it is not needed."""
        if self._rotates and self._is_full():
            self._writer.close()
            self._part += 1
            self._open()
        time_ns = None if message is None else message.sim_time_ns
        self._writer.write(raw.key, raw.encoding, raw.payload, raw.sent_ns, time_ns)
        if self._from_ns is None:
            self._from_ns = self._writer.last_time_ns
        if self._viewer is not None and message is not None:
            self._viewer.write(message)

    def flush_if_due(self) -> None:
        """Write what is buffered to the file if it is old enough; call it when no message
        arrives.
        """
        self._writer.flush_if_due()

    def _is_full(self) -> bool:
        size, seconds = self._rotation.size_bytes, self._rotation.seconds
        if size is not None and self._writer.size_bytes >= size:
            return True
        if seconds is None or self._from_ns is None:
            return False
        return self._writer.last_time_ns - self._from_ns >= seconds * 1e9

    def close(self) -> None:
        """Close the last file; raises LogError."""
        self._writer.close()
