"""Shared by all tests."""

import sys
from pathlib import Path

# ``harness`` is a module beside the tests, ``closed_loop`` one of the benchmarks: no packages of ours.
sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1] / "benchmarks")]
