# SPDX-License-Identifier: Apache-2.0
"""Track which thrusters of a chaser work, as far as it knows. No I/O."""

from __future__ import annotations

from collections.abc import Iterable

from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import ThrusterState, WrenchCommand

from .fault_detection import ThrusterFault


class ThrusterHealth:
    """Failures found or reported, and the thrusters that the operator isolated or trusts.

    ``full_N`` (n,): thrusts of healthy thrusters, N.
    """

    def __init__(self, full_N: Array) -> None:
        self._full_N = full_N
        self._failed: dict[int, ThrusterFault] = {}
        self._commanded_isolated: frozenset[int] = frozenset()
        self._trusted: frozenset[int] = frozenset()

    def add_fault(self, fault: ThrusterFault) -> None:
        """Take a failure into account."""
        self._failed[fault.thruster] = fault

    def apply_command(self, command: WrenchCommand) -> tuple[list[int], bool]:
        """Take over the thrusters that a command isolates and trusts.

        Return those whose failure is revoked, and whether anything has changed.
        """
        count = len(self._full_N)
        shut = frozenset(j for j in command.isolated if j < count)
        trusted = frozenset(command.trusted)
        revoked = [j for j in trusted - self._trusted if self._failed.pop(j, None) is not None]
        changed = shut != self._commanded_isolated or trusted != self._trusted
        self._commanded_isolated, self._trusted = shut, trusted
        return revoked, changed

    @property
    def isolated(self) -> tuple[int, ...]:
        """Return the thrusters whose shut-off valves are to be closed, in ascending order."""
        unusable = {j for j, fault in self._failed.items() if fault.kind != "weak"}
        return tuple(sorted(self._commanded_isolated | (unusable - self._trusted)))

    def available_N(self) -> Array:
        """Return the known thrust of every open thruster, (n,) N."""
        available_N = self._full_N.copy()
        for thruster, fault in self._failed.items():
            available_N[thruster] *= fault.factor
        available_N[list(self.isolated)] = 0.0
        return available_N

    def suspects(self, shut: Iterable[int]) -> list[bool]:
        """Return for every thruster whether a failure of it can be detected.

        Not if it is ``shut``, known to be stuck, or trusted by command. One that is weak may fail
        for good.
        """
        stuck = {j for j, fault in self._failed.items() if fault.kind != "weak"}
        excluded = {*stuck, *shut, *self._trusted}
        return [thruster not in excluded for thruster in range(len(self._full_N))]

    def states(self) -> tuple[ThrusterState, ...]:
        """Return the state of every thruster for the report."""
        states: list[ThrusterState] = ["healthy"] * len(self._full_N)
        for thruster, fault in self._failed.items():
            states[thruster] = fault.kind
        return tuple(states)
