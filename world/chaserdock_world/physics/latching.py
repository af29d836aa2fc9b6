# SPDX-License-Identifier: Apache-2.0
"""Simulate touches and latches: probes on ports, joints, their loads and their faults.

A latch without play is a rigid joint of the engine, one with play or that slips is a spring
(``compliant_latch``). ``latch`` decides when a latch closes or opens.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.docking_geometry import view_of
from chaserdock_protocol.scenario import Scenario

from .compliant_latch import ENGAGED_M, CompliantLatch, Grip
from .definitions import PROBE_RADIUS_M, TARGET
from .engine import BodyContact
from .latch import ProbeLatch, capture_ports, latch_faults
from .moving_bodies import MovingBodies
from .port_loads import PortLoadRecorder, port_attitude

ContactPairs = tuple[tuple[str, str], ...]


class Latching:
    """Hold the chasers that have a port, by latches, and record the loads at their ports.

    ``openings``: chaser and reason of latches that no command has opened.
    """

    def __init__(self, scenario: Scenario, bodies: MovingBodies) -> None:
        self._scenario, self._bodies, self._engine = scenario, bodies, bodies.engine
        self._target = bodies.numbers[TARGET]
        self.latches = {
            f"chaser/{port.chaser}": ProbeLatch(
                port.chaser,
                port,
                scenario.docking.tolerances,
                scenario.time.physics_hz,
                latch_faults(scenario, port.chaser),
            )
            for port in capture_ports(scenario)
        }
        self.port_loads = {
            name: self._load_recorder(latch.chaser) for name, latch in self.latches.items()
        }
        self.openings: list[tuple[int, str]] = []
        # Chasers with a rigid joint, in the order in which they latched.
        self._joints: list[str] = []
        self._compliant: dict[str, CompliantLatch] = {}
        # Whether a latch closed in the last step: its joint acts first in the next one.
        self._closing = False

    def _load_recorder(self, chaser: int) -> PortLoadRecorder:
        q_port = port_attitude(np.asarray(self._scenario.chasers[chaser].q_wxyz))
        frame = self._bodies.plants[TARGET].frame
        if frame is not None:
            q_port = rotations.multiply(rotations.conjugate(frame.q_wxyz), q_port)
        return PortLoadRecorder(q_port, 1.0 / self._scenario.time.physics_hz)

    # -- in every step -----------------------------------------------------------------------------

    def begin_step(self) -> set[int]:
        """Execute commands and faults of the latches that are due.

        Return the numbers of the bodies with a closed latch.
        """
        for name, latch in self.latches.items():
            if latch.apply_due_commands(self._bodies.step_count):
                self._detach(name)
            if latch.faults and latch.latched:
                self._apply_faults(name, latch)
        attached = (*self._joints, *self._compliant)
        return {self._bodies.numbers[name] for name in (*attached, TARGET)} if attached else set()

    def push(self) -> None:
        """Apply the loads of latches with play, and of those that slip, for one step."""
        if not self._compliant:
            return
        bodies, reach_m = self._bodies, self._scenario.chaser.probe_reach_m
        target = bodies.state(TARGET)
        for name, compliant in tuple(self._compliant.items()):
            chaser = bodies.numbers[name]
            slip = self.latches[name].fault_at("latch_slip", bodies.step_count)
            grip = Grip() if slip is None else slip.grip
            force, torque, tip = compliant.load(target, bodies.state(name), reach_m, grip)
            for body, sign in ((self._target, 1.0), (chaser, -1.0)):
                self._engine.push_at(
                    body, (sign * force).tolist(), (sign * torque).tolist(), tip.tolist()
                )
            q_chaser = bodies.before[chaser][1]
            self._record_load(name, [*force, *rotations.rotate_inverse(q_chaser, torque)])
            if name in self._compliant and compliant.slipped_m > ENGAGED_M:
                self._open(name, f"slipped {compliant.slipped_m * 1e3:.0f} mm, out of its port")

    def end_step(self) -> None:
        """Record the loads at the ports with rigid joints in the last step; open overloaded
        latches.
        """
        if not self._joints:
            return
        closing, self._closing = self._closing, False
        for name in tuple(self._joints):
            reaction = self._engine.reaction(self._target, self._bodies.numbers[name])
            self._record_load(name, reaction, closing)

    def _record_load(self, name: str, reaction: Sequence[float], closing: bool = False) -> None:
        before, numbers = self._bodies.before, self._bodies.numbers
        self.port_loads[name].add(
            reaction, before[self._target][1], before[numbers[name]][1], closing
        )
        strength = self._scenario.truth.latch
        for load, limit, unit in (
            (math.hypot(*reaction[:3]), strength.strength_N, "N"),
            (math.hypot(*reaction[3:]), strength.strength_N_m, "N m"),
        ):
            if limit is not None and load > limit and not closing and self.latches[name].latched:
                self._open(name, f"{load:.3g} {unit} on the port, strength {limit:g} {unit}")

    def _apply_faults(self, name: str, latch: ProbeLatch) -> None:
        """Open a closed latch, or let it slip, where a fault says so."""
        step = self._bodies.step_count
        if latch.fault_at("latch_open", step) is not None:
            self._open(name, "fault latch_open")
        elif name in self._joints and latch.fault_at("latch_slip", step) is not None:
            self._remove_joint(name)
            self._compliant[name] = self._compliant_latch(name)

    # -- contacts ----------------------------------------------------------------------------------

    def find_contacts(self) -> tuple[ContactPairs, set[str]]:
        """Return the contacts after the last step.

        The pairs of bodies, sorted, without probe tips on the target; and the chasers whose tips
        touch it.
        """
        names = self._bodies.names
        pairs, tips = set(), set()
        for contact in self._engine.contacts():
            if (tip := self._touching_tip(contact)) is not None:
                tips.add(tip)
            else:
                pairs.add(tuple(sorted((names[contact.a], names[contact.b]))))
        return tuple(sorted((a, b) for a, b in pairs)), tips

    def _touching_tip(self, contact: BodyContact) -> str | None:
        """Return the chaser whose probe tip touches the target in a contact, or None."""
        names = self._bodies.names
        a, b = names[contact.a], names[contact.b]
        for name, other, point in ((a, b, contact.point_a_m), (b, a, contact.point_b_m)):
            if other == TARGET and self._is_tip(name, point):
                return name
        return None

    def _is_tip(self, name: str, point_m: Sequence[float]) -> bool:
        """Return whether a point (3,), WRF, of a chaser's surface is on the round end of
        its probe.
        """
        if name not in self.latches:
            return False
        s = self._bodies.state(name)
        ahead_m = float(rotations.rotate_inverse(s.q_wxyz, np.array(point_m) - s.position_m)[0])
        return ahead_m > self._scenario.chaser.probe_reach_m - 2.0 * PROBE_RADIUS_M

    def process_contacts(self) -> ContactPairs:
        """Pass the touches of the last step to the latches; return the other contacts."""
        pairs, tips = self.find_contacts()
        for name in sorted(tips):
            latch, bodies = self.latches[name], self._bodies
            q_off = np.asarray(self._scenario.chasers[latch.chaser].q_wxyz)
            reach_m = self._scenario.chaser.probe_reach_m
            chaser, target = bodies.state_before(name), bodies.state_before(TARGET)
            view = view_of(latch.port, reach_m, q_off, chaser, target)
            if latch.touch(bodies.step_count - 1, view):
                self.attach(name)
        if self._closing:
            self._bodies.before.clear()  # the joints change the rates abruptly
        return pairs

    # -- joints ------------------------------------------------------------------------------------

    def attach(self, name: str) -> None:
        """Hold a chaser's probe in its port in their current relative pose."""
        play = self._scenario.truth.latch
        if play.play_m or play.play_deg:
            self._compliant[name] = self._compliant_latch(name)
        else:
            self._add_joint(name)
            self._closing = True
        # The contact spring would work against the latch.
        self._engine.set_collisions(self._target, self._bodies.numbers[name], False)

    def _open(self, name: str, reason: str) -> None:
        """Open a latch that no command opens."""
        self.openings.append((self.latches[name].chaser, reason))
        self.latches[name].open(self._bodies.step_count)
        self._detach(name)

    def _detach(self, name: str) -> None:
        if name in self._joints:
            self._remove_joint(name)
        self._compliant.pop(name, None)
        self._engine.set_collisions(self._target, self._bodies.numbers[name], True)

    def _compliant_latch(self, name: str) -> CompliantLatch:
        """Return a latch that holds a chaser where it is."""
        target, chaser = self._bodies.state(TARGET), self._bodies.state(name)
        play = self._scenario.truth.latch
        tip = np.array([self._scenario.chaser.probe_reach_m, 0.0, 0.0])
        place = chaser.position_m + rotations.rotate(chaser.q_wxyz, tip) - target.position_m
        return CompliantLatch(
            rotations.rotate_inverse(target.q_wxyz, place),
            rotations.multiply(rotations.conjugate(target.q_wxyz), chaser.q_wxyz),
            play.play_m,
            math.radians(play.play_deg),
        )

    def _add_joint(self, name: str) -> None:
        """Fix a chaser's probe tip to the target in their current relative pose."""
        plants, chaser = self._bodies.plants, self._bodies.state(name)
        tip = np.array([self._scenario.chaser.probe_reach_m, 0.0, 0.0])
        tip_world = chaser.position_m + rotations.rotate(chaser.q_wxyz, tip)
        chaser = plants[name].to_engine(chaser)
        target = plants[TARGET].to_engine(self._bodies.state(TARGET))
        if plants[name].frame is not None:
            tip = rotations.rotate_inverse(chaser.q_wxyz, tip_world - chaser.position_m)
        relative = rotations.multiply(rotations.conjugate(target.q_wxyz), chaser.q_wxyz)
        port = rotations.rotate_inverse(target.q_wxyz, tip_world - target.position_m)
        self._engine.join(self._target, self._bodies.numbers[name], port, tip, relative)
        self._joints.append(name)

    def _remove_joint(self, name: str) -> None:
        self._joints.remove(name)
        self._engine.separate(self._target, self._bodies.numbers[name])
