# SPDX-License-Identifier: Apache-2.0
"""Other projects in an interpreter of their own, for comparison."""

from __future__ import annotations

import json
import subprocess
from typing import Any


def run_in(python: str, script: str, given: Any) -> Any:
    """Run a script in the interpreter ``python``, with ``given`` as JSON on its stdin; return what
    it prints as JSON after ``RESULT``. Raises SystemExit if it fails.
    """
    done = subprocess.run(
        [python, "-c", script],
        input=json.dumps(given),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"{python} failed: {done.stderr.strip()[-2000:]}")
    return json.loads(done.stdout.split("RESULT")[1])
