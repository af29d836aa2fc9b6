# SPDX-License-Identifier: Apache-2.0
"""What the container image omits from installed packages: docker/slim.py."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import daqp
from harness import ROOT

without_symbols = runpy.run_path(str(ROOT / "docker" / "slim.py"), run_name="slim")[
    "without_symbols"
]


def test_a_library_without_symbols_is_smaller_and_loads(tmp_path: Path) -> None:
    assert daqp.__file__ is not None
    module = Path(daqp.__file__)
    library = next(module.parents[1].glob("daqp*.so"), module)
    content = library.read_bytes()
    kept = without_symbols(content)
    assert len(kept) < len(content)
    (tmp_path / library.name).write_bytes(kept)
    program = "import daqp, sys; print(daqp.__file__)"
    said = subprocess.check_output(
        [sys.executable, "-c", program], cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)}
    )
    assert said.decode().strip() == str(tmp_path / library.name)


def test_other_files_are_unchanged() -> None:
    assert without_symbols(b"INPUT(libm.so.6)") == b"INPUT(libm.so.6)"
