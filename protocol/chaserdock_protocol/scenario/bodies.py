# SPDX-License-Identifier: Apache-2.0
"""Scenario sections ``[target]`` and ``[chaser]``."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from chaserdock_models import plane
from chaserdock_models.arrays import Array
from chaserdock_models.decimation import simplified
from chaserdock_models.meshes import TriangleMesh, mass_properties, without_parts
from chaserdock_models.satellites import FINE_M, satellite
from chaserdock_models.shape_distance import chaser_boxes
from chaserdock_models.targets import (
    UNKNOWN_TARGET,
    Box,
    TargetModel,
    target_model,
    target_names,
)
from chaserdock_models.thruster_bodies import BODIES
from pydantic import Field, model_validator

from .fields import (
    Name,
    NotNegative,
    Oriented,
    Positive,
    PositiveVector,
    Section,
    UnitQuaternion,
    Vector,
)
from .surface import Surface
from .target import Geometry
from .thrusters import MAX_THRUSTERS, Modulation, Thruster, check_layout


class MeshKnowledge(Section):
    """What the flight software knows of a target's mesh. The world draws a mesh that differs: its
    errors are drawn from the seed with these standard deviations."""

    simplification_m: Annotated[float, Field(ge=2e-4, le=0.02, allow_inf_nan=False)] = Field(
        default=0.001,
        description="Largest deviation of the known mesh's facets from curved surfaces, or from "
        "the surface of a file, m.",
    )
    panel_deg: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = Field(
        default=0.5,
        description="Standard deviation of the rotation of each joint (rotation vector, per "
        "axis), such as of a solar panel, degrees.",
    )
    scale_share: Annotated[float, Field(ge=0, le=0.05, allow_inf_nan=False)] = Field(
        default=0.003,
        description="Standard deviation of the relative size of the body without what moves on "
        "joints.",
    )
    missing: tuple[Name, ...] = Field(
        default=(),
        description="Parts that the satellite has and the known mesh lacks, such as "
        "`antenna_whip`.",
    )


Sigma = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class FlightTarget(Section):
    """Nominal target of the flight software: shape, motion model, and assumed mass properties."""

    model: Name = Field(
        default="paper",
        description="Name of a known target: `paper`, `servicer`, `client` with markers, "
        "`geo_servicer`, `cubesat_12u` without; or, in a file, the path relative to it of a "
        "target file (`….toml`) or of a mesh (`….glb`, `.gltf`, `.obj`, `.stl`, `.ply`, "
        "`.off`, `.dae`). "
        "With `geometry`: the name of that geometry.",
    )
    geometry: Geometry | None = Field(
        default=None, description="Shape and markers, in place of those of a known `model`."
    )
    motion: Literal["constant_rates", "static", "torque_free"] = Field(
        default="constant_rates",
        description="`constant_rates`: prescribed constant velocity and angular velocity, as in "
        "the paper. `static`: prescribed, at rest. `torque_free`: a rigid body, which "
        "contact forces can move.",
    )
    mass_kg: Positive = Field(default=1.25, description="Mass, kg. Used by `torque_free` only.")
    inertia_kg_m2: PositiveVector | None = Field(
        default=None,
        description="Moments of inertia about the axes of TRF through the centre of mass, kg m². "
        "Used by `torque_free` only. Without it: those of the model's mesh, or of a "
        "homogeneous cuboid of its size.",
    )
    inertia_products_kg_m2: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="Elements xy, xz, yz of the inertia tensor (TRF), kg m². Used by "
        "`torque_free` only.",
    )
    centre_of_mass_m: Vector = Field(
        default=(0.0, 0.0, 0.0), description="Centre of mass (TRF), m. Used by `torque_free` only."
    )

    mass_sigma_share: Sigma = Field(
        default=0.1,
        description="Standard deviation of the stated mass, as a share of it. Used by "
        "`torque_free` only.",
    )
    inertia_sigma_share: Sigma = Field(
        default=0.15,
        description="Standard deviation of each element of the stated inertia tensor, as a share "
        "of the mean moment. Used by `torque_free` only.",
    )
    centre_of_mass_sigma_m: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = Field(
        default=0.005,
        description="Standard deviation of the stated centre of mass per axis, m. Used by "
        "`torque_free` only.",
    )
    knowledge: MeshKnowledge = MeshKnowledge()

    @model_validator(mode="after")
    def _known(self) -> FlightTarget:
        if self.geometry is None:
            target_model(self.model)
        elif self.model in target_names():
            raise ValueError(
                f"model: {self.model!r} is the name of a known target; choose another one for "
                "this geometry"
            )
        if self.inertia_kg_m2 is not None:
            a, b, c = np.linalg.eigvalsh(self.inertia_tensor).tolist()
            if a <= 0.0:
                raise ValueError(
                    f"inertia_products_kg_m2 {self.inertia_products_kg_m2}: too large for a "
                    "body's inertia"
                )
            _check_inertia((a, b, c) if any(self.inertia_products_kg_m2) else self.inertia_kg_m2)
        elif any(self.inertia_products_kg_m2):
            raise ValueError("inertia_products_kg_m2: needs inertia_kg_m2")
        self._check_knowledge()
        return self

    def _check_knowledge(self) -> None:
        name = self.shape().satellite
        if not name:
            # Defaults may be stated: a serialized scenario has all keys.
            default = MeshKnowledge()
            for key in MeshKnowledge.model_fields:
                if getattr(self.knowledge, key) != getattr(default, key):
                    raise ValueError(f"knowledge.{key}: {self.model!r} has no mesh")
            return
        try:
            self._check_missing()
        except ValueError as error:
            raise ValueError(f"knowledge.missing: {error}") from None

    def _check_missing(self) -> None:
        mesh = self.nominal_mesh(self.knowledge.simplification_m)
        if mesh is not None:
            without_parts(mesh, self.knowledge.missing)

    @property
    def moments(self) -> tuple[float, float, float]:
        """Moments of inertia about the axes of TRF through the centre of mass, kg m^2."""
        if self.inertia_kg_m2 is None and (mesh := self.nominal_mesh()) is not None:
            x, y, z = np.diag(mass_properties(mesh, self.mass_kg)[1]).tolist()
            return (x, y, z)
        return self.inertia_kg_m2 or cuboid_inertia(self.mass_kg, self.shape().size_m)

    @property
    def inertia_tensor(self) -> Array:
        """Inertia tensor (3, 3) about the centre of mass, TRF axes, kg m^2."""
        if self.inertia_kg_m2 is None and (mesh := self.nominal_mesh()) is not None:
            return mass_properties(mesh, self.mass_kg)[1]
        xy, xz, yz = self.inertia_products_kg_m2
        return np.diag(self.moments) + np.array([[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]])

    def shape(self) -> TargetModel:
        """Return geometry and markers."""
        return (
            target_model(self.model) if self.geometry is None else self.geometry.model(self.model)
        )

    def nominal_mesh(self, tolerance_m: float = FINE_M) -> TriangleMesh | None:
        """Return the target's mesh as it was designed; None without one."""
        if self.geometry is not None:
            return self.geometry.nominal_mesh(self.model, tolerance_m)
        return satellite(self.model, tolerance_m) if self.shape().satellite else None

    def as_unknown(self) -> FlightTarget:
        """Return the target of flight software that knows neither shape nor mass properties."""
        return FlightTarget(model=UNKNOWN_TARGET, motion=self.motion)

    def as_known(self) -> FlightTarget:
        """Return the target as the flight software knows it.

        Of a mesh from a file it knows the simplified surface only, without missing parts.
        """
        surface = None if self.geometry is None else self.geometry.surface
        if self.geometry is None or surface is None or surface.known:
            return self
        mesh = self.known_mesh()
        assert mesh is not None
        known = Surface.of(
            mesh, surface.file, surface.scale, surface.origin_m, surface.deviation_m, known=True
        )
        inertia = self.inertia_tensor
        return self.model_copy(
            update={
                "geometry": self.geometry.model_copy(update={"surface": known}),
                "knowledge": self.knowledge.model_copy(update={"missing": ()}),
                # Of the nominal mesh, not of the simplified one.
                "inertia_kg_m2": tuple(np.diag(inertia).tolist()),
                "inertia_products_kg_m2": (
                    float(inertia[0, 1]),
                    float(inertia[0, 2]),
                    float(inertia[1, 2]),
                ),
            }
        )

    def known_mesh(self) -> TriangleMesh | None:
        """Return the mesh that the flight software knows: simplified, and without the parts that
        are missing in it.

        None for a target without a mesh. Raises ValueError for a missing part that the mesh does
        not have.
        """
        tolerance_m, missing = self.knowledge.simplification_m, self.knowledge.missing
        mesh = self.nominal_mesh(tolerance_m)
        surface = None if self.geometry is None else self.geometry.surface
        if mesh is None or (surface is not None and surface.known):
            return mesh
        return (
            without_parts(mesh, missing)
            if surface is None
            else _simplified(mesh, missing, tolerance_m)
        )


@lru_cache(maxsize=8)
def _simplified(mesh: TriangleMesh, missing: tuple[str, ...], tolerance_m: float) -> TriangleMesh:
    return simplified(without_parts(mesh, missing), tolerance_m)


class Target(FlightTarget, Oriented):
    """The target: shape, initial state, and motion."""

    position_m: Vector = Field(
        default=(0.0, 0.0, 0.0), description="Initial position of its centre (WRF), m."
    )
    q_wxyz: UnitQuaternion = Field(
        default=(1.0, 0.0, 0.0, 0.0),
        description="Initial attitude, TRF to WRF: unit quaternion, scalar first.",
    )
    velocity_m_s: Vector = Field(
        default=(0.015, 0.0075, 0.03),
        description="Initial velocity (WRF), m/s. Ignored by `static`.",
    )
    omega_rad_s: Vector = Field(
        default=(0.015, 0.045, 0.03),
        description="Initial angular velocity (TRF), rad/s. Ignored by `static`.",
    )

    @model_validator(mode="after")
    def _has_a_shape(self) -> Target:
        if self.model == UNKNOWN_TARGET:
            raise ValueError(
                f"model: {UNKNOWN_TARGET!r} is what flight software gets with perception.name = "
                '"features"; the world needs a shape'
            )
        return self


def _check_inertia(i: tuple[float, float, float]) -> None:
    if 2 * max(i) > sum(i) * (1 + 1e-9):
        raise ValueError(
            f"inertia_kg_m2 {i}: no principal moment may exceed the sum of the other two"
        )


@lru_cache(maxsize=64)
def cuboid_inertia(
    mass_kg: float, size_m: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Return the principal moments (kg m^2) of a homogeneous cuboid."""
    x, y, z = (s * s for s in size_m)
    return (mass_kg * (y + z) / 12, mass_kg * (x + z) / 12, mass_kg * (x + y) / 12)


_LIGHTEST_KG = 1e-3
"""Least mass of a chaser: newtons of thrust move a lighter one by more in a tick than filters bear.
"""


class Body(Section):
    """The body and actuators of every chaser."""

    body: Literal["slider", "tetra12", "atmos"] | None = Field(
        default=None,
        description="A predefined body with thrusters: `slider` (the paper's, 16 thrusters), "
        "`tetra12` (12 thrusters) or `atmos` (8 thrusters in a plane, for a floor). Its values "
        "replace the defaults below.",
    )
    mass_kg: Positive = Field(default=30.0, description="Mass, kg. At least 1 g.")
    size_m: PositiveVector = Field(
        default=(0.25, 0.25, 0.05), description="Edges of the body's cuboid (CRF), m."
    )
    inertia_kg_m2: PositiveVector | None = Field(
        default=None,
        description="Principal moments of inertia about the axes of CRF, kg m². Without it: "
        "those of a homogeneous cuboid.",
    )
    force_max_N: Positive = Field(default=2.0, description="Largest force per body axis, N.")
    torque_max_N_m: Positive = Field(default=0.05, description="Largest torque per body axis, N m.")
    mesh: Literal["", "chaser_body"] = Field(
        default="",
        description="Mesh that the cameras see in place of the body's cuboid, scaled to "
        "`size_m`; without it, the cuboid.",
    )
    degrees_of_freedom: Literal["spatial", "planar"] = Field(
        default="spatial",
        description="`spatial`: all bodies, the target too, move freely in six. `planar`: they are "
        "on a floor, slide along x and y of WRF and turn about z "
        "([world.md](world.md#bodies-on-a-floor)).",
    )
    probe_reach_m: Positive = Field(
        default=0.35,
        description="Distance of the docking probe's tip from the body's centre along +X (CRF), m.",
    )
    actuation: Literal["ideal", "thrusters"] = Field(
        default="ideal",
        description="`ideal`: the commanded force and torque act on the body. `thrusters`: "
        "pulses of `thrusters` do.",
    )
    thrusters: tuple[Thruster, ...] = Field(
        default=(),
        max_length=MAX_THRUSTERS,
        description="Position, direction and thrust of every thruster.",
    )
    modulation: Modulation = Modulation()
    thruster_test_s: NotNegative = Field(
        default=10.0,
        description="A thruster whose function has not been confirmed for this long is tested "
        "when it is safe to do so, s. 0: no tests.",
    )
    thruster_faults_by_command: bool = Field(
        default=False,
        description="Whether operators may inject thruster faults (`chaserdock command "
        "thruster-fault`).",
    )

    @model_validator(mode="before")
    @classmethod
    def _apply_predefined_body(cls, values: Any) -> Any:
        if (
            isinstance(values, dict)
            and isinstance(name := values.get("body"), str)
            and name in BODIES
        ):
            return BODIES[name] | values
        return values

    @model_validator(mode="after")
    def _check_consistent(self) -> Body:
        if self.inertia_kg_m2 is not None:
            _check_inertia(self.inertia_kg_m2)
        if self.mass_kg < _LIGHTEST_KG:
            raise ValueError(f"mass_kg: must be at least {_LIGHTEST_KG:g} (got {self.mass_kg:g})")
        front_m = self.size_m[0] / 2.0
        if self.probe_reach_m <= front_m:
            raise ValueError(
                f"probe_reach_m: the probe's tip, {self.probe_reach_m:g} m from the centre, is "
                f"within the body, whose front is at {front_m:g} m; make probe_reach_m longer than "
                f"that, or size_m[0] shorter than {2.0 * self.probe_reach_m:g} m"
            )
        if self.actuation == "thrusters":
            check_layout(self.thrusters, self.wrench_max)
        return self

    @property
    def is_planar(self) -> bool:
        """Whether bodies are on a floor."""
        return self.degrees_of_freedom == "planar"

    @property
    def wrench_max(self) -> Array:
        """Largest force and torque (6,) per body axis, N and N m; 0 along axes on which a floor
        leaves no motion.
        """
        limits = np.array([self.force_max_N] * 3 + [self.torque_max_N_m] * 3)
        if self.is_planar:
            limits[np.delete(np.arange(6), plane.AXES)] = 0.0
        return limits

    @property
    def inertia(self) -> tuple[float, float, float]:
        return self.inertia_kg_m2 or cuboid_inertia(self.mass_kg, self.size_m)

    def boxes(self) -> tuple[Box, ...]:
        """Return body and probe as cuboids (CRF). Raises ValueError as `chaser_boxes`."""
        return chaser_boxes(self.size_m, self.probe_reach_m)
