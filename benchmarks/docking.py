"""Does it dock? ``python benchmarks/docking.py [--quick] [--json FILE] [--flights N] [--seen N] [--aborts N]``
``[--actuation thrusters|ideal] [--rate HZ] [--failures N]``.

Flies ``docking-contact`` many times in one process: from seeded starts, at target rates from zero to three times the
paper's about any axis. ``--flights`` with a statistical eye (2 mm and 0.1 degrees of white noise, every tenth picture
blind), ``--seen`` with rendered pictures and the real perception, ``--aborts`` aborted at a random time, with a second
approach after every fifth; ``--failures`` with a jet that sticks open, and as many with one that sticks shut, untold,
jet after jet: at ``--failed-at``, or at a random time between 2 and 24 s. ``--first`` is the first seed. Prints outcomes
by cause, and figures at contact.
"""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_controller.captures import target_body
from chaserdock_protocol import rotations
from chaserdock_protocol.messages import OperatorCommand, ProbeTouch
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_world.physics import TARGET
from offline import Eye, Offline, momentum, seeing_eye, statistical_eye
from results import options_of, write_json

ROOT = Path(__file__).resolve().parents[1]
APPROACH_AT_S = 4.0
LIMIT_S = 100.0
OPEN_WITHIN_S = 30.0
REACHED_M = 0.05


Failure = tuple[str, int, float]
"""Of a jet: kind, number, time in s."""


def mission(
    seed: int, actuation: str = "thrusters", rate_hz: int | None = None, failure: Failure | None = None
) -> Scenario:
    """``docking-contact`` from a start and at rates that depend on the seed alone."""
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
        values |= {"time.rate_hz": rate_hz, "time.picture_hz": rate_hz}
    if failure is not None:
        kind, jet, at_s = failure
        values["jet_failure"] = f"[{{chaser=0,jet={jet},at_s={at_s},kind='{kind}'}}]"
    overrides = [f"{key}={value}" for key, value in values.items()]
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
    """How one flight ended. ``touch`` is the one at which the latch closed."""

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

    def line(self) -> str:
        """The flight on its own, while the others still fly."""
        text = f"{self.seed}: {self.cause}"
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


def dock(seed: int, scenario: Scenario, eye_of: Callable[[Scenario], Eye]) -> Outcome:
    """One approach until it is verified, given up or the time is over."""
    flight = Offline(scenario, eye_of(scenario))
    conservation, told = Conservation(flight), False
    while flight.time_s < LIMIT_S and flight.phase(0) != "verified":
        now = not told and flight.time_s >= APPROACH_AT_S
        flight.step((order("approach"),) if now else ())
        told |= now
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
    )


def offset_error_m(flight: Offline) -> float:
    """How far the chaser is from its nominal place at the target, on ground truth."""
    own, target = flight.physics.state("chaser/0"), flight.physics.state(TARGET)
    offset = rotations.rotate_inverse(target.q_wxyz, own.position_m - target.position_m)
    return float(np.linalg.norm(offset - np.array(flight.scenario.chasers[0].position_m)))


def abort(seed: int, scenario: Scenario, eye_of: Callable[[Scenario], Eye], again: bool) -> Outcome:
    """An approach, aborted at a random time; then, if ``again``, a second one to its end."""
    flight = Offline(scenario, eye_of(scenario))
    abort_at_s = APPROACH_AT_S + float(np.random.default_rng([seed, 0xAB0]).uniform(0.0, 32.0))
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


def figures(name: str, outcomes: list[Outcome]) -> dict[str, float]:
    """What docking flights showed, by figure."""
    touches = [o.touch for o in outcomes if o.touch is not None]
    out: dict[str, float] = {
        f"{name}_flights": len(outcomes),
        f"{name}_verified": sum(o.verified for o in outcomes),
        f"{name}_collisions": sum(bool(o.touched) for o in outcomes),
    }
    for key, values in {
        "contact_lateral_m": [t.lateral_m for t in touches],
        "contact_angle_rad": [t.angle_rad for t in touches],
        "contact_closing_m_s": [t.closing_m_s for t in touches],
        "contact_lateral_speed_m_s": [t.lateral_speed_m_s for t in touches],
        "momentum_error": [o.linear for o in outcomes if o.linear is not None],
        "angular_momentum_error": [o.angular for o in outcomes if o.angular is not None],
        "propellant_kg": [o.propellant_kg for o in outcomes if o.verified and o.propellant_kg],
    }.items():
        if values:
            out[f"{name}_{key}_median"] = float(np.median(values))
            out[f"{name}_{key}_max"] = float(np.max(values))
    return out


def table(name: str, outcomes: list[Outcome]) -> None:
    print(f"{name}: {len(outcomes)} flights")
    for cause, number in Counter(o.cause for o in outcomes).most_common():
        seeds = [str(o.seed) for o in outcomes if o.cause == cause]
        shown = ", ".join(seeds[:6]) + (", …" if len(seeds) > 6 else "")
        print(f"  {number:4d}  {cause}  (seeds {shown})")


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--seen", type=int, default=100)
    parser.add_argument("--aborts", type=int, default=50)
    parser.add_argument("--failures", type=int, default=12)
    parser.add_argument("--failed-at", type=float, help="s; at random by default")
    parser.add_argument("--actuation", choices=("thrusters", "ideal"), default="thrusters")
    parser.add_argument("--rate", type=int, help="Hz, of control and pictures; the scenario's by default")
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    flights, seen, aborts = (4, 1, 4) if options.quick else (options.flights, options.seen, options.aborts)
    failures = 0 if options.actuation == "ideal" else 2 if options.quick else options.failures

    def noisy(scenario: Scenario) -> Eye:
        return statistical_eye(scenario, scenario.seed, 0.002, math.radians(0.1), blind=0.1)

    result: dict[str, float] = {}
    begun_s = time.perf_counter()
    seeds = range(options.first, options.first + max(flights, seen, aborts, failures))

    def scenario_of(seed: int, failure: Failure | None = None) -> Scenario:
        return mission(seed, options.actuation, options.rate, failure)

    for name, number, eye in (("noise", flights, noisy), ("vision", seen, seeing_eye)):
        outcomes = []
        for seed in seeds[:number]:
            outcomes.append(dock(seed, scenario_of(seed), eye))
            print(f"{name} {outcomes[-1].line()}", file=sys.stderr, flush=True)
        if outcomes:
            table(name, outcomes)
            result |= figures(name, outcomes)
    for kind in ("stuck_on", "stuck_off"):
        outcomes = []
        for seed in seeds[:failures]:
            at_s = options.failed_at or float(np.random.default_rng([seed, 0xFA1]).uniform(2.0, 24.0))
            outcomes.append(dock(seed, scenario_of(seed, (kind, seed % 12, at_s)), noisy))
            print(f"{kind} jet {seed % 12} {at_s:.2f} s {outcomes[-1].line()}", file=sys.stderr, flush=True)
        if outcomes:
            table(kind, outcomes)
            result |= figures(kind, outcomes)
    outcomes = []
    for seed in seeds[:aborts]:
        outcomes.append(abort(seed, scenario_of(seed), noisy, again=seed % 5 == 0))
        print(f"abort {outcomes[-1].line()}", file=sys.stderr, flush=True)
    if outcomes:
        table("abort", outcomes)
        opened = [o.opened_s for o in outcomes if o.opened_s is not None]
        result |= {
            "aborts": len(outcomes),
            "aborts_opened": len(opened),
            "aborts_opened_max_s": max(opened, default=math.nan),
            "aborts_collisions": sum(bool(o.touched) for o in outcomes),
            "aborts_tried_again": sum(o.again is not None for o in outcomes),
            "aborts_verified_again": sum(o.again is True for o in outcomes),
        }
    width = max(map(len, result), default=0)
    for name, value in result.items():
        print(f"{name:{width}}  {value:.5g}")
    print(f"{time.perf_counter() - begun_s:.0f} s", file=sys.stderr)
    write_json(options.json, result)


if __name__ == "__main__":
    main()
