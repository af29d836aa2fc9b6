"""One seeded docking flight: ``docking-contact`` from a random start, at a random rate, to its end (``docking.py``)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_controller.estimation.composite_body import target_body
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import OperatorCommand, ProbeTouch
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_world.physics.simulation import TARGET
from offline import CameraPose, Offline, momentum

ROOT = Path(__file__).resolve().parents[1]
APPROACH_AT_S = 4.0
LIMIT_S = 96.0
ABORT_WITHIN_S = 42.0
"""After the command to approach: it is verified by then, unless it had to try again."""
OPEN_WITHIN_S = 30.0
REACHED_M = 0.05


Failure = tuple[str, int, float]
"""Of a thruster: kind, number, time in s."""


def mission(
    seed: int,
    actuation: str = "thrusters",
    rate_hz: int | None = None,
    failure: Failure | None = None,
    changes: tuple[str, ...] = (),
) -> Scenario:
    """``docking-contact`` from a start and at rates that depend on the seed alone; ``changes`` as of ``run --set``."""
    rng = np.random.default_rng([seed, 0xD0C])
    paper_omega, paper_velocity = math.hypot(0.015, 0.045, 0.03), math.hypot(0.015, 0.0075, 0.03)

    def towards(length: float) -> list[float]:
        direction = rng.normal(size=3)
        return (length * direction / np.linalg.norm(direction)).tolist()

    factor = float(rng.uniform(0.0, 3.0))
    values: dict[str, Any] = {
        "seed": seed,
        "target.omega_rad_s": towards(factor * paper_omega),
        "target.velocity_m_s": towards(factor * paper_velocity),
        "target.q_wxyz": rotations.normalize(rng.normal(size=4)).tolist(),
        "timeline": [],
        "chaser.actuation": actuation,
    }
    if rate_hz is not None:
        values |= {"time.rate_hz": rate_hz, "time.image_hz": rate_hz}
    if failure is not None:
        kind, thruster, at_s = failure
        values["thruster_failure"] = f"[{{chaser=0,thruster={thruster},at_s={at_s},kind='{kind}'}}]"
    overrides = [*(f"{key}={value}" for key, value in values.items()), *changes]
    scenario = load_scenario(ROOT / "scenarios" / "docking-contact.toml", tuple(overrides))
    chaser = scenario.chasers[0].model_copy(
        update={
            "start_offset_m": tuple(rng.uniform(-0.08, 0.08, 3).tolist()),
            "start_rotation_rad": tuple(rng.uniform(-0.08, 0.08, 3).tolist()),
            "start_velocity_m_s": tuple(rng.uniform(-0.01, 0.01, 3).tolist()),
        }
    )
    return scenario.model_copy(update={"chasers": (chaser,)})


@dataclass
class Conservation:
    """Momentum of chaser and target from shortly before the touch to half a second after the latch has closed.

    What the actuators gave is taken off, step by step; ``linear`` and ``angular`` are relative errors.
    """

    flight: Offline
    linear: float | None = None
    angular: float | None = None
    _begun: tuple[Array, Array] | None = None
    _given: list[Array] = field(default_factory=lambda: [np.zeros(3), np.zeros(3)])
    _left_steps: int | None = None

    def __post_init__(self) -> None:
        s = self.flight.scenario
        body = target_body(s)
        self._masses = {
            TARGET: (body.mass_kg, np.diag(body.inertia_kg_m2)),
            "chaser/0": (s.chaser.mass_kg, np.asarray(s.chaser.inertia)),
        }
        self.flight.fly = self.fly  # type: ignore[method-assign]

    def fly(self, end_step: int) -> None:
        """Flies as the flight does, one step at a time while it counts."""
        physics, scenario = self.flight.physics, self.flight.scenario
        near = self.flight.phase(0) in ("final", "contact") and self._gap_m() < 0.015
        if (self._begun is None and not near) or self.linear is not None:
            Offline.fly(self.flight, end_step)
            return
        if self._begun is None:
            self._begun = momentum(physics, self._masses)
            self.flight.given("chaser/0")
        while physics.step_count < end_step:
            own, target = physics.state("chaser/0"), physics.state(TARGET)
            m, n = self._masses["chaser/0"][0], self._masses[TARGET][0]
            centre = (m * own.position_m + n * target.position_m) / (m + n)
            Offline.fly(self.flight, physics.step_count + 1)
            given = self.flight.given("chaser/0")
            pushed = rotations.rotate(own.q_wxyz, given[:3])
            turned = rotations.rotate(own.q_wxyz, given[3:]) + np.cross(own.position_m - centre, pushed)
            self._given[0] = self._given[0] + np.asarray(pushed)
            self._given[1] = self._given[1] + np.asarray(turned, dtype=float)
            if self._left_steps is None and physics.latches["chaser/0"].latched:
                self._left_steps = scenario.time.physics_hz // 2
            elif self._left_steps is not None and self.linear is None:
                self._left_steps -= 1
                if self._left_steps == 0:
                    self._conclude()

    def _gap_m(self) -> float:
        own, target = self.flight.physics.state("chaser/0"), self.flight.physics.state(TARGET)
        s = self.flight.scenario
        centre = rotations.rotate_inverse(target.q_wxyz, own.position_m - target.position_m)
        port = s.docking.ports[0]
        return float((centre - np.array(port.position_m)) @ np.array(port.axis)) - s.chaser.probe_reach_m

    def _conclude(self) -> None:
        assert self._begun is not None
        now = momentum(self.flight.physics, self._masses)
        errors = [
            float(np.linalg.norm(now[k] - self._begun[k] - self._given[k]) / np.linalg.norm(self._begun[k]))
            for k in range(2)
        ]
        self.linear, self.angular = errors


@dataclass
class Outcome:
    """How one flight ended. ``touch`` is the one at which the latch closed; ``peak_m`` the greatest distance from the
    reference on the true target from the thruster's ``failure`` on until it is captured."""

    seed: int
    cause: str
    verified: bool
    touch: ProbeTouch | None
    touched: set[tuple[str, str]]
    linear: float | None = None
    angular: float | None = None
    opened_s: float | None = None
    again: bool | None = None
    phase: str = ""
    propellant_kg: float = 0.0
    verdicts: list[tuple[float, str]] = field(default_factory=list)
    failure: Failure | None = None
    peak_m: float | None = None
    verified_s: float | None = None
    image_share_seen: float | None = None

    def found_s(self) -> float | None:
        """How long after its failure the thruster was found to have failed that way; None: never."""
        if self.failure is None:
            return None
        kind, thruster, at_s = self.failure
        what = f"thruster {thruster} {kind.replace('_', ' ')}, found"
        return next((t - at_s for t, text in self.verdicts if text.startswith(what)), None)

    def false_alarms(self) -> int:
        """Thrusters that were found to have failed in a way that they had not."""
        told = [text for _, text in self.verdicts if ", found" in text]
        return len(told) - (self.found_s() is not None)

    def line(self) -> str:
        """The flight on its own, while the others still fly."""
        text = f"{self.seed}: {self.cause}"
        if self.failure is not None and self.peak_m is not None:
            kind, thruster, at_s = self.failure
            found_s = self.found_s()
            found = "not found" if found_s is None else f"found after {found_s:.2f} s"
            text += (
                f"; thruster {thruster} {kind} at {at_s:.2f} s, {found}, {self.peak_m * 1e3:.1f} mm at most"
            )
        if (t := self.touch) is not None:
            text += f"; {t.lateral_m * 1e3:.2f} mm, {math.degrees(t.angle_rad):.3f} deg, {t.closing_m_s * 1e3:.2f} mm/s"
        if self.linear is not None and self.angular is not None:
            text += f"; momentum {self.linear:.1e}, {self.angular:.1e}"
        if self.opened_s is not None:
            text += f" after {self.opened_s:.1f} s" + ("" if self.again is None else f", again: {self.again}")
        for at_s, what in self.verdicts:
            text += f"; at {at_s:.2f} s {what}"
        return text


def cause_of(flight: Offline, verified: bool) -> str:
    """In a few words, what the flight's end came of."""
    if flight.touched:
        return f"collision {sorted(flight.touched)[0]}"
    backed = [what for _, what in flight.events if ": retreat (" in what]
    reason = backed[-1].partition(": retreat (")[2].rstrip(")").partition(": ")[2] if backed else ""
    kind = reason.partition(":")[0] if reason else ""
    if verified:
        return "verified at the first attempt" if not backed else f"verified after a retreat: {kind}"
    return f"not verified, last retreat: {kind}" if backed else f"not verified, phase {flight.phase(0)}"


def order(what: str) -> OperatorCommand:
    return OperatorCommand(command=what, chaser=0, operator="benchmark")  # type: ignore[arg-type]


def dock(
    seed: int,
    scenario: Scenario,
    eye_of: Callable[[Scenario], CameraPose],
    failure: Failure | None = None,
    approach_at_s: float = APPROACH_AT_S,
) -> Outcome:
    """One approach until it is verified, given up or the time is over."""
    flight = Offline(scenario, eye_of(scenario))
    conservation, told, peak_m = Conservation(flight), False, 0.0
    images, seen = 0, 0
    while flight.time_s < approach_at_s + LIMIT_S and flight.phase(0) != "verified":
        now = not told and flight.time_s >= approach_at_s
        out = flight.step((order("approach"),) if now else ())
        told |= now
        if (
            failure is not None
            and flight.time_s > failure[2]
            and flight.phase(0) not in ("latched", "verified")
        ):
            peak_m = max(peak_m, reference_error_m(flight))
        images, seen = images + 1, seen + bool(out.target.accepted)
    verified = flight.phase(0) == "verified"
    touch = next((t for t in flight.touches if t.latched), None)
    flight.close()
    return Outcome(
        seed,
        cause_of(flight, verified),
        verified,
        touch,
        flight.touched,
        conservation.linear,
        conservation.angular,
        propellant_kg=flight.propellant_kg,
        verdicts=flight.verdicts,
        failure=failure,
        peak_m=None if failure is None else peak_m,
        verified_s=flight.time_s if verified else None,
        image_share_seen=seen / max(images, 1),
    )


def reference_error_m(flight: Offline) -> float:
    """How far the chaser is from its reference on the true target; 0 before there is one."""
    own, target = flight.physics.state("chaser/0"), flight.physics.state(TARGET)
    if flight.last is None or 0 not in flight.last.references:
        return 0.0
    offset = flight.flight.guidance.chasers[0].move.at(np.array([flight.time_s]))[0][0]
    place = target.position_m + rotations.rotate(target.q_wxyz, offset)
    return float(np.linalg.norm(place - own.position_m))


def offset_error_m(flight: Offline) -> float:
    """How far the chaser is from its nominal place at the target, on ground truth."""
    own, target = flight.physics.state("chaser/0"), flight.physics.state(TARGET)
    offset = rotations.rotate_inverse(target.q_wxyz, own.position_m - target.position_m)
    return float(np.linalg.norm(offset - np.array(flight.scenario.chasers[0].position_m)))


def abort(seed: int, scenario: Scenario, eye_of: Callable[[Scenario], CameraPose], again: bool) -> Outcome:
    """An approach, aborted at a random time; then, if ``again``, a second one to its end."""
    flight = Offline(scenario, eye_of(scenario))
    abort_at_s = APPROACH_AT_S + float(np.random.default_rng([seed, 0xAB0]).uniform(0.0, ABORT_WITHIN_S))
    for what, until_s in (("", APPROACH_AT_S), ("approach", abort_at_s)):
        flight.step((order(what),) if what else ())
        while flight.time_s < until_s:
            flight.step()
    phase = flight.phase(0)
    flight.step((order("abort"),))
    opened_s = None
    while flight.time_s < abort_at_s + OPEN_WITHIN_S and opened_s is None:
        flight.step()
        if flight.phase(0) == "hold" or offset_error_m(flight) < REACHED_M:
            opened_s = flight.time_s - abort_at_s
    verified = None
    if again and opened_s is not None:
        begun_s = flight.time_s
        flight.step((order("approach"),))
        while flight.time_s < begun_s + LIMIT_S and flight.phase(0) != "verified":
            flight.step()
        verified = flight.phase(0) == "verified"
    flight.close()
    cause = f"aborted in {phase}: " + ("opened" if opened_s is not None else "NOT opened")
    if flight.touched:
        cause += ", COLLISION"
    return Outcome(
        seed,
        cause,
        bool(verified),
        None,
        flight.touched,
        opened_s=opened_s,
        again=verified,
        phase=phase,
        verdicts=flight.verdicts,
    )
