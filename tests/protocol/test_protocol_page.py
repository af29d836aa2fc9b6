# SPDX-License-Identifier: Apache-2.0
"""docs/protocol.md matches the message types and the topics table."""

from __future__ import annotations

import subprocess
import sys

from chaserdock_protocol import messages, topics
from harness import ROOT


def test_the_committed_page_is_up_to_date() -> None:
    command = [sys.executable, str(ROOT / "docs" / "make_protocol.py"), "--print"]
    made = subprocess.run(
        command, capture_output=True, text=True, check=True, encoding="utf-8"
    ).stdout
    committed = (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8")
    assert committed == made, "run: python docs/make_protocol.py"


def test_the_page_has_every_topic_and_every_message() -> None:
    page = (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8")
    for topic in topics.TOPICS:
        assert f"| `{topic.key}` |" in page
    for kind in messages.VERSION:
        assert f"\n### {kind.__name__}\n" in page
        assert f"`{messages.encoding_of(kind)}`" in page
        for name in kind.__struct_fields__:
            assert f"| `{name}` |" in page
