# SPDX-License-Identifier: Apache-2.0
"""Writes images as files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
from chaserdock_protocol.output_files import write_atomically


def write_image(path: Path, pixels: Any) -> None:
    """Write an image, grey or BGR, in the format of the path's suffix.

    OpenCV's own writer says nothing of a full disk. Raises WriteError.
    """
    write_atomically(path, cv2.imencode(path.suffix, pixels)[1].tobytes())
