# SPDX-License-Identifier: Apache-2.0
"""Flies a case and checks the invariants on the way."""

from __future__ import annotations

import contextlib
import os
import tempfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.scenario import ScenarioError, load_scenario
from chaserdock_protocol.transport import RawSample

from chaserdock.toml_text import toml_document

from .checks.check import Violation
from .checks.estimates import NEES, CovarianceConsistency
from .checks.expectations import LEAST_SAMPLES, Expectation
from .checks.flight_checks import FlightChecks
from .checks.tracking import TRACKING, TrackingAccuracy
from .mission import simulate
from .swarm import Case


@dataclass(frozen=True)
class SimulationResult:
    """A simulated flight and its verdict.

    ``outcome``: the first violated invariant, or else the worst final state of the chasers that are
    to dock. ``fingerprint``: digest of all messages and their times, equal for equal flights.
    ``means``: quantity (of ``EXPECTATIONS``), subject, and mean over the flight; empty unless no
    sensor lies and the plant is as stated.
    """

    seed: int
    case: Case
    violations: tuple[Violation, ...]
    outcome: str
    fingerprint: str
    means: tuple[tuple[str, str, float], ...]
    sim_time_s: float


def fly_case(
    case: Case, seed: int, folder: Path | None = None, *, to_violation: bool = False
) -> SimulationResult:
    """Simulate a case and check the invariants. Raises ScenarioError.

    ``folder``: keep the log there. ``to_violation``: end the flight at the first violation.
    """
    with contextlib.ExitStack() as stack:
        in_memory = tempfile.TemporaryDirectory(
            prefix=f"chaserdock-{os.getpid()}-", dir=memory_folder()
        )
        scratch = Path(stack.enter_context(in_memory))
        path, text = scratch / "scenario.toml", toml_document(case)
        write_atomically(path, text)
        try:
            checks, fingerprint = FlightChecks(load_scenario(path)), 0
        except ScenarioError as error:
            # The text must not name the temporary file.
            raise ScenarioError(str(error).replace(f"{path}: ", "")) from None
        if folder is not None:  # only now: a refused case leaves no folder
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / "scenario.toml"
            write_atomically(path, text)

        def tap(sender: str, raw: RawSample) -> None:
            nonlocal fingerprint
            fingerprint = fingerprint_after(fingerprint, sender, raw)
            checks.observe(sender, raw)

        def over() -> bool:
            return to_violation and bool(checks.violations)

        flight = simulate(path, path.parent / "run", tap=tap, over=over)
        if not over():
            checks.end(flight)
    return SimulationResult(
        seed=seed,
        case=case,
        violations=tuple(checks.violations),
        outcome=checks.outcome,
        fingerprint=f"{fingerprint:08x}",
        means=_means(checks),
        sim_time_s=checks.view.time_s,
    )


def fingerprint_after(fingerprint: int, sender: str, raw: RawSample) -> int:
    """Return the digest of all messages of a flight up to ``raw``, from that of those before."""
    head = zlib.crc32(f"{sender}{raw.key}{raw.sent_ns}".encode(), fingerprint)
    return zlib.crc32(raw.payload, head)


EXPECTATIONS: dict[str, Expectation] = {of.name: of for of in (NEES, TRACKING)}
"""Quantities of which flights have means, by name."""


def _means(checks: FlightChecks) -> tuple[tuple[str, str, float], ...]:
    """Return the means of the quantities with an expectation in a flight that should meet it."""
    if not checks.view.causes.honest:
        return ()
    estimates, tracking = checks.find(CovarianceConsistency), checks.find(TrackingAccuracy)
    found = {(NEES, "target"): estimates.nees}
    found |= {(NEES, f"chaser/{i}"): values for i, values in estimates.relative_nees.items()}
    found |= {(TRACKING, f"chaser/{i}"): values for i, values in tracking.values.items()}
    return tuple(
        (of.name, subject, sum(values) / len(values))
        for (of, subject), values in found.items()
        if len(values) >= LEAST_SAMPLES
    )


def memory_folder() -> str | None:
    """Return a folder in memory for logs that are not kept; None if this system has none."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None
