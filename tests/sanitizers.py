# SPDX-License-Identifier: Apache-2.0
"""The C kernels under AddressSanitizer and UndefinedBehaviorSanitizer: fuzz programs (tests/native)
and Python tests.

The compiler of the package comes without AddressSanitizer; gcc is needed (Debian: gcc and
libc6-dev).
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

from chaserdock_models.native import build
from source_tree import ROOT

PROGRAMS = {
    folder: "fuzz_" + folder.split("/")[-2].removeprefix("chaserdock_")
    for folder in build.NATIVE_FOLDERS
}
"""Fuzz program of each folder with kernels: ``tests/native/NAME.c``."""
NEEDED = "gcc with the libraries of its sanitizers (Debian: apt-get install gcc libc6-dev)"
_SANITIZERS = ("-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
_FLAGS = (
    *(flag for flag in build.FLAGS if flag not in ("-O3", "-Werror")),
    "-g",
    "-Wno-psabi",
    "-Wno-unused-function",
    *_SANITIZERS,
)
_ENVIRONMENT = {
    "ASAN_OPTIONS": "abort_on_error=1:detect_leaks=0:quarantine_size_mb=8",
    "UBSAN_OPTIONS": "abort_on_error=1:print_stacktrace=1",
}
# Python tests that together call all kernels. casadi loads its solvers with RTLD_DEEPBIND, which
# AddressSanitizer refuses.
_TESTS = (
    "tests/architecture/test_native.py",
    "tests/agents/test_model_perception.py::test_search_for_the_sun_behind_a_target_is_spread_over_images",
    "tests/agents/test_perception.py",
    "tests/agents/test_small_markers.py::test_one_far_marker_always_lists_its_true_pose",
    "tests/agents/test_views.py",
    "tests/chaserdock/test_batch_dynamics.py",
    "tests/controller/test_dynamics.py",
    "tests/controller/test_identification.py::test_the_transition_is_the_derivative_of_the_prediction",
    "tests/controller/test_joint.py",
    "tests/controller/test_nmpc_qp.py",
    "tests/missions/test_statistical.py::test_measurements_depend_on_seed_chaser_and_number_only",
    "tests/world/test_mesh_renderer.py",
    "tests/world/test_physics.py",
    "tests/world/test_pixels.py",
    "tests/world/test_render.py",
    "-mnot slow",
    "-knot ipopt and not mujoco and not where_the_lens_ends",
    "--all-kernels",
)


def kernels_in(folder: str) -> set[str]:
    """Return the names of the kernels in one of the folders ``NATIVE_FOLDERS``."""
    sources = "".join(path.read_text() for path in (ROOT / folder).glob("*.c"))
    return set(re.findall(r"^EXPORT \w+ NAME\((\w+)\)", sources, re.MULTILINE))


@cache
def available() -> bool:
    """Test whether gcc can link with the sanitizers' libraries."""
    if shutil.which("gcc") is None:
        return False
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "empty.c"
        source.write_text("int main(void) { return 0; }\n")
        command = ["gcc", *_SANITIZERS, str(source), "-o", f"{folder}/empty"]
        return subprocess.run(command, capture_output=True).returncode == 0


def _compile(*arguments: str) -> None:
    command = ["gcc", *_FLAGS, *arguments]
    completed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if completed.returncode:
        raise RuntimeError(f"{' '.join(command)}\n{completed.stderr}")


def compile_program(name: str, kernels: Path, to: Path, optimize: str = "-O1") -> Path:
    """Compile the fuzz program ``name`` with the sources in the folder ``kernels``, into the folder
    ``to``; return its path.

    Raises RuntimeError with the compiler's messages if it does not compile.
    """
    source, program = ROOT / "tests" / "native" / f"{name}.c", to / name
    _compile(
        optimize,
        f"-I{kernels}",
        f"-I{build.HERE}",
        "-DLEVEL=fuzz_",
        str(source),
        "-o",
        str(program),
        "-lm",
    )
    return program


def targets(program: Path) -> list[str]:
    """Return the kernels that a program calls."""
    return subprocess.run([program], check=True, capture_output=True, text=True).stdout.split()


def fuzz(program: Path, target: str, inputs: int, seed: int, first: int = 0) -> str:
    """Call a kernel with inputs ``first``, ``first`` + 1, ...; return what was found, empty if
    nothing.
    """
    command = [str(program), target, str(first), str(inputs), str(seed)]
    completed = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | _ENVIRONMENT
    )
    return completed.stderr or (f"status {completed.returncode}" if completed.returncode else "")


def _compile_library(folder: str, to: Path, optimize: str) -> None:
    """Compile the kernels of ``folder`` with sanitizers, beside a copy of their sources, as
    `KernelLibrary` expects.
    """
    shutil.copytree(ROOT / folder, to, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    x86_64 = platform.machine().lower() in ("x86_64", "amd64")
    shared = (
        optimize,
        "-fPIC",
        f"-I{to}",
        f"-I{build.HERE}",
        f'-DSOURCE_DIGEST="{build.source_digest(to)}"',
    )
    objects = []
    for level, _ in build.X86_64 if x86_64 else build.OTHER:
        objects.append(str(to / f"v{level}.o"))
        processor = [f"-march=x86-64-v{level}"] if x86_64 else []
        _compile(
            *shared,
            *processor,
            f"-DLEVEL=v{level}_",
            "-c",
            str(to / "kernels.c"),
            "-o",
            objects[-1],
        )
    _compile(
        *shared,
        "-shared",
        str(build.HERE / "dispatch.c"),
        *objects,
        "-o",
        str(to / build.LIBRARY_NAME),
    )


def run_tests(*arguments: str, optimize: str = "-O1") -> subprocess.CompletedProcess[str]:
    """Run Python tests of all kernels in a process in which the kernels have sanitizers;
    ``arguments`` for pytest.
    """
    find = ["gcc", "-print-file-name=libasan.so"]
    runtime = subprocess.run(find, check=True, capture_output=True, text=True).stdout.strip()
    with tempfile.TemporaryDirectory() as folder:
        for number, kernels in enumerate(build.NATIVE_FOLDERS):
            _compile_library(kernels, Path(folder) / str(number), optimize)
        paths = [str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")]
        environment = os.environ | _ENVIRONMENT
        environment |= {"LD_PRELOAD": runtime, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
        environment |= {"SANITIZED_KERNELS": folder}
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-p",
            "sanitized_kernels",
            "-p",
            "no:cacheprovider",
        ]
        return subprocess.run(
            [*command, *(arguments or _TESTS)],
            cwd=ROOT,
            env=environment,
            capture_output=True,
            text=True,
        )
