# SPDX-License-Identifier: Apache-2.0
"""``chaserdock dataset``: labelled images, and the scores of a perception on them."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .options import (
    JsonOpt,
    RendererOption,
    SetOpt,
    complete_scenario,
    fail,
    print_result,
    refuse_options,
)

if TYPE_CHECKING:
    from chaserdock.datasets.types import Selection


class LayoutOption(StrEnum):
    """Layouts of datasets."""

    speed = "speed+"
    bop = "bop"
    euroc = "euroc"
    colmap = "colmap"
    both = "both"


class SplitOption(StrEnum):
    """Parts of a dataset."""

    train = "train"
    validation = "validation"
    all = "all"


def _show_progress(label: str, total: int, quiet: bool) -> Callable[[int], None]:
    """Return a function that shows the number of images done on a terminal."""
    if quiet or not sys.stderr.isatty():
        return lambda done: None
    return lambda done: print(
        f"\r{label} {done} of {total}",
        end="\n" if done == total else "",
        file=sys.stderr,
        flush=True,
    )


def dataset(
    context: typer.Context,
    source: Annotated[
        str,
        typer.Argument(
            help="folder of a dataset (ours, or SPEED, SPEED+ or BOP) to score a perception on; "
            "with --out: scenario whose target is drawn, or the log of a flight",
            autocompletion=complete_scenario,
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="draw a dataset into this folder, a new one")
    ] = None,
    images: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=1_000_000,
            help="--out: number of images; scoring: use the first so many only",
        ),
    ] = None,
    layout: Annotated[
        LayoutOption,
        typer.Option(
            "--format",
            help="--out: layout of images and labels: speed+, bop or both; of a flight: euroc, "
            "colmap or both",
        ),
    ] = LayoutOption.both,
    seed: Annotated[
        int,
        typer.Option(min=0, max=2**32 - 1, help="--out: seed of views, noise and geometry errors"),
    ] = 0,
    range_m: Annotated[
        tuple[float, float],
        typer.Option(
            "--range", metavar="LEAST MOST", help="--out: distance of the target, m, log-uniform"
        ),
    ] = (1.0, 3.0),
    offset: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1.0,
            help="--out: largest distance of the target from the middle, share of half the image",
        ),
    ] = 0.2,
    phase: Annotated[
        tuple[float, float],
        typer.Option(
            metavar="LEAST MOST", help="--out: angle at the target between sun and camera, degrees"
        ),
    ] = (0.0, 120.0),
    validation: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="--out: share of the images for validation")
    ] = 0.2,
    renderer: Annotated[
        RendererOption,
        typer.Option(
            help="--out: fast: as the simulated cameras; path: path tracing, needs mitsuba"
        ),
    ] = RendererOption.fast,
    samples: Annotated[
        int, typer.Option(min=1, max=4096, help="--renderer path: paths of light per pixel")
    ] = 64,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="--renderer path: processors")] = 1,
    overrides: SetOpt = None,
    name: Annotated[
        str | None,
        typer.Option(
            "--perception",
            help="scoring: model, default, paper, an installed plugin, or MODULE:CLASS; the "
            "scenario's by default",
        ),
    ] = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            help="scoring: scenario with the target's geometry; for datasets from elsewhere",
            autocompletion=complete_scenario,
        ),
    ] = None,
    split: Annotated[
        SplitOption | None,
        typer.Option(
            help="scoring: part of the dataset; by default validation, or train without it"
        ),
    ] = None,
    domain: Annotated[
        str | None,
        typer.Option(
            help="scoring: kind of images: synthetic (the default), lightbox or sunlamp of SPEED+, "
            "synthetic or real of SPEED, a folder of BOP such as train_pbr"
        ),
    ] = None,
    object: Annotated[
        int | None,
        typer.Option(min=0, help="scoring: number of the target in BOP scenes of several objects"),
    ] = None,
    as_json: JsonOpt = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="show no progress")] = False,
) -> None:
    """Score a perception on labelled images (SPEED score, ADD); or draw such images: random views
    of a scenario's target with pose labels, in the SPEED+ and BOP formats; or write the images of a
    flight as a sequence with true poses, for SLAM and structure from motion.
    """
    if out is None:
        refuse_options(context, ("layout", *_DRAWING), "only with --out")
        from chaserdock.datasets.types import Selection

        wanted = Selection(domain, object, None if split is None else split.value)
        _score(Path(source), name, scenario, wanted, images, as_json, quiet)
        return
    scoring = ("name", "scenario", "split", "domain", "object", "as_json")
    refuse_options(context, scoring, "not with --out")
    if _is_log(Path(source)):
        refuse_options(context, ("images", *_DRAWING), "not for a flight")
        _write_sequence(Path(source), out, layout)
        return
    if layout in (LayoutOption.euroc, LayoutOption.colmap):
        raise fail(f"--format {layout.value}: only for a flight; give the folder of its log")
    if images is None:
        raise fail("--images: needed with --out")
    if renderer is not RendererOption.path:
        refuse_options(context, ("samples", "jobs"), "only with --renderer path")

    from chaserdock_protocol.scenario import load_scenario
    from chaserdock_protocol.shipped_scenarios import find_scenario

    from chaserdock.datasets.export import EXACT_CAMERA, export_dataset
    from chaserdock.datasets.types import Layout
    from chaserdock.datasets.views import ViewLimits

    limits = ViewLimits(range_m, offset, phase)
    sets = (EXACT_CAMERA, f"seed={seed}", *(overrides or ()))
    loaded = load_scenario(find_scenario(source), sets)
    layouts: tuple[Layout, ...] = (
        ("bop", "speed+") if layout is LayoutOption.both else (layout.value,)
    )
    progress = _show_progress("image", images, quiet)
    export_dataset(
        loaded, out, images, limits, layouts, validation, progress,
        samples if renderer is RendererOption.path else None, jobs,
    )  # fmt: skip
    print(f"{out}: {images} images of {loaded.target.model}, {' and '.join(layouts)}, seed {seed}")


_DRAWING = (
    "seed", "range_m", "offset", "phase", "validation", "overrides", "renderer", "samples", "jobs",
)  # fmt: skip
"""Options of drawn images."""


def _is_log(source: Path) -> bool:
    return source.suffix == ".mcap" or next(source.glob("*.mcap"), None) is not None


def _write_sequence(log: Path, out: Path, layout: LayoutOption) -> None:
    """Write the images of a flight as a sequence."""
    from chaserdock.datasets.sequences import export_sequence
    from chaserdock.datasets.types import SequenceLayout

    if layout in (LayoutOption.speed, LayoutOption.bop):
        raise fail(f"--format {layout.value}: not for a flight; give euroc or colmap")
    layouts: tuple[SequenceLayout, ...] = (
        ("euroc", "colmap") if layout is LayoutOption.both else (layout.value,)
    )
    for chaser, images in export_sequence(log, out, layouts).items():
        print(f"{out}: {images} images of chaser {chaser}, {' and '.join(layouts)}")


def _score(
    folder: Path,
    name: str | None,
    scenario: str | None,
    wanted: Selection,
    images: int | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Print the scores of a perception."""
    from chaserdock_protocol.scenario import flight_scenario, load_scenario
    from chaserdock_protocol.shipped_scenarios import find_scenario

    from chaserdock.datasets.evaluation import perception_of, score_perception
    from chaserdock.datasets.reading import read_dataset

    data, flight = read_dataset(folder, wanted)
    if scenario is not None:
        flight = flight_scenario(load_scenario(find_scenario(scenario)))
    if flight is None:
        raise fail(f"{folder}: states no target; give --scenario with the geometry of the target")
    chosen = data.images[:images]
    split = wanted.split or chosen[0].split
    method = perception_of(name, flight, data.camera)
    progress = _show_progress("image", len(chosen), quiet or as_json)
    figures = score_perception(method, chosen, data.camera, data.shape, progress)
    used = name or flight.perception.name
    facts = {
        "dataset": str(folder),
        "format": data.layout,
        "domain": data.domain,
        "object": data.object,
        "split": split,
        "perception": used,
    }
    parts = (data.layout, data.domain, split, data.object and f"object {data.object}")
    title = f"{used} on {folder} ({', '.join(str(p) for p in parts if p)})"
    # JSON has no NaN: figures without a single pose are null.
    values = {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in figures.items()}
    print_result(
        as_json,
        facts | values,
        _table(title, figures),
    )


def _table(title: str, f: dict[str, float]) -> list[str]:
    """Return the lines of a table of figures."""
    count, found = int(f["images"]), int(f["with_pose"])
    add = "add_s" if "add_s_right_share" in f else "add"
    lines = [title, f"images {count}, with a pose {found} ({found / count:.1%})"]
    lines += [
        f"SPEED score {year}: {f[f'speed_score_{year}']:.5f} over all images, "
        f"{f[f'speed_score_{year}_with_pose']:.5f} over poses"
        for year in ("2019", "2021")
    ]
    lines.append(f"{'':24}{'mean':>12}{'p50':>12}{'p95':>12}")
    rows = [
        ("attitude error, deg", "attitude_rad", math.degrees(1.0)),
        ("position error, mm", "position_m", 1e3),
        ("position, mm per m", "position_share", 1e3),
        (f"{add.upper().replace('_', '-')}, mm", f"{add}_m", 1e3),
    ]
    for label, key, factor in rows:
        if f"{key}_mean" in f:
            lines.append(
                f"{label:24}"
                + "".join(f"{factor * f[f'{key}_{q}']:12.3f}" for q in ("mean", "p50", "p95"))
            )
    if f"{add}_right_share" in f:
        lines.append(
            f"{add.upper().replace('_', '-')} below 10 % of {f['diameter_m']:.3f} m: "
            f"{f[f'{add}_right_share']:.1%} of all images"
        )
    lines.append(
        f"CPU time per image: {1e3 * f['cpu_s_mean']:.1f} ms mean, {1e3 * f['cpu_s_max']:.1f} ms "
        "max"
    )
    return lines
