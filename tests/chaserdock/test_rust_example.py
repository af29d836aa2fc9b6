# SPDX-License-Identifier: Apache-2.0
"""The Rust example decodes odometry as rosbags encodes it, and passes its own tests."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from chaserdock_agents.ros2 import conversion
from chaserdock_agents.ros2.types import TYPES
from chaserdock_protocol import topics
from harness import ROOT

from chaserdock.logs import open_log

DECODER = ROOT / "examples" / "rust_odometry" / "src" / "odometry.rs"

pytestmark = pytest.mark.skipif(shutil.which("rustc") is None, reason="no Rust compiler")


def compiled(source: Path, program: Path, *options: str) -> Path:
    command = ["rustc", "--edition", "2021", *options, str(source), "-o", str(program)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return program


def test_own_tests_pass(tmp_path: Path) -> None:
    done = subprocess.run(
        [compiled(DECODER, tmp_path / "tests", "--test")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert "2 passed" in done.stdout


def test_decodes_odometry_of_a_flight_to_the_last_bit(tmp_path: Path) -> None:
    source = tmp_path / "main.rs"
    source.write_text(
        f'#[path = "{DECODER}"]\nmod odometry;\nuse std::io::Read;\nfn main() {{\n'
        "    let mut bytes = vec![];\n    std::io::stdin().read_to_end(&mut bytes).unwrap();\n"
        '    println!("{:?}", odometry::odometry(&bytes).unwrap());\n}\n'
    )
    program = compiled(source, tmp_path / "decode")
    log = open_log(ROOT / "tests" / "golden" / "two-chasers.mcap")
    message = list(log.messages(topics.ODOMETRY))[-1]
    ros = conversion.odometry(message)
    data = bytes(TYPES.serialize_cdr(ros, "nav_msgs/msg/Odometry"))
    printed = subprocess.run([program], input=data, capture_output=True, check=True).stdout.decode()
    found = {
        name: tuple(map(float, numbers.split(", ")))
        for name, numbers in re.findall(r"(\w+): \[([^]]*)\]", printed)
    }
    w, *xyz = message.q_wxyz
    v = ros.twist.twist.linear
    assert found == {
        "position_m": message.position_m,
        "q_xyzw": (*xyz, w),
        "velocity_m_s": (v.x, v.y, v.z),
        "rate_rad_s": message.omega_rad_s,
    }
    assert 'frame: "world", child_frame: "chaser_1"' in printed
