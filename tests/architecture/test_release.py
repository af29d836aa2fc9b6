# SPDX-License-Identifier: Apache-2.0
"""What is published: the version, the checks of wheels, the workflow."""

from __future__ import annotations

import importlib.util
import struct
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest
from chaserdock_models.native.build import NATIVE_FOLDERS, TARGETS, place_of
from source_tree import ROOT


def _module(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, ROOT / "release" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


release = _module("build_wheels")


def test_a_release_has_the_version_of_its_tag() -> None:
    release.check_tag(f"v{release.version()}")
    with pytest.raises(release.ReleaseError, match=r"the tag is v99\.0\.0"):
        release.check_tag("v99.0.0")


def test_the_lock_file_has_the_version_of_pyproject() -> None:
    locked = tomllib.loads((ROOT / "uv.lock").read_text(encoding="utf-8"))["package"]
    assert [p["version"] for p in locked if p["name"] == "chaserdock"] == [release.version()]


def test_every_target_is_built_and_every_kernel_expected() -> None:
    assert set(release.TARGETS) == set(TARGETS)
    assert {place_of(folder) for folder in NATIVE_FOLDERS} == release.KERNELS


def macho(
    processor: int = 0x0100000C, oldest: int = 11 << 16, library: str = "/usr/lib/libSystem.B.dylib"
) -> bytes:
    """Return the head of a macOS library."""
    name = library.encode() + b"\0" * (8 - len(library) % 8)
    loads = struct.pack("<6I", 0xC, 24 + len(name), 24, 0, 0, 0) + name
    built = struct.pack("<6I", 0x32, 24, 1, oldest, oldest, 0)
    signature = struct.pack("<4I", 0x1D, 16, 0, 0)
    commands = loads + built + signature
    return struct.pack("<8I", 0xFEEDFACF, processor, 0, 6, 3, len(commands), 0, 0) + commands


def wheel(folder: Path, platform: str, content: bytes, without: str = "") -> Path:
    path = folder / f"chaserdock-1.0-py3-none-{platform}.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "chaserdock-1.0.dist-info/METADATA", "Metadata-Version: 2.4\nVersion: 1.0\nName: x\n"
        )
        for name in (*release.DATA, *sorted(release.KERNELS)):
            if name != without:
                archive.writestr(name, content)
    return path


def test_a_wheel_that_can_be_published_passes(tmp_path: Path) -> None:
    assert (
        release.check_wheel(wheel(tmp_path, "macosx_11_0_arm64", macho()), "1.0")
        == "macosx_11_0_arm64"
    )
    linux = wheel(tmp_path, "manylinux_2_17_aarch64", b"")
    assert release.check_wheel(linux, "1.0") == "manylinux_2_17_aarch64"


@pytest.mark.parametrize(
    ("platform", "content", "without", "expected", "message"),
    [
        ("linux_x86_64", b"", "", "1.0", "does not accept the platform"),
        ("manylinux_2_17_x86_64", b"", "", "1.1", "not version 1.1"),
        (
            "manylinux_2_17_x86_64",
            b"",
            "chaserdock/shipped/single.toml",
            "1.0",
            "missing files.*single",
        ),
        ("manylinux_2_17_x86_64", b"", "chaserdock_models/native/kernels.so", "1.0", "libraries"),
        ("macosx_11_0_arm64", b"\x7fELF" + bytes(60), "", "1.0", "not a 64-bit Mach-O file"),
        ("macosx_11_0_arm64", macho(processor=0x01000007), "", "1.0", "does not load it"),
        ("macosx_11_0_arm64", macho(oldest=14 << 16), "", "1.0", "does not load it"),
        (
            "macosx_11_0_arm64",
            macho(library="/opt/lib/libomp.dylib"),
            "",
            "1.0",
            "needs /opt/lib/libomp",
        ),
    ],
)
def test_a_wheel_that_must_not_be_published_is_refused(
    tmp_path: Path, platform: str, content: bytes, without: str, expected: str, message: str
) -> None:
    with pytest.raises(release.ReleaseError, match=message):
        release.check_wheel(wheel(tmp_path, platform, content, without), expected)


def test_a_platform_tag_may_not_promise_more_than_auditwheel_finds() -> None:
    assert release.fits("manylinux_2_5_x86_64", "manylinux_2_17_x86_64")
    assert not release.fits("manylinux_2_28_x86_64", "manylinux_2_17_x86_64")
    assert not release.fits("manylinux_2_17_x86_64", "manylinux_2_17_aarch64")
    assert not release.fits("linux_x86_64", "manylinux_2_17_x86_64")


def test_the_release_is_published_without_a_stored_secret() -> None:
    """Trusted publishing: the index trusts the workflow's identity."""
    text = (ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8")
    assert "id-token: write" in text
    assert "secrets." not in text
    assert "password" not in text
    assert 'python release/build_wheels.py --tag "$GITHUB_REF_NAME"' in text
