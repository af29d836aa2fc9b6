# SPDX-License-Identifier: Apache-2.0
"""Errors of the known geometry: information of an image on them, correction of the tracker mesh,
and the messages that carry both.
"""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_agents.chaser.perception.model import tracking
from chaserdock_agents.chaser.perception.model.alignment import Pyramid
from chaserdock_agents.chaser.perception.model.geometry import GeometryCorrection
from chaserdock_agents.chaser.perception.model.mesh import TrackerMesh
from chaserdock_agents.chaser.perception.model.perception import ModelPerception, PoseTrack
from chaserdock_agents.chaser.perception.pipeline import GeometryInformation
from chaserdock_agents.chaser.sighting import apply_geometry, look
from chaserdock_models.camera import Camera
from chaserdock_models.geometry_errors import error_modes, geometry_parameters
from chaserdock_models.meshes import with_geometry_errors
from chaserdock_models.satellites import satellite
from chaserdock_protocol.messages import GeometryEstimate, Image
from chaserdock_world.rendering.background import Light
from markerless_cases import Scene, mesh_of, perturbed, random_view, wrong_boxes

CAMERA = Camera.from_hfov(480, 270, np.deg2rad(60.0))
PANEL_RAD, SCALE = np.deg2rad(1.0), 0.005


def test_parameters_of_a_satellite_displace_what_they_name() -> None:
    mesh = satellite("geo_servicer", 0.002)
    parameters = geometry_parameters(mesh, 0.01, 0.003)
    assert len(parameters) == 3 * len(mesh.joints) + 2
    assert [(p.name, p.sigma) for p in parameters[-2:]] == [("scale", 0.003), ("rim", 0.001)]
    modes = error_modes(mesh, 0.01, 0.003)
    joint = next(iter(mesh.joints))
    turned = with_geometry_errors(mesh, 0.0, {joint: np.array([0.0, 0.01, 0.0])})
    moved = np.concatenate([p.vertices_m for p in turned.parts])
    known = np.concatenate([p.vertices_m for p in mesh.parts])
    k = [p.name for p in parameters].index(f"{joint} y")
    np.testing.assert_allclose(known + modes[k], moved, atol=1e-12)
    rim = np.linalg.norm(modes[-1], axis=1)
    assert 0.001 <= rim.max() < 0.00142 + 1e-9
    assert np.count_nonzero(rim) < len(rim)
    assert geometry_parameters(mesh, 0.0, 0.0) == ()


def test_corrected_mesh_is_displaced_and_keeps_the_covariance() -> None:
    mesh = mesh_of(panel_sigma_rad=PANEL_RAD, scale_sigma=SCALE)
    mean, covariance = np.array([0.5, -1.0, 0.3]), np.diag([0.04, 0.09, 0.25]) + 0.01
    corrected = GeometryCorrection(mean, covariance).applied(mesh)
    np.testing.assert_allclose(
        corrected.vertices_m - mesh.vertices_m, np.tensordot(mean, mesh.modes_m, 1)
    )
    for vertex in (0, 9, 20):
        before, after = mesh.modes_m[:, vertex], corrected.modes_m[:, vertex]
        np.testing.assert_allclose(after.T @ after, before.T @ covariance @ before, atol=1e-15)


def test_information_of_a_corrected_mesh_is_about_the_errors_before() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 3))
    correction = GeometryCorrection(rng.normal(size=3), root @ root.T + 0.1 * np.eye(3))
    rows, error = rng.normal(size=(5, 3)), rng.normal(size=3)
    # Rows measure errors before: of the corrected mesh they measure x with e = mean + C x.
    seen = rows @ correction.factor
    x = np.linalg.solve(correction.factor, error - correction.mean)
    position, by_x, known = rng.normal(size=3), rng.normal(size=(3, 3)), np.eye(3)
    measured = correction.of_uncorrected(
        GeometryInformation(seen.T @ seen, seen.T @ (seen @ x), position, by_x, known)
    )
    np.testing.assert_allclose(measured.matrix, rows.T @ rows, atol=1e-9)
    np.testing.assert_allclose(measured.vector, rows.T @ (rows @ error), atol=1e-9)
    np.testing.assert_allclose(
        measured.position_m + measured.position_by_errors @ error, position + by_x @ x, atol=1e-9
    )


@pytest.mark.slow
def test_views_from_all_around_find_the_errors_and_their_correction_makes_poses_accurate() -> None:
    true = np.array([1.5, -1.2, 0.8])
    boxes = wrong_boxes((true[0] * PANEL_RAD, true[1] * PANEL_RAD), 1.0 + true[2] * SCALE)
    scene, rng = Scene(CAMERA, boxes=boxes), np.random.default_rng(12)
    mesh = mesh_of(panel_sigma_rad=PANEL_RAD, scale_sigma=SCALE)
    information, vector = np.eye(3), np.zeros(3)

    def seen(of: TrackerMesh, number: int) -> tuple[np.ndarray, GeometryInformation]:
        pose, light = random_view(rng, 1.5, CAMERA)
        pyramid = Pyramid(scene.image(pose, light, number), CAMERA)
        found = tracking.refine_from_prior(
            pyramid, of, perturbed(pose, rng, 0.005, np.deg2rad(0.7))
        )
        assert found is not None
        return tracking.pose_error(found[0].pose, pose), found[0].geometry

    for number in range(6):
        _, measured = seen(mesh, number)
        information, vector = information + measured.matrix, vector + measured.vector
    covariance = np.asarray(np.linalg.inv(information), dtype=float)
    mean = covariance @ vector
    # The scale is hardly observable without its effect on the range; the panels are.
    np.testing.assert_allclose(mean[:2], true[:2], atol=0.4)
    assert np.all(np.sqrt(np.diag(covariance)[:2]) < 0.35)
    corrected = mesh.corrected(mean, covariance)
    assert max(
        float(np.linalg.norm(seen(corrected, 20 + n)[0][3:])) for n in range(2)
    ) < np.deg2rad(0.2)


def image_of(pixels: np.ndarray, tick: int) -> Image:
    return Image(
        tick=tick, sim_time_ns=tick, chaser=0, width_px=480, height_px=270, encoding="mono8",
        data=pixels.tobytes()
    )  # fmt: skip


def test_perception_publishes_what_new_views_tell_and_tracks_on_after_a_correction() -> None:
    mesh = mesh_of(panel_sigma_rad=PANEL_RAD, scale_sigma=SCALE)
    perception = ModelPerception(CAMERA, mesh)
    scene, pose = Scene(CAMERA), random_view(np.random.default_rng(3), 2.0, CAMERA)[0]
    light = Light((-0.5, -0.4, -1.0))
    found = tracking.refine_from_prior(Pyramid(scene.image(pose, light, 0), CAMERA), mesh, pose)
    assert found is not None
    perception._tracks = (
        PoseTrack(*found, age=7),
    )  # in place of an acquisition; the next view is a new one
    measured = []
    for number in range(1, 4):
        sighting = look(perception, image_of(scene.image(pose, light, number), number), None)
        assert sighting.solutions
        measured.append(sighting.geometry)
    assert measured[0] is not None
    assert len(measured[0].vector) == 3
    # Control points reused: no new information, but a new position.
    assert [len(m.vector) for m in measured[1:] if m is not None] == [0, 0]
    for m in measured:
        assert m is not None
        # A larger body is farther away.
        assert np.dot(m.position_m, np.reshape(m.position_by_errors, (3, 3))[:, 2]) > 0.0
        assert np.linalg.norm(np.subtract(m.position_m, pose.position)) < 0.02
    estimate = GeometryEstimate(
        names=("a", "b", "scale"),
        sigmas=(PANEL_RAD, PANEL_RAD, SCALE),
        values=(0.2 * PANEL_RAD, 0.0, 0.0),
        covariance=tuple(
            np.diag([0.04 * PANEL_RAD**2, 0.04 * PANEL_RAD**2, 0.25 * SCALE**2]).ravel().tolist()
        ),
        views=5,
        coverage=0.1,
    )
    assert apply_geometry(perception, estimate) is None
    np.testing.assert_allclose(
        perception.mesh.vertices_m - mesh.vertices_m, 0.2 * mesh.modes_m[0], atol=1e-12
    )
    after = look(perception, image_of(scene.image(pose, light, 9), 9), None)
    assert after.solutions
    assert after.geometry is not None  # a new view by the corrected mesh
    same = perception.mesh
    assert apply_geometry(perception, estimate) is None
    assert perception.mesh is same


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"values": (0.0,)}, "3 names with 1 values and 9 covariances"),
        ({"covariance": (0.0,) * 9}, "the mesh has 3 errors"),
        ({"sigmas": (0.0, 1.0, 1.0)}, "3 names with 3 values"),
    ],
)
def test_malformed_estimate_is_refused(changes: dict[str, tuple[float, ...]], text: str) -> None:
    mesh = mesh_of(panel_sigma_rad=PANEL_RAD, scale_sigma=SCALE)
    perception = ModelPerception(CAMERA, mesh)
    values = {
        "sigmas": (1.0,) * 3,
        "values": (0.0,) * 3,
        "covariance": tuple(np.eye(3).ravel().tolist()),
    }
    estimate = GeometryEstimate(names=("a", "b", "c"), views=1, coverage=0.1, **(values | changes))
    refused = apply_geometry(perception, estimate)
    assert refused is not None
    assert text in refused
    assert perception.mesh is mesh
