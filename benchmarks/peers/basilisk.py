# SPDX-License-Identifier: Apache-2.0
"""Basilisk in an interpreter of its own, for comparison (``pip install bsk`` there)."""

from __future__ import annotations

import json
import subprocess
from typing import Any


def run_basilisk(python: str, script: str, given: Any) -> Any:
    """Run a script in Basilisk's interpreter, with ``given`` as JSON on its stdin; return what it
    prints as JSON after ``RESULT``. Raises SystemExit if it fails.
    """
    done = subprocess.run(
        [python, "-c", script],
        input=json.dumps(given),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"Basilisk failed: {done.stderr.strip()[-2000:]}")
    return json.loads(done.stdout.split("RESULT")[1])
