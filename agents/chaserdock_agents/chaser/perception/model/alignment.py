# SPDX-License-Identifier: Apache-2.0
"""Align a synthetic view of the tracker mesh with an image: pose, covariance and share of inliers.

Control points are gradient maxima of the synthetic view. Their profiles are found in the image by
signed correlation and give the pose by robust least squares (native/align.c).
"""

from __future__ import annotations

import math
from ctypes import Structure, byref, c_double, c_int64
from dataclasses import dataclass, replace

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.native import address
from numpy.typing import NDArray

from ..lens import NativeLens, native_lens
from ..native import LIBRARY, function
from ..pipeline import GeometryInformation
from ..refine import PoseInCamera
from .mesh import NO_PATTERN, WRINKLES, TrackerMesh
from .rendering import Lighting, PixelWindow, SyntheticView, pose_array, render


@LIBRARY.structure("LevelCamera")
class _LevelCamera(Structure):
    """`LevelCamera` of native/align.c."""

    _fields_ = [
        ("fx", c_double), ("fy", c_double), ("cx", c_double), ("cy", c_double),
        ("height", c_double), ("width", c_double), ("lens", NativeLens),
    ]  # fmt: skip


@dataclass(frozen=True)
class AlignmentParameters:
    """Parameters of the alignment of control points, tuned by benchmarks/perception.py (``shape``).

    The median error of twelve views at 0.9 to 4 m, from a prior 1 % and 1.5 degrees off, is 0.106 %
    of the range with these. Comments state the error at half and at twice a value.
    """

    # Samples of a profile: PROFILE in native/align.c.
    profile: int = 9
    # Capacity for the control points of a cell: PER_CELL_MOST in native/align.c.
    per_cell_most: int = 4
    # Side of the cells over which control points are spread, px: about a profile. Half: 0.109;
    # twice: 0.106 %.
    cell_px: int = 8
    # Most control points that a cell keeps: two, so that two edges in it count. Half: 0.133; twice:
    # 0.102 %.
    per_cell: int = 2
    # Least gradient of control points, grey levels per pixel, in even light and in estimated light.
    # In a dim image, noise hides weaker edges, which would count as outliers.
    least_gradient: tuple[float, float] = (0.5, 1.5)
    # Border of a window around the target, px: the largest search and half a profile.
    margin_px: int = 14
    # Least correlation of a profile with the image. Half: 0.107 %.
    min_correlation: float = 0.6
    # Standard deviation of a grey level by noise, and by texture that the mesh does not have.
    noise: float = 2.0
    # ``INLIER_PX`` while errors of the geometry are not estimated yet, as these displace points by
    # pixels. Half: 0.106 %; twice: the same.
    displaced_inlier_px: float = 5.0
    # Reach of the search once they are estimated, px: twice ``INLIER_PX``. A third: 0.101; twice:
    # 0.103 %.
    refined_reach_px: int = 3
    # Distance from an edge, px, at which the surfaces beside it are looked up.
    beside_px: float = 3.0
    # Number of neighbouring control points whose errors are equal, so that their information counts
    # once. Fitted to the errors of poses (NEES, docs/evidence/markerless.md).
    correlated_points: float = 5.5
    # Most control points that count as independent: shading and facets that the mesh does not have
    # do not become more accurate with more pixels.
    independent_most: float = 60.0
    # The same on a side in the shade, or with the sun behind the target, where it brightens rims,
    # which are displaced together.
    independent_dim: float = 25.0
    # Least z in IRF of the direction to a sun that counts as behind the target.
    behind_z: float = 0.3


_MATCH = AlignmentParameters()

INLIER_PX = 1.5
"""Largest distance (px of the level) of a match from the pose at which it counts: Tukey's cut-off.

Half the width of an edge with its spread. Of twelve views half loses two; twice errs by 0.120
instead of 0.106 % of the range.
"""
MIN_POINTS = 24
"""Least number of control points, of those in the image, and of those that count: four for each
unknown of a pose. Half and twice: the same poses.
"""
NEAR_PX = 1300.0
"""Diameter of the target in the image, in pixels of level 0, beyond which it shows texture that the
mesh does not have.
"""
_SPREAD_PX = {0: 0.6, 1: 0.45, -1: 1.2}
"""Point spread of the synthetic view by level: standard deviation in pixels of the level."""


class Pyramid:
    """Levels of one image (h, w), uint8, which are made when first used.

    Level k has 2**-k times as many pixels along each axis.
    """

    def __init__(self, image: NDArray[np.uint8], camera: Camera) -> None:
        self.camera = camera
        self._levels: dict[int, NDArray[np.float32]] = {0: image.astype(np.float32)}

    def level(self, k: int) -> NDArray[np.float32]:
        """Return the float image of level ``k``, -1 or more."""
        if k not in self._levels:
            if k < 0:
                finer = self.level(k + 1)
                size = (2 * finer.shape[1], 2 * finer.shape[0])
                made = cv2.resize(finer, size, interpolation=cv2.INTER_CUBIC)
            else:
                finer = self.level(k - 1)
                # The centres of pixels stay in place only for even sizes.
                finer = finer[: finer.shape[0] // 2 * 2, : finer.shape[1] // 2 * 2]
                made = cv2.resize(
                    finer, (finer.shape[1] // 2, finer.shape[0] // 2), interpolation=cv2.INTER_AREA
                )
            self._levels[k] = np.ascontiguousarray(made, dtype=np.float32)
        return self._levels[k]

    def lens(self, k: int) -> tuple[float, float, float, float]:
        """Return the lens of level ``k``: fx, fy, cx, cy, px."""
        c, scale = self.camera, 0.5**k
        return (
            c.fx_px * scale,
            c.fy_px * scale,
            (c.cx_px + 0.5) * scale - 0.5,
            (c.cy_px + 0.5) * scale - 0.5,
        )


@dataclass(frozen=True)
class ControlPoints:
    """n control points of a rendering.

    ``points_m`` (n, 3): in TRF. ``ahead_m`` (n, 3): a pixel further along the gradient, in TRF.
    ``profiles`` (n, 9): grey levels. ``owners`` (n,): triangles. ``level``, ``pose``: of the
    rendering. ``displaced_m`` (k, n, 3): displacement by each mode of the mesh. ``border_m`` (n,):
    standard deviation of where a point is seen. ``independent``: most of them that count as
    independent.
    """

    points_m: Array
    ahead_m: Array
    profiles: Array
    owners: NDArray[np.int64]
    level: int
    pose: PoseInCamera
    displaced_m: Array
    border_m: Array
    independent: float = _MATCH.independent_most


@dataclass(frozen=True)
class Alignment:
    """Pose of the target aligned with an image.

    ``inlier_share``: of the points in the image. ``correlation``: mean of the points in the image,
    -1 to 1. ``rms_px``: residual of the inliers, pixels of level 0. ``covariance`` (6, 6): as in
    `TargetPose`. ``modes`` (k,): estimated errors of the geometry in standard deviations.
    ``geometry``: what the image alone tells about them.
    """

    pose: PoseInCamera
    inlier_share: float
    correlation: float
    rms_px: float
    covariance: Array
    points: ControlPoints
    modes: Array
    geometry: GeometryInformation

    @property
    def score(self) -> float:
        """How well the synthetic view explains the image, 0 to 1."""
        return self.inlier_share * max(self.correlation, 0.0)


def diameter_px(camera: Camera, mesh: TrackerMesh, pose: PoseInCamera) -> float:
    """Return the diameter of the target in the image, px of level 0."""
    return 2.0 * mesh.radius_m * camera.fx_px / float(np.linalg.norm(pose.position))


def window_of(
    pyramid: Pyramid, k: int, mesh: TrackerMesh, pose: PoseInCamera
) -> tuple[PixelWindow, int, int] | None:
    """Return the window of level ``k`` that the target can touch, and its first column and row.

    None if the target is out of view.
    """
    at = mesh.vertices_m @ pose.rotation.T + pose.position
    at = at[at[:, 2] > 0.05]
    if not len(at):
        return None
    fx, fy, cx, cy = pyramid.lens(k)
    scale = 0.5**k
    height, width = int(pyramid.camera.height_px * scale), int(pyramid.camera.width_px * scale)
    u, v = fx * at[:, 0] / at[:, 2] + cx, fy * at[:, 1] / at[:, 2] + cy
    left, right = (
        max(0, math.floor(u.min()) - _MATCH.margin_px),
        min(width, math.ceil(u.max()) + _MATCH.margin_px),
    )
    top, bottom = (
        max(0, math.floor(v.min()) - _MATCH.margin_px),
        min(height, math.ceil(v.max()) + _MATCH.margin_px),
    )
    if right - left < 3 * _MATCH.profile or bottom - top < 3 * _MATCH.profile:
        return None
    return PixelWindow(bottom - top, right - left, (fx, fy, cx - left, cy - top)), left, top


def area_px(pyramid: Pyramid, k: int, mesh: TrackerMesh, pose: PoseInCamera) -> float:
    """Return the area, px, of the target's window of level ``k``; 0 if the target is out of
    view.
    """
    found = window_of(pyramid, k, mesh, pose)
    return float(found[0].height * found[0].width) if found else 0.0


def control_points(
    pyramid: Pyramid, k: int, mesh: TrackerMesh, pose: PoseInCamera, light: Lighting
) -> ControlPoints | None:
    """Render level ``k`` at ``pose`` and return its control points; None if there are too few."""
    found = window_of(pyramid, k, mesh, pose)
    if found is None:
        return None
    window, left, top = found
    synthetic = render(mesh, pose, window, light)
    patch = image_window(pyramid, k, window, left, top)
    view, gain = in_grey_levels(synthetic, patch)

    spread = _SPREAD_PX.get(k, 0.4)
    view = np.asarray(cv2.GaussianBlur(view, (0, 0), spread), dtype=np.float32)
    h, w = view.shape
    cells = (-(-h // _MATCH.cell_px)) * (-(-w // _MATCH.cell_px))
    most = cells * _MATCH.per_cell
    points, ahead = np.empty((most, 3)), np.empty((most, 3))
    profiles, owners = np.empty((most, _MATCH.profile)), np.empty(most, dtype=np.int64)
    work = np.empty(h * w + cells * 5 * _MATCH.per_cell_most)

    vertices, triangles, _, _ = mesh.contiguous
    at = pose_array(pose)
    least = _MATCH.least_gradient[light.shadows]
    brightness = light.ambient + (0.0 if light.weak else light.direct)
    n = function("control_points", c_int64)(
        address(view), address(synthetic.nearest), address(synthetic.owner), c_int64(h), c_int64(w),
        (c_double * 4)(*window.lens), address(at), address(vertices), address(triangles),
        (c_double * 3)(
            _MATCH.cell_px, _MATCH.per_cell, min(max(0.02 * gain * brightness, least), 4.0)
        ),
        address(points), address(ahead), address(profiles), address(owners), address(work),
    )  # fmt: skip

    if n < MIN_POINTS:
        return None
    points, owners = points[:n].copy(), owners[:n].copy()
    near = diameter_px(pyramid.camera, mesh, pose) > NEAR_PX
    used = ~_on_textured(mesh, pose, window, synthetic, points, ahead[:n], near)
    if used.sum() < MIN_POINTS:
        return None
    points, owners = points[used], owners[used]

    displaced, border = mesh.mode_displacements(owners, points), mesh.border_of(owners)
    behind = light.to_sun_irf is not None and light.to_sun_irf[2] > _MATCH.behind_z
    dim = behind or light.weak or (light.shadows and light.direct == 0.0)
    independent = _MATCH.independent_dim if dim else _MATCH.independent_most
    return ControlPoints(
        points, ahead[:n][used], profiles[:n][used], owners, k, pose, displaced, border, independent
    )


def _on_textured(
    mesh: TrackerMesh,
    pose: PoseInCamera,
    window: PixelWindow,
    view: SyntheticView,
    points: Array,
    ahead: Array,
    near: bool,
) -> NDArray[np.bool_]:
    """Return which points (n,) are edges between surfaces with the same pattern, which displaces
    them.

    Beside such an edge, lines of a grid of solar cells move it to either side; on a ``near`` target
    also wrinkles of foil, on which shadows bend.
    """
    # From farther away, shadows on foil give more information than their bends cost.
    patterns = (
        mesh.patterns if near else np.where(mesh.patterns == WRINKLES, NO_PATTERN, mesh.patterns)
    )
    if not patterns.any():
        return np.zeros(len(points), dtype=bool)
    fx, fy, cx, cy = window.lens
    at, next_to = (p @ pose.rotation.T + pose.position for p in (points, ahead))
    px = at[:, :2] / at[:, 2:] * (fx, fy) + (cx, cy)
    step = next_to[:, :2] / next_to[:, 2:] * (fx, fy) + (cx, cy) - px
    last = np.array([window.width - 1, window.height - 1])
    beside = []
    for side in (-_MATCH.beside_px, _MATCH.beside_px):
        column, row = np.clip(np.rint(px + side * step).astype(np.int64), 0, last).T
        owner = view.owner[row, column]
        beside.append(np.where(owner >= 0, patterns[owner], NO_PATTERN))
    return (beside[0] == beside[1]) & (beside[0] != NO_PATTERN)


def image_window(
    pyramid: Pyramid, k: int, window: PixelWindow, left: int, top: int
) -> NDArray[np.float32]:
    """Return the image of level ``k`` on the grid of a window of ideal pixels."""
    image = pyramid.level(k)
    if not pyramid.camera.distorts:
        return image[top : top + window.height, left : left + window.width]
    # The distortion is smooth: map every eighth pixel only, and interpolate between them.
    rows, columns = -(-window.height // 8) + 1, -(-window.width // 8) + 1
    scale = 2.0**k
    v, u = np.mgrid[0:rows, 0:columns] * 8.0
    ideal = (np.stack([u + left, v + top], axis=-1) + 0.5) * scale - 0.5
    px = (pyramid.camera.distort(ideal) + 0.5) / scale - 0.5
    # Linear interpolation: corners of the coarse grid lie on pixels.
    to_coarse = np.array([[0.125, 0.0, 0.0], [0.0, 0.125, 0.0]])
    maps = cv2.warpAffine(
        px.astype(np.float32),
        to_coarse,
        (window.width, window.height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )
    return np.asarray(
        cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR), dtype=np.float32
    )


def in_grey_levels(
    view: SyntheticView, patch: NDArray[np.float32]
) -> tuple[NDArray[np.float32], float]:
    """Return a synthetic view (h, w) in grey levels of the image, on its background, and its gain.

    ``patch`` (h, w): the image. The gain is the ratio of the means within the target. The
    background is a local mean of the image outside of the target and a border, so that it follows
    the Earth without taking over edges of the target.
    """
    inside = view.coverage > 0.99
    mean = float(view.grey[inside].mean()) if inside.any() else 0.0
    gain = float(patch[inside].mean()) / mean if mean > 1e-6 else 100.0
    small = (max(patch.shape[1] // 4, 1), max(patch.shape[0] // 4, 1))
    covered = cv2.resize(view.coverage, small, interpolation=cv2.INTER_AREA)
    outside = np.asarray(cv2.dilate(covered, np.ones((5, 5))) < 1e-3, dtype=np.float32)
    values = cv2.resize(patch, small, interpolation=cv2.INTER_AREA) * outside
    background = np.zeros_like(values)
    missing = np.ones_like(values)
    for side in (9, 33, 129):
        share = cv2.blur(outside, (side, side), borderType=cv2.BORDER_CONSTANT)
        local = cv2.blur(values, (side, side), borderType=cv2.BORDER_CONSTANT)
        use = np.minimum(share / 0.05, 1.0) * missing
        background += use * local / np.maximum(share, 1e-6)
        missing -= use
    background = cv2.resize(
        background, (patch.shape[1], patch.shape[0]), interpolation=cv2.INTER_LINEAR
    )
    return np.asarray(gain * view.grey + (1.0 - view.coverage) * background, dtype=np.float32), gain


def align(
    pyramid: Pyramid,
    points: ControlPoints,
    prior: PoseInCamera,
    reach_px: int,
    modes: Array | None = None,
    iterations: int = 6,
) -> Alignment | None:
    """Align control points with an image; None if that fails.

    Searches within ``reach_px`` pixels of their level around ``prior``. ``modes`` (k,): errors of
    the geometry as far as they are known. They are estimated with the pose: points that they
    displace by more than the width of an edge would be outliers otherwise.
    """
    k = len(points.displaced_m)
    known = np.zeros(k) if modes is None or len(modes) != k else modes
    if not k:
        found = _match(pyramid, points, known, prior, reach_px, iterations, INLIER_PX)
        return found and _alignment(pyramid, points, known, found)
    found = _match(pyramid, points, known, prior, reach_px, iterations, _MATCH.displaced_inlier_px)
    solved = found and _alignment(pyramid, points, known, found)
    if not solved:
        return None
    found = _match(
        pyramid, points, solved.modes, solved.pose, _MATCH.refined_reach_px, 1, INLIER_PX
    )
    return found and _alignment(pyramid, points, solved.modes, found)


@dataclass(frozen=True)
class _Matches:
    """Matches of n points found by align_points (native/align.c).

    ``pose``; ``inside``: number of points in the image; ``residual``, ``weight``, ``correlation``
    (n,); ``rows`` (n, 6).
    """

    pose: PoseInCamera
    inside: int
    residual: Array
    weight: Array
    correlation: Array
    rows: Array


def _match(
    pyramid: Pyramid, points: ControlPoints, modes: Array, prior: PoseInCamera, reach_px: int,
    iterations: int, inlier_px: float
) -> _Matches | None:  # fmt: skip
    """Match the profiles of control points, displaced by ``modes``, and fit the pose.

    None with too few matches.
    """
    image = pyramid.level(points.level)
    n = len(points.points_m)
    camera = _LevelCamera(*pyramid.lens(points.level), *image.shape, native_lens(pyramid.camera))
    settings = (c_double * 5)(reach_px, iterations, _MATCH.min_correlation, _MATCH.noise, inlier_px)
    displacement = np.einsum("k,kni->ni", modes, points.displaced_m) if len(modes) else 0.0
    at, ahead = points.points_m + displacement, points.ahead_m + displacement
    pose, residual, weight = pose_array(prior), np.empty(n), np.empty(n)
    correlation, rows, work = np.empty(n), np.empty((n, 6)), np.empty(2 * n)
    inside = function("align_points", c_int64)(
        byref(camera), address(image), settings, address(at), address(ahead),
        address(points.profiles), address(points.border_m),
        c_int64(n), address(pose), address(residual), address(weight), address(correlation),
        address(rows), address(work),
    )  # fmt: skip
    if inside < MIN_POINTS or int((weight > 0.0).sum()) < MIN_POINTS:
        return None
    aligned = PoseInCamera(pose[:3], pose[3:].reshape(3, 3))
    return _Matches(aligned, int(inside), residual, weight, correlation, rows)


def _alignment(
    pyramid: Pyramid, points: ControlPoints, modes: Array, found: _Matches
) -> Alignment | None:
    """Estimate pose and errors of the geometry together from matches; None if not observable."""
    used = found.weight > 0.0
    residual, weight, moved = found.residual[used], found.weight[used], found.rows[used, 3:]
    pose = found.pose
    # By dtheta: a rotation phi in camera axes is R dtheta. By modes: a displacement in TRF moves a
    # point as the rotated displacement of the position in IRF does.
    jacobian = np.concatenate([moved, found.rows[used, :3] @ pose.rotation], axis=1)
    shifts = np.einsum("ni,kni->nk", moved @ pose.rotation, points.displaced_m[:, used])
    solved = _solve(_Fit(residual, weight, jacobian, shifts, points.independent), modes)
    if solved is None:
        return None
    step, covariance, geometry = solved
    geometry = replace(geometry, position_m=pose.position + geometry.position_m)
    if len(modes):
        turn = rotations.to_matrix(rotations.exp(step[3:6]))
        pose = PoseInCamera(pose.position + step[:3], pose.rotation @ turn)
    rms = math.sqrt(float(np.average(residual**2, weights=weight))) * 2.0**points.level
    seen = found.weight >= 0.0
    share, correlation = float(used.sum()) / found.inside, float(found.correlation[seen].mean())
    return Alignment(pose, share, correlation, rms, covariance, points, modes + step[6:], geometry)


@dataclass(frozen=True)
class _Fit:
    """Least-squares fit of m control points, linearized at a pose.

    ``residual`` (m,): pixels. ``weight`` (m,). ``jacobian`` (m, 6): derivative of the residual by
    position (IRF) and rotation (TRF). ``shifts`` (m, k): displacement of each point, pixels, by the
    k modes of the geometry. ``independent``: as in `ControlPoints`.
    """

    residual: Array
    weight: Array
    jacobian: Array
    shifts: Array
    independent: float


def _solve(fit: _Fit, modes: Array) -> tuple[Array, Array, GeometryInformation] | None:
    """Return the step (6 + k,), the pose's covariance (6, 6) and the information about the modes.

    The step is of pose and modes; None for a pose that is not observable. The errors of the
    geometry have standard deviation 1 as prior around 0; ``modes`` (k,) is where the fit is
    linearized. Control points near to each other err together, which divides their information.
    """
    rows = np.concatenate([fit.jacobian, fit.shifts], axis=1)
    chi_square = float(fit.residual**2 @ fit.weight) / max(len(fit.residual) - 6, 1)
    correlated = max(_MATCH.correlated_points, len(fit.residual) / fit.independent)
    weight = fit.weight / (correlated * max(chi_square, 1.0))
    information = rows.T @ (rows * weight[:, None])
    right = rows.T @ (weight * fit.residual)
    geometry = _without_pose(information, right, modes)
    information[6:, 6:] += np.eye(len(modes))
    right[6:] -= modes
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if not values[0] > 1e-10 * values[-1]:
        return None
    inverse = (vectors / values) @ vectors.T * np.outer(scale, scale)
    covariance = inverse[:6, :6]
    return inverse @ right, 0.5 * (covariance + covariance.T), geometry


def _without_pose(information: Array, right: Array, modes: Array) -> GeometryInformation:
    """Return what a fit tells about the modes whatever the pose: its Schur complement.

    ``information`` (6 + k, 6 + k), ``right`` (6 + k,): normal equations linearized at ``modes``
    (k,). Also states how the position depends on the modes, as a displacement from where the fit is
    linearized.
    """
    of_pose = np.asarray(np.linalg.pinv(information[:6, :6], hermitian=True), dtype=float)
    gain = information[6:, :6] @ of_pose
    matrix = information[6:, 6:] - gain @ information[:6, 6:]
    matrix = 0.5 * (matrix + matrix.T)
    moved, by_modes = (of_pose @ right[:6])[:3], -gain.T[:3]
    return GeometryInformation(
        matrix,
        right[6:] - gain @ right[:6] + matrix @ modes,
        moved - by_modes @ modes,
        by_modes,
        of_pose[:3, :3],
    )
