# SPDX-License-Identifier: Apache-2.0
"""Watches a mission that other machines or containers fly, waits for its log, and judges it."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import JoinReply, MissionEnd
from chaserdock_protocol.process import StopSignal
from chaserdock_protocol.recording.scan import LOG_NAME
from chaserdock_protocol.run_name import run_name
from chaserdock_protocol.scenario import Scenario, scenario_from_json
from chaserdock_protocol.transport import Link, Node
from chaserdock_protocol.transport.session import (
    NoFullScenario,
    ignore_foreign_publishers,
    join,
    request_scenario,
)

from chaserdock.exit_codes import STOPPED

from .launcher import Fleet, judge, print_outcome, start_line
from .mission_address import MissionAddress
from .progress import ProgressReporter, Show
from .reach import TO_JUDGE, check_rights

LOG_CLOSED_S = 60.0
"""Wall time, s, after the end of the mission within which the recorder must close its log."""
HOST_FOLDER = "HOST_RUNS"
"""Environment variable with the path on the host of the folder that a container judges."""
_MCAP_END = b"\x89MCAP0\r\n"


class JudgeError(ChaserdockError):
    """The mission left no log."""


def judge_mission(
    out: Path, link: Link, timeout_s: float | None, world_timeout_s: float, show: Show
) -> int:
    """Watch the mission on ``link`` to its end, judge its log in ``out/SCENARIO-RUN`` and write
    report.html beside the log.

    Returns the exit status. ``world_timeout_s``: wall time after which an absent world counts as
    lost. Raises JoinRefused without a mission within ``timeout_s``, JudgeError if it left no log,
    RightsError.
    """
    check_rights(link, "judge", TO_JUDGE)
    node = Node("operator", "operator", link)
    try:
        stop = StopSignal(watch_parent=False)
        mission = join(node, node.host.unique_id(), stop, timeout_s)
        if mission is None:
            return STOPPED

        folder = out / run_name(mission)
        scenario = _scenario_of(node, mission, stop)
        if scenario is None:
            return STOPPED

        reporter = ProgressReporter(scenario, show)
        # Keys differ between the parties of a mission on several hosts: each has its own folder.
        address = MissionAddress(namespace=link.namespace, endpoint=",".join(link.connect))
        reporter.report(start_line(scenario, mission.mode, folder, address))
        ignore_foreign_publishers(node, mission.source, reporter.report_foreign)

        try:
            failure = _watch(node, reporter, stop, world_timeout_s)
        finally:
            reporter.close()
        if stop():
            return STOPPED

        log = folder / LOG_NAME
        if not log.exists():
            raise JudgeError(
                f"{log}: no such log; {failure or 'does the recorder write to this folder?'}"
            )
        if not _wait_for_end(log):
            failure = (
                failure
                or f"the recorder did not close its log within {LOG_CLOSED_S:g} s after the end"
            )

        outcome = judge(Fleet(), folder, failure, reporter)
        print_outcome(outcome, show)
        page = _write_page(log)
        if show is not Show.json:
            print(files_lines(folder, page), flush=True)
        return outcome.status
    finally:
        node.close()  # last, because the router may exit once this node has left


def _scenario_of(node: Node, mission: JoinReply, stop: StopSignal) -> Scenario | None:
    """Return the mission's full scenario, or that of the flight software of a world that gives no
    other; None if stopped.
    """
    try:
        text = request_scenario(node, mission, stop)
    except NoFullScenario as reason:
        print(f"chaserdock: {reason} Judging without its criteria.", file=sys.stderr)
        text = mission.scenario_json
    return None if text is None else scenario_from_json(text, "the world's scenario")


def _watch(
    node: Node, reporter: ProgressReporter, stop: StopSignal, world_timeout_s: float
) -> str | None:
    """Show the flight until it ends. Returns why it failed, or None."""
    world_seen_s = time.monotonic()

    def changed(process: str, alive: bool) -> None:
        nonlocal world_seen_s
        if process == "world":
            world_seen_s = float("inf") if alive else time.monotonic()

    node.subscribe(topics.END)
    reporter.subscribe(node)
    node.watch_liveliness(changed)
    node.declare_liveliness()
    while not stop():
        received = node.receive(0.1)
        if received is not None:
            reporter.update(received.message)
            if isinstance(received.message, MissionEnd):
                return None if received.message.complete else received.message.reason
        reporter.refresh()
        if time.monotonic() - world_seen_s > world_timeout_s:
            return f"the world has been absent for {world_timeout_s:g} s"
    return None


def _write_page(log: Path) -> Path | None:
    """Write report.html beside the log; report an error, which does not change the verdict."""
    from chaserdock.analysis.report import write_report

    try:
        return write_report(log)
    except ChaserdockError as error:
        print(f"chaserdock: no report.html: {error}", file=sys.stderr)
        return None


def files_lines(folder: Path, page: Path | None) -> str:
    """Return the folder of a mission, as the host of a container names it; below it, its files."""
    from chaserdock.analysis.summary import SUMMARY_NAME

    host = os.environ.get(HOST_FOLDER)
    where = str(folder) if host is None else f"on the host, {host}/{folder.name}"
    report = [] if page is None else [page.name]
    others = [name for name in (LOG_NAME, SUMMARY_NAME) if (folder / name).is_file()]
    return f"{where}\n  {', '.join([*report, *others])}"


def _wait_for_end(log: Path) -> bool:
    """Wait until a log has its footer, which the recorder writes last. Returns False if it does not
    appear.
    """
    deadline = time.monotonic() + LOG_CLOSED_S
    while time.monotonic() < deadline:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - len(_MCAP_END)))
            if log.stat().st_size > 2 * len(_MCAP_END) and file.read() == _MCAP_END:
                return True
        time.sleep(0.1)
    return False
