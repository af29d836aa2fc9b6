# SPDX-License-Identifier: Apache-2.0
"""What is published: the version, the checks of wheels, the workflow."""

from __future__ import annotations

import importlib.util
import re
import shutil
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
from chaserdock_models.native.build import NATIVE_FOLDERS, TARGETS
from source_tree import ROOT


def _module(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, ROOT / "release" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


version = _module("version")
release = _module("build_wheels")


@pytest.mark.parametrize(
    ("described", "expected"),
    [
        ("v1.2.3", "1.2.3"),
        ("v1.2.3-4-gabc123", "1.2.4.dev4+gabc123"),
        ("v1.2.0rc1", "1.2.0rc1"),
        ("v1.2.0rc1-2-gabc123", "1.2.0rc2.dev2+gabc123"),
        ("", None),
        ("$Format:%(describe)$", None),
    ],
)
def test_version_follows_the_tag(described: str, expected: str | None) -> None:
    assert version.from_description(described) == expected


def test_version_of_a_clone_an_archive_and_a_bare_tree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CHASERDOCK_VERSION", raising=False)
    for name in ("CITATION.cff", ".git_archival.txt", ".gitattributes"):
        shutil.copy(ROOT / name, tmp_path)
    number = version.cited(ROOT)
    assert version.version(tmp_path) == f"{number}+nogit"

    def git(*arguments: str) -> str:
        own = ("-c", "user.name=test", "-c", "user.email=test@example.org")
        return subprocess.check_output(["git", *own, *arguments], cwd=tmp_path, text=True)

    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "first")
    assert re.fullmatch(rf"{number}\.dev1\+g[0-9a-f]+", version.version(tmp_path))
    git("tag", "v2.0.0")
    assert version.version(tmp_path) == "2.0.0"
    archive = tmp_path / "archive"
    archive.mkdir()
    git("archive", "-o", "archive.tar", "HEAD")
    subprocess.run(["tar", "xf", "../archive.tar"], cwd=archive, check=True)
    assert version.version(archive) == "2.0.0"
    monkeypatch.setenv("CHASERDOCK_VERSION", "3.4.5")
    assert version.version(tmp_path) == "3.4.5"


def test_a_release_has_the_version_of_the_citation() -> None:
    release.check_release_version(version.cited(ROOT))
    release.check_release_version("99.0.0.dev1+gabc")
    with pytest.raises(release.ReleaseError, match=r"the tag says 99\.0\.0"):
        release.check_release_version("99.0.0")


def test_every_target_is_built_and_every_kernel_expected() -> None:
    assert set(release.TARGETS) == set(TARGETS)
    assert {
        f"{folder.partition('/')[2]}/kernels.so" for folder in NATIVE_FOLDERS
    } == release.KERNELS


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
    assert "python release/build_wheels.py" in text
    assert "fetch-depth: 0" in text  # else git knows no tags
