# SPDX-License-Identifier: Apache-2.0
"""The part of a scenario that flight software receives: chasers, controller and standby
(docs/flight_scenario.md).

Ground truth, what is random and what is planned to fail are not in it. A section that flight
software receives is a field of ``FlightScenario``; any other one is a field of ``Scenario``
(mission.py).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

from chaserdock_models.camera import Camera
from chaserdock_models.clock import Timing
from chaserdock_models.targets import TargetModel
from pydantic import Field, TypeAdapter, ValidationError, model_validator

from .assurance import AssuranceSection
from .bodies import Body, FlightTarget
from .camera import FlightCamera
from .checks import check_flight
from .detumble import Detumble
from .docking import Docking
from .errors import invalid
from .fields import MAX_CHASERS, Name, Section
from .inspection import Inspection
from .mapping import Mapping
from .migrations import FORMAT
from .navigation import NavigationSection
from .orbit import Orbit
from .plume import PlumeSection
from .ranging import Ranging
from .schema import (
    MAPPING,
    MAX_DURATION_S,
    Approach,
    Controller,
    EstimatorSection,
    FlightChaser,
    Limits,
    PerceptionSection,
    Time,
    TimelineEntry,
)


@lru_cache(maxsize=64)
def _timing(physics_hz: int, rate_hz: int, image_hz: int, latency_steps: int) -> Timing:
    return Timing(
        physics_hz=physics_hz, rate_hz=rate_hz, image_hz=image_hz, latency_steps=latency_steps
    )


class FlightScenario(Section):
    """The part of a scenario that the flight software receives.

    Nominal bodies and sensors, its own settings, and the mission.
    """

    format: Literal[3] = Field(
        default=FORMAT,
        description=f"Version of the format of this file. Without it: {FORMAT}, the present one.",
    )
    name: Name = Field(description="Name of the scenario; the names of run folders begin with it.")
    duration_s: float = Field(
        gt=0,
        le=MAX_DURATION_S,
        allow_inf_nan=False,
        description="Length of the mission, s of simulated time.",
    )
    time: Time = Time()
    orbit: Orbit | None = None
    plume: PlumeSection | None = None
    target: FlightTarget = FlightTarget()
    chaser: Body = Body()
    camera: FlightCamera = FlightCamera()
    navigation: NavigationSection = NavigationSection()
    ranging: Ranging | None = None
    perception: PerceptionSection = PerceptionSection()
    mapping: Mapping = Mapping()
    estimator: EstimatorSection = EstimatorSection()
    controller: Controller = Controller()
    limits: Limits = Limits()
    approach: Approach = Approach()
    assurance: AssuranceSection | None = None
    inspection: Inspection = Inspection()
    docking: Docking = Docking()
    detumble: Detumble = Detumble()
    chasers: tuple[FlightChaser, ...] = Field(min_length=1, max_length=MAX_CHASERS)
    timeline: tuple[TimelineEntry, ...] = ()

    @model_validator(mode="after")
    def _check_flight(self) -> FlightScenario:
        try:
            controller = self.controller.at_rate(self.time.rate_hz)
        except ValueError as error:
            raise ValueError(f"controller: {error}") from None
        object.__setattr__(self, "controller", controller)
        check_flight(self)
        return self

    @property
    def timing(self) -> Timing:
        time = self.time
        return _timing(
            time.physics_hz, time.rate_hz, time.image_hz, round(time.latency_s * time.physics_hz)
        )

    @property
    def maps_target(self) -> bool:
        """Whether the target's shape is unknown to the flight software, which maps it."""
        return self.perception.name == MAPPING

    def chooses_port(self, chaser: int) -> bool:
        """Return whether the timeline chooses a port for a chaser, on a target of unknown shape."""
        return any(e.port is not None and chaser in e.chasers for e in self.timeline)

    def camera_model(self) -> Camera:
        """Return the camera as calibrated."""
        return self.camera.model()

    def target_model(self) -> TargetModel:
        """Return geometry and markers of the target."""
        return self.target.shape()

    @property
    def ticks(self) -> int:
        return self.timing.ticks_in(self.duration_s)


_FLIGHT: TypeAdapter[FlightScenario] = TypeAdapter(FlightScenario)


def flight_scenario(scenario: FlightScenario) -> FlightScenario:
    """Return the part of a scenario that flight software receives; the object holds nothing
    else.
    """
    return FlightScenario.model_validate_json(flight_scenario_json(scenario))


def flight_scenario_json(scenario: FlightScenario) -> str:
    """Return the JSON of the flight scenario of a scenario."""
    # Serialized by the declared types, which leaves out the fields of their subclasses.
    target = scenario.target
    known = target.as_unknown() if scenario.maps_target else target.as_known()
    if known is not scenario.target:
        scenario = scenario.model_copy(update={"target": known})
    return _FLIGHT.dump_json(scenario).decode()


def flight_scenario_from_json(text: str, source: str) -> FlightScenario:
    """Return a flight scenario from JSON. Raises ScenarioError, also for a full scenario, whose
    keys are unknown.
    """
    try:
        return FlightScenario.model_validate_json(text)
    except ValidationError as error:
        raise invalid(error, FlightScenario, source) from None
