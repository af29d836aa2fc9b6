# SPDX-License-Identifier: Apache-2.0
"""Build what a package index receives, and inspect it: ``python release/build_wheels.py [--out
dist] [--tag vX.Y.Z]``.

Makes the sdist, and from the sdist one wheel for each kind of machine, all cross-compiled with zig
on this one. Needs Python 3.11 or later and pip; the tools (release/requirements.txt) are installed
into a temporary environment. Fails if an index would reject a file, or if a file lacks a part:
exact list of kernels, machine and oldest system of each, platform tag, version.
"""

from __future__ import annotations

import argparse
import os
import re
import struct
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import venv
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TARGETS = ("x86_64-linux", "aarch64-linux", "arm64-macos")
KERNELS = {
    "chaserdock_models/native/kernels.so",
    "chaserdock_world/rendering/native/kernels.so",
    "chaserdock_agents/chaser/perception/native/kernels.so",
    "chaserdock_controller/nmpc/native/kernels.so",
    "chaserdock_controller/estimation/joint/native/kernels.so",
    "chaserdock_world/physics/native/kernels.so",
    "chaserdock/envs/native/kernels.so",
}
# Files that a mission needs beside modules.
DATA = (
    "chaserdock/shipped/single.toml",
    "chaserdock/py.typed",
    "chaserdock_models/native/kernels.c",
)
_WHEEL = re.compile(r"chaserdock-(?P<version>[^-]+)-py3-none-(?P<platform>[a-z0-9_]+)\.whl")
_AUDITED = re.compile(r'following platform tag:\s+"([a-z0-9_]+)"')


class ReleaseError(Exception):
    """A file cannot be built, or must not be published as it is."""


@dataclass(frozen=True)
class MachO:
    """What a macOS library states of itself: its processor, its oldest system, the libraries it
    needs, its signature.
    """

    arm64: bool
    oldest_macos: tuple[int, int]
    needs: tuple[str, ...]
    signed: bool


def read_macho(content: bytes) -> MachO:
    """Read the header and load commands of a 64-bit Mach-O file (Apple's mach-o/loader.h). Raises
    ReleaseError.
    """
    if len(content) < 32 or content[:4] != b"\xcf\xfa\xed\xfe":
        raise ReleaseError("not a 64-bit Mach-O file")
    _, processor, _, _, commands, _, _, _ = struct.unpack_from("<8I", content)
    oldest, needs, signed, at = (0, 0), [], False, 32
    for _ in range(commands):
        command, size = struct.unpack_from("<2I", content, at)
        if command == 0xC:  # LC_LOAD_DYLIB
            name = at + struct.unpack_from("<I", content, at + 8)[0]
            needs.append(content[name : at + size].partition(b"\0")[0].decode())
        elif command == 0x32:  # LC_BUILD_VERSION
            packed = struct.unpack_from("<I", content, at + 12)[0]
            oldest = (packed >> 16, packed >> 8 & 0xFF)
        signed = signed or command == 0x1D  # LC_CODE_SIGNATURE
        at += size
    return MachO(processor == 0x0100000C, oldest, tuple(needs), signed)


def check_macos_kernel(content: bytes) -> None:
    """Raise ReleaseError unless the library runs on every macOS from 11 on, on Apple processors."""
    found = read_macho(content)
    if not found.arm64 or not found.signed or not (0, 0) < found.oldest_macos <= (11, 0):
        raise ReleaseError(f"macOS 11 on arm64 does not load it: {found}")
    if set(found.needs) - {"/usr/lib/libSystem.B.dylib"}:
        raise ReleaseError(f"it needs {', '.join(found.needs)}")


def check_wheel(wheel: Path, expected: str) -> str:
    """Check the name and content of a wheel and return its platform tag. Raises ReleaseError.

    ``expected``: the version that it must have.
    """
    named = _WHEEL.fullmatch(wheel.name)
    if named is None:
        raise ReleaseError(f"{wheel.name}: not named as a wheel of chaserdock for any Python 3")
    platform = named["platform"]
    # The platforms that the Python Package Index accepts (warehouse, forklift/legacy.py), of those
    # built here.
    if not re.fullmatch(r"manylinux_2_\d+_(x86_64|aarch64)|macosx_1[1-9]_0_arm64", platform):
        raise ReleaseError(f"{wheel.name}: an index does not accept the platform {platform}")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        libraries = {name for name in names if name.endswith((".so", ".dylib"))}
        missing = [name for name in DATA if name not in names]
        if libraries != KERNELS or missing or len(names) != len(set(names)):
            raise ReleaseError(
                f"{wheel.name}: libraries {sorted(libraries)}, missing files {missing}"
            )
        metadata = archive.read(f"chaserdock-{named['version']}.dist-info/METADATA").decode()
        if f"\nVersion: {expected}\n" not in metadata:
            raise ReleaseError(f"{wheel.name}: not version {expected}")
        if platform.startswith("macosx"):
            for name in sorted(libraries):
                try:
                    check_macos_kernel(archive.read(name))
                except ReleaseError as error:
                    raise ReleaseError(f"{wheel.name}: {name}: {error}") from None
    return platform


def version() -> str:
    """Return the version that pyproject.toml states."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "version"
    ]


def check_tag(tag: str) -> None:
    """Raise ReleaseError unless the tag is ``v`` and the version of pyproject.toml."""
    if tag != f"v{version()}":
        raise ReleaseError(f"the tag is {tag}, the version in pyproject.toml {version()}")


class Tools:
    """The build tools in an environment of their own, in ``folder``."""

    def __init__(self, folder: Path) -> None:
        venv.create(folder, with_pip=True)
        self._bin = folder / "bin"
        requirements = str(ROOT / "release" / "requirements.txt")
        self.run("pip", "install", "-q", "--require-hashes", "-r", requirements, cwd=ROOT)

    def run(self, module: str, *arguments: str, cwd: Path, **environment: str) -> str:
        """Run a module and return what it printed. Raises ReleaseError if it fails."""
        done = subprocess.run(
            [str(self._bin / "python"), "-m", module, *arguments],
            cwd=cwd,
            env=os.environ | environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise ReleaseError(f"{module} {' '.join(arguments)}:\n{done.stdout}{done.stderr}")
        return done.stdout

    def build(self, tree: Path, out: Path, kind: str, **environment: str) -> Path:
        """Build ``kind`` (``sdist`` or ``wheel``) of a source tree into ``out`` and return the new
        file.
        """
        before = set(out.iterdir())
        self.run("hatchling", "build", "-t", kind, "-d", str(out), cwd=tree, **environment)
        (made,) = set(out.iterdir()) - before
        return made

    def audit(self, wheel: Path, platform: str) -> None:
        """Raise ReleaseError unless auditwheel finds that a Linux wheel keeps what its platform tag
        promises.
        """
        # The kernels for AVX2 are chosen at run time: they do not raise the processor that a wheel
        # needs.
        said = self.run(
            "auditwheel", "show", "--disable-isa-ext-check", str(wheel), cwd=wheel.parent
        )
        found = _AUDITED.search(said)
        if found is None or not fits(found[1], platform):
            raise ReleaseError(f"{wheel.name}: auditwheel finds:\n{said}")


def fits(audited: str, platform: str) -> bool:
    """Return whether a wheel that runs on the platform ``audited`` may claim ``platform``, which
    must not be older.
    """

    def parts(tag: str) -> tuple[int, str] | None:
        found = re.fullmatch(r"manylinux_2_(\d+)_(\w+)", tag)
        return None if found is None else (int(found[1]), found[2])

    one, other = parts(audited), parts(platform)
    return one is not None and other is not None and one[1] == other[1] and one[0] <= other[0]


def build(out: Path) -> Iterator[Path]:
    """Build and check all files into ``out`` and yield each. Raises ReleaseError."""
    with tempfile.TemporaryDirectory(prefix="chaserdock-release-") as name:
        tools = Tools(Path(name) / "tools")
        yield (sdist := tools.build(ROOT, out, "sdist"))
        with tarfile.open(sdist) as archive:
            archive.extractall(name, filter="data")
        tree = Path(name) / sdist.name.removesuffix(".tar.gz")
        for target in TARGETS:
            wheel = tools.build(tree, out, "wheel", CHASERDOCK_TARGET=target)
            platform = check_wheel(wheel, version())
            if platform.startswith("manylinux"):
                tools.audit(wheel, platform)
            yield wheel


def main() -> int:
    """Build everything; the exit status is 1 if a file may not be published."""
    parser = argparse.ArgumentParser(description="Build and inspect sdist and wheels.")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "dist", help="folder for the files (default: dist)"
    )
    parser.add_argument("--tag", help="fail unless the version is that of this tag, vX.Y.Z")
    options = parser.parse_args()
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    if any(out.iterdir()):
        print(
            f"build_wheels: {out} is not empty; everything in it would be published",
            file=sys.stderr,
        )
        return 2
    try:
        if options.tag is not None:
            check_tag(options.tag)
        for file in build(out.resolve()):
            print(f"{file} ({file.stat().st_size / 1e6:.1f} MB)", flush=True)
    except (ReleaseError, ValueError) as error:
        print(f"build_wheels: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
