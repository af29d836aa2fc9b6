# SPDX-License-Identifier: Apache-2.0
"""One tick of the controller, without I/O: ingest, estimate, guide, plan, command."""

from __future__ import annotations

from collections.abc import Callable

from chaserdock_protocol.messages import TargetEstimate
from chaserdock_protocol.scenario import FlightScenario

from .estimation.estimators import make_estimator
from .estimation.guarded import FAILED as ESTIMATOR_FAILED
from .estimation.stage import EstimationStage
from .estimation.types import Estimator
from .guidance.stage import GuidanceStage
from .ingest.stage import IngestStage
from .interfaces import TickInputs, TickOutputs
from .nmpc.stage import PlanningStage
from .output.message_builders import target_message
from .output.stage import OutputStage
from .parameters import nmpc_parameters


class ControllerCore:
    """Runs the controller's stages in turn; their state lasts from tick to tick.

    ``inspecting``: chasers that guidance let inspect the target in the last tick. ``now_s``: a wall
    clock that only measures solve times; with ``realtime`` the scenario's solve budget follows from
    them. ``estimator``: replaces the scenario's. Raises PluginError for an installed solver that
    cannot be held to a budget.
    """

    def __init__(
        self,
        scenario: FlightScenario,
        now_s: Callable[[], float],
        estimator: Estimator | None = None,
        realtime: bool = False,
    ) -> None:
        self.scenario = scenario
        self.ingest = IngestStage(scenario)
        estimator = estimator or make_estimator(scenario.estimator.name, scenario)
        self.estimation = EstimationStage(scenario, estimator)
        self.guidance = GuidanceStage(scenario)
        self.planning = PlanningStage(scenario, nmpc_parameters(scenario), now_s, realtime)
        self.output = OutputStage(scenario)
        self.inspecting: frozenset[int] = frozenset()

    def step(self, inputs: TickInputs) -> TickOutputs:
        """Process one tick. A chaser with invalid odometry is excluded from planning and coasts."""
        observation = self.ingest.run(inputs, self.output.sent)
        estimation = self.estimation.run(observation, self.inspecting)
        guidance = self.guidance.run(observation, estimation, self.planning.history)
        self.inspecting = frozenset(d.chaser for d in guidance.directives if d.inspects)
        plan = self.planning.run(observation, estimation, guidance)
        return self.output.run(observation, estimation, guidance, plan)

    def estimate(self, inputs: TickInputs) -> TargetEstimate:
        """Run ingest and estimation only; call it in place of ``step``."""
        observation = self.ingest.run(inputs, self.output.sent)
        return target_message(observation, self.estimation.run(observation))

    def doubts(self, chaser: int) -> bool:
        """Return whether the odometry of a chaser may be wrong, judged by the last tick."""
        consistency = self.estimation.consistency
        return chaser < len(consistency) and consistency[chaser].doubtful

    def failed_parts(self) -> tuple[str, ...]:
        """Return the parts that failed in the last tick, as they are counted."""
        estimator_failed = (ESTIMATOR_FAILED,) if self.estimation.estimator.failed else ()
        return (*estimator_failed, *self.planning.failed)

    @property
    def estimator(self) -> Estimator:
        """Return the target estimator."""
        return self.estimation.estimator
