# SPDX-License-Identifier: Apache-2.0
"""3-D scene, drawn with viser: bodies, estimate, plans, corridors, keep-out sphere, camera
frustums.
"""

from __future__ import annotations

import math
from typing import Any, Literal, cast, get_args

import numpy as np
import trimesh
import viser
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import LandmarkMap
from chaserdock_protocol.scenario import FlightScenario, Scenario
from chaserdock_world.orbit import earth_disc, to_sun
from chaserdock_world.rendering.background import star_field

from chaserdock.analysis.dressed_bodies import chaser_body, target_body

from . import shapes
from .history import History
from .plots import COLOURS, ESTIMATE_COLOUR
from .snapshot import MissionState, Pose, pose_of

_IN_CORRIDOR = frozenset({"approach", "wait", "align", "final", "contact", "docked"})
"""Phases in which a chaser's corridor is drawn."""
ViewFrom = Literal["beside the target", "on the target", "the world"]
VIEWS: tuple[ViewFrom, ...] = get_args(ViewFrom)
"""Frames that can be fixed on the screen: world axes at the target's position; target frame; world
frame.
"""

TRAIL_S = 60.0
"""Time (s) of the path drawn behind each chaser. Larger: more of the manoeuvre, more crossing
lines.
"""
_VIEW_M = 0.1
"""Size (m) of the drawn camera frustum; for display only, half a chaser. Larger: frustums hide the
target.
"""
_FAINT = 0.55
"""Brightness of frustums and corridors. Larger: they draw the eye from bodies and paths."""
_REFERENCE_M, _REFERENCE_RAD = 0.02, math.radians(3.0)
"""Distance (m) and angle (rad) of a chaser from its reference from which the reference is drawn:
nearer ones lie inside the body.
"""
_LANDMARK_M = 0.008
"""Size (m) of a landmark. Larger: they hide each other; smaller: they are not seen from 5 m."""
_PORT_M = 0.15
"""Length (m) of the axis of a chosen port, half a chaser."""
_RING_RGB = (96, 104, 116)
"""Colour (0 to 255) of the rings: grey, darker than the faint lines of chasers. Brighter: they hide
paths.
"""
_STARS_M, _STARS_REACH = 100.0, 20.0
"""Least distance (m) of the stars, and over the size of the scene: far outside of it."""
_BESIDE_EARTH_RAD = 0.25
"""Angle (rad) of the first view from the edge of the Earth: half of half a picture. Larger: the
Earth leaves it; smaller: it fills it.
"""
_FIRST_VIEW = np.array([-0.55, -0.85, 0.55])
"""Direction from the target to the first view: from behind and above chaser 0."""
_Disc = tuple[tuple[float, float, float], float]
"""Direction towards the Earth, and its angular radius, rad."""
_IDENTITY = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def _faint(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    red, green, blue = (round(_FAINT * level) for level in colour)
    return red, green, blue


def _view_beside(axis: Array, radius_rad: float) -> Array:
    """Return the direction (3,) from the target to a first view that has the edge of the Earth in
    the picture. axis (3,): unit vector towards the Earth.
    """
    turns = np.arange(0.0, 2.0 * math.pi, math.pi / 8.0)
    views = [rotations.rotate(rotations.exp([0.0, 0.0, turn]), _FIRST_VIEW) for turn in turns]
    away_rad = [math.acos(-view @ axis / np.linalg.norm(view)) for view in views]
    return views[int(np.argmin(np.abs(np.array(away_rad) - radius_rad - _BESIDE_EARTH_RAD)))]


def _earth_disc(scenario: FlightScenario) -> _Disc | None:
    """Return the Earth's disc as images show it. A flight scenario knows it by its orbit only."""
    known = isinstance(scenario, Scenario) or scenario.orbit is not None
    return earth_disc(cast("Scenario", scenario)) if known else None


class SceneView:
    """Scene of one mission. The pose of the root node ``/scene`` keeps the chosen frame fixed."""

    def __init__(self, server: viser.ViserServer, scenario: FlightScenario) -> None:
        self._scenario = scenario
        self._scene = scene = server.scene
        scene.configure_default_lights(cast_shadow=False)
        self._root = scene.add_frame("/scene", show_axes=False)
        self._root_pose = _IDENTITY
        self._reach_m = max(math.hypot(*c.position_m) for c in scenario.chasers)
        stars_m = max(_STARS_M, _STARS_REACH * self._reach_m)
        first_view = self._add_space(_earth_disc(scenario), stars_m)
        near = first_view * [1.0, 1.0, 0.0]
        self._near = near / np.linalg.norm(near)
        self._add_scale()

        body = target_body(scenario)
        self._estimate = scene.add_frame("/scene/estimate", axes_length=0.15, axes_radius=0.002)
        if body.parts:
            self._target = self._body("/scene/target", shapes.mesh_of(body))
            size = scenario.target_model().size_m
            self._lines(
                "/scene/estimate/box", shapes.box_edges(size) * 1.02, _rgb(ESTIMATE_COLOUR), 2.0
            )
        else:  # of unknown shape, while it flies
            self._target = scene.add_frame("/scene/target", show_axes=False)
        self._map: LandmarkMap | None = None

        self._keep_out_m = scenario.limits.min_distance_target_m
        self._keep_out = self._lines(
            "/scene/estimate/keep_out", shapes.sphere(self._keep_out_m), (176, 118, 128), 1.0
        )
        self._keep_out.visible = False

        self._chasers: list[Any] = []
        self._numbers: list[Any] = []
        self._plans: list[Any] = []
        self._references: list[Any] = []
        self._trails: list[Any] = []
        self._corridors: dict[int, Any] = {}
        self._corridors_shown = True
        self._frustums: list[Any] = []

        camera = scenario.camera_model()
        for i in range(len(scenario.chasers)):
            colour = _rgb(COLOURS[i % len(COLOURS)])
            name = f"/scene/chaser_{i}"
            self._chasers.append(self._body(name, shapes.mesh_of(chaser_body(scenario, i))))
            self._numbers.append(self._label(f"/number_{i}", str(i)))

            self._frustums.append(
                scene.add_camera_frustum(
                    f"{name}/camera",
                    fov=2.0 * math.atan2(camera.height_px / 2.0, camera.fy_px),
                    aspect=camera.width_px / camera.height_px,
                    scale=_VIEW_M,
                    thickness=1.0,
                    thickness_units="screen",
                    color=_faint(colour),
                    wxyz=np.asarray(camera.q_crf_irf_wxyz),
                    position=np.asarray(camera.position_crf_m),
                    cast_shadow=False,
                )
            )

            self._plans.append(
                self._lines(f"/scene/plan_{i}", shapes.polyline(np.zeros((0, 3))), colour, 2.0)
            )
            self._references.append(
                scene.add_frame(
                    f"/scene/reference_{i}", axes_length=0.08, axes_radius=0.0025, visible=False
                )
            )

            trail = self._lines(
                f"/scene/estimate/trail_{i}", shapes.polyline(np.zeros((0, 3))), colour, 1.0
            )
            self._trails.append(trail)

            corridor = shapes.corridor_of(scenario, i)
            if corridor is not None:
                self._corridors[i] = self._lines(
                    f"/scene/estimate/corridor_{i}", corridor, _faint(colour), 1.0
                )

        self.view: ViewFrom = VIEWS[0]
        x, y, z = 2.0 * self._reach_m * first_view
        server.initial_camera.position = (x, y, z)
        server.initial_camera.look_at = (0.0, 0.0, 0.0)
        server.initial_camera.far = 10.0 * stars_m
        server.initial_camera.near = 1e-5 * server.initial_camera.far

    def _add_space(self, disc: _Disc | None, stars_m: float) -> Array:
        """Add the stars and the Earth of the simulated images, on black whatever the theme of the
        page. Return the direction (3,) from the target to the first view.
        """
        first_view = _FIRST_VIEW
        self._scene.set_background_image(np.zeros((2, 2, 3), np.uint8))
        directions, levels = star_field()
        if disc is not None:
            towards, radius_rad = disc
            axis = np.array(towards) / np.linalg.norm(towards)
            sun = np.array(to_sun(cast("Scenario", self._scenario)))
            self._body("/scene/earth", shapes.earth(axis, radius_rad, sun, self._reach_m))
            beside = directions @ axis < math.cos(radius_rad)
            directions, levels = directions[beside], levels[beside]
            first_view = _view_beside(axis, radius_rad)
        self._scene.add_point_cloud(
            "/scene/stars",
            (stars_m * directions).astype(np.float32),
            np.repeat(levels[:, None], 3, axis=1),
            point_size=0.0015 * stars_m,
            point_shape="circle",
            precision="float32",
        )
        return first_view

    def _add_scale(self) -> None:
        """Add rings around the target, in the plane z = 0 of WRF, with their radii."""
        self._rings = self._scene.add_frame("/scene/rings", show_axes=False)
        self._radii: dict[float, Any] = {}
        for radius_m in shapes.scale_of(self._reach_m):
            name = f"{radius_m:g}"
            self._lines(f"/scene/rings/{name}", shapes.ring(radius_m), _RING_RGB, 1.0)
            self._radii[radius_m] = self._label(f"/radius_{name}", f"{name} m")

    def _label(self, name: str, text: str) -> Any:
        """Add a label, which follows no other node: viser draws one at its parent's pose in the
        picture before, and draws no other picture until something changes.
        """
        return self._scene.add_label(name, text, visible=False)

    def show_scale(self, shown: bool) -> None:
        """Show or hide the rings."""
        for node in (self._rings, *self._radii.values()):
            node.visible = shown

    def _body(self, name: str, mesh: shapes.Mesh) -> Any:
        solid = trimesh.Trimesh(
            mesh.vertices_m,
            mesh.triangles,
            vertex_normals=mesh.normals,
            vertex_colors=mesh.colours,
            process=False,
            validate=False,
        )
        return self._scene.add_mesh_trimesh(name, solid, cast_shadow=False, receive_shadow=False)

    def _lines(self, name: str, segments: Any, colour: tuple[int, int, int], pixels: float) -> Any:
        return self._scene.add_line_segments(
            name, segments, colour, thickness=pixels, thickness_units="screen"
        )

    def show_corridors(self, shown: bool) -> None:
        """Show or hide the corridors of chasers that fly in one."""
        self._corridors_shown = shown

    def show_keep_out(self, shown: bool) -> None:
        """Show or hide the keep-out sphere."""
        self._keep_out.visible = shown

    def show_views(self, shown: bool) -> None:
        """Show or hide the camera frustums."""
        for frustum in self._frustums:
            frustum.visible = shown

    def draw(self, state: MissionState, history: History, slow: bool) -> None:
        """Draw the state; update trails only if ``slow``."""
        estimate, true = state.estimate(), state.true_target()
        shown = true or estimate
        self._place(self._target, shown)
        self._place(self._estimate, estimate)
        self._fix_frame(shown or _IDENTITY)
        if shown is not None:
            self._rings.position = shown.position_m
            self._place_radii(shown.position_m)
        keep_out_m = state.keep_out_m(self._scenario.limits.min_distance_target_m)
        if keep_out_m != self._keep_out_m:
            self._keep_out_m, self._keep_out.points = keep_out_m, shapes.sphere(keep_out_m)
        if state.map is not None and state.map is not self._map:
            self._draw_map(state.map)
        for i, chaser in enumerate(state.chasers):
            pose = state.chaser(i)
            self._place(self._chasers[i], pose)
            self._place(self._numbers[i], None if pose is None else self._above(pose))
            away = chaser.error()
            apart = away is not None and (away[0] > _REFERENCE_M or away[1] > _REFERENCE_RAD)
            reference = pose_of(chaser.reference) if chaser.reference and apart else None
            self._place(self._references[i], reference)
            if (corridor := self._corridors.get(i)) is not None:
                in_it = chaser.reference is not None and chaser.reference.phase in _IN_CORRIDOR
                if corridor.visible != (in_it and self._corridors_shown):
                    corridor.visible = not corridor.visible
            if chaser.plan is not None:
                self._plans[i].points = shapes.polyline(
                    np.reshape(chaser.plan.positions_m, (-1, 3))
                )
            if slow and estimate is not None:
                trail = history.trails[i].between(state.time_s() - TRAIL_S, state.time_s())
                self._trails[i].points = shapes.polyline(trail)

    def _draw_map(self, known: LandmarkMap) -> None:
        """Draw the landmarks of a map, and its ports with their axes."""
        self._map = known
        self._scene.add_point_cloud(
            "/scene/estimate/landmarks",
            np.reshape(known.landmarks_m, (-1, 3)).astype(np.float32),
            _rgb(ESTIMATE_COLOUR),
            point_size=_LANDMARK_M,
            point_shape="circle",
            precision="float32",
        )
        for port in known.ports:
            at = np.array(port.position_m)
            axis = shapes.polyline(np.stack([at, at + _PORT_M * np.array(port.axis)]))
            colour = _rgb(COLOURS[port.chaser % len(COLOURS)])
            self._lines(f"/scene/estimate/port_{port.chaser}", axis, colour, 4.0)

    def _fix_frame(self, target: Pose) -> None:
        if self.view == "the world":
            q, p = _IDENTITY.q_wxyz, _IDENTITY.position_m
        elif self.view == "on the target":
            q = rotations.conjugate(target.q_wxyz)
            p = -rotations.rotate(q, target.position_m)
        else:
            q, p = _IDENTITY.q_wxyz, -target.position_m
        self._root.position, self._root.wxyz = p, q
        self._root_pose = Pose(p, q)

    def _on_screen(self, point_m: Array) -> Array:
        """Return a point (3,) of WRF in the frame that is fixed on the screen."""
        root = self._root_pose
        return root.position_m + rotations.rotate(root.q_wxyz, point_m)

    def _above(self, chaser: Pose) -> Pose:
        """Return where the number of a chaser stands."""
        up = np.array([0.0, 0.0, 0.75 * self._scenario.chaser.size_m[2]])
        over = chaser.position_m + rotations.rotate(chaser.q_wxyz, up)
        return Pose(self._on_screen(over), _IDENTITY.q_wxyz)

    def _place_radii(self, target_m: Array) -> None:
        """Place the radii of the rings at their nearest points. ``target_m`` (3,): WRF."""
        for radius_m, label in self._radii.items():
            label.position = self._on_screen(target_m + radius_m * self._near)
            label.visible = self._rings.visible

    def _place(self, node: Any, pose: Pose | None) -> None:
        if node.visible != (pose is not None):
            node.visible = pose is not None
        if pose is not None:
            node.position, node.wxyz = pose.position_m, pose.q_wxyz
