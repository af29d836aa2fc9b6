# SPDX-License-Identifier: Apache-2.0
"""Commands for meshes of targets: ``chaserdock mesh …``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .help import add_command, command_group
from .options import JsonOpt, fail

if TYPE_CHECKING:
    from chaserdock_protocol.scenario.mesh_files import MeshFile

app = command_group(
    "mesh", "Check mesh files of targets, and write the shipped satellites as files."
)


def export(
    name: Annotated[
        str, typer.Argument(help="shipped satellite: geo_servicer, cubesat_12u, chaser_body")
    ],
    out: Annotated[
        Path, typer.Option(help="file to write: .glb, or .obj with its materials beside it")
    ],
    tolerance_mm: Annotated[
        float,
        typer.Option(
            min=0.01, max=20.0, help="largest deviation of facets from curved surfaces, mm"
        ),
    ] = 0.2,
) -> None:
    """Write a shipped satellite as a mesh file."""
    from chaserdock_models.satellites import satellite
    from chaserdock_protocol.scenario.mesh_files import write_mesh

    try:
        mesh = satellite(name, 1e-3 * tolerance_mm)
    except ValueError as error:
        raise fail(str(error)) from None
    try:
        write_mesh(mesh, out)
    except ValueError as error:
        raise fail(f"--out {out}: {error}") from None
    except OSError as error:
        raise fail(f"--out {out}: cannot be written: {error.strerror or error}") from None
    print(f"{out}: {len(mesh.parts)} parts, {mesh.triangle_count} triangles")


def check(
    file: Annotated[Path, typer.Argument(help="mesh file: .glb, .gltf, .obj, .stl or .ply")],
    scale: Annotated[
        float,
        typer.Option(
            min=1e-9, max=1e9, help="factor from the file's unit of length to m (mesh_scale)"
        ),
    ] = 1.0,
    as_json: JsonOpt = False,
) -> None:
    """Check whether a mesh file can fly as a target, and print what becomes of it. Status 2 when it
    cannot.
    """
    import json

    from chaserdock_protocol.scenario.mesh_files import read_mesh

    found = read_mesh(file, scale)
    facts = _facts(found)
    if as_json:
        print(json.dumps(facts, indent=2))
        return
    x, y, z = facts["size_m"]
    print(
        f"{file}: {len(facts['parts'])} parts, {facts['triangles']} triangles, {x:.3f} x {y:.3f} x {z:.3f} m"
    )
    width = max(len(p["name"]) for p in facts["parts"])
    for p in facts["parts"]:
        joint = f", moves with {p['joint']}" if p["joint"] else ""
        print(
            f"  {p['name']:{width}}  {p['triangles']:6} triangles  {p['volume_dm3']:9.4f} dm³  reflectance {p['diffuse']:.2f}"
            f"  {p['material']}{joint}"
        )
    centre, inertia = facts["centre_of_mass_m"], facts["inertia_per_kg_m2"]
    print(f"centre of mass ({', '.join(f'{v:.4f}' for v in centre)}) m; inertia of 1 kg about it:")
    for row in inertia:
        print("  " + "  ".join(f"{v:9.6f}" for v in row) + "  kg m²")
    print(f"collisions: {facts['convex_pieces']} convex pieces")
    for note in found.notes:
        print(f"note: {note}")


def _facts(found: MeshFile) -> dict[str, Any]:
    from chaserdock_models.meshes import mass_properties, volume_m3
    from chaserdock_world.physics.collision_hulls import collision_hulls

    mesh = found.mesh
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
                "joint": p.joint,
            }
            for p in mesh.parts
        ],
        "triangles": mesh.triangle_count,
        "size_m": (high - low).tolist(),
        "centre_of_mass_m": centre.tolist(),
        "inertia_per_kg_m2": inertia.tolist(),
        "convex_pieces": len(collision_hulls(mesh)),
        "deviation_m": found.deviation_m,
        "notes": list(found.notes),
    }


add_command(app, export)
add_command(app, check)
