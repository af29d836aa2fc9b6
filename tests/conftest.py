"""Shared by all tests."""

import sys
from pathlib import Path

# ``harness`` is a module beside the tests, not a package of ours.
sys.path.insert(0, str(Path(__file__).resolve().parent))
