# SPDX-License-Identifier: Apache-2.0
"""Fly many training environments at once, by the kernels in ``native``; without gymnasium.

Environments that are done start anew with the next step. The same seed gives the same bits, and
those of an environment do not depend on the number of others.
"""

from __future__ import annotations

import ctypes
from ctypes import byref, c_void_p
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.native import location
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.plant import PrincipalFrame
from numpy.typing import NDArray

from .native import LIBRARY, function
from .task import TASKS, TrainingTask, task_of

if TYPE_CHECKING:
    from .images import BatchImages
    from .reference import ReferenceFlight

Floats = NDArray[np.float32]
Booleans = NDArray[np.bool_]
ObservationArray = NDArray[Any]
"""float32, or uint8 for images."""


@LIBRARY.structure("Batch")
class _State(ctypes.Structure):
    """Mirror `Batch` of native/batch.h."""

    _fields_ = [
        (name, c_void_p)
        for name in (
            "bodies", "targets", "wrench", "memory", "docked", "errors", "unseen", "work", "pulse",
            "opened", "age", "plant", "done", "outcome", "random", "actions", "observations",
            "rewards", "seen", "terminated", "truncated", "rejected", "idle",
        )
    ]  # fmt: skip


@dataclass(frozen=True, eq=False)
class BatchStep:
    """What a step of n environments with m chasers gave.

    ``observations`` (n, m, width), or images (n, m, h, w, 1); ``rewards``, ``terminated``,
    ``truncated`` and ``outcomes`` (n, m), the last by their index in ``OUTCOMES``; ``rejected``
    (n,): actions of the episode that were not finite, and were taken as zero.
    """

    observations: ObservationArray
    rewards: Array
    terminated: Booleans
    truncated: Booleans
    outcomes: IntArray
    rejected: IntArray


class DockingBatch:
    """A batch of ``environments`` of the training task of a scenario.

    Raises ScenarioError for a scenario that is not for training (see ``task_of``), ValueError for
    fewer than one environment.
    """

    def __init__(self, scenario: Scenario, environments: int) -> None:
        if environments < 1:
            raise ValueError(f"environments: at least 1 (got {environments})")
        self.task: TrainingTask = task_of(scenario, environments)
        t = self.task.numbers
        n, m = environments, int(t.chasers)
        self.environments, self.chasers = n, m
        rows = {"bodies": 30, "wrench": 6, "memory": 8, "docked": 7, "errors": 12}
        a: dict[str, NDArray[Any]] = {k: np.zeros((count, t.pitch)) for k, count in rows.items()}
        a |= {name: np.zeros((n * m, t.actuators), np.int64) for name in ("pulse", "opened")}
        a |= {name: np.zeros(n, np.int64) for name in ("age", "plant", "done", "rejected", "idle")}
        a |= {name: np.zeros((n, m), np.uint8) for name in ("terminated", "truncated")}
        a["targets"] = np.zeros((30, t.target_pitch))
        for body in (a["bodies"], a["targets"]):
            body[[6, 13, 14, 15, 16, 23]] = 1.0  # bodies that fill up the last four
        a["unseen"] = np.zeros((n, t.surface.faces, 4))
        a["seen"] = np.zeros((n, t.surface.points), np.uint8)
        a["work"] = np.zeros(24 * t.steps)
        a["outcome"] = np.zeros((n, m), np.int64)
        a["random"] = np.zeros(n, np.uint64)
        a["actions"] = np.zeros((n, m, t.actuators), np.float32)
        a["observations"] = np.zeros((n, m, t.width), np.float32)
        # The kernel counts in them by body, up to a multiple of four.
        a["rewards"] = np.zeros(t.pitch)
        self._arrays = a
        self._state = _State(*(location(a[field[0]]) for field in _State._fields_))
        self._step, self._start = function("step_batch"), function("start_batch")
        # Imported where they are needed: they load the world's renderer, and the NMPC.
        self._images: BatchImages | None = None
        if self.task.learning.observation == "images":
            from .images import BatchImages

            self._images = BatchImages(scenario, environments)
        self._reference: ReferenceFlight | None = None
        if self.task.learning.action == "reference":
            from .reference import ReferenceFlight

            self._reference = ReferenceFlight(
                scenario, self.task.learning.reference, TASKS[t.task], n
            )

    def start(self, seed: int | None = None, chosen: Booleans | None = None) -> ObservationArray:
        """Start all environments, or those ``chosen`` (n,), and return the observations.

        ``seed``: of all random numbers from now on, of every environment; by default they go on.
        """
        if seed is not None:
            # Environment k has the same numbers whatever the number of environments.
            words = (
                np.random.SeedSequence([seed % 2**64, k]).generate_state(1, np.uint64)[0]
                for k in range(self.environments)
            )
            self._arrays["random"][:] = np.fromiter(words, np.uint64, self.environments)
        done = self._arrays["done"]
        waiting = np.zeros_like(done) if chosen is None else done & ~chosen  # for their next step
        done[:] = True if chosen is None else chosen
        if self._reference is not None:
            self._reference.restart(done.astype(bool))
        self._start(byref(self.task.numbers), byref(self._state))
        done |= waiting
        return self._observations()

    def step(self, actions: NDArray[np.floating]) -> BatchStep:
        """Fly all environments for a tick with actions (n, m, actuators).

        Wrenches in shares of the limits, -1 to 1 along CRF's axes, open times of the thrusters in
        shares of a tick, 0 to 1, or offsets of the NMPC's reference (``ReferenceFlight``), -1 to 1;
        values beyond are limited. Raises ValueError for another shape.
        """
        a, given = self._arrays, np.asarray(actions)
        if given.shape != a["actions"].shape:
            raise ValueError(f"actions: the shape is {given.shape}, not {a['actions'].shape}")
        with np.errstate(over="ignore", invalid="ignore"):
            a["actions"][...] = given
        if self._reference is not None:
            flying = a["done"] == 0
            self._reference.restart(~flying)
            seen, moved = a["observations"].astype(float), a["actions"].astype(float)
            a["actions"][...] = self._reference.wrenches(seen, moved, flying)
        self._step(byref(self.task.numbers), byref(self._state))
        n, m = self.environments, self.chasers
        return BatchStep(
            self._observations(),
            a["rewards"][: n * m].reshape(n, m).copy(),
            a["terminated"].astype(bool),
            a["truncated"].astype(bool),
            a["outcome"].copy(),
            a["rejected"].copy(),
        )

    @property
    def seen(self) -> Booleans:
        """Which points (n, points) of the target's surface were seen in the episode, in the order
        of ``surface_of``; without a meaning for other tasks than ``inspect``.
        """
        return self._arrays["seen"].astype(bool)

    @property
    def plants(self) -> IntArray:
        """Number (n,) of the body of each environment among those of ``[truth]``: what it adds to
        the scenario's seed.
        """
        return self._arrays["plant"].copy()

    def state(self, environment: int, chaser: int | None) -> BodyState:
        """Return the motion of a chaser, or of the target for None."""
        if chaser is None:
            return self._motions("targets", slice(environment, environment + 1))[0]
        column = environment * self.chasers + chaser
        return self._motions("bodies", slice(column, column + 1))[0]

    def _motions(self, bodies: str, columns: slice) -> list[BodyState]:
        """Return the motions of bodies by the columns of their array."""
        y = self._arrays[bodies][:, columns].T.copy()
        frame = PrincipalFrame(y[:, 23:27], y[:, 27:30])
        s = frame.to_body(BodyState(y[:, 0:3], y[:, 3:6], y[:, 6:10], y[:, 10:13]))
        return [
            BodyState(*row)
            for row in zip(s.position_m, s.velocity_m_s, s.q_wxyz, s.omega_rad_s, strict=True)
        ]

    def _observations(self) -> ObservationArray:
        """Return what the chasers observe now, (n, m, ...)."""
        if self._images is None:
            return self._arrays["observations"].copy()
        n, m = self.environments, self.chasers
        targets = self._motions("targets", slice(n))
        chasers = self._motions("bodies", slice(n * m))
        states = [[target, *chasers[e * m : e * m + m]] for e, target in enumerate(targets)]
        return self._images.take(states, self._arrays["age"], self._arrays["random"])
