"""Watches a mission that others fly (containers, hosts), waits for its log and judges it, as ``run`` does for its own."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import MissionEnd
from chaserdock_protocol.process import StopSignal
from chaserdock_protocol.recording.scan import LOG_NAME
from chaserdock_protocol.run_name import run_name
from chaserdock_protocol.scenario import scenario_from_json
from chaserdock_protocol.transport import Link, Node
from chaserdock_protocol.transport.session import join, new_instance

from chaserdock.exit_codes import STOPPED

from .json_events import Start
from .launcher import Fleet, judge
from .progress import ProgressReporter, Show

LOG_CLOSED_S = 60.0
"""After the end the recorder has that long (wall time) to have everything and close its log."""
_MCAP_END = b"\x89MCAP0\r\n"


class JudgeError(ChaserdockError):
    """There is nothing to judge."""


def judge_mission(out: Path, link: Link, patience_s: float | None, world_away_s: float, show: Show) -> int:
    """Watches the mission on ``link`` to its end, judges the log in ``out/SCENARIO-RUN``, and writes report.html beside
    it; the mission's status.

    ``world_away_s``: a world that has been gone (wall time) for so long counts as lost. Raises JoinRefused when no
    mission is there within ``patience_s``, JudgeError when it left no log.
    """
    node = Node("operator", "operator", link)
    try:
        stop = StopSignal(watch_parent=False)
        mission = join(node, new_instance(), stop, patience_s)
        if mission is None:
            return STOPPED
        folder = out / run_name(mission)
        scenario = scenario_from_json(mission.scenario_json, "the world's scenario")
        reporter = ProgressReporter(scenario, show)
        reporter.tell(
            Start(
                scenario=scenario.name,
                seed=scenario.seed,
                mode=mission.mode,
                duration_s=scenario.duration_s,
                chasers=len(scenario.chasers),
                folder=str(folder),
            )
        )
        try:
            failure = _watch(node, reporter, stop, world_away_s)
        finally:
            reporter.close()
        if stop():
            return STOPPED
        log = folder / LOG_NAME
        if not log.exists():
            raise JudgeError(f"{log}: there is no log; {failure or 'did the recorder write there?'}")
        if not _wait_for_end(log):
            failure = failure or f"the recorder has not closed its log within {LOG_CLOSED_S:g} s of the end"
        status = judge(Fleet(), folder, failure, reporter)
        _write_page(log)
        return status
    finally:
        node.close()  # only now, as the router may end with this


def _watch(node: Node, reporter: ProgressReporter, stop: StopSignal, world_away_s: float) -> str | None:
    """Shows the flight until it has ended; why it failed, or None."""
    seen = {"world": time.monotonic()}

    def changed(process: str, alive: bool) -> None:
        if process == "world":
            seen["world"] = float("inf") if alive else time.monotonic()

    node.subscribe(topics.END)
    reporter.subscribe(node)
    node.watch_liveliness(changed)
    node.declare_liveliness()
    while not stop():
        received = node.receive(0.1)
        if received is not None:
            reporter.take(received.message)
            if isinstance(received.message, MissionEnd):
                return None if received.message.complete else received.message.reason
        reporter.show()
        if time.monotonic() - seen["world"] > world_away_s:
            return f"the world has been gone for {world_away_s:g} s"
    return None


def _write_page(log: Path) -> None:
    """A page on the flight beside the log. That it cannot be written is told, and is no verdict on the flight."""
    from chaserdock.analysis.report import write_report

    try:
        write_report(log)
    except ChaserdockError as error:
        print(f"chaserdock: no report.html: {error}", file=sys.stderr)


def _wait_for_end(log: Path) -> bool:
    """Waits until a log has its footer (a recorder's last act); False when it does not come."""
    deadline = time.monotonic() + LOG_CLOSED_S
    while time.monotonic() < deadline:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - len(_MCAP_END)))
            if log.stat().st_size > 2 * len(_MCAP_END) and file.read() == _MCAP_END:
                return True
        time.sleep(0.1)
    return False
