# SPDX-License-Identifier: Apache-2.0
"""The C kernels under sanitizers: arbitrary floating-point input, and that the sanitizers and
checks find faults.

`python benchmarks/fuzz.py` does the same for longer.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
import sanitizers
from chaserdock_models.native.build import NATIVE_FOLDERS
from source_tree import ROOT

needs_gcc = pytest.mark.skipif(not sanitizers.available(), reason=f"needs {sanitizers.NEEDED}")
INPUTS = 1000
# Sizes of working memory, which the targets of their kernels call.
WORKSPACES = {"qp_workspace", "tick_workspace", "predict_workspace", "innovate_workspace"}


@pytest.mark.parametrize("folder", NATIVE_FOLDERS)
def test_every_kernel_has_a_fuzz_target(folder: str) -> None:
    kernels = sanitizers.kernels_in(folder)
    program = (ROOT / "tests" / "native" / f"{sanitizers.PROGRAMS[folder]}.c").read_text()
    assert kernels
    assert set(re.findall(r'\{"(\w+)", \1\}', program)) == kernels - WORKSPACES


@pytest.mark.slow
@needs_gcc
@pytest.mark.parametrize("folder", NATIVE_FOLDERS)
def test_kernels_stand_any_floating_point_input(folder: str, tmp_path: Path) -> None:
    """NaN, infinities and denormals among others: no access outside of arrays, no undefined
    operation, no endless loop.
    """
    program = sanitizers.compile_program(
        sanitizers.PROGRAMS[folder], ROOT / folder, tmp_path, "-O0"
    )
    assert [
        found
        for kernel in sanitizers.targets(program)
        if (found := sanitizers.fuzz(program, kernel, INPUTS, 1))
    ] == []


@needs_gcc
@pytest.mark.slow(minutes=1.5)
def test_python_tests_call_all_kernels_under_sanitizers() -> None:
    run = sanitizers.run_tests()
    assert run.returncode == 0, f"{run.stdout[-3000:]}\n{run.stderr[-3000:]}"


@pytest.mark.slow
@needs_gcc
@pytest.mark.parametrize(
    ("folder", "kernel", "source", "right", "wrong", "finding"),
    [
        (
            1,
            "draw_stars",
            "scene.c",
            "if (!(x > -1.0 && y > -1.0",
            "if ((x < -1.0 && y > -1.0",
            "outside the range",
        ),
        (
            2,
            "refine_corners",
            "corners.c",
            "if (row > p->height - 2)",
            "if (row > p->height)",
            "heap-buffer-overflow",
        ),
        (
            3,
            "plan_violation",
            "planes.c",
            "or_nan(worst[i], problem->to_target",
            "of(worst[i], problem->to_target",
            "violated: worst",
        ),
    ],
)
def test_planted_faults_are_found(
    folder: int, kernel: str, source: str, right: str, wrong: str, finding: str, tmp_path: Path
) -> None:
    """An undefined conversion, a read behind the image, and a NaN that gets lost."""
    name, copy = NATIVE_FOLDERS[folder], tmp_path / "kernels"
    shutil.copytree(ROOT / name, copy, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    text = (copy / source).read_text()
    assert text.count(right) == 1
    (copy / source).write_text(text.replace(right, wrong))
    program = sanitizers.compile_program(sanitizers.PROGRAMS[name], copy, tmp_path, "-O0")
    found = sanitizers.fuzz(program, kernel, INPUTS, 1)
    assert finding in found
    number = int(re.findall(rf"aborted: {kernel}, input (\d+), seed 1", found)[-1])
    assert finding in sanitizers.fuzz(program, kernel, 1, 1, first=number)  # the stated input alone
