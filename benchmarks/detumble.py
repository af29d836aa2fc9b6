# SPDX-License-Identifier: Apache-2.0
"""Stopping a tumbling client: ``python benchmarks/detumble.py [--quick] [--json FILE] [--tumbles N] [--first SEED]
[--sets 0123 013 03] [--set KEY=VALUE] [--results FILE]``.

Flies stacks of the client of ``detumble`` and some of its chasers, latched from the start, in one process with the
scenario's sensors and statistical perception. Tumbles of 5 to 10 degrees/s and attitudes are drawn from the seed. Five
seconds after the start all chasers are commanded to detumble. A set such as ``03`` names chasers of the scenario: 0 and 3
are at opposite faces, 0 and 1 at adjacent ones.

Prints the time until the stack stays below 0.05 degrees/s and 1 mm/s, the impulse of all thrusters until then, and both over
those of the linear programme: the shortest time, and the least impulse in that time, if the attitude were frozen.
``--results FILE`` appends every flight to FILE (JSON lines) and does not repeat flights that are in it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
from common import Figures, append_line, make_parser, percentiles, print_figures, read_lines, write_json

from chaserdock.evaluation.detumble_flights import DetumbleOutcome, fly_stack, stack_scenario
from chaserdock.evaluation.perception import RenderedImages


class DetumbleRow(msgspec.Struct, frozen=True):
    """One flight in the results file: chasers, settings and outcome."""

    chasers: str
    settings: str
    outcome: DetumbleOutcome


def line_of(o: DetumbleOutcome) -> str:
    """Return a flight as one line."""
    head = f"seed {o.seed}: {o.rate_deg_s:.1f} degrees/s"
    if o.refused:
        return f"{head}, refused: {o.refused}"
    least = (
        "no linear programme"
        if o.least is None
        else f"LP {o.least.time_s:.2f} s, {o.least.impulse_N_s:.1f} N s"
    )
    time = "not stopped" if o.time_s is None else f"{o.time_s:.2f} s"
    return f"{head}, {time}, {o.impulse_N_s:.1f} N s; {least}"


def figures_of(name: str, outcomes: list[DetumbleOutcome]) -> Figures:
    """Return the figures of a set of chasers."""
    stopped = [o for o in outcomes if o.time_s is not None]
    out: Figures = {
        f"{name}_flights": len(outcomes),
        f"{name}_stopped": len(stopped),
        f"{name}_refused": sum(bool(o.refused) for o in outcomes),
    }
    if not stopped:
        return out
    least = [(o, o.time_s, o.least) for o in stopped if o.time_s is not None and o.least is not None]
    held_s = sum(o.held_s for o in stopped)
    for key, unit, values in (
        ("time", "s", [o.time_s for o in stopped if o.time_s is not None]),
        ("impulse", "N_s", [o.impulse_N_s for o in stopped]),
        ("lp_time", "s", [x.time_s for _, _, x in least]),
        ("lp_impulse", "N_s", [x.impulse_N_s for _, _, x in least]),
        ("time_over_lp", "ratio", [time_s / x.time_s for _, time_s, x in least]),
        ("impulse_over_lp", "ratio", [o.impulse_N_s / x.impulse_N_s for o, _, x in least]),
        ("final_rate", "deg_s", [o.final_rate_deg_s for o in stopped]),
        ("final_speed", "m_s", [o.final_speed_m_s for o in stopped]),
    ):
        out |= percentiles(values, f"{name}_{key}", unit, "median", "max")
    return out | {f"{name}_held_N_s_per_minute": 60.0 * sum(o.held_N_s for o in stopped) / held_s}


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--tumbles", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--sets", nargs="+", default=["0123", "013", "03"], metavar="CHASERS")
    parser.add_argument("--duration", type=float, default=30.0, help="s, from the command on")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="scenario override")
    parser.add_argument("--results", type=Path, metavar="FILE")
    o = parser.parse_args()
    number = 2 if o.quick else o.tumbles
    settings = f"duration={o.duration:g} set={sorted(o.set)}"
    rows = [msgspec.convert(row, DetumbleRow) for row in read_lines(o.results)]
    known = {(r.chasers, r.outcome.seed): r.outcome for r in rows if r.settings == settings}
    figures: Figures = {}
    for chasers in o.sets:
        outcomes = []
        for seed in range(o.first, o.first + number):
            outcome = known.get((chasers, seed))
            if outcome is None:
                scenario = stack_scenario(seed, [int(c) for c in chasers], o.set)
                outcome = fly_stack(scenario, RenderedImages, o.duration)
                append_line(o.results, msgspec.to_builtins(DetumbleRow(chasers, settings, outcome)))
                print(f"{chasers} {line_of(outcome)}", file=sys.stderr, flush=True)
            outcomes.append(outcome)
        figures |= (part := figures_of(f"chasers_{chasers}", outcomes))
        print_figures(part)
    write_json(o.json, figures)


if __name__ == "__main__":
    main()
