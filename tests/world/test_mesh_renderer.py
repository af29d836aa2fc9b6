# SPDX-License-Identifier: Apache-2.0
"""The mesh renderer: grey levels, silhouettes and shadow edges against closed forms, and
independence of what cannot matter.
"""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.meshes import Material, TriangleMesh
from chaserdock_models.satellites import box, lathe, satellite
from chaserdock_models.targets import Box
from chaserdock_world.physics.simulation import TARGET, Physics
from chaserdock_world.rendering.background import SPACE_LEVEL, WHITE_LEVEL, Light
from chaserdock_world.rendering.cameras import Cameras
from chaserdock_world.rendering.mesh_renderer import MeshRenderer
from numpy.typing import NDArray
from world_cases import scenario

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
# The camera looks along +X of WRF: IRF x is -Y, IRF y is -Z.
FORWARD = np.array([0.5, -0.5, 0.5, -0.5])
IDENTITY = (1.0, 0.0, 0.0, 0.0)
GREY = Material("grey", 0.6)
SUN = Light((-1.0, 0.0, 0.0), 0.8, 0.2)


def draw(
    mesh: TriangleMesh, light: Light = SUN, q: object = IDENTITY, at_x: float = 0.0, **more: object
) -> NDArray[np.uint8]:
    renderer = MeshRenderer(CAMERA, mesh)
    return renderer.render((-1.0, 0.0, 0.0), FORWARD, (at_x, 0.0, 0.0), q, light=light, **more)  # type: ignore[arg-type]


def plate(size_m: float = 0.4, material: Material = GREY) -> TriangleMesh:
    """A square plate whose front is at x = 0."""
    return TriangleMesh(
        "plate", (box("plate", material, (0.02, size_m, size_m), (0.01, 0.0, 0.0)),), {}
    )


def test_lambert_ambient_and_lamp() -> None:
    for light, expected in (
        (Light((-1.0, 0.0, 0.0), 0.8, 0.2), WHITE_LEVEL),
        (Light((-1.0, 1.0, 0.0), 0.8, 0.2), WHITE_LEVEL * (0.2 + 0.8 * 0.5**0.5)),
        (Light((1.0, 0.0, 0.1), 0.8, 0.2), WHITE_LEVEL * 0.2),
        (Light((1.0, 0.0, 0.1), 0.0, 0.0, lamp=100.0), 100.0),
    ):
        assert abs(float(draw(plate(), light)[120, 160]) - 0.6 * expected) <= 0.6


def test_specular_reflection_is_brightest_at_the_mirror_angle() -> None:
    glossy = plate(material=Material("glossy", 0.2, 0.5, 30.0))
    row = draw(glossy, Light((-1.0, 0.15, 0.0), 0.8, 0.0))[120].astype(float)
    # The half vector is the normal where the view is mirrored: at y = 0.15.
    assert abs(float(np.flatnonzero(row == row.max()).mean()) - (159.5 - 0.15 * 300.0)) < 2.0
    expected = WHITE_LEVEL * 0.8 * (0.2 / np.hypot(1.0, 0.15) + 0.5)
    assert abs(row.max() - expected) < 2.0


@pytest.mark.parametrize("turn_deg", [0.0, 3.0, 20.0, 45.0])
def test_silhouette_is_exact_to_a_tenth_of_a_pixel(turn_deg: float) -> None:
    """The covered area, and the first moment, of a turned square at sub-pixel places.

    Samples of an edge along the pixels lie an eighth of a pixel apart, which bounds the error of
    the moment.
    """
    for shift in (0.0, 0.0007, 0.0013, 0.0021):
        mesh = TriangleMesh(
            "plate", (box("p", GREY, (0.02, 0.4, 0.3), (0.01, shift, 0.7 * shift)),), {}
        )
        q = rotations.exp([np.radians(turn_deg), 0.0, 0.0])
        image = draw(mesh, q=q).astype(float)
        share = (image - SPACE_LEVEL) / (np.median(image[110:130, 150:170]) - SPACE_LEVEL)
        share[share < 0.02] = 0.0  # noise of rounding; stars are masked below
        share[:30], share[-30:] = 0.0, 0.0
        share = np.clip(share, 0.0, 1.0)
        perimeter = 2 * (0.4 + 0.3) * 300.0
        assert abs(share.sum() - 0.4 * 0.3 * 300.0**2) < 0.1 * perimeter
        rows, columns = np.mgrid[0:240, 0:320]
        centre = rotations.rotate(q, (0.0, shift, 0.7 * shift))
        assert abs((share * columns).sum() / share.sum() - (159.5 - 300.0 * centre[1])) < 0.068
        assert abs((share * rows).sum() / share.sum() - (119.5 - 300.0 * centre[2])) < 0.068


@pytest.mark.slow
def test_no_background_shows_between_triangles() -> None:
    ball = lathe(
        "ball",
        GREY,
        [
            (0.0, -0.3),
            *[(0.3 * np.sin(a), -0.3 * np.cos(a)) for a in np.linspace(0.1, 3.0, 40)],
            (0.0, 0.3),
        ],
        (0.0, 0.0, 0.0),
        (0.3, 0.2, 1.0),
        1e-4,
    )
    light = Light((-1.0, 0.0, 0.0), 0.0, 1.0)
    for turn in np.linspace(0.0, 1.0, 5):
        image = draw(
            TriangleMesh("ball", (ball,), {}), light, rotations.exp([turn, 0.3, 0.0]), at_x=0.3
        )
        rows, columns = np.mgrid[0:240, 0:320]
        inside = np.hypot(rows - 119.5, columns - 159.5) < 60.0
        assert np.ptp(image[inside]) == 0
        assert image[inside][0] == round(0.6 * WHITE_LEVEL)


def test_shadow_edge_is_exact_to_a_third_of_a_pixel() -> None:
    """A bar in front of a plate casts its shadow there, displaced along the sun's direction."""
    bar = Box((0.02, 0.05, 0.3), (0.0, 0.0, 0.0))
    for slope in (0.31, 0.47, 0.62):
        light = Light((-1.0, slope, 0.0), 0.8, 0.2)
        poses = ([bar], (-0.3, 0.0, 0.0), IDENTITY)
        row = draw(plate(0.8), light, obstacles=[poses])[120].astype(float)
        lit, dark = 0.6 * WHITE_LEVEL * (0.2 + 0.8 / np.hypot(1.0, slope)), 0.6 * WHITE_LEVEL * 0.2
        # Of the solid bar, two edges bound the shadow: front right and back left, seen from the
        # sun.
        low, high = (-0.025 - slope * 0.31, 0.025 - slope * 0.29)
        left, right = 159.5 - 300.0 * high, 159.5 - 300.0 * low
        window = row[round(left) - 8 : round(right) + 9]
        share = np.clip((lit - window) / (lit - dark), 0.0, 1.0)
        columns = np.arange(round(left) - 8, round(right) + 9)
        assert abs(share.sum() - (right - left)) < 0.6
        assert abs((share * columns).sum() / share.sum() - (left + right) / 2.0) < 0.3


def test_lit_surfaces_have_no_shadow_of_their_own() -> None:
    for slope in (0.0, 1.0, 4.0):
        image = draw(plate(), Light((-1.0, slope, 0.3 * slope), 0.9, 0.1))
        assert np.ptp(image[70:170, 110:210]) == 0


def test_textures_average_to_the_material() -> None:
    light = Light((-1.0, 0.0, 0.0), 0.0, 1.0)
    foil = draw(plate(material=Material("foil", 0.5, texture="insulation")), light)[70:170, 110:210]
    assert foil.std() > 2.0
    assert abs(float(foil.mean()) - 0.5 * WHITE_LEVEL) < 4.0
    cells = [
        draw(plate(material=Material("cells", 0.2, texture="cells")), light, at_x=x)[
            100:140, 140:180
        ].astype(float)
        for x in (0.0, 1.0)
    ]
    share = 1.0 - (1.0 - 0.0016 / 0.04) ** 2
    expected = WHITE_LEVEL * (0.2 + share * 0.25)
    assert abs(cells[1].mean() - expected) < 1.0
    assert cells[0].max() > cells[1].max() > expected


def test_image_does_not_depend_on_bodies_that_are_nowhere_or_behind() -> None:
    reference = draw(satellite("cubesat_12u"))
    block = [Box((0.2, 0.2, 0.2))]
    for position in ((np.nan, 0.0, 0.0), (-5.0, 0.1, 0.0)):
        image = draw(
            satellite("cubesat_12u"),
            Light((0.0, -1.0, 0.0)),
            obstacles=[(block, position, IDENTITY)],
        )
        np.testing.assert_array_equal(
            image, draw(satellite("cubesat_12u"), Light((0.0, -1.0, 0.0)))
        )
    assert reference.max() > 50


def test_mesh_partly_behind_the_camera_is_clipped() -> None:
    long = TriangleMesh("long", (box("b", GREY, (4.0, 0.2, 0.2), (0.0, 0.0, -0.3)),), {})
    image = draw(long, Light((0.0, 0.0, 1.0), 0.8, 0.2))
    # The top face, 0.2 m below the camera, fills the image below the far edge.
    edge = 119.5 + 300.0 * 0.2 / 3.0
    assert np.all(image[round(edge) + 3 :, 159] == round(0.6 * WHITE_LEVEL))
    assert image[round(edge) - 3, 159] < 40


@pytest.mark.slow
def test_cameras_draw_the_true_mesh_and_the_chasers_mesh() -> None:
    values = {
        "target": {"model": "cubesat_12u"},
        "perception": {"name": "model"},
        "chasers": [
            {"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
            {"position_m": [0.9, 0.0, 0.4], "q_wxyz": [0.0, 0.0, 0.0, 1.0]},
        ],
    }
    images = []
    for changes in (
        {},
        {"chaser": {"mesh": "chaser_body"}},
        {"target": {"model": "cubesat_12u", "knowledge": {"panel_deg": 8.0}}},
    ):
        s = scenario(**(values | changes))
        physics = Physics(s)
        states = {name: physics.state(name) for name in (TARGET, "chaser/0", "chaser/1")}
        images.append(Cameras(s).render(0, 0, 0, states).astype(float))
    assert (images[0] > 20).mean() > 0.02
    assert np.abs(images[0] - images[1]).max() > 20
    assert np.abs(images[0] - images[2]).max() > 20
