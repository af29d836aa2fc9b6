# SPDX-License-Identifier: Apache-2.0
"""Robustness of the C kernels: ``python benchmarks/fuzz_kernels.py [--inputs N] [--quick] [--json
FILE]``.

Compiles all kernels with AddressSanitizer and UndefinedBehaviorSanitizer. Part ``fuzz`` calls each
with seeded random arrays, NaN, infinities and denormals among them, and checks what the kernel
promises (tests/native); part ``tests`` runs the Python tests that call the kernels. Status 1 if
anything is found; 2 without gcc. Repeat a finding, "KERNEL, input I, seed S", with ``--kernel
KERNEL --first I --inputs 1 --seed S``.
"""

from __future__ import annotations

import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from common import ROOT, Figures, make_parser, write_json

sys.path.insert(0, str(ROOT / "tests"))

import sanitizers


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
                f"{name:24} {inputs:9} inputs  {duration_s:6.1f} s  {'FOUND' if found else 'nothing found'}",
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


def main() -> None:
    parser = make_parser(__doc__, ("fuzz", "tests"))
    parser.add_argument(
        "--inputs", type=int, help="inputs per kernel (default 1000000, with --quick 50000)"
    )
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--kernel", help="this kernel only")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="processes at once")
    options = parser.parse_args()
    if not sanitizers.available():
        print(f"needs {sanitizers.NEEDED}", file=sys.stderr)
        sys.exit(2)
    figures, bad = Figures(), 0
    if "fuzz" in options.only:
        inputs = options.inputs or (50_000 if options.quick else 1_000_000)
        figures, bad = fuzz_all(options.kernel, inputs, options.seed, options.first, options.jobs)
    if "tests" in options.only and options.kernel is None:
        run = sanitizers.run_tests()
        print("\n".join(run.stdout.splitlines()[-5:]))
        if run.returncode:
            print(f"{run.stdout[-3000:]}\n{run.stderr[-6000:]}")
        bad += bool(run.returncode)
        figures["tests_status"] = run.returncode
    write_json(options.json, figures)
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
