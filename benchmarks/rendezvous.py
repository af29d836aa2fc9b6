# SPDX-License-Identifier: Apache-2.0
"""Whole rendezvous from 200 m to the verified latch: ``python benchmarks/rendezvous.py [--scenario
v-bar r-bar] [--seeds N]``.

One process, with statistical perception. ``--markers``: markers in rendered images instead of
statistical ones, and bearing and range where these are more accurate. ``--images``: only the last
leg, with rendered images and without ranging. ``--leg N``: one leg. Prints time, change of
velocity, tracking at the hold points, step of the estimate at the first markers, and contact.
``--quick``: only the last leg, from the last hold point on. ``--events``: print the controller's
events.
"""

from __future__ import annotations

import argparse
import math
import time

from common import Figures, make_parser, print_figures, write_json
from flights import load_shipped
from flights.rendezvous import last_leg, leg, rendezvous

from chaserdock.experiments.in_process import InProcessMission, TickRecord
from chaserdock.experiments.perception import RenderedImages


def fly(name: str, seed: int, options: argparse.Namespace) -> Figures:
    """Fly one scenario with one seed; return its figures."""
    markers = ('perception.name="default"',) if options.markers else ()
    scenario = load_shipped(name, f"seed={seed}", *markers, *options.set)
    if options.leg is not None:
        scenario = leg(scenario, options.leg)
    elif options.quick or options.images:
        scenario = last_leg(scenario, images=options.images)
    begin_s, shown = time.process_time(), [0]

    def report(record: TickRecord, flight: InProcessMission) -> None:
        if not options.events:
            return
        for at_s, level, text in flight.events[shown[0] :]:
            print(f"    {at_s:.1f} s {level}: {text}", flush=True)
        shown[0] = len(flight.events)

    out = rendezvous(scenario, RenderedImages(scenario), report)
    begin = f"{name}_{seed}_"
    figures = {
        f"{begin}verified": float(out.verified_s is not None),
        f"{begin}verified_s": math.nan if out.verified_s is None else out.verified_s,
        f"{begin}delta_v_m_s": out.delta_v_m_s,
        f"{begin}propellant_kg": out.propellant_kg,
        f"{begin}keep_out_margin_m": out.keep_out_margin_m,
        f"{begin}max_closing_m_s": out.max_closing_m_s,
        f"{begin}contact_lateral_m": out.contact_lateral_m,
        f"{begin}contact_angle_deg": out.contact_angle_deg,
        f"{begin}contact_closing_m_s": out.contact_closing_m_s,
        f"{begin}collisions": len(out.contacts),
        f"{begin}warnings": sum(level != "info" for _, level, _ in out.events),
        f"{begin}processor_s": time.process_time() - begin_s,
    }
    for hold in out.holds:
        at = f"{begin}hold_{round(hold.range_m)}m_"
        figures |= {
            f"{at}position_rms_m": hold.position_rms_m,
            f"{at}angle_max_deg": hold.angle_max_deg,
            f"{at}estimate_rms_m": hold.estimate_rms_m,
        }
    if (over := out.hand_over) is not None:
        figures |= {
            f"{begin}hand_over_range_m": over.range_m,
            f"{begin}hand_over_step_m": over.step_m,
            f"{begin}hand_over_step_deg": over.step_deg,
            f"{begin}hand_over_step_sigmas": over.step_sigmas,
            f"{begin}hand_over_error_before_sigmas": over.error_sigmas,
        }
    return figures


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--scenario", nargs="+", default=["v-bar", "r-bar"], help="shipped scenarios"
    )
    parser.add_argument("--seeds", type=int, default=1, help="seeds of each, from 0")
    parser.add_argument("--images", action="store_true", help="last leg with rendered images")
    parser.add_argument(
        "--markers", action="store_true", help="rendered images, and ranging far away"
    )
    parser.add_argument(
        "--leg",
        type=int,
        metavar="N",
        help="only from the place before command N of the timeline to the next",
    )
    parser.add_argument("--events", action="store_true", help="print the controller's events")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override a scenario key"
    )
    options = parser.parse_args()
    figures: Figures = {}
    for name in options.scenario:
        for seed in range(options.seeds):
            print(f"{name}, seed {seed}:", flush=True)
            figures |= (part := fly(name, seed, options))
            print_figures(part)
    write_json(options.json, figures)


if __name__ == "__main__":
    main()
