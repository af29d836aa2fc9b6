# SPDX-License-Identifier: Apache-2.0
"""Markers on meshes: closed plates, and poses that the marker perception measures in their
images.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from chaserdock_agents.chaser.perception import Perception
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.meshes import Material, MeshPart, TriangleMesh, open_edges, volume_m3
from chaserdock_models.satellites import satellite
from chaserdock_models.targets import Marker, TargetModel, target_model
from chaserdock_world.rendering.mesh_markers import ABOVE_M, marker_parts, with_markers
from chaserdock_world.rendering.mesh_renderer import MeshRenderer

# On the +X face of the bus of geo_servicer, x right and y up as seen from outside.
BUS = satellite("geo_servicer").parts[0]
FRONT_M = float(BUS.vertices_m[:, 0].max())
UPRIGHT = (0.5, 0.5, 0.5, 0.5)


def marked() -> tuple[TargetModel, TriangleMesh]:
    markers = tuple(
        Marker(k, 0.08, (FRONT_M, y, z), UPRIGHT)
        for k, (y, z) in enumerate(((0.07, -0.09), (0.07, 0.03), (-0.06, -0.09)))
    )
    model = replace(target_model("geo_servicer"), markers=markers, white_margin_m=0.01)
    return model, with_markers(satellite("geo_servicer"), model)


def test_plate_is_closed_and_counter_clockwise() -> None:
    model, _ = marked()
    for margin in (0.01, 0.0):
        white, black = marker_parts(replace(model, white_margin_m=margin), model.markers[1])
        plate = MeshPart(
            "plate", Material("m"), white.vertices_m, np.vstack([white.triangles, black.triangles])
        )
        assert open_edges(plate) == 0
        assert np.isclose(volume_m3(plate), (0.08 + 2 * margin) ** 2 * (ABOVE_M + 1e-3))
        assert 0 < len(black.triangles) < len(white.triangles)


def test_marker_perception_measures_the_pose_of_a_marked_mesh() -> None:
    model, mesh = marked()
    camera = Camera.from_hfov(1280, 720, np.deg2rad(60.0))
    renderer, perception = MeshRenderer(camera, mesh, None, 0.6), Perception(camera, model)
    # The +X face upright before a camera that looks along z with y down.
    facing = rotations.from_matrix(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]))
    for turn in ([0.1, 0.2, 0.1], [-0.2, -0.15, 0.4]):
        position, q = np.array([0.02, 0.03, 0.9]), rotations.multiply(facing, rotations.exp(turn))
        image = renderer.render(np.zeros(3), rotations.IDENTITY, position, q)
        sighting = perception.estimate(image)
        assert sorted(sighting.marker_ids.tolist()) == [0, 1, 2]
        error = np.linalg.norm(sighting.solutions[0].position_irf_m - position)
        turned = rotations.log(
            rotations.multiply(rotations.conjugate(q), sighting.solutions[0].q_irf_trf_wxyz)
        )
        assert error < 1.5e-3
        assert np.degrees(np.linalg.norm(turned)) < 0.25
