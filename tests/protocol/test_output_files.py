# SPDX-License-Identifier: Apache-2.0
"""A file that a user gets is complete, or as it was."""

from __future__ import annotations

import errno
import os
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from chaserdock_protocol.errors import ChaserdockError, WriteError, errors_of_writing
from chaserdock_protocol.output_files import replaced, write_atomically
from chaserdock_protocol.process import print_status


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no file reach the disk, as when the last block is taken."""

    def fails(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fails)


@pytest.mark.parametrize("content", ["{}\n", b"\x00\x01", "ü\n"])
def test_a_file_is_written_and_replaced(tmp_path: Path, content: str | bytes) -> None:
    path = tmp_path / "summary.json"
    for old in (None, "much longer than the new one"):
        if old is not None:
            path.write_text(old)
            path.chmod(0o600)
        write_atomically(path, content)
        expected = content.encode() if isinstance(content, str) else content
        assert path.read_bytes() == expected
        assert os.listdir(tmp_path) == ["summary.json"]
    assert path.stat().st_mode & 0o777 == 0o600


@pytest.mark.usefixtures("full_disk")
@pytest.mark.parametrize("old", [None, "old"])
def test_a_full_disk_is_one_line_and_leaves_the_old_file(tmp_path: Path, old: str | None) -> None:
    path = tmp_path / "summary.json"
    if old is not None:
        path.write_text(old)
    with pytest.raises(ChaserdockError) as caught:
        write_atomically(path, "new")
    assert str(caught.value) == f"{path}: cannot be written: No space left on device"
    assert isinstance(caught.value, OSError)
    assert [p.read_text() for p in tmp_path.iterdir()] == [old] * (old is not None)


def test_an_error_while_writing_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.svg"
    path.write_text("old")

    def fail_half_way() -> None:
        with replaced(path) as new:
            assert new.suffix == ".svg"
            new.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert [p.read_text() for p in tmp_path.iterdir()] == ["old"]


def test_devices_and_links_stay_what_they_are(tmp_path: Path) -> None:
    write_atomically(Path(os.devnull), "text")
    assert not Path(os.devnull).is_file()
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("old")
    link.symlink_to(target)
    write_atomically(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_the_text_names_the_file_once(tmp_path: Path) -> None:
    missing = tmp_path / "no-folder" / "a.json"
    with pytest.raises(WriteError, match=r"a\.json: cannot be written: No such file"):
        write_atomically(missing, "")
    with pytest.raises(ChaserdockError) as caught, errors_of_writing(tmp_path):
        write_atomically(missing, "")
    assert str(caught.value) == f"{missing}: cannot be written: No such file or directory"


def test_a_status_that_cannot_be_printed_ends_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stderr", full)
        print_status("world", "completed")
        with pytest.raises(OSError, match="No space"):
            print("what print alone does", file=sys.stderr, flush=True)
        with suppress(OSError):
            full.close()
