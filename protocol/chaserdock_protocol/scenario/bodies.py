"""The scenario's sections of bodies: the target and the chasers' body."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from chaserdock_models.targets import TargetModel, target_model, target_names
from chaserdock_models.thruster_bodies import BODIES
from pydantic import Field, model_validator

from .fields import Name, NotNegative, Positive, PositiveVector, Section, UnitQuaternion, Vector
from .target import Geometry
from .thrusters import MAX_THRUSTERS, Modulation, Thruster, check_layout


class Target(Section):
    """The target's model (geometry and markers), initial state, and how it moves.

    ``model`` is a known name or, in a file, the path of a target file; with ``geometry`` it is just a name.

    ``constant_rates`` and ``static`` prescribe the motion, as the paper does; ``torque_free`` is a rigid
    body's (then ``inertia_kg_m2``, principal, and ``mass_kg`` count).
    """

    model: Name = "paper"
    geometry: Geometry | None = None
    motion: Literal["constant_rates", "static", "torque_free"] = "constant_rates"
    position_m: Vector = (0.0, 0.0, 0.0)
    q_wxyz: UnitQuaternion = (1.0, 0.0, 0.0, 0.0)
    velocity_m_s: Vector = (0.015, 0.0075, 0.03)
    omega_rad_s: Vector = (0.015, 0.045, 0.03)
    mass_kg: Positive = 1.25
    inertia_kg_m2: PositiveVector | None = None

    @model_validator(mode="after")
    def _known(self) -> Target:
        if self.geometry is None:
            target_model(self.model)
        elif self.model in target_names():
            raise ValueError(f"model: {self.model!r} is a known target; give this geometry a name of its own")
        if self.inertia_kg_m2 is not None:
            _check_inertia(self.inertia_kg_m2)
        return self

    def shape(self) -> TargetModel:
        """Geometry and markers."""
        return target_model(self.model) if self.geometry is None else self.geometry.model(self.model)


def _check_inertia(i: tuple[float, float, float]) -> None:
    if 2 * max(i) > sum(i) * (1 + 1e-9):
        raise ValueError(
            f"inertia_kg_m2 {i}: no moment may exceed the sum of the other two (no body is like that)"
        )


def cuboid_inertia(mass_kg: float, size_m: tuple[float, float, float]) -> tuple[float, float, float]:
    """Principal moments (kg m^2) of a homogeneous cuboid about its axes."""
    x, y, z = (s * s for s in size_m)
    return (mass_kg * (y + z) / 12, mass_kg * (x + z) / 12, mass_kg * (x + y) / 12)


class Body(Section):
    """A chaser's body; ``inertia_kg_m2`` (principal) defaults to the homogeneous cuboid's.

    ``body`` names one that is shipped with thrusters, whose figures are then the defaults. ``actuation``: the commanded
    wrench itself (``ideal``), or pulses of the thrusters. ``thruster_test_s``: a thruster of which its chaser has not seen for so long
    that it works is tested where that may be; 0: never. ``thruster_faults_by_command``: operators may make thrusters fail in
    flight, for tests.
    """

    body: Literal["slider", "tetra12"] | None = None
    mass_kg: Positive = 30.0
    size_m: PositiveVector = (0.25, 0.25, 0.05)
    inertia_kg_m2: PositiveVector | None = None
    force_max_N: Positive = 2.0
    torque_max_N_m: Positive = 0.05
    probe_reach_m: Positive = 0.35
    actuation: Literal["ideal", "thrusters"] = "ideal"
    thrusters: Annotated[tuple[Thruster, ...], Field(max_length=MAX_THRUSTERS)] = ()
    modulation: Modulation = Modulation()
    thruster_test_s: NotNegative = 10.0
    thruster_faults_by_command: bool = False

    @model_validator(mode="before")
    @classmethod
    def _shipped(cls, values: Any) -> Any:
        if isinstance(values, dict) and isinstance(name := values.get("body"), str) and name in BODIES:
            return BODIES[name] | values
        return values

    @model_validator(mode="after")
    def _possible(self) -> Body:
        if self.inertia_kg_m2 is not None:
            _check_inertia(self.inertia_kg_m2)
        if self.actuation == "thrusters":
            check_layout(self.thrusters, self.force_max_N, self.torque_max_N_m)
        return self

    @property
    def inertia(self) -> tuple[float, float, float]:
        return self.inertia_kg_m2 or cuboid_inertia(self.mass_kg, self.size_m)
