# SPDX-License-Identifier: Apache-2.0
"""Estimate the pose of the target from an image; entry point of the perception by markers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.targets import TargetModel
from chaserdock_protocol.pose_image import UnusableImage
from numpy.typing import ArrayLike, NDArray

from . import baseline as paper
from . import corners, detect, pattern, pnp
from .corners import CornerErrors
from .pattern import ENOUGH
from .pnp import FurtherMarkers, TargetPose
from .reading import PLACE_CELLS, CellReader
from .refine import PoseInCamera

Method = Literal["default", "paper", "paper_iterative"]


@dataclass(frozen=True, eq=False)
class GeometryInformation:
    """Information of one image about the k errors of the geometry, in their standard deviations.

    ``matrix`` (k, k) and ``vector`` (k,), matrix times estimate: for an unknown pose; empty for an
    image without a new view. ``position_m`` (3,), IRF: of the target if its geometry has no errors.
    ``position_by_errors`` (3, k): derivative of that by the errors. ``position_covariance`` (3, 3),
    m²: for known errors.
    """

    matrix: Array
    vector: Array
    position_m: Array
    position_by_errors: Array
    position_covariance: Array


@dataclass(frozen=True)
class PerceptionResult:
    """Result for one image.

    ``solutions``: best first; empty without a trustworthy pose, two if the tilt of coplanar markers
    is ambiguous. ``marker_ids`` (n,) and ``corners_px`` (n, 4, 2), distorted image: of the used
    markers. ``rejected_ids``: detected but not used, ascending: not on this target, duplicate,
    inconsistent with the others, or with an unusable side. ``geometry``: what the image tells about
    the errors of a known shape, if the perception estimates them. ``acquiring``: whether work on an
    earlier image goes on.
    """

    solutions: tuple[TargetPose, ...]
    marker_ids: NDArray[np.int64]
    corners_px: Array
    rejected_ids: tuple[int, ...]
    geometry: GeometryInformation | None = None
    acquiring: bool = False


_INNER_PX = (3.5, 7.0, 10.5)
"""Distances inside a marker's side, px, of a contour that a threshold window finds there: half a
window, of up to 23 px, in steps that the fit of sides reaches."""
_FAR_MOVE_PX, _SETTLED_MOVE_PX = 1.0, 0.3
"""Corrections, px, of the corners that a prediction gives: above the first the fit is repeated from
its result, and above the second that repetition is not trusted. A single fit from further away
takes an inner cell's edge for a side in 1 of 100 images; one that is repeated never did."""
_LEAST_SIDE_PX = 14.0
"""Side, px, of markers that are read where a prediction puts them: two a cell. A search finds those
as well: a prediction saves time, and does not extend the range."""
_NO_COARSE = np.zeros(0, dtype=np.intp), np.zeros((0, 4, 2)), CornerErrors.even(np.zeros(0))
_NO_FURTHER = FurtherMarkers(*_NO_COARSE, range(0))


def _largest_move_px(refined: corners.Refined, start_px: Array) -> Array:
    """Return by how much a refinement moved the corners (n, 4, 2) of each marker at most."""
    return np.abs(refined.corners_px - start_px).max(axis=(1, 2))


class _Further:
    """Markers to be added to a pose: ``coarse`` detections, whose sides cannot be fitted, with row,
    corners (ideal px) and their errors, and missed ones that are read by their cells.
    """

    def __init__(
        self,
        perception: Perception,
        image: NDArray[np.uint8],
        coarse: tuple[NDArray[np.intp], Array, CornerErrors],
    ) -> None:
        self._perception, self._image, self._coarse = perception, image, coarse
        self._rows, self._px, _ = _NO_COARSE

    def markers(
        self, pose: PoseInCamera, used: NDArray[np.intp], reach: int
    ) -> tuple[int, FurtherMarkers]:
        """Return the number of markers returned before, and those that the image shows beside the
        ``used`` rows at a pose, up to ``reach`` half cells away.
        """
        by = self._perception
        read = by.reader.read(self._image, by.camera, pose, used, reach)
        rows, (coarse, px, errors) = read.rows, self._coarse
        if not (len(rows) or len(read.faint) or len(coarse)):
            return len(self._rows), _NO_FURTHER
        new = ~np.isin(coarse, used)
        coarse, px, errors = coarse[new], px[new], errors.part(new)
        if len(rows):
            refined = by.refined(self._image, read.corners_px[rows], rows, len(used))
            rows = rows[refined.good]
            left = ~np.isin(coarse, rows)  # a fitted marker replaces a coarse one
            fitted = refined.part(refined.good)
            coarse = np.concatenate([rows, coarse[left]])
            px = np.concatenate([fitted.corners_px, px[left]])
            errors = fitted.errors.followed_by(errors.part(left))
        if len(read.faint):
            fitted = by.patterns(self._image, read.corners_px[read.faint], read.faint)
            new = fitted.good & ~np.isin(read.faint, coarse)
            coarse = np.concatenate([coarse, read.faint[new]])
            px = np.concatenate([px, fitted.corners_px[new]])
            errors = errors.followed_by(fitted.errors.part(new))
        before, count = len(self._rows), len(coarse)
        if reach:
            at = read.corners_px[read.rows]
            coarse, px = np.concatenate([coarse, read.rows]), np.concatenate([px, at])
            cell_px = corners.mean_side_px(at) / by.reader.cells
            errors = errors.followed_by(CornerErrors.of_places(PLACE_CELLS * cell_px))
        self._rows = np.concatenate([self._rows, coarse])
        self._px = np.concatenate([self._px, px])
        return before, FurtherMarkers(coarse, px, errors, range(count, len(coarse)))

    def after(self, rows: NDArray[np.intp], px: Array) -> tuple[NDArray[np.intp], Array]:
        """Return rows and corners of detections, followed by those of `markers`."""
        if not len(self._rows):
            return rows, px
        return np.concatenate([rows, self._rows]), np.concatenate([px, self._px])


class Perception:
    """Estimates the pose of one target model in the images of one camera.

    Stateless: `estimate` depends on its arguments only. ``method``: "default", or for the paper's
    baseline "paper" (EPnP) or "paper_iterative". Raises ValueError for another method, or for an
    unknown marker dictionary.
    """

    def __init__(self, camera: Camera, model: TargetModel, method: Method = "default") -> None:
        if method not in get_args(Method):
            raise ValueError(
                f"unknown perception method {method!r}; known: {', '.join(get_args(Method))}"
            )
        self.camera = camera
        self.model = model
        self.method: Method = method
        self._dictionary = detect.dictionary_of(model.dictionary)
        self.table = pnp.MarkerTable.of(model)
        # Targets with many markers per face do not need the small ones that are lost at half size.
        self._enough = ENOUGH if len(model.markers) >= 6 * ENOUGH else None
        self._rows = {int(i): row for row, i in enumerate(self.table.ids)}
        self.reader = CellReader(self.table, self._dictionary)

    def estimate(
        self, image: NDArray[np.uint8], predicted: tuple[ArrayLike, ArrayLike] | None = None
    ) -> PerceptionResult:
        """Estimate the target's pose in a grey image (h, w), uint8.

        ``predicted``: position in IRF (3,), metres, and rotation TRF to IRF (4,), if known. Markers
        are read where it puts them; if none is there, its region is searched, then the whole
        image. Corners are fitted to the image in each case. Raises ValueError for an image of
        another shape or type than the camera's.
        """
        shape = (self.camera.height_px, self.camera.width_px)
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.shape != shape:
            got = (
                f"{image.dtype} {image.shape}"
                if isinstance(image, np.ndarray)
                else type(image).__name__
            )
            raise UnusableImage(f"expected a uint8 image of {shape}, got {got}")
        image = np.ascontiguousarray(image)
        if self.method != "default":
            return self._estimate_paper(image)

        if predicted is not None:
            sighting = self._estimate_at(image, *predicted)
            if sighting.solutions:
                return sighting
            region = detect.region_of(self.camera, self.model, *predicted)
            sighting = sighting if region is None else self._estimate_in(image, region)
            if sighting.solutions:
                return sighting

        sighting = self._estimate_in(image, None)
        rejected = sighting.rejected_ids
        if sighting.solutions or len(set(rejected)) < len(
            rejected
        ):  # solved, or ambiguous by duplicates, which a thorough search cannot resolve
            return sighting
        again = self._estimate_in(image, None, thorough=True)
        return again if again.solutions else sighting

    def _estimate_at(
        self, image: NDArray[np.uint8], position_m: ArrayLike, q_wxyz: ArrayLike
    ) -> PerceptionResult:
        """Return what markers show that are read where a predicted pose puts them, and others that
        their pose shows; no solution if none is there.
        """
        nothing = PerceptionResult((), np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), ())
        position, q = np.asarray(position_m, dtype=float), np.asarray(q_wxyz, dtype=float)
        if not (np.isfinite(position).all() and np.isfinite(q).all()):
            return nothing
        pose = PoseInCamera(position, rotations.to_matrix(q))
        read = self.reader.read(image, self.camera, pose, _NO_COARSE[0])
        rows, px = read.rows, read.corners_px[read.rows]
        large = corners.mean_side_px(px) >= _LEAST_SIDE_PX
        rows, px = rows[large], px[large]
        refined = self.refined(image, px, rows)
        far = refined.good & (_largest_move_px(refined, px) > _FAR_MOVE_PX)
        if far.any():
            again = self.refined(image, refined.corners_px[far], rows[far])
            settled = again.good & (
                _largest_move_px(again, refined.corners_px[far]) <= _SETTLED_MOVE_PX
            )
            refined = refined.with_others(far, replace(again, good=settled))
        rows, refined = rows[refined.good], refined.part(refined.good)
        return self._solved(image, self.table.ids[rows], rows, refined, _NO_COARSE)

    def _estimate_in(
        self, image: NDArray[np.uint8], region: detect.Region | None, thorough: bool = False
    ) -> PerceptionResult:
        found = detect.detect(image, self._dictionary, region, thorough, self._enough)
        rows = np.array([self._rows.get(i, -1) for i in found.ids.tolist()], dtype=np.intp)
        known = rows >= 0
        px, rows = self.camera.undistort(found.corners_px[known]), rows[known]
        imaged = np.isfinite(px).all(axis=(1, 2))
        px, rows = px[imaged], rows[imaged]
        refined = self.refined(image, px, rows)
        coarse = _NO_COARSE
        if not refined.good.all():
            # The detector may have mistaken the outer edge of the white border for that of the
            # marker, or the inner edge of what a threshold window leaves of its black border.
            side_px = corners.mean_side_px(px)
            shares = [self.table.margin_share[rows]]
            shares += [-d / (side_px + 2.0 * d) for d in (_INNER_PX if thorough else ())]
            for share in shares:
                lost = ~refined.good
                shifted = corners.inside_border(px[lost], share[lost])
                refined = refined.with_others(lost, self.refined(image, shifted, rows[lost]))
            lost = ~refined.good
            errors = CornerErrors.even(corners.coarse_sigma_px(self.camera, px[lost]))
            coarse = rows[lost], px[lost], errors
            refined, rows = refined.part(refined.good), rows[refined.good]
        return self._solved(image, found.ids, rows, refined, coarse, thorough)

    def _solved(
        self,
        image: NDArray[np.uint8],
        ids: NDArray[np.int64],
        rows: NDArray[np.intp],
        refined: corners.Refined,
        coarse: tuple[NDArray[np.intp], Array, CornerErrors],
        thorough: bool = False,
    ) -> PerceptionResult:
        """Return the sighting of markers ``rows`` with refined corners, and of ``coarse`` ones.

        ``ids``: all that were found.
        """
        px, errors = refined.corners_px, refined.errors
        further = _Further(self, image, coarse)
        solutions, used = pnp.solve(self.camera, self.table, rows, px, errors, further.markers)
        if not solutions and thorough and len(coarse[0]):
            rows, px = np.concatenate([rows, coarse[0]]), np.concatenate([px, coarse[1]])
            errors = errors.followed_by(coarse[2])
            further = _Further(self, image, _NO_COARSE)
            solutions, used = pnp.solve(self.camera, self.table, rows, px, errors, further.markers)
        rows, px = further.after(rows, px)
        return self._sighting(ids, solutions, self.table.ids[rows[used]], px[used])

    def refined(
        self, image: NDArray[np.uint8], px: Array, rows: NDArray[np.intp], known: int = 0
    ) -> corners.Refined:
        """Return the corners of markers, refined by all cells of small ones, by the sides of
        others; ``px`` (n, 4, 2), ideal: where they are to about two pixels.
        """
        margin, outlined = self.table.margin_share[rows], self.table.outlined[rows]
        refined = corners.refine(image, self.camera, px, self.reader.cells, margin, outlined)
        which = pattern.which_to_fit(self.camera, px, self.reader.cells, known)
        for start in (refined.corners_px, px):  # by sides, and as they were found
            if not len(which):
                break
            fitted = self.patterns(image, start[which], rows[which])
            refined = refined.with_others(which, fitted)
            which = which[~fitted.good]
        return refined

    def patterns(
        self, image: NDArray[np.uint8], px: Array, rows: NDArray[np.intp]
    ) -> corners.Refined:
        """Return the corners of small markers by all their cells; ``px`` as for `refined`."""
        white, margin = self.reader.white[rows], self.table.margin_share[rows]
        return pattern.fit(image, self.camera, px, white, margin, self.table.outlined[rows])

    def _estimate_paper(self, image: NDArray[np.uint8]) -> PerceptionResult:
        found = paper.detect(image, self.camera, self._dictionary)
        ids, counts = np.unique(found.ids, return_counts=True)
        once = set(ids[counts == 1].tolist()) & self._rows.keys()
        kept = np.array([int(i) in once for i in found.ids], dtype=bool)
        ids, px = found.ids[kept], found.corners_px[kept]
        rows = np.array([self._rows[int(i)] for i in ids], dtype=np.intp)
        solutions = paper.solve(
            self.camera, self.table.corners[rows], px, iterative=self.method != "paper"
        )
        if not solutions:
            ids, px = ids[:0], px[:0]
        return self._sighting(found.ids, solutions, ids, px)

    def _sighting(
        self,
        found_ids: NDArray[np.int64],
        solutions: tuple[TargetPose, ...],
        ids: NDArray[np.int64],
        ideal_px: Array,
    ) -> PerceptionResult:
        rejected = found_ids.tolist()
        for i in ids.tolist():
            if i in rejected:  # it may have been found by its cells only
                rejected.remove(i)
        return PerceptionResult(
            solutions, ids, self.camera.distort(ideal_px), tuple(sorted(rejected))
        )
