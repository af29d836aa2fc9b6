# SPDX-License-Identifier: Apache-2.0
"""Read the bytes of mesh files and of the files that they name, checked at the boundary.

Only regular files of bounded size are read, and a mesh names files of its own folder only. A pipe
or device never blocks.
"""

from __future__ import annotations

import io
import os
import re
import stat
import warnings
from pathlib import Path
from typing import Any
from urllib.parse import unquote

MOST_BYTES = 1 << 30
"""Size of a file that is read, bytes: that of five million triangles as text."""
MOST_TRIANGLES = 5_000_000
"""Triangles of a file, 250 for each that is drawn: bounds time and memory of reading it."""
_MOST_PIXELS = 1 << 26
"""Pixels of a texture, 8192 x 8192: stops an image that unpacks to gigabytes."""
_COUNT = re.compile(rb"^\s*element\s+(\w+)\s+(\S+)", re.MULTILINE)


_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff", ".gif", ".webp")
_GREY = re.compile(rb"^([ \t]*k[ads])[ \t]+(\S+)[ \t\r]*$", re.MULTILINE | re.IGNORECASE)
"""A grey in a material file by one number, for which trimesh drops all materials of the file."""


class MeshFileError(ValueError):
    """A mesh file that cannot be read; the text says what is wrong and what would be right."""


def read_bytes(path: Path) -> bytes:
    """Return the content of a regular file. Raises MeshFileError."""
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise MeshFileError("no such file") from None
    except (OSError, ValueError) as error:
        raise MeshFileError(
            f"cannot be read: {getattr(error, 'strerror', None) or error}"
        ) from None
    try:
        status = os.fstat(number)
        if not stat.S_ISREG(status.st_mode):
            raise MeshFileError("not a regular file; a mesh is read from a file, no pipe or device")
        if status.st_size > MOST_BYTES:
            raise MeshFileError(
                f"has {status.st_size / 1e9:.1f} GB; simplify it to at most {MOST_BYTES / 1e9:.1f}"
            )
        with open(number, "rb", closefd=False) as file:
            return file.read(MOST_BYTES)
    except OSError as error:
        raise MeshFileError(f"cannot be read: {error.strerror or error}") from None
    finally:
        os.close(number)


class ReferencedFiles:
    """Files that a mesh file names, beside it or below; also a resolver of trimesh.

    ``refused``: reasons why files that trimesh asked for are not read.
    """

    def __init__(self, mesh: Path) -> None:
        self._folder = mesh.parent.resolve()
        self.file_name = mesh.name
        self.refused: list[str] = []

    def read(self, name: str) -> bytes:
        """Return the content of a file. Raises MeshFileError, which names it."""
        if re.match(r"[a-zA-Z][a-zA-Z0-9+.-]+:", name):
            raise MeshFileError(f"refers to {name[:80]!r}; put the file beside the mesh instead")
        try:
            path = (self._folder / name.strip().replace("\\", "/")).resolve()
            inside = path.is_relative_to(self._folder)
        except (OSError, ValueError, RuntimeError):  # a name with a zero byte, a loop of links
            raise MeshFileError(
                f"refers to {name[:80]!r}, which is not the name of a file"
            ) from None
        if not inside:
            raise MeshFileError(
                f"refers to {name[:80]!r} outside its folder; put it beside the mesh"
            )
        try:
            return read_bytes(path)
        except MeshFileError as error:
            raise MeshFileError(f"refers to {name[:80]!r}: {error}") from None

    def get(self, name: str) -> bytes:
        """Return the content of a file for trimesh, which goes on without those that it lacks.

        Options before the name of a texture (MTL) are skipped. Raises FileNotFoundError.
        """
        try:
            data = self.read(name)
            if name.lower().endswith(_IMAGES):
                open_image(data, f"texture {name[:80]!r}")
            return _GREY.sub(rb"\1 \2 \2 \2", data) if name.lower().endswith(".mtl") else data
        except MeshFileError as error:
            last = name.split()[-1] if name.split() else ""
            if name.strip().startswith("-") and last != name.strip():
                return self.get(last)
            self.refused.append(str(error))
            raise FileNotFoundError(name) from None

    __getitem__ = get

    def read_uri(self, uri: str) -> bytes:
        """Return the content of a relative URI with percent codes. Raises MeshFileError."""
        return self.read(unquote(uri))


def check_counts(data: bytes, suffix: str) -> None:
    """Check that the counts in the head of a file fit its size. Raises MeshFileError."""
    counts: list[tuple[str, str]] = []
    if suffix == ".ply":
        head = data[: data.find(b"end_header")] if b"end_header" in data else b""
        counts = [(a.decode(), b.decode("ascii", "replace")) for a, b in _COUNT.findall(head)]
        if not head.startswith(b"ply"):
            raise MeshFileError("it does not begin with 'ply' or has no 'end_header'")
    elif suffix == ".off":
        lines = (line.split(b"#")[0].split() for line in data[:10_000].splitlines())
        words = [word.decode("ascii", "replace") for line in lines for word in line]
        if not words or words[0].upper() not in ("OFF", "COFF"):
            raise MeshFileError("it does not begin with 'OFF'")
        counts = list(zip(("vertex", "face"), words[1:3], strict=False))
    elif suffix == ".stl" and not data.lstrip().startswith(b"solid"):
        if len(data) < 84:
            raise MeshFileError(f"it has {len(data)} bytes; a binary STL has 84 or more")
        triangles = int.from_bytes(data[80:84], "little")
        if len(data) - 84 != 50 * triangles:
            raise MeshFileError(
                f"its head says {triangles:,} triangles; "
                f"it has bytes for {(len(data) - 84) // 50:,}"
            )
    for what, text in counts:
        if not text.isdecimal() or int(text) > len(data):
            raise MeshFileError(
                f"its head says {text[:20]} of {what!r}; it has {len(data):,} bytes"
            )


def check_triangles(count: int) -> None:
    """Raise MeshFileError for more triangles than are read."""
    if count > MOST_TRIANGLES:
        raise MeshFileError(
            f"has {count:,} or more triangles; simplify it to at most {MOST_TRIANGLES:,}"
        )


def printable(name: str) -> str:
    """Return the name of a material as one line of at most 64 characters."""
    return "".join(c if c.isprintable() else "_" for c in name)[:64] or "material"


def plain_name(name: str) -> str:
    """Return the name of a part, as scenarios write it."""
    return re.sub(r"[^A-Za-z0-9._-]", "_", name).lstrip("._-")[:60] or "part"


def open_image(data: bytes, name: str) -> Any:
    """Return an image of Pillow, which unpacks its pixels on use. Raises MeshFileError."""
    from PIL import Image  # needed for meshes with textures only

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of bombs, which are refused by their size
            image = Image.open(io.BytesIO(data))
    except Image.DecompressionBombError:
        raise MeshFileError(
            f"{name} has too many pixels; reduce it to at most 8192 x 8192"
        ) from None
    except Exception:  # Pillow raises whatever its readers stumble over
        raise MeshFileError(f"{name} is not an image that can be read; use PNG or JPEG") from None
    if image.width * image.height > _MOST_PIXELS:
        raise MeshFileError(
            f"{name} has {image.width} x {image.height} pixels; reduce it to at most 8192 x 8192"
        )
    return image
