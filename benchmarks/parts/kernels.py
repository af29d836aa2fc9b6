# SPDX-License-Identifier: Apache-2.0
"""Robustness of the C kernels under AddressSanitizer and UndefinedBehaviorSanitizer.

Repeat a finding, "KERNEL, input I, seed S", with ``--kernel KERNEL --first I --inputs 1 --seed S``.
"""

from __future__ import annotations

import sys
import tempfile
import time
from argparse import ArgumentParser
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import sanitizers
from common import ROOT, BenchmarkFailed, Figures, Group, Options


def fuzz_all(
    kernel: str | None, inputs: int, seed: int, first: int, jobs: int
) -> tuple[Figures, int]:
    """Run the fuzz targets; return figures and the number of kernels with a finding."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as threads:
        programs = threads.map(
            lambda item: sanitizers.compile_program(item[1], ROOT / item[0], Path(folder)),
            sanitizers.PROGRAMS.items(),
        )
        runs = [(program, name) for program in programs for name in sanitizers.targets(program)]
        chosen = [run for run in runs if kernel in (None, run[1])]
        if not chosen:
            sys.exit(f"no kernel {kernel}; there are {', '.join(name for _, name in runs)}")

        def timed(run: tuple[Path, str]) -> tuple[str, str, float]:
            begin_s = time.monotonic()
            return run[1], sanitizers.fuzz(*run, inputs, seed, first), time.monotonic() - begin_s

        bad, figures = 0, Figures()
        for name, found, duration_s in threads.map(timed, chosen):
            print(
                f"{name:24} {inputs:9} inputs  {duration_s:6.1f} s  "
                f"{'FOUND' if found else 'nothing found'}",
                flush=True,
            )
            for line in found.splitlines()[:12] + found.splitlines()[-1:] * bool(found):
                print(f"    {line[:200]}")
            bad += bool(found)
            figures[f"{name}_inputs"] = inputs
    return figures | {
        "kernels": len(chosen),
        "inputs": inputs * len(chosen),
        "kernels_with_findings": bad,
    }, bad


def kernels(options: Options) -> Figures:
    """Call every kernel with a million random inputs (``--quick``: 50,000), NaN, infinities and
    denormals among them, and check what it promises (tests/native).
    """
    if not sanitizers.available():
        raise SystemExit(f"needs {sanitizers.NEEDED}")
    inputs = options.inputs or (50_000 if options.quick else 1_000_000)
    figures, bad = fuzz_all(options.kernel, inputs, options.seed, options.first, options.jobs)
    if bad:
        raise BenchmarkFailed(f"{bad} kernels with a finding", figures)
    return figures


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--inputs", type=int, metavar="N", help="mutations or inputs of each target"
    )
    parser.add_argument("--kernel", help="this kernel only")
    parser.add_argument("--seed", type=int, default=1, help="of mutations and inputs (default: 1)")


GROUP = Group(
    {"kernels": kernels},
    ("first", "jobs"),
    add_options,
)
