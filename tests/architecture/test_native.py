# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels: the same bits from every instruction set, and one clear error where they
cannot be had.
"""

from __future__ import annotations

import ctypes
import itertools
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from chaserdock_agents.chaser.perception import corners, refine
from chaserdock_agents.chaser.perception import native as perception_native
from chaserdock_controller.estimation.joint import JointEstimator
from chaserdock_controller.estimation.joint import kernels as joint_kernels
from chaserdock_controller.estimation.joint import native as joint_native
from chaserdock_controller.nmpc import NmpcInput, kernels, make_solver
from chaserdock_controller.nmpc import native as nmpc_native
from chaserdock_controller.nmpc.rti import RtiSolver
from chaserdock_models import native, passive_safety
from chaserdock_models.camera import Camera
from chaserdock_models.lenses import LensModel
from chaserdock_models.native import KernelLibrary
from chaserdock_models.native.build import LIBRARY_NAME, NATIVE_FOLDERS, X86_64, source_digest
from chaserdock_models.shape_distance import box_table, chaser_boxes
from chaserdock_models.targets import Box, target_model
from chaserdock_world.rendering import native as rendering_native
from chaserdock_world.rendering import scene_geometry as faces
from chaserdock_world.rendering.rasterizer import Renderer
from flight_cases import scenario
from joint_cases import SyntheticFlight, navigation, parameters
from nmpc_cases import PARAMS, Array, at_rest, fixed_problem, fly, swap
from nmpc_kernels import build_rows
from numpy.typing import NDArray
from source_tree import MODULES, ROOT

LEVELS = [number for number, _ in X86_64]


def has(number: int) -> bool:
    return native.LIBRARY.level != 0 and number <= native.LIBRARY.level


@pytest.mark.parametrize("number", LEVELS)
def test_every_instruction_set_gives_the_same_bits(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two chasers swapping head-on, one in a corridor: interior point, tilted planes, cone."""
    if not has(number):
        pytest.skip(f"this processor has no copy {number}")
    corridors = np.zeros((2, 31, 5))
    corridors[0, :] = [-1.0, 0.0, 0.0, 1.2, 2.0]

    def flown() -> tuple[Array, list[int]]:
        problem_at, states = swap()

        def with_corridor(x: Array, now_s: float) -> NmpcInput:
            problem = problem_at(x, now_s)
            return NmpcInput(**{**vars(problem), "corridors": corridors})

        flight = fly(make_solver("rti", PARAMS, 2), with_corridor, states, 0.1, 2.0)
        return flight.states, [int(p.iterations.sum()) for p in flight.plans]

    expected, iterations = flown()
    assert any(iterations)
    own = nmpc_native.function
    monkeypatch.setattr(kernels, "function", lambda name, result=None: own(name, result, number))
    states, _ = flown()
    np.testing.assert_array_equal(states, expected)


@pytest.mark.parametrize("number", LEVELS)
@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("perspective", ()),
        ("perspective", (-0.18, 0.05, 0.0006, -0.0004)),
        ("perspective", (0.5, 0, 0, 0, 0, 1.9, 0.3, 0, 1e-3, 0, 1e-3, 0, 0.02, -0.02)),
        ("equidistant", (0.35, 0.0, 0.0, 0.0)),
    ],
)
def test_every_instruction_set_sees_the_same_bits(
    number: int,
    model: LensModel,
    distortion: tuple[float, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Corners of large markers and of such with a narrow border, and a pose from a start far
    off.
    """
    if not has(number):
        pytest.skip(f"this processor has no copy {number}")
    rng = np.random.default_rng(3)
    camera = replace(Camera.from_hfov(320, 240, 1.0), distortion=distortion, lens_model=model)
    outlined = np.arange(12) % 2 == 0
    image = rng.integers(0, 60, (240, 320), dtype=np.uint8)
    quads = np.array([[40, 40], [90, 45], [88, 95], [38, 90]]) + rng.uniform(0, 120, (12, 1, 2))
    margin = rng.uniform(0.02, 0.2, 12)
    for quad, share in zip(quads, margin, strict=True):
        middle = quad.mean(axis=0)
        for scale, level in ((1.0 + 2.0 * share, 200), (1.0, 10)):
            outline = np.rint(16.0 * camera.distort(middle + scale * (quad - middle))).astype(
                np.int32
            )
            cv2.fillConvexPoly(image, outline, level, cv2.LINE_AA, 4)
    image = np.asarray(cv2.GaussianBlur(image, (7, 7), 0.7), dtype=np.uint8)
    points = rng.uniform(-0.3, 0.3, (2, 4, 3))
    truth = pose_at([0.1, -0.05, 1.5], [0.4, -2.0, 0.9])
    pixels = camera.project_ideal(points @ truth.rotation.T + truth.position) + rng.normal(
        0.0, 0.1, (2, 4, 2)
    )
    whitening = rng.normal(0.0, 0.3, (2, 8, 8)) + np.eye(8)
    start = pose_at([0.0, 0.0, 1.2], [0.0, -1.6, 0.5])

    def seen() -> list[NDArray[Any]]:
        found = corners.refine(image, camera, quads, 6, margin, outlined)
        pose = refine.refine(camera.matrix(), points, pixels, whitening, start)
        assert pose is not None
        np.testing.assert_allclose(pose.rotation, truth.rotation, atol=0.01)
        errors = found.errors.whitening, found.errors.common
        return [found.corners_px, found.good, *errors, pose.position, pose.rotation]

    expected = seen()
    assert 0 < expected[1].sum() < 12
    own = perception_native.function
    for module in (corners, refine):
        monkeypatch.setattr(module, "function", lambda name, result=None: own(name, result, number))
    for ours, theirs in zip(seen(), expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("number", LEVELS)
def test_every_instruction_set_draws_the_same_image(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not has(number):
        pytest.skip(f"this processor has no copy {number}")
    renderer = Renderer(Camera.from_hfov(320, 240, 1.0), target_model("servicer"))
    rng = np.random.default_rng(7)
    views = [(rng.uniform(-0.4, 0.4, 3), rng.normal(size=4)) for _ in range(6)]

    def drawn() -> list[NDArray[np.uint8]]:
        eye, ahead = np.array([0.0, 0.0, -1.2]), np.array([1.0, 0.0, 0.0, 0.0])
        other = (chaser_boxes(), np.array([0.3, 0.1, 0.2]), ahead)
        return [renderer.render(eye, ahead, p, q / np.linalg.norm(q), [other]) for p, q in views]

    expected = drawn()
    assert all(image.max() > 60 for image in expected)
    own = rendering_native.function
    monkeypatch.setattr(faces, "function", lambda name, result=None: own(name, result, number))
    np.testing.assert_array_equal(drawn(), expected)


@pytest.mark.parametrize("number", LEVELS)
def test_every_instruction_set_estimates_the_same_bits(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three chasers, as the covariance then ends within a vector."""
    if not has(number):
        pytest.skip(f"this processor has no copy {number}")

    def estimated() -> list[Array]:
        errors = navigation("lab")
        flight = SyntheticFlight(scenario(), errors, 3, 1)
        estimator = JointEstimator(parameters(scenario(), errors), 3)
        for _ in range(8):
            estimator.update(flight.inputs())
            flight.step()
        state = estimator.state
        assert state is not None
        return [state.position_m, state.q_wxyz, state.extra, state.covariance]

    expected = estimated()
    own = joint_native.function
    monkeypatch.setattr(
        joint_kernels, "function", lambda name, result=None: own(name, result, number)
    )
    for ours, theirs in zip(estimated(), expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("number", LEVELS)
def test_every_instruction_set_certifies_the_same_bits(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not has(number):
        pytest.skip(f"this processor has no copy {number}")
    coast, rng = passive_safety.CoastModel(1.13e-3, 11000.0), np.random.default_rng(5)
    states = np.concatenate(
        [rng.normal(0.0, 50.0, (31, 3)), rng.normal(0.0, 0.05, (31, 3))], axis=1
    )
    spread = rng.normal(size=(6, 6)) * np.array([0.05] * 3 + [1e-4] * 3)[:, None]
    motion = passive_safety.disturbed(spread @ spread.T, 1e-7)
    expected = coast.certify(states, motion, 0.75)
    own = native.function
    monkeypatch.setattr(
        passive_safety, "function", lambda name, result=None: own(name, result, number)
    )
    assert coast.certify(states, motion, 0.75) == expected


@pytest.mark.parametrize("corner", [np.nan, np.inf, -np.inf, 1e300, -1e9])
def test_corners_that_lie_nowhere_are_not_good(corner: float) -> None:
    image = np.full((48, 64), 200, dtype=np.uint8)
    quads = np.array([[[10.0, 10.0], [30.0, 10.0], [30.0, 30.0], [10.0, 30.0]]])
    quads[0, 2, 0] = corner
    found = corners.refine(
        image, Camera.from_hfov(64, 48, 1.0), quads, 6, np.array([0.1]), np.array([True])
    )
    assert not found.good.any()
    np.testing.assert_array_equal(found.corners_px, quads)
    with pytest.raises(ValueError, match="has no corners"):
        corners.refine(
            image[:1], Camera.from_hfov(64, 48, 1.0), quads, 6, np.array([0.1]), np.array([True])
        )


def pose_at(position: list[float], rotation_vector: list[float]) -> refine.PoseInCamera:
    return refine.PoseInCamera(np.array(position), refine.rotation_matrix(rotation_vector))


@pytest.mark.parametrize("turn", [0.0, 1e-9, 0.3, 2.0])
def test_a_refined_pose_is_where_the_error_no_longer_falls(turn: float) -> None:
    """The gradient by OpenCV's projection, which the kernel does not use; a start off by ``turn``
    rad comes back.
    """
    rng = np.random.default_rng(5)
    matrix = np.array([[600.0, 0.0, 320.0], [0.0, 590.0, 240.0], [0.0, 0.0, 1.0]])
    points = rng.uniform(-0.3, 0.3, (2, 4, 3))
    truth = pose_at([0.1, -0.05, 1.5], [0.4, -2.0, 0.9])
    at = points @ truth.rotation.T + truth.position
    pixels = at[..., :2] / at[..., 2:] * [600.0, 590.0] + [320.0, 240.0]
    pixels += rng.normal(0.0, 0.2, pixels.shape)
    whitening = rng.normal(0.0, 0.3, (2, 8, 8)) + np.eye(8)
    start = refine.PoseInCamera(
        truth.position, refine.rotation_matrix([0.0, turn, 0.0]) @ truth.rotation
    )
    pose = refine.refine(matrix, points, pixels, whitening, start)
    assert pose is not None
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-14)
    found = refine.residual_of(matrix, points, pixels, whitening, pose)
    assert found is not None
    residual, jacobian = found
    step = np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ residual)
    assert np.abs(step).max() < 1e-5
    assert (
        refine.refine(
            matrix, points - [0.0, 0.0, 50.0], pixels, whitening, pose_at([0, 0, 1], [0, 0, 0])
        )
        is None
    )


def copied(folder: Path) -> KernelLibrary:
    """A copy of the NMPC's sources and library, to be tampered with."""
    target = folder / "native"
    shutil.copytree(
        nmpc_native.LIBRARY.path.parent, target, ignore=shutil.ignore_patterns("__pycache__")
    )
    return KernelLibrary(str(target / "__init__.py"))


def test_a_library_of_other_sources_is_refused(tmp_path: Path) -> None:
    copy = copied(tmp_path)
    assert copy.library.source_digest().decode() == source_digest(copy.path.parent)
    with (copy.path.parent / "problem.c").open("a") as file:
        file.write("\n/* an edit */\n")
    with pytest.raises(ImportError, match=r"compiled from other sources.*pip install"):
        _ = KernelLibrary(str(copy.path)).library


def test_a_library_that_is_missing_or_broken_is_named(tmp_path: Path) -> None:
    copy = copied(tmp_path)
    copy.path.write_bytes(b"not a library")
    with pytest.raises(ImportError, match=r"compiled for another kind of machine.*pip install"):
        _ = copy.library
    copy.path.unlink()
    with pytest.raises(ImportError, match=r"missing.*pip install"):
        _ = copy.library


def test_a_structure_of_another_layout_is_refused(tmp_path: Path) -> None:
    """Members of equal size in another order, another size, one too few: each named, on loading."""
    fields = kernels.Model._fields_
    swapped = [fields[1], fields[0], *fields[2:]]
    narrow = [(fields[0][0], ctypes.c_float), *fields[1:]]
    path = str(copied(tmp_path).path)
    for members, said in (
        (swapped, "step_s of 8 bytes at byte 0 in C, mass_kg of 8 bytes at byte 0 in Python"),
        (narrow, "step_s of 8 bytes at byte 0 in C, step_s of 4 bytes at byte 0 in Python"),
        (fields[:-1], "Model of 240 bytes at byte 0 in C, Model of 232 bytes at byte 0 in Python"),
    ):
        copy = KernelLibrary(path)
        copy.structure("Model")(type("Wrong", (ctypes.Structure,), {"_fields_": members}))
        with pytest.raises(ImportError, match=f"structure Model of C and Wrong.*: {said}"):
            _ = copy.library
    with pytest.raises(ImportError, match="structure Model"):
        nmpc_native.LIBRARY.structure("Model")(type("Late", (ctypes.Structure,), {"_fields_": []}))
    nmpc_native.LIBRARY.structure("Model")(kernels.Model)
    with pytest.raises(ImportError, match=r"no LAYOUT\(Unknown, ...\)"):
        nmpc_native.LIBRARY.structure("Unknown")(kernels.Model)


def test_every_structure_is_compared_with_c() -> None:
    """No ctypes structure of the sources is left out, except the one that describes the others."""
    for _, path in MODULES:
        for before, line in itertools.pairwise(path.read_text().splitlines()):
            if re.match(r"class \w+\((ctypes\.)?Structure\)", line):
                assert before.startswith("@LIBRARY.structure(") or "_Member" in line, path


@pytest.mark.parametrize("folder", NATIVE_FOLDERS)
def test_a_library_needs_no_other(folder: str) -> None:
    """Neither a C library nor any other: so one file serves every Linux of its processor."""
    content = (ROOT / folder / LIBRARY_NAME).read_bytes()
    assert not any(name in content for name in (b"libc.so", b"libm.so", b"GLIBC_"))


def test_rows_between_chasers_far_apart_are_left_out_only_where_none_is_reached() -> None:
    """The quick test for a pair finds what the whole one finds: with a reach just above and just
    below the room.
    """
    states = np.array([at_rest(np.array([-2.0, 2.0, 0.0])), at_rest(np.array([2.0, 2.0, 0.0]))])
    problem = fixed_problem(states, states[:, :3], d_target=0.0)
    frame = make_solver("rti", PARAMS, 2)._frame  # pyright: ignore[reportAttributeAccessIssue]
    task = frame.begin(problem, 0.0, None)
    x = frame.rolled(task, task.start)
    room_m = 0.5 * (4.0 - 0.35 - 5e-3)
    for reach_m, rows in ((room_m - 1e-6, 0), (room_m + 1e-6, 30)):
        found = build_rows(task.problem, PARAMS, x, np.full((2, 31), reach_m))
        assert list(found.n_rows) == [rows, rows]


def test_working_memory_is_enough() -> None:
    """No kernel writes beyond its output, with the largest number of rows."""
    n, d = 3, PARAMS.stages
    sizes = (ctypes.c_int64(value) for value in (n, d, 2))
    doubles = nmpc_native.function("tick_workspace", ctypes.c_int64)(*sizes)
    guarded = np.full(doubles + 64, 7.0)
    rng = np.random.default_rng(1)
    states = np.array([at_rest(0.3 * rng.normal(size=3)) for _ in range(n)])
    corridors = np.tile([1.0, 0, 0, 0.5, 0.0], (n, d + 1, 1))
    boxes = np.tile(box_table((Box((0.2, 0.2, 0.2)), Box((0.1, 0.1, 0.1)))), (d + 1, 1, 1))
    shapes = {"boxes": boxes, "box_clearance_m": np.full(n, 0.3)}
    problem = NmpcInput(
        **{**vars(fixed_problem(states, -states[:, :3])), "corridors": corridors, **shapes}
    )
    solver = make_solver("rti", PARAMS, n)
    assert isinstance(solver, RtiSolver)
    solver._workspace, solver._extra = guarded, 2  # pyright: ignore[reportPrivateUsage]
    plan = solver.solve(problem, 0.0)
    assert plan.iterations.all()
    assert (guarded[doubles:] == 7.0).all()
    assert (guarded[:doubles] != 7.0).mean() > 0.5


def test_solvers_in_two_threads_plan_as_in_one() -> None:
    """Every tick of two flights at once, from different states, has the bits of the flight
    alone.
    """
    problem_at, states = swap()

    def flown(offset_m: float) -> list[Array]:
        solver, inputs = make_solver("rti", PARAMS, 2), []
        for tick in range(60):
            moved = states.copy()
            moved[:, 1] += offset_m + 1e-3 * tick
            inputs.append(solver.solve(problem_at(moved, 0.1 * tick), 0.1 if tick else 0.0).inputs)
        return inputs

    offsets = (0.0, 0.07)
    alone = [flown(offset_m) for offset_m in offsets]
    with ThreadPoolExecutor(2) as threads:
        together = list(threads.map(flown, offsets))
    np.testing.assert_array_equal(together, alone)


@pytest.mark.parametrize("folder", NATIVE_FOLDERS)
def test_kernels_have_no_static_memory(folder: str) -> None:
    """Static variables would be shared by threads; static constants and functions are not
    variables.
    """
    sources = [path for pattern in ("*.c", "*.h") for path in sorted((ROOT / folder).glob(pattern))]
    assert sources
    for path in sources:
        for declaration in re.findall(
            r"^[^/\n]*\bstatic\b[^;{=(]*[;{=(]", path.read_text(), re.MULTILINE
        ):
            assert declaration.endswith("(") or " const " in declaration, (
                f"{path.name}: {declaration}"
            )
