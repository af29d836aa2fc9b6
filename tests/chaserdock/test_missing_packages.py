# SPDX-License-Identifier: Apache-2.0
"""Without a package that only some commands need, these say in one line what is missing; the others
work.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from harness import ROOT
from packaging.requirements import Requirement

GOLDEN = str(ROOT / "tests" / "golden" / "capture.mcap")
# Start the program where a package cannot be imported, as if it were not installed.
_WITHOUT = """
import sys
sys.modules[sys.argv[1]] = None
sys.argv[:2] = ["chaserdock"]
from chaserdock.cli.main import main
main()
"""


def without(package: str, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", _WITHOUT, package, *command],
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [("world", "single"), ("simulate", "single"), ("run", "single", "--out", "never-made")],
)
def test_world_without_pybullet_names_its_platforms_and_mujoco(command: tuple[str, ...]) -> None:
    done = without("pybullet", *command)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    program, _, text = line.partition(": ")
    assert program == ("world" if command[0] == "world" else "chaserdock")
    assert text.startswith("the world needs PyBullet, which is not installed; it has wheels for")
    assert "Python 3.11 on Linux x86_64 only" in line
    assert "pip install -e '.[mujoco]' and set world.engine = \"mujoco\"" in line


MUJOCO = """
extends = "single"
name = "elsewhere"
duration_s = 0.4
[world]
engine = "mujoco"
[success]
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [("--seeds", "1"), ("--seeds", "1", "--images")], ids=["statistical", "images"]
)
def test_a_mission_on_mujoco_needs_no_pybullet(tmp_path: Path, options: tuple[str, ...]) -> None:
    scenario = tmp_path / "elsewhere.toml"
    scenario.write_text(MUJOCO, encoding="utf-8")
    done = without("pybullet", "simulate", str(scenario), *options, "--out", str(tmp_path / "out"))
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
def test_other_commands_need_no_pybullet() -> None:
    for command in (("scenario",), ("log", GOLDEN)):
        done = without("pybullet", *command)
        assert (done.returncode, done.stderr) == (0, ""), command


@pytest.mark.parametrize(
    ("package", "extra", "command"),
    [
        ("rosbags", "ros2", ("ros2",)),
        ("rosbags", "ros2", ("ros2", "--control")),
        (
            "mujoco",
            "mujoco",
            ("run", "single", "--set", "world.engine=mujoco", "--out", "never-made"),
        ),
        (
            "rosbags",
            "ros2",
            ("log", GOLDEN, "--export", "never-made", "--format", "rosbag2"),
        ),
    ],
)
def test_a_command_without_its_extra_names_it(
    package: str, extra: str, command: tuple[str, ...]
) -> None:
    done = without(package, *command)
    assert done.returncode == 2
    assert done.stderr == (
        f"chaserdock: {package}, of the extra chaserdock[{extra}], is not installed; in a clone of "
        f"chaserdock, pip install -e '.[{extra}]'\n"
    )


def test_pybullet_is_required_where_it_has_a_wheel_and_nowhere_else() -> None:
    """Elsewhere pip would compile it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (pybullet,) = (r for r in map(Requirement, project["dependencies"]) if r.name == "pybullet")
    assert pybullet.marker is not None
    here = {"sys_platform": "linux", "platform_machine": "x86_64", "python_version": "3.11"}
    assert pybullet.marker.evaluate(here)
    for other in (
        {"sys_platform": "darwin"},
        {"platform_machine": "aarch64"},
        {"python_version": "3.12"},
    ):
        assert not pybullet.marker.evaluate(here | other)
