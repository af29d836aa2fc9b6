# SPDX-License-Identifier: Apache-2.0
"""``chaserdock scenario``: list, check, show and create scenarios."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from chaserdock_protocol.errors import ChaserdockError

from chaserdock.exit_codes import BAD_INPUT
from chaserdock.terminal import wrapped
from chaserdock.toml_text import toml_document

from .options import JsonOpt, SetOpt, complete_scenario, fail, refuse_options

if TYPE_CHECKING:
    from chaserdock_protocol.scenario import Scenario

_NEW = """\
# A scenario: what flies, and when a mission is a success. Every key: docs/scenario.md, or for
# editors `chaserdock scenario --schema`. Check it with
#   chaserdock scenario {file}
# and run it with
#   chaserdock run {file}
format = 3
name = "{name}"
description = "One chaser synchronizes with the tumbling target."
duration_s = 40.0
# The steady interval, which the errors under [success] refer to, begins here.
settling_s = 20.0

# Initial motion of the target, in m/s and rad/s. `model` is `paper`, `servicer`, or the path of a
# target file.
[target]
model = "paper"
velocity_m_s = [0.015, 0.0075, 0.03]
omega_rad_s = [0.015, 0.045, 0.03]

# What the chasers know of their own motion and cameras: `exact`, `lab`, `orbit` or `poor`.
[navigation]
grade = "exact"

[camera]
width_px = 960
height_px = 540

# One table per chaser: its place relative to the target, and where it starts relative to that
# place.
[[chasers]]
position_m = [-1.0, 0.0, 0.0]
look_at = "target"
start_offset_m = [-0.15, 0.03, 0.0]

[success]
steady_position_rms_m = 0.01
steady_orientation_rms_deg = 0.5
"""


def scenario(
    context: typer.Context,
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SCENARIO]",
            help="scenario files, or names of shipped scenarios; none: list the shipped ones",
            autocompletion=complete_scenario,
        ),
    ] = None,
    overrides: SetOpt = None,
    show: Annotated[
        bool,
        typer.Option(
            "--show", help="print it as TOML: with its base, its overrides and all defaults"
        ),
    ] = False,
    changes: Annotated[
        bool, typer.Option("--changes", help="print only values that differ from the default")
    ] = False,
    new: Annotated[
        bool, typer.Option("--new", help="write a short commented scenario file of this name")
    ] = False,
    schema: Annotated[
        bool,
        typer.Option(
            "--schema",
            help="print the JSON schema of scenario files, for editors (taplo, Even Better TOML)",
        ),
    ] = False,
    flight: Annotated[
        bool,
        typer.Option(
            "--flight",
            help="print the part that flight software receives as JSON, for a world of your own",
        ),
    ] = False,
    as_json: JsonOpt = False,
) -> None:
    """Check scenarios; or list, show or create them. Status 2 if one is not valid, with one line
    per error.
    """
    if sum((show or changes, new, schema, flight)) > 1:
        raise fail("--show, --new, --schema and --flight exclude each other")
    if names:
        refuse_options(context, ("schema", "as_json"), "not with a scenario")
    else:
        refuse_options(
            context, ("overrides", "show", "changes", "new", "flight"), "needs a scenario"
        )
    if schema:
        _print_schema()
    elif not names:
        _list_shipped(as_json)
    elif new:
        refuse_options(context, ("overrides",), "not with --new")
        _write_new(_only(names))
    elif flight:
        from chaserdock_protocol.scenario import flight_scenario_json, load_scenario
        from chaserdock_protocol.shipped_scenarios import find_scenario

        loaded = load_scenario(find_scenario(_only(names)), tuple(overrides or ()))
        print(flight_scenario_json(loaded))
    elif show or changes:
        from chaserdock_protocol.scenario import load_scenario
        from chaserdock_protocol.scenario.camera import lens_note
        from chaserdock_protocol.shipped_scenarios import find_scenario

        loaded = load_scenario(find_scenario(_only(names)), tuple(overrides or ()))
        print(as_toml(loaded, changes), end="")
        if note := lens_note(loaded.camera_model()):
            print(f"note: {note}", file=sys.stderr)
    else:
        _check(names, tuple(overrides or ()))


def _only(names: list[str]) -> str:
    """Return the one name; exit with status 2 for several."""
    if len(names) > 1:
        raise fail(f"{names[1]}: one scenario only with --show and --new")
    return names[0]


def _list_shipped(as_json: bool) -> None:
    """List the shipped scenarios with their duration and number of chasers."""
    import json
    import shutil

    from chaserdock_protocol.scenario import load_scenario
    from chaserdock_protocol.shipped_scenarios import shipped_names, shipped_scenario

    scenarios = [load_scenario(shipped_scenario(name)) for name in shipped_names()]
    if as_json:
        rows = [
            {
                "name": s.name,
                "chasers": len(s.chasers),
                "duration_s": s.duration_s,
                "description": s.description,
            }
            for s in scenarios
        ]
        print(json.dumps(rows, indent=2))
        return
    width = max(len(s.name) for s in scenarios)
    head = [f"{'name':{width}}  chasers  duration"]
    head += [f"{s.name:{width}}  {len(s.chasers):7}  {s.duration_s:6.0f} s" for s in scenarios]
    texts = ["description", *(s.description for s in scenarios)]
    columns = shutil.get_terminal_size().columns
    in_one_line = len(head[0]) + 2 + max(map(len, texts)) <= columns
    for first, text in zip(head, texts, strict=True):
        if in_one_line:
            print(f"{first}  {text}")
        else:
            print("\n".join([first, *wrapped([f"    {text}"], columns)]))


def _check(names: list[str], overrides: tuple[str, ...]) -> None:
    """Print whether each scenario is valid; exit with status 2 if one is not."""
    from chaserdock_protocol.scenario import load_scenario
    from chaserdock_protocol.scenario.camera import lens_note
    from chaserdock_protocol.shipped_scenarios import find_scenario

    failed = False
    for file in names:
        try:
            found = load_scenario(find_scenario(file), overrides)
        except ChaserdockError as error:
            fail(str(error))
            failed = True
        else:
            number = len(found.chasers)
            chasers = "1 chaser" if number == 1 else f"{number} chasers"
            print(f"{file}: valid: {found.name}, {chasers}, {found.duration_s:g} s")
            if note := lens_note(found.camera_model()):
                print(f"{file}: note: {note}")
    if failed:
        raise typer.Exit(BAD_INPUT)


def _print_schema() -> None:
    from chaserdock_protocol.scenario import Scenario
    from chaserdock_protocol.scenario.json_schema import editor_schema_text

    print(editor_schema_text(Scenario), end="")


def _write_new(name: str) -> None:
    """Write a scenario file that can be run, and changed."""
    import tomllib

    from chaserdock_protocol.output_files import write_atomically
    from chaserdock_protocol.scenario import parse_scenario

    path = Path(name if name.endswith(".toml") else f"{name}.toml")
    example = tomllib.loads(_NEW.format(name="example", file="example.toml"))
    parse_scenario(example | {"name": path.stem}, name)
    if path.exists():
        raise fail(f"{path}: exists already")
    try:
        write_atomically(path, _NEW.format(name=path.stem, file=path))
    except OSError as error:
        raise fail(str(error)) from None
    print(f"{path}: run it with: chaserdock run {path}")


def as_toml(scenario: Scenario, changes: bool = False) -> str:
    """Return a scenario in TOML's notation; ``changes``: without values that equal the default."""
    from chaserdock_protocol.scenario.camera import REPLACED_BY_INTRINSICS

    unused = set[str](REPLACED_BY_INTRINSICS if scenario.camera.intrinsics is not None else ())
    values = scenario.model_dump(
        mode="json", exclude_none=True, exclude_defaults=changes, exclude={"camera": unused}
    )
    if changes:
        body = _changed_body(scenario)
        values = {"format": scenario.format, **values, **({"chaser": body} if body else {})}
    return toml_document(values)


def _changed_body(scenario: Scenario) -> dict[str, Any]:
    """Return the values of ``[chaser]`` that differ from the defaults of its predefined body."""
    predefined = type(scenario.chaser)(body=scenario.chaser.body).model_dump(mode="json")
    values = scenario.chaser.model_dump(mode="json", exclude_none=True)
    changed = {k: v for k, v in values.items() if v != predefined[k]}
    return {"body": scenario.chaser.body, **changed} if scenario.chaser.body else changed
