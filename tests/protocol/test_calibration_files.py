# SPDX-License-Identifier: Apache-2.0
"""Calibration files as the tools of others write them, and files that must be refused."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.scenario.calibration_files import read_calibration
from chaserdock_protocol.scenario.camera import lens_note
from chaserdock_protocol.scenario.errors import ScenarioError
from chaserdock_protocol.shipped_scenarios import find_scenario

MATRIX = np.array([[520.1, 0.0, 318.2], [0.0, 521.3, 243.9], [0.0, 0.0, 1.0]])
FIVE = (-0.2112, 0.0531, 0.0011, -0.0021, 0.0071)
RATIONAL = (0.22, -0.03, 0.8e-3, -0.6e-3, 0.004, 0.41, 0.012, 0.003)
FOURTEEN = (*RATIONAL, 9e-4, -4e-4, -7e-4, 3e-4, 0.031, -0.022)
FISHEYE = (-0.0023, 0.0412, -0.0387, 0.0067)

SAMPLE = """%YAML:1.0
---
calibration_time: "Fri Nov 27 10:00:00 2026"
nr_of_frames: 20
image_width: 640
image_height: 480
board_width: 9
board_height: 6
square_size: 30.
fix_aspect_ratio: 1.
# flags:  +fix_aspectRatio +zero_tangent_dist
flags: 10
fisheye_model: {fisheye}
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 520.1, {skew}, 318.2, 0., 521.3, 243.9, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: {count}
   cols: 1
   dt: d
   data: [ {data} ]
avg_reprojection_error: 2.1000000000000002e-01
per_view_reprojection_errors: !!opencv-matrix
   rows: 2
   cols: 1
   dt: f
   data: [ 2.01345861e-01, 1.98213443e-01 ]
grid_points: []
"""

# OpenCV 2.4's sample.
OLD_SAMPLE = """%YAML:1.0
calibration_Time: "Fri 27 Nov 2026 10:00:00"
nrOfFrames: 17
image_Width: 640
image_Height: 480
board_Width: 9
square_Size: 50.
flagValue: 10
Camera_Matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 520.1, 0., 318.2, 0., 521.3,
       243.9, 0., 0., 1. ]
Distortion_Coefficients: !!opencv-matrix
   rows: 8
   cols: 1
   dt: d
   data: [ -0.2112, 0.0531, 0.0011, -0.0021, 0.0071, 0., 0., 0. ]
"""

ROS = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [520.1, 0, 318.2, 0, 521.3, 243.9, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: [{data}]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [500.2, 0, 317.9, 0, 0, 510.7, 243.1, 0, 0, 0, 1, 0]
"""

# ros2 topic echo /camera_info
ECHO = """header:
  stamp:
    sec: 12
    nanosec: 5000
  frame_id: camera
height: 480
width: 640
distortion_model: plumb_bob
d:
- -0.2112
- 0.0531
- 0.0011
- -0.0021
- 0.0071
k:
- 520.1
- 0.0
- 318.2
- 0.0
- 521.3
- 243.9
- 0.0
- 0.0
- 1.0
binning_x: {binning}
binning_y: 0
roi:
  x_offset: {offset}
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
---
"""

KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: {camera_model}
  distortion_coeffs: [{data}]
  distortion_model: {model}
  intrinsics: [520.1, 521.3, 318.2, 243.9]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""
SECOND = """cam1:
  T_cn_cnm1:
  - [0.999, 0.001, 0.002, -0.11]
  - [-0.001, 0.999, 0.003, 0.0]
  - [-0.002, -0.003, 0.999, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.0023, 0.0412, -0.0387, 0.0067]
  distortion_model: equidistant
  intrinsics: [401.5, 402.5, 377.5, 241.5]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""


def text(numbers) -> str:
    return ", ".join(map(repr, numbers))


def sample(data=FIVE, fisheye=0, skew="0.") -> str:
    return SAMPLE.format(data=text(data), count=len(data), fisheye=fisheye, skew=skew)


def ros(model="plumb_bob", data=FIVE) -> str:
    return ROS.format(model=model, data=text(data), count=len(data))


def kalibr(model="radtan", data=FIVE[:4], camera_model="pinhole") -> str:
    return KALIBR.format(model=model, data=text(data), camera_model=camera_model)


def echo(binning=0, offset=0) -> str:
    return ECHO.format(binning=binning, offset=offset)


def written(tmp_path: Path, content: str, name="camera.yaml") -> Path:
    path = tmp_path / name
    path.write_text(content)
    return path


READ = {
    "sample": (sample(), FIVE, "perspective"),
    "sample, 4": (sample(FIVE[:4]), FIVE[:4], "perspective"),
    "sample, 8": (sample(RATIONAL), RATIONAL, "perspective"),
    "sample, 14": (sample(FOURTEEN), FOURTEEN, "perspective"),
    "sample, 12 as 14": (sample((*FOURTEEN[:12], 0.0, 0.0)), FOURTEEN[:12], "perspective"),
    "sample, fisheye": (sample(FISHEYE, 1), FISHEYE, "equidistant"),
    "old sample": (OLD_SAMPLE, FIVE, "perspective"),
    "ROS": (ros(), FIVE, "perspective"),
    "ROS, rational": (ros("rational_polynomial", RATIONAL), RATIONAL, "perspective"),
    "ROS, fisheye": (ros("equidistant", FISHEYE), FISHEYE, "equidistant"),
    "ROS, of driver": (
        ros().replace("distortion_model", "camera_model"), FIVE, "perspective"
    ),
    "ROS, message": (echo(), FIVE, "perspective"),
    "Kalibr": (kalibr(), FIVE[:4], "perspective"),
    "Kalibr, fisheye": (kalibr("equidistant", FISHEYE), FISHEYE, "equidistant"),
    "Kalibr, none": (kalibr("none", ()), (), "perspective"),
    "Kalibr, OpenVINS": ("%YAML:1.0 # as OpenCV\n\n" + kalibr(), FIVE[:4], "perspective"),
}  # fmt: skip


@pytest.mark.parametrize(("content", "distortion", "model"), READ.values(), ids=READ)
def test_files_of_other_tools_are_read(tmp_path, content, distortion, model):
    assert read_calibration(written(tmp_path, content)) == {
        "width_px": 640,
        "height_px": 480,
        "fx_px": 520.1,
        "fy_px": 521.3,
        "cx_px": 318.2,
        "cy_px": 243.9,
        "distortion": list(distortion),
        "lens_model": model,
    }


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize("names", ["sample", "interactive"])
def test_what_opencv_writes_is_read(tmp_path, suffix, names):
    """Written by OpenCV's own writer, with the keys of its sample and of its interactive tool."""
    path = tmp_path / f"camera.{suffix}"
    store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if names == "sample":
        store.write("calibration_time", "Fri Nov 27 10:00:00 2026")
        store.write("image_width", 640)
        store.write("image_height", 480)
        store.writeComment("flags:  +fix_k4 +fix_k5")
        store.write("flags", 6144)
        store.write("fisheye_model", 0)
        store.write("camera_matrix", MATRIX)
        store.write("distortion_coefficients", np.array(FIVE).reshape(-1, 1))
        store.write("avg_reprojection_error", 0.21)
    else:
        store.write("calibrationDate", "Fri 27 Nov 2026 10:00:00")
        store.write("framesCount", 17)
        store.startWriteStruct("cameraResolution", cv2.FILE_NODE_SEQ)
        store.write("", 640)
        store.write("", 480)
        store.endWriteStruct()
        store.write("cameraMatrix", MATRIX)
        store.write("cameraMatrix_std_dev", np.array([[0.1, 0.1, 0.2, 0.2]]).T)
        store.write("dist_coeffs", np.array([FIVE]))
        store.write("dist_coeffs_std_dev", np.full((5, 1), 1e-3))
        store.write("avg_reprojection_error", 0.21)
    store.release()
    found = read_calibration(path)
    assert (found["width_px"], found["height_px"]) == (640, 480)
    assert (found["fx_px"], found["fy_px"], found["cx_px"], found["cy_px"]) == (
        520.1, 521.3, 318.2, 243.9
    )  # fmt: skip
    assert found["distortion"] == list(FIVE)


def test_one_camera_of_a_camchain_is_named(tmp_path):
    path = written(tmp_path, kalibr() + SECOND, "camchain.yaml")
    with pytest.raises(
        ScenarioError, match=r"several cameras \(cam0, cam1\); name one, as in camc"
    ):
        read_calibration(path)
    found = read_calibration(tmp_path / "camchain.yaml#cam1")
    assert (found["width_px"], found["fx_px"], found["lens_model"]) == (752, 401.5, "equidistant")
    assert read_calibration(tmp_path / "camchain.yaml#cam0")["lens_model"] == "perspective"
    with pytest.raises(ScenarioError, match="no camera 'cam2'; it has cam0, cam1"):
        read_calibration(tmp_path / "camchain.yaml#cam2")


REFUSED = {
    "skew": (sample(skew="0.8"), r"camera_matrix: has a skew of 0\.8 px"),
    "fisheye, 5": (sample(FIVE, 1), "a fisheye_model takes 4 coefficients, not 5"),
    "6 coefficients": (sample((*FIVE, 0.1)), "takes 0, 4, 5, 8, 12 or 14 coefficients, not 6"),
    "fewer than stated": (sample().replace("rows: 5", "rows: 8"), "5 numbers where 8 x 1 are"),
    "NaN": (sample((*FIVE[:4], ".Nan")).replace("'", ""), "must have finite numbers"),
    "infinite": (sample().replace("521.3", ".Inf"), "camera_matrix must have finite numbers"),
    "2 x 3": (sample().replace("rows: 3", "rows: 2").replace(", 0., 0., 1. ]", " ]"), "3 x 3"),
    "uncalibrated": (ros().replace("520.1, 0, 318.2, 0, 521.3, 243.9", "0, 0, 0, 0, 0, 0"),
                     "focal lengths must be positive"),
    "another size": (sample().replace("image_width: 640", "image_width: 300"),
                     r"principal point \(318.2, 243.9\) is not in the image of 300 x 480"),
    "no size": (sample().replace("image_width", "breadth"),
                "no width of the image.*nr_of_frames"),
    "half a pixel": (sample().replace("image_width: 640", "image_width: 640.5"), "whole, positive"),
    "stereo": (sample().replace("camera_matrix", "M1"), r"no camera matrix \(camera_matrix\)"),
    "unknown model": (ros("thin_prism"), "distortion_model thin_prism is not known; known: plumb"),
    "plumb_bob, 8": (ros(data=RATIONAL), "plumb_bob takes 0, 4 or 5 coefficients, not 8"),
    "equidistant, 5": (ros("equidistant", FIVE), "equidistant takes 4 coefficients, not 5"),
    "binning": (echo(binning=2), "binning_x must be 0 or 1"),
    "region": (echo(offset=16), "roi must begin at 0, 0"),
    "omni": (kalibr(camera_model="omni"), "cam0.camera_model omni is not known; known: pinhole"),
    "fov": (kalibr("fov", (0.9,)), "cam0.distortion_model fov is not known; known: radtan, equi"),
    "radtan, 5": (kalibr(data=FIVE), "radtan takes 4 coefficients, not 5"),
    "omni's intrinsics": (kalibr().replace("[520.1,", "[1.2, 520.1,"), "fu, fv, pu, pv .got 5"),
    "no resolution": (kalibr().replace("resolution", "size"), "no width of the image"),
    "text": ("a camera\n", "not a calibration file"),
    "nothing": ("", "not a calibration file"),
    "broken YAML": (sample().replace("]", "", 1), "not a calibration file"),
    "broken XML": ("<opencv_storage><a></opencv_storage>", "not a calibration file"),
    "broken JSON": ('{"camera_matrix": ', "not a calibration file"),
    "a list": ("- 1\n- 2\n", "not a calibration file"),
}  # fmt: skip


@pytest.mark.parametrize(("content", "message"), REFUSED.values(), ids=REFUSED)
def test_wrong_files_are_refused_in_one_line(tmp_path, content, message):
    path = written(tmp_path, content)
    with pytest.raises(ScenarioError, match=message) as raised:
        read_calibration(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)


def test_files_that_are_none_are_refused(tmp_path):
    (tmp_path / "image.yaml").write_bytes(bytes(range(256)))
    with pytest.raises(ScenarioError, match="not UTF-8"):
        read_calibration(tmp_path / "image.yaml")
    with pytest.raises(ScenarioError, match="no such calibration file"):
        read_calibration(tmp_path / "none.yaml")
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(ScenarioError, match="no such calibration file"):
        read_calibration(tmp_path / "pipe.yaml")


def test_a_scenario_flies_the_camera_of_its_file(tmp_path):
    written(tmp_path, sample(FISHEYE, 1))
    scenario = load_scenario(
        find_scenario("single"),
        (f"camera.calibration={json.dumps(str(tmp_path / 'camera.yaml'))}",),
    )
    camera = scenario.camera_model()
    assert (camera.lens_model, camera.distortion) == ("equidistant", FISHEYE)
    assert camera.matrix() == pytest.approx(MATRIX)
    assert camera.position_crf_m == scenario.camera.position_m


LENS = "camera.intrinsics={width_px=640,height_px=360,fx_px=319.56,fy_px=319.56,cx_px=320.0,"


def test_a_lens_that_ends_in_the_image_is_refused_or_announced():
    bad = f"{LENS}cy_px=180.0,distortion=[-0.9,0.0,0.0,0.0]}}"
    with pytest.raises(ScenarioError, match=r"inverted only up to 130 px .* \(31\.3 degrees\), in"):
        load_scenario(find_scenario("single"), (bad,))
    wide = f"{LENS}cy_px=180.0,distortion=[-0.2535,0.0924,-0.0006,0.0007,-0.0191]}}"
    note = lens_note(load_scenario(find_scenario("single"), (wide,)).camera_model())
    assert note is not None
    assert note.startswith("camera: the lens ends 325 px from the principal point (57.0 degrees)")
    assert lens_note(load_scenario(find_scenario("harsh-light")).camera_model()) is None
