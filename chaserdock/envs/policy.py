# SPDX-License-Identifier: Apache-2.0
"""Policies in ONNX files: from observations (n, width) to actions (n, actuators).

The metadata of a file state for what it was trained; ``facts_of`` makes them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_protocol.errors import ChaserdockError, require_extra
from chaserdock_protocol.scenario import FlightScenario, Scenario
from numpy.typing import NDArray

from .batch import Floats
from .observation import names_of
from .task import TASKS, TrainingTask

_LISTED = 3
"""Names of an observation that an error lists; all of them would not fit into a line."""


class PolicyError(ChaserdockError):
    """A policy that cannot be read, or is not for a scenario."""


def facts_of(task: TrainingTask) -> dict[str, str]:
    """Return the metadata of a policy that is trained for a task.

    Raises PolicyError for a task with images: flight software hands estimates to a policy.
    """
    scenario = task.scenario
    if task.learning.observation == "images":
        raise PolicyError(
            f"{scenario.name}: learning.observation: a policy that flies takes estimates, "
            '"truth" or "statistical" (got "images")'
        )
    return {
        "task": TASKS[task.numbers.task],
        "action": task.learning.action,
        "observation": json.dumps(names_of(len(scenario.chasers), TASKS[task.numbers.task])),
        "actuation": scenario.chaser.actuation,
        "actuators": str(task.actuators),
        "rate_hz": str(float(scenario.time.rate_hz)),
    }


class Policy:
    """A policy of the file ``path``, on one thread.

    ``task``: of ``TASKS`` (task.py). Raises PolicyError for a file that is no policy,
    MissingPackageError without ``chaserdock[learn]``.
    """

    def __init__(self, path: Path) -> None:
        require_extra("onnxruntime", "learn")
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        if not path.is_file():
            raise PolicyError(f"{path}: no such policy")
        try:
            self._session: Any = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
            facts: Mapping[str, str] = self._session.get_modelmeta().custom_metadata_map
            self.names = tuple(json.loads(facts["observation"]))
            self.task, self.actuation = facts["task"], facts["actuation"]
            self.action = facts.get("action", "actuators")
            self.actuators, self.rate_hz = int(facts["actuators"]), float(facts["rate_hz"])
            width = self._session.get_inputs()[0].shape[1]
        except Exception as error:  # ONNX Runtime raises classes of its own
            cause = str(error).splitlines()[0]
            raise PolicyError(f"{path}: no policy with the metadata of facts_of: {cause}") from None
        if width != len(self.names):
            raise PolicyError(
                f"{path}: its metadata name {len(self.names)} elements, its network takes {width}"
            )
        self.path = path

    def check(self, scenario: Scenario | FlightScenario) -> None:
        """Raise PolicyError if the policy is not for the chasers of a scenario."""
        needed = names_of(len(scenario.chasers), self.task)
        if self.names != needed:
            where = next(
                (k for k, pair in enumerate(zip(self.names, needed, strict=False))
                 if pair[0] != pair[1]),
                min(len(self.names), len(needed)),
            )  # fmt: skip
            has, wants = (
                ", ".join(n[where : where + _LISTED]) or "nothing" for n in (self.names, needed)
            )
            raise PolicyError(
                f"{self.path}: observes {len(self.names)} elements, {scenario.name} has "
                f"{len(needed)}; from element {where} on: {has}, not {wants}"
            )
        given = scenario.chaser.actuation, scenario.time.rate_hz
        if given != (self.actuation, self.rate_hz):
            raise PolicyError(
                f"{self.path}: commands {self.actuation!r} at {self.rate_hz:g} Hz; {scenario.name} "
                f"has {given[0]!r} at {given[1]:g} Hz"
            )

    def actions(self, observations: NDArray[np.floating]) -> Floats:
        """Return the actions (n, actuators) for observations (n, width)."""
        given = np.asarray(observations, dtype=np.float32)
        return self._session.run(None, {"observation": given})[0]
