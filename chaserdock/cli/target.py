# SPDX-License-Identifier: Apache-2.0
"""``chaserdock target``: check a target or a satellite; write its mesh, or its markers."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .options import JsonOpt, fail, print_result, refuse_options

if TYPE_CHECKING:
    from chaserdock_models.meshes import TriangleMesh
    from chaserdock_models.targets import TargetModel


class Paper(StrEnum):
    """Sheet sizes."""

    a4 = "a4"
    letter = "letter"


def target(
    context: typer.Context,
    name: Annotated[
        str,
        typer.Argument(
            metavar="TARGET",
            help="mesh file (.glb, .gltf, .obj, .stl, .ply, .off or .dae), target file (.toml), "
            "shipped target (paper, servicer, client) or satellite (geo_servicer, cubesat_12u, "
            "chaser_body)",
        ),
    ],
    scale: Annotated[
        float,
        typer.Option(
            min=1e-9,
            max=1e9,
            help="mesh file: factor from its unit of length to m (target.geometry.mesh_scale)",
        ),
    ] = 1.0,
    mesh: Annotated[
        Path | None,
        typer.Option(help="write a satellite's mesh: .glb, or .obj with its materials beside it"),
    ] = None,
    tolerance_mm: Annotated[
        float,
        typer.Option(
            min=0.01,
            max=20.0,
            help="--mesh: largest deviation of facets from curved surfaces, mm",
        ),
    ] = 0.2,
    markers: Annotated[
        Path | None,
        typer.Option(
            help="write the markers as sheets to print at true scale, with cutting marks and ids: "
            ".pdf, or .svg (one file per page, numbered)"
        ),
    ] = None,
    paper: Annotated[Paper, typer.Option(help="--markers: sheet size")] = Paper.a4,
    as_json: JsonOpt = False,
) -> None:
    """Check whether a target can fly and print what becomes of it; or write its mesh or its markers
    as files. Status 2 when it cannot fly.
    """
    if mesh is not None and markers is not None:
        raise fail("--mesh and --markers exclude each other")
    if mesh is None:
        refuse_options(context, ("tolerance_mm",), "only with --mesh")
    if markers is None:
        refuse_options(context, ("paper",), "only with --markers")
    if mesh is not None or markers is not None:
        refuse_options(context, ("scale", "as_json"), "not with --mesh and --markers")
    if mesh is not None:
        _write_mesh(name, mesh, tolerance_mm)
    elif markers is not None:
        _write_markers(name, markers, paper)
    else:
        _check(context, name, scale, as_json)


def _write_mesh(name: str, out: Path, tolerance_mm: float) -> None:
    from chaserdock_models.satellites import satellite

    from chaserdock.targets.mesh_writer import write_mesh

    try:
        mesh = satellite(name, 1e-3 * tolerance_mm)
    except ValueError as error:
        raise fail(str(error)) from None
    try:
        write_mesh(mesh, out)
    except ValueError as error:
        raise fail(f"--mesh {out}: {error}") from None
    except OSError as error:
        raise fail(f"--mesh {out}: cannot be written: {error.strerror or error}") from None
    print(f"{out}: {len(mesh.parts)} parts, {mesh.triangle_count} triangles")


def _write_markers(name: str, out: Path, paper: Paper) -> None:
    from chaserdock_protocol.scenario.files import find_target

    from chaserdock.targets.marker_sheets import SHEETS_MM, write_sheets

    if out.suffix.lower() not in (".pdf", ".svg"):
        raise fail(f"--markers {out}: must end in .pdf or .svg")
    model = find_target(name)
    try:
        count, written = write_sheets(model, out, SHEETS_MM[paper.value])
    except ValueError as error:
        raise fail(f"{name}: {error}") from None
    except OSError as error:
        raise fail(f"--markers {out}: cannot be written: {error.strerror or error}") from None
    print(f"{len(model.markers)} markers on {count} sheet(s): {', '.join(map(str, written))}")
    print("print without scaling, and check the 100 mm ruler on the sheet")


def _check(context: typer.Context, name: str, scale: float, as_json: bool) -> None:
    """Print the facts about a mesh (file or shipped satellite), or about a target of cuboids."""
    from chaserdock_models.satellites import satellite, satellite_names
    from chaserdock_protocol.scenario.files import find_target
    from chaserdock_protocol.scenario.mesh_files import MeshFile, read_mesh
    from chaserdock_protocol.scenario.surface import SUFFIXES

    if Path(name).suffix.lower() in SUFFIXES:
        found = read_mesh(Path(name), scale)
    else:
        refuse_options(context, ("scale",), "only with a mesh file")
        if name not in satellite_names():
            model = find_target(name)
            print_result(as_json, _facts_of_boxes(model), _lines_of_boxes(name, model))
            return
        found = MeshFile(satellite(name), (), 0.0)
    facts = _facts_of_mesh(found.mesh) | {
        "deviation_m": found.deviation_m,
        "notes": list(found.notes),
    }
    print_result(as_json, facts, _lines_of_mesh(name, facts))


def _facts_of_boxes(model: TargetModel) -> dict[str, Any]:
    return {
        "cuboids": len(model.boxes),
        "size_m": list(model.size_m),
        "mesh": model.satellite,
        "dictionary": model.dictionary,
        "markers": [{"id": m.id, "side_m": m.side_m} for m in model.markers],
    }


def _lines_of_boxes(name: str, model: TargetModel) -> list[str]:
    x, y, z = model.size_m
    drawn = f", drawn as {model.satellite}" if model.satellite else ""
    ids: dict[float, list[str]] = {}
    for marker in model.markers:
        ids.setdefault(marker.side_m, []).append(str(marker.id))
    return [
        f"{name}: {len(model.boxes)} cuboid(s), {x:.3f} x {y:.3f} x {z:.3f} m{drawn}",
        f"{len(model.markers)} markers of {model.dictionary}",
        *(f"  {1e3 * side_m:6.1f} mm: id {', '.join(those)}" for side_m, those in ids.items()),
    ]


def _lines_of_mesh(name: str, facts: dict[str, Any]) -> list[str]:
    x, y, z = facts["size_m"]
    parts, triangles = facts["parts"], facts["triangles"]
    lines = [f"{name}: {len(parts)} parts, {triangles} triangles, {x:.3f} x {y:.3f} x {z:.3f} m"]
    width = max(len(p["name"]) for p in parts)
    for p in parts:
        joint = f", moves with {p['joint']}" if p["joint"] else ""
        lines.append(
            f"  {p['name']:{width}}  {p['triangles']:6} triangles  {p['volume_dm3']:9.4f} dm³  "
            f"reflectance {p['diffuse']:.2f}  {p['material']}{joint}"
        )
    centre = ", ".join(f"{v:.4f}" for v in facts["centre_of_mass_m"])
    lines.append(f"centre of mass ({centre}) m; inertia of 1 kg about it:")
    for row in facts["inertia_per_kg_m2"]:
        lines.append("  " + "  ".join(f"{v:9.6f}" for v in row) + "  kg m²")
    lines.append(f"collisions: {facts['convex_pieces']} convex pieces")
    return [*lines, *(f"note: {note}" for note in facts["notes"])]


def _facts_of_mesh(mesh: TriangleMesh) -> dict[str, Any]:
    from chaserdock_models.meshes import mass_properties, volume_m3
    from chaserdock_world.physics.collision_hulls import collision_hulls

    low, high = mesh.bounds_m()
    centre, inertia = mass_properties(mesh, 1.0)
    return {
        "parts": [
            {
                "name": p.name,
                "triangles": len(p.triangles),
                "volume_dm3": 1e3 * volume_m3(p),
                "material": p.material.name,
                "diffuse": p.material.diffuse,
                "specular": p.material.specular,
                "shininess": p.material.shininess,
                "joint": p.joint,
            }
            for p in mesh.parts
        ],
        "triangles": mesh.triangle_count,
        "size_m": (high - low).tolist(),
        "centre_of_mass_m": centre.tolist(),
        "inertia_per_kg_m2": inertia.tolist(),
        "convex_pieces": len(collision_hulls(mesh)),
    }
