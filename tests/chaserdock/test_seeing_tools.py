"""Marker sheets in true scale, targets by file, and calibration from rendered boards."""

import re

import cv2
import numpy as np
import pytest
from chaserdock_agents.chaser.perception import Perception
from chaserdock_agents.chaser.perception.detect import detect, dictionary_of
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.targets import face_rotation, target_model
from chaserdock_protocol.scenario import load_scenario, scenario_from_json
from chaserdock_protocol.scenario.files import find_target
from chaserdock_protocol.scenario.overrides import ScenarioError
from chaserdock_world.rendering.background import Light
from chaserdock_world.rendering.lens import Lens
from chaserdock_world.rendering.rasterizer import Renderer
from chaserdock_world.rendering.tinyrenderer import TinyRenderer

from chaserdock.calibration.intrinsics import BadBoard, TooFew, board_of, calibrate, write_calibration
from chaserdock.calibration.marker_sheets import SHEETS_MM, lay_out, write_sheets

TARGET = """
dictionary = "DICT_4X4_50"
white_margin_m = 0.01
[[cuboids]]
size_m = [0.2, 0.3, 0.25]
[[cuboids]]
size_m = [0.02, 0.4, 0.1]
position_m = [0.0, 0.35, 0.0]
[[markers]]
id = 0
side_m = 0.12
face = "-x"
at_m = [0.03, 0.02]
[[markers]]
id = 1
side_m = 0.06
face = "-x"
cuboid = 1
"""
SCENARIO = """
name = "own-target"
duration_s = 1.0
[target]
model = "mine.toml"
[[chasers]]
position_m = [-1.0, 0.0, 0.0]
q_wxyz = [1.0, 0.0, 0.0, 0.0]
"""
# The -X face upright before a camera that looks along z with y down.
FACING = rotations.from_matrix(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))


@pytest.mark.parametrize("name", ["paper", "servicer"])
def test_a_printed_sheet_shows_the_markers_in_true_size(name, tmp_path):
    """Paints the rectangles that the SVG file holds, finds the markers in the painting, measures them."""
    model = target_model(name)
    count, files = write_sheets(model, tmp_path / "m.svg", SHEETS_MM["a4"])
    assert count == len(files)
    found: dict[int, float] = {}
    px_per_mm = 8.0
    for file in files:
        text = file.read_text()
        assert 'width="210mm" height="297mm" viewBox="0 0 210 297"' in text
        page = np.full((round(297 * px_per_mm), round(210 * px_per_mm)), 255, np.uint8)
        for x, y, w, h in re.findall(r'<rect x="(\S+)" y="(\S+)" width="(\S+)" height="(\S+)"/>', text):
            x, y, w, h = (float(v) * px_per_mm for v in (x, y, w, h))
            page[round(y) : round(y + h), round(x) : round(x + w)] = 0
        seen = detect(page, dictionary_of(model.dictionary), None)
        for i, corners in zip(seen.ids.tolist(), seen.corners_px, strict=True):
            found[i] = float(np.linalg.norm(corners[1] - corners[0])) / px_per_mm
    assert found.keys() == {m.id for m in model.markers}
    for marker in model.markers:
        assert found[marker.id] == pytest.approx(1000 * marker.side_m, abs=0.5)


def test_pdf_and_svg_hold_the_same_rectangles_and_the_pdfs_table_is_right(tmp_path):
    model = target_model("servicer")
    count, (file,) = write_sheets(model, tmp_path / "m.pdf", SHEETS_MM["letter"])
    data = file.read_bytes()
    assert data.startswith(b"%PDF-1.4")
    assert data.count(b"/Type /Page ") == count > 1
    assert b"/MediaBox [0 0 612.0000 792.0000]" in data
    assert data.count(b" re f\n") == sum(len(s.rectangles) for s in lay_out(model, SHEETS_MM["letter"]))
    assert b"2.83464567 0 0 2.83464567 0 0 cm" in data  # millimetres to points, 72 to the inch
    start = int(re.findall(rb"startxref\n(\d+)", data)[0])
    assert data[start : start + 4] == b"xref"
    for number, place in enumerate(re.findall(rb"(\d{10}) 00000 n", data), 1):
        assert data[int(place) :].startswith(b"%d 0 obj" % number)
    for sheet in lay_out(model, SHEETS_MM["a4"]):
        for x, y, w, h in sheet.rectangles:
            assert 0 < x < x + w < 210
            assert 0 < y < y + h < 297 - 26


def test_a_marker_larger_than_the_sheet_is_refused(tmp_path):
    with pytest.raises(ValueError, match="too large"):
        write_sheets(target_model("servicer"), tmp_path / "m.pdf", (100.0, 150.0))


def test_a_target_of_a_file_travels_with_the_scenario_and_is_seen(tmp_path):
    (tmp_path / "mine.toml").write_text(TARGET)
    (tmp_path / "s.toml").write_text(SCENARIO)
    scenario = load_scenario(tmp_path / "s.toml")
    (tmp_path / "mine.toml").unlink()
    model = scenario_from_json(scenario.model_dump_json(), "x").target_model()
    assert model == scenario.target_model()
    assert model.name == "mine"
    assert [m.id for m in model.markers] == [0, 1]
    assert model.markers[0].position_trf_m == pytest.approx((-0.1, -0.03, 0.02))
    camera = Camera.from_hfov(1280, 720, 1.0)
    position, q = np.array([0.0, 0.0, 1.0]), rotations.multiply(FACING, rotations.exp([0.2, 0.1, 0.3]))
    for renderer in (Renderer(camera, model), TinyRenderer(camera, model)):
        image = renderer.render(np.zeros(3), rotations.IDENTITY, position, q)
        sighting = Perception(camera, model).estimate(image)
        assert sorted(sighting.marker_ids.tolist()) == [0, 1]
        assert np.linalg.norm(sighting.solutions[0].position_irf_m - position) < 2e-3


def test_a_mesh_is_drawn_by_pybullet_with_the_markers_on_it(tmp_path):
    """A tetrahedron with a marker that floats before it."""
    (tmp_path / "rock.obj").write_text(
        "v -0.1 -0.3 -0.3\nv -0.1 0.3 -0.3\nv -0.1 0 0.4\nv 0.4 0 0\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    )
    mesh = 'mesh = "rock.obj"\n' + TARGET.replace('face = "-x"\nat_m = [0.03, 0.02]', POSE).replace(
        SECOND, ""
    )
    (tmp_path / "mine.toml").write_text(mesh)
    (tmp_path / "s.toml").write_text(SCENARIO)
    with pytest.raises(ScenarioError, match=r"camera\.renderer"):
        load_scenario(tmp_path / "s.toml")
    model = load_scenario(tmp_path / "s.toml", ("camera.renderer=pybullet",)).target_model()
    camera = Camera.from_hfov(640, 480, 1.0)
    q = rotations.multiply(FACING, rotations.exp([0.1, 0.2, -0.3]))
    image = TinyRenderer(camera, model).render(
        np.zeros(3), rotations.IDENTITY, np.array([0.0, 0.0, 1.2]), q, (), Light((0.2, 0.1, -1.0))
    )
    sighting = Perception(camera, model).estimate(image)
    assert sighting.marker_ids.tolist() == [0]
    assert np.linalg.norm(sighting.solutions[0].position_irf_m - (0.0, 0.0, 1.2)) < 5e-3
    assert image[190, 320] > 40  # the mesh above the marker
    (tmp_path / "rock.obj").unlink()
    with pytest.raises(ScenarioError, match=r"rock\.obj: no such mesh"):
        find_target(str(tmp_path / "mine.toml"))


POSE = f"position_m = [-0.11, 0.0, 0.0]\nq_wxyz = {face_rotation(1).tolist()}"
SECOND = '[[markers]]\nid = 1\nside_m = 0.06\nface = "-x"\ncuboid = 1\n'


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (('"DICT_4X4_50"', '"DICT_4X5_50"'), "unknown ArUco dictionary"),
        (("id = 1", "id = 50"), "markers 0 to 49"),
        (("id = 1", "id = 0"), "also that of"),
        (("cuboid = 1", "cuboid = 2"), "no cuboid 2"),
        (("at_m = [0.03, 0.02]", "at_m = [0.1, 0.02]"), "beyond its face"),
        (('face = "-x"\nat_m = [0.03, 0.02]', "side = 3"), "not a key"),
        (("side_m = 0.06", "side_m = -1"), "greater than 0"),
        (("cuboid = 1", ""), "overlaps"),
        (('face = "-x"\nat_m = [0.03, 0.02]', "position_m = [0.0, 0.0, 0.0]"), "go together"),
        (('face = "-x"\nat_m = [0.03, 0.02]', POSE), "must lie on a face"),
    ],
)
def test_a_target_file_that_cannot_be_is_told_so(change, told, tmp_path):
    assert change[0] in TARGET
    (tmp_path / "mine.toml").write_text(TARGET.replace(*change))
    with pytest.raises(ScenarioError, match=told) as error:
        find_target(str(tmp_path / "mine.toml"))
    assert str(tmp_path / "mine.toml") in str(error.value)


TRUE = Camera(640, 480, 615.0, 612.0, 325.0, 236.0, (-0.22, 0.06, 8e-4, -5e-4, 0.0))


def board_images(board, count, seed=3):
    """The board, drawn flat, warped exactly into the ideal image (4 samples a pixel), and distorted."""
    rows, columns = (6, 8)
    scale = 4000.0  # pixels a metre of the drawing
    if board.charuco is not None:
        drawing = board.charuco.generateImage((round(columns * 0.03 * scale), round(rows * 0.03 * scale)))
        origin = 0.0
    else:
        squares = (np.indices((board.size[1] + 1, board.size[0] + 1)).sum(axis=0) % 2 * 255).astype(np.uint8)
        drawing = np.kron(squares, np.ones((120, 120), np.uint8))
        origin = 0.03
    drawing = cv2.copyMakeBorder(drawing, 80, 80, 80, 80, cv2.BORDER_CONSTANT, value=255)
    origin += 80 / scale
    generator, lens, out = np.random.default_rng(seed), Lens(TRUE), {}
    for k in range(count):
        turn = rotations.to_matrix(rotations.exp(generator.uniform(-0.5, 0.5, 3)))
        centre = np.array([*generator.uniform(-0.03, 0.03, 2), generator.uniform(0.38, 0.5)])
        middle = (
            np.array([columns, rows]) * 0.015
            if board.charuco is not None
            else board.points_m.mean(axis=0)[:2]
        )
        at = centre - turn @ np.append(middle, 0.0)
        # Pixel of the drawing -> metres on the board -> ideal pixel -> sample.
        to_board = np.array(
            [[1 / scale, 0, 0.5 / scale - origin], [0, 1 / scale, 0.5 / scale - origin], [0, 0, 1]]
        )
        shift = 1.5 - 4.0 * lens.origin_px
        to_sample = np.array([[4.0, 0, shift[0]], [0, 4.0, shift[1]], [0, 0, 1]])
        homography = to_sample @ TRUE.matrix() @ np.column_stack([turn[:, :2], at]) @ to_board
        size = (4 * lens.size_px[0], 4 * lens.size_px[1])
        fine = cv2.warpPerspective(drawing, homography, size, flags=cv2.INTER_AREA, borderValue=90)
        ideal = np.asarray(cv2.resize(fine, lens.size_px, interpolation=cv2.INTER_AREA), np.uint8)
        noisy = lens.distorted(ideal) * 0.85 + generator.normal(0.0, 1.5, (480, 640))
        out[f"{k:02}.png"] = np.clip(noisy, 0, 255).astype(np.uint8)
    return out


@pytest.mark.parametrize("kind", ["charuco 8x6", "chessboard 7x5"])
def test_a_camera_is_calibrated_from_rendered_boards(kind, tmp_path):
    board = board_of(kind, 0.03, 0.022, "DICT_4X4_50")
    images: dict = board_images(board, 14)
    images["empty.png"] = np.zeros((480, 640), np.uint8)
    images["small.png"] = np.zeros((100, 100), np.uint8)
    images["broken.png"] = None
    # A board bent in the middle: every corner found, and none where it should be.
    bent = images["13.png"]
    x, y = np.meshgrid(np.arange(640, dtype=np.float32), np.arange(480, dtype=np.float32))
    images["bent.png"] = np.asarray(cv2.remap(bent, x + 6 * np.sin(y / 40), y, cv2.INTER_LINEAR), np.uint8)
    found = calibrate(images, board)
    assert found.left_out.keys() == {"empty.png", "small.png", "broken.png", "bent.png"}
    assert "badly" in found.left_out["bent.png"]
    assert found.total_rms_px < 0.3
    truth = (TRUE.fx_px, TRUE.fy_px, TRUE.cx_px, TRUE.cy_px)
    matrix = found.matrix
    got = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    assert np.abs(np.subtract(got, truth)).max() < 2.5
    # What counts: where it puts pixels. All over the image, but its corners, to half a pixel.
    fx, fy, cx, cy = (float(v) for v in got)
    ours = Camera(640, 480, fx, fy, cx, cy, tuple(found.distortion.tolist()))
    rays = np.stack(
        [*np.meshgrid(np.linspace(-0.3, 0.3, 9), np.linspace(-0.22, 0.22, 7)), np.ones((7, 9))], axis=-1
    )
    away = ours.project(rays) - TRUE.project(rays)
    assert np.linalg.norm(away - away.mean(axis=(0, 1)), axis=-1).max() < 0.5

    write_calibration(found, tmp_path / "camera.yaml")
    (tmp_path / "s.toml").write_text(
        SCENARIO.replace("mine.toml", "paper") + '[camera]\ncalibration = "camera.yaml"\n'
    )
    camera = load_scenario(tmp_path / "s.toml").camera_model()
    assert camera.matrix() == pytest.approx(matrix)
    assert camera.distortion == pytest.approx(tuple(found.distortion))


def test_too_few_images_and_boards_that_cannot_be_are_told():
    board = board_of("charuco 8x6", 0.03, 0.022, "DICT_4X4_50")
    with pytest.raises(TooFew, match=r"0 usable[\s\S]*a\.png: 0 corners"):
        calibrate({"a.png": np.zeros((480, 640), np.uint8)}, board)
    for wrong in (("charuco 2x6", 0.03, 0.02), ("checkers", 0.03, 0.02), ("charuco 8x6", 0.03, 0.04)):
        with pytest.raises(BadBoard):
            board_of(*wrong, "DICT_4X4_50")
