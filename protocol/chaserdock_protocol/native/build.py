"""Compiles the kernels: ``python protocol/chaserdock_protocol/native/build.py``; the package's build does it by itself.

The compiler is zig's (a Clang), from the wheel `ziglang`, so that a machine needs no compiler of its own. Nothing is
taken from that machine: neither its headers nor a C library, nor the kind of its processor.
"""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
LIBRARY = HERE / "kernels.so"

# No floating-point liberties (base.h says why), and no calls into a C library.
FLAGS = (
    "-std=c11", "-O3", "-ffp-contract=off", "-fno-math-errno", "-ffreestanding", "-fno-builtin", "-fvisibility=hidden",
    "-Wall", "-Wextra", "-Werror",
)  # fmt: skip
# One copy of the kernels for each instruction set, by the number that `level` in dispatch.c gives.
X86_64 = ((2, "-mcpu=x86_64_v2"), (3, "-mcpu=x86_64_v3"))
OTHER = ((0, "-mcpu=baseline"),)


def source_digest(folder: Path = HERE) -> str:
    """SHA-256 of what the library is made from, in ``folder``, hexadecimal."""
    digest = hashlib.sha256()
    for path in sorted([*folder.glob("*.c"), *folder.glob("*.h"), folder / "build.py"]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def compile_kernels(library: Path = LIBRARY) -> None:
    """Writes the shared library. Raises RuntimeError, with the compiler's words, where it cannot be made."""
    levels = X86_64 if platform.machine().lower() in ("x86_64", "amd64") else OTHER
    target = ["-target", f"{platform.machine()}-linux-gnu.2.17", "-fPIC"] if sys.platform == "linux" else []
    with tempfile.TemporaryDirectory(prefix="chaserdock-kernels-") as name:
        folder = Path(name)
        environment = os.environ | {
            "ZIG_GLOBAL_CACHE_DIR": f"{name}/zig",
            "ZIG_LOCAL_CACHE_DIR": f"{name}/zig",
        }

        def zig(*arguments: str) -> None:
            command = [sys.executable, "-m", "ziglang", "cc", *target, *arguments]
            done = subprocess.run(command, cwd=HERE, env=environment, capture_output=True, text=True)
            if done.returncode:
                raise RuntimeError(
                    f"the kernels do not compile: {' '.join(command)}\n{done.stdout}{done.stderr}"
                )

        objects = []
        for level, processor in levels:
            objects.append(str(folder / f"v{level}.o"))
            zig(*FLAGS, processor, f"-DLEVEL=v{level}_", "-c", "kernels.c", "-o", objects[-1])
        objects.append(str(folder / "dispatch.o"))
        zig(
            *FLAGS,
            levels[0][1],
            f'-DSOURCE_DIGEST="{source_digest()}"',
            "-c",
            "dispatch.c",
            "-o",
            objects[-1],
        )
        linked = folder / library.name
        alone = ["-nostdlib", "-s", "-Wl,-z,defs"] if sys.platform == "linux" else []
        zig("-shared", *alone, *objects, "-o", str(linked))
        # Into place in one step: a process may have the old one loaded.
        beside = library.with_suffix(".new")
        beside.write_bytes(linked.read_bytes())
        beside.chmod(0o755)
        beside.replace(library)


if __name__ == "__main__":
    compile_kernels()
