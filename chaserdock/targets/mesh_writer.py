# SPDX-License-Identifier: Apache-2.0
"""Write meshes as files through trimesh, for ``chaserdock_protocol.scenario.mesh_files`` to
read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from chaserdock_models.meshes import Material, TriangleMesh
from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.scenario.mesh_files import EXTRAS
from chaserdock_protocol.scenario.surface import SurfaceMaterial

SUFFIXES = (".glb", ".obj")


def write_mesh(mesh: TriangleMesh, path: Path) -> None:
    """Write a mesh as GLB, or as OBJ with its materials beside it. Raises OSError, and ValueError
    for another ending.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb
    from trimesh.exchange.obj import export_obj
    from trimesh.visual import TextureVisuals

    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"must end in {' or '.join(SUFFIXES)}")
    scene = trimesh.Scene()
    scene.metadata[EXTRAS] = {"joints": {name: list(at) for name, at in mesh.joints.items()}}
    for part in mesh.parts:
        solid = trimesh.Trimesh(part.vertices_m, part.triangles, process=False)
        material = _pbr(part.material) if path.suffix.lower() == ".glb" else _phong(part.material)
        solid.visual = TextureVisuals(material=material)
        extras = {"material": SurfaceMaterial.of(part.material).model_dump(), "joint": part.joint}
        solid.metadata[EXTRAS] = extras
        scene.add_geometry(solid, node_name=part.name, geom_name=part.name)
    if path.suffix.lower() == ".glb":
        write_atomically(path, export_glb(scene))
        return
    text, files = export_obj(scene, return_texture=True, mtl_name=f"{path.stem}.mtl")
    for name, data in files.items():
        write_atomically(path.parent / name, data)
    write_atomically(path, text)


def _pbr(m: Material) -> Any:
    from trimesh.visual.material import PBRMaterial

    grey = [m.diffuse] * 3
    roughness = (2.0 / (m.shininess + 2.0)) ** 0.25
    return PBRMaterial(
        name=m.name, baseColorFactor=[*grey, 1.0], metallicFactor=0.0, roughnessFactor=roughness
    )


def _phong(m: Material) -> Any:
    from trimesh.visual.material import SimpleMaterial

    grey, gloss = [round(255 * m.diffuse)] * 3, [round(255 * m.specular)] * 3
    return SimpleMaterial(
        name=m.name.replace(" ", "_"),
        diffuse=[*grey, 255],
        ambient=[*grey, 255],
        specular=[*gloss, 255],
        glossiness=m.shininess,
    )
