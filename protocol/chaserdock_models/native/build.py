# SPDX-License-Identifier: Apache-2.0
"""Compile the kernels: ``python protocol/chaserdock_models/native/build.py``. Building the package
does this as well.

The compiler is zig's Clang from the wheel ``ziglang``; no system compiler is needed. The result
does not depend on the build machine: its headers, C library and processor type are not used. So it
can be compiled for another one (TARGETS).
"""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
import sys
import sysconfig
import tempfile
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
LIBRARY_NAME = "kernels.so"
# Folders with kernels, relative to the root of the source tree.
NATIVE_FOLDERS = (
    "protocol/chaserdock_models/native",
    "world/chaserdock_world/rendering/native",
    "agents/chaserdock_agents/chaser/perception/native",
    "controller/chaserdock_controller/nmpc/native",
    "controller/chaserdock_controller/estimation/joint/native",
    "world/chaserdock_world/physics/native",
    "chaserdock/envs/native",
)
# Sources that every library contains in addition to those of its own folder.
_SHARED = ("base.h", "elementary.h", "dispatch.c", "build.py")

# No floating-point optimizations that change results (see base.h), and no calls into a C library.
FLAGS = (
    "-std=c11",
    "-O3",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-ffreestanding",
    "-fno-builtin",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
    "-Werror",
)
# One copy of the kernels for each instruction set, numbered as `level` in dispatch.c.
X86_64 = ((2, "-mcpu=x86_64_v2"), (3, "-mcpu=x86_64_v3"))
OTHER = ((0, "-mcpu=baseline"),)
# On Linux a library needs no other.
_FREESTANDING = ("-nostdlib", "-s", "-Wl,-z,defs")


@dataclass(frozen=True)
class BuildTarget:
    """A kind of machine that kernels can be compiled for.

    Its instruction sets, zig's flags for compiling and linking, and the platform tag of its wheel.
    """

    levels: tuple[tuple[int, str], ...]
    compile_flags: tuple[str, ...]
    link_flags: tuple[str, ...]
    tag: str


def _linux(machine: str, levels: tuple[tuple[int, str], ...]) -> BuildTarget:
    # glibc 2.17 is the oldest that a package index accepts wheels for; the kernels use none.
    flags = ("-target", f"{machine}-linux-gnu.2.17", "-fPIC")
    return BuildTarget(levels, flags, _FREESTANDING, f"manylinux_2_17_{machine}")


TARGETS = {
    "x86_64-linux": _linux("x86_64", X86_64),
    "aarch64-linux": _linux("aarch64", OTHER),
    "arm64-macos": BuildTarget(
        OTHER,
        ("-target", "aarch64-macos.11.0"),
        ("-s", f"-Wl,-install_name,@rpath/{LIBRARY_NAME}"),
        "macosx_11_0_arm64",
    ),
}


def this_machine() -> BuildTarget:
    """Return the target of this machine; one outside TARGETS has the platform tag that Python
    reports.
    """
    system = {"linux": "linux", "darwin": "macos"}.get(sys.platform, sys.platform)
    machine = platform.machine().lower()
    tag = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    if f"{machine}-{system}" in TARGETS:
        return TARGETS[f"{machine}-{system}"]
    if system == "linux":
        return _linux(machine, OTHER)
    return BuildTarget(X86_64 if machine in ("x86_64", "amd64") else OTHER, (), (), tag)


def source_digest(folder: Path) -> str:
    """Return the SHA-256 (hexadecimal) of the sources of the library in ``folder``."""
    digest = hashlib.sha256()
    own = {path for pattern in ("*.c", "*.h") for path in folder.glob(pattern)}
    for path in sorted(own | {HERE / name for name in _SHARED}, key=lambda p: (p.name, str(p))):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def compile_kernels(
    folder: Path, target: BuildTarget | None = None, library: Path | None = None
) -> Path:
    """Compile ``kernels.c`` of ``folder`` into a shared library and return the library's path.

    ``target``: by default this machine. ``library``: the path to write, by default LIBRARY_NAME in
    ``folder``. Raises RuntimeError with the compiler's output if compilation fails.
    """
    target = target or this_machine()
    library = library or folder / LIBRARY_NAME
    with tempfile.TemporaryDirectory(prefix="chaserdock-kernels-") as name:
        temporary = Path(name)
        environment = os.environ | {
            "ZIG_GLOBAL_CACHE_DIR": f"{name}/zig",
            "ZIG_LOCAL_CACHE_DIR": f"{name}/zig",
        }

        def zig(*arguments: str) -> None:
            command = [sys.executable, "-m", "ziglang", "cc", *target.compile_flags, *arguments]
            completed = subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, text=True
            )
            if completed.returncode:
                raise RuntimeError(
                    "the kernels do not compile: "
                    f"{' '.join(command)}\n{completed.stdout}{completed.stderr}"
                )

        include = f"-I{HERE}"
        objects = []
        for level, processor in target.levels:
            objects.append(str(temporary / f"v{level}.o"))
            zig(
                *FLAGS,
                include,
                processor,
                f"-DLEVEL=v{level}_",
                "-c",
                "kernels.c",
                "-o",
                objects[-1],
            )
        objects.append(str(temporary / "dispatch.o"))
        digest = f'-DSOURCE_DIGEST="{source_digest(folder)}"'
        zig(*FLAGS, target.levels[0][1], digest, "-c", str(HERE / "dispatch.c"), "-o", objects[-1])
        linked = temporary / LIBRARY_NAME
        zig("-shared", *target.link_flags, *objects, "-o", str(linked))
        # Replace atomically: a process may have the old library loaded.
        beside = library.with_suffix(".new")
        beside.write_bytes(linked.read_bytes())
        beside.chmod(0o755)
        beside.replace(library)
    return library


def compile_all(root: Path) -> list[Path]:
    """Compile the libraries of all packages below ``root``, the source tree, and return their
    paths.
    """
    return [compile_kernels(root / folder) for folder in NATIVE_FOLDERS]


def place_of(folder: str) -> str:
    """Return the place among the packages of the library in a folder of ``NATIVE_FOLDERS``."""
    first, _, rest = folder.partition("/")
    # `chaserdock` is a package, the other roots are folders of packages.
    return f"{folder if first == 'chaserdock' else rest}/{LIBRARY_NAME}"


def compile_into(out: Path, root: Path, target: BuildTarget) -> dict[Path, str]:
    """Compile all libraries for ``target`` into ``out``; return each one's file, with its place
    among the packages.
    """
    libraries = {}
    for folder in NATIVE_FOLDERS:
        place = place_of(folder)
        file = out / place
        file.parent.mkdir(parents=True)
        libraries[compile_kernels(root / folder, target, file)] = place
    return libraries


if __name__ == "__main__":
    compile_all(HERE.parents[2])
