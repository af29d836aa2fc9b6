# SPDX-License-Identifier: Apache-2.0
"""Writes tracked poses as Parquet, CSV or TUM files while images come.

Parquet and CSV: a row for each pose of each target in each image, and one without a pose where
there is none. TUM: the best pose, as lines ``time_s x y z qx qy qz qw``.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, TextIO

import pyarrow as pa
from chaserdock_agents.gateway.cameras import CapturedImage
from chaserdock_protocol.errors import errors_of_writing
from chaserdock_protocol.output_files import replaced

from chaserdock.logs.export import TableFormat, create_table_file

from .subjects import TrackError
from .tracker import TrackedImage, TrackedPose, TrackedTarget

_ROWS = 256
"""Rows that are held in memory before they are written: some seconds of images."""
_FORMATS: dict[str, TableFormat] = {".parquet": "parquet", ".csv": "csv"}
ENDINGS = (*_FORMATS, ".tum")
_SCHEMA = pa.schema(
    [
        ("image", pa.int64()),
        ("time_ns", pa.int64()),
        ("stamp", pa.string()),
        ("target", pa.string()),
        ("status", pa.string()),
        ("solution", pa.int64()),
        *((f"position_m_{axis}", pa.float64()) for axis in "xyz"),
        *((f"q_{axis}", pa.float64()) for axis in "wxyz"),
        ("covariance", pa.list_(pa.float64())),
        ("residual_px", pa.float64()),
        ("marker_ids", pa.list_(pa.int64())),
    ]
)


class PoseFile(Protocol):
    """A file that takes the poses of images."""

    def write(self, image: CapturedImage, tracked: TrackedImage) -> None: ...


@contextmanager
def pose_file(path: Path, targets: int) -> Generator[PoseFile]:
    """Open a new file of poses by its ending; it takes its place when the block ends. Raises
    TrackError.
    """
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise TrackError(f"--out {path}: must end in {', '.join(ENDINGS)}")
    if ending == ".tum" and targets > 1:
        raise TrackError(
            f"--out {path}: a TUM file has one trajectory, and there are {targets} markers; give "
            ".csv or .parquet"
        )
    with errors_of_writing(path, TrackError), replaced(path) as new:
        if ending == ".tum":
            with new.open("w", encoding="ascii") as text:
                yield _TumFile(text)
            return
        table = _TableFile(create_table_file(new, _SCHEMA, _FORMATS[ending]))
        try:
            yield table
        finally:
            table.close()


class _TableFile:
    def __init__(self, file: Any) -> None:
        self._file = file
        self._rows: list[dict[str, Any]] = []

    def write(self, image: CapturedImage, tracked: TrackedImage) -> None:
        for target in tracked.targets:
            about = {
                "image": image.sequence,
                "time_ns": image.time_ns,
                "stamp": image.stamp,
                "target": target.name,
                "status": target.status,
                "marker_ids": target.marker_ids.tolist(),
            }
            self._rows += [about | values for values in _poses(target)]
        if len(self._rows) >= _ROWS:
            self._flush()

    def close(self) -> None:
        self._flush()
        self._file.close()

    def _flush(self) -> None:
        self._file.write_table(pa.Table.from_pylist(self._rows, _SCHEMA))
        self._rows = []


def _poses(target: TrackedTarget) -> list[dict[str, Any]]:
    return [_values(number, pose) for number, pose in enumerate(target.poses)] or [{}]


def _values(number: int, pose: TrackedPose) -> dict[str, Any]:
    position = zip("xyz", pose.position_m.tolist(), strict=True)
    attitude = zip("wxyz", pose.q_wxyz.tolist(), strict=True)
    return {
        "solution": number,
        **{f"position_m_{axis}": value for axis, value in position},
        **{f"q_{axis}": value for axis, value in attitude},
        "covariance": pose.covariance.ravel().tolist(),
        "residual_px": float(pose.residual_px),
    }


class _TumFile:
    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, image: CapturedImage, tracked: TrackedImage) -> None:
        pose = tracked.pose
        if pose is None:
            return
        w, *xyz = pose.q_wxyz.tolist()
        values = " ".join(repr(v) for v in (*pose.position_m.tolist(), *xyz, w))
        seconds, nanoseconds = divmod(image.time_ns, 1_000_000_000)
        self._file.write(f"{seconds}.{nanoseconds:09d} {values}\n")
