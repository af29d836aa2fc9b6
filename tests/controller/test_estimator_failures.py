# SPDX-License-Identifier: Apache-2.0
"""An installed estimator or solver that fails costs estimates or plans, not the controller."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from importlib.metadata import EntryPoint
from typing import Any, cast

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.estimation.estimators import make_estimator
from chaserdock_controller.estimation.guarded import GuardedEstimator
from chaserdock_controller.estimation.types import (
    Estimate,
    EstimatorEvent,
    EstimatorInputs,
    Shock,
    no_estimate,
)
from chaserdock_controller.interfaces import TargetState
from chaserdock_controller.nmpc.types import NmpcPlan
from chaserdock_controller.nmpc.warm_start import checked_plan
from chaserdock_controller.process import ControllerProcess
from chaserdock_models import rotations
from chaserdock_protocol import codec, plugins
from chaserdock_protocol.failure_watch import FAILURES_TO_ERROR
from chaserdock_protocol.messages import Tick
from chaserdock_protocol.plugins import PluginError
from chaserdock_protocol.replay_node import ReplayNode
from chaserdock_protocol.scenario import parse_scenario
from chaserdock_protocol.transport import Node
from flight_cases import odometry, scenario
from joint_cases import SyntheticFlight, navigation
from msgspec import structs

from chaserdock.experiments.in_process import InProcessMission
from chaserdock.experiments.perception import RenderedImages

SCENARIO = {
    "name": "test",
    "duration_s": 30.0,
    "perception": {"name": "statistical"},
    "estimator": {"name": "own"},
    "target": {"model": "servicer", "motion": "torque_free", "omega_rad_s": [0.02, 0.05, -0.03]},
    "chasers": [{"position_m": [-1.2, 0.3, 0.2], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    "timeline": [{"at_s": 0.2, "command": "approach", "chasers": [0]}],
}
RNG = np.random.default_rng(7)


def raises(*_: object) -> Any:
    raise RuntimeError("two\nlines")


class Unreliable:
    """The filter ``joint``, of which a test replaces members in flight."""

    def __init__(self, mission: Any) -> None:
        self.inner = make_estimator("joint", mission)
        self.replaced: dict[str, Any] = {}
        MADE.append(self)

    def __getattr__(self, name: str) -> Any:
        if name in self.replaced:
            return self.replaced[name]
        return getattr(self.inner, name)

    @property
    def shape(self) -> Any:
        return self.replaced["shape"]() if "shape" in self.replaced else self.inner.shape

    def update(self, inputs: EstimatorInputs) -> Any:
        found = self.inner.update(inputs)
        return self.replaced["update"](found) if "update" in self.replaced else found


MADE: list[Unreliable] = []


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    entry = EntryPoint("own", f"{__name__}:Unreliable", "chaserdock.estimators")
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])
    monkeypatch.setattr(EntryPoint, "load", lambda _: Unreliable)
    yield
    MADE.clear()


def target_with(**changes: Any) -> Callable[[Estimate], Any]:
    return lambda found: replace(found, target=replace(found.target, **changes))


def chaser_with(**changes: Any) -> Callable[[Estimate], Any]:
    return lambda found: replace(found, chasers=(replace(found.chasers[0], **changes),))


FAILURES: dict[str, dict[str, Any]] = {
    "an error in update": {"update": raises},
    "None": {"update": lambda _: None},
    "a state in place of an estimate": {"update": lambda found: found.target},
    "no target": {"update": lambda found: replace(found, target=None)},
    "a position that is NaN": {"update": target_with(position_m=np.full(3, np.nan))},
    "a rate that is infinite": {"update": target_with(omega_rad_s=np.full(3, np.inf))},
    "a list": {"update": target_with(velocity_m_s=[0.0, 0.0, 0.0])},
    "a quaternion of length 2": {"update": target_with(q_wxyz=np.array([2.0, 0.0, 0.0, 0.0]))},
    "a covariance of 6": {"update": target_with(covariance=np.eye(6))},
    "a negative variance": {"update": target_with(covariance=-np.eye(12))},
    "an unknown status": {"update": target_with(status="fine")},
    "an unknown chaser": {"update": target_with(rejected=(3,))},
    "another time": {"update": target_with(time_ns=5)},
    "a motion that is NaN": {"update": chaser_with(disturbance=np.full(6, np.nan))},
    "a motion of another chaser": {"update": chaser_with(chaser=2)},
    "a relative pose of another type": {"update": chaser_with(relative=np.zeros(7))},
    "innovations of another type": {"update": lambda found: replace(found, innovations=(5.5,))},
    "an innovation that is infinite": {
        "update": lambda found: replace(
            found, innovations=(structs.replace(found.innovations[0], squared=np.inf),)
        )
    },
    "an event without level": {
        "update": lambda found: replace(found, events=(EstimatorEvent(0, cast(Any, ""), ""),))
    },
}


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("kind", ["an error in update", "None", "a position that is NaN"])
def test_controller_goes_on_with_the_last_estimate_when_its_estimator_fails(kind: str) -> None:
    mission = parse_scenario(SCENARIO, "test")
    with InProcessMission(mission, RenderedImages(mission)) as flight:
        while flight.time_s < 0.6:
            flight.step()
        estimator = MADE[-1]
        estimator.replaced = FAILURES[kind]
        statuses, begin = [], len(flight.events)
        for _ in range(FAILURES_TO_ERROR + 2):
            out = flight.step().outputs
            assert out is not None
            assert 0 in out.wrenches
            for message in (out.target, *out.wrenches.values()):
                codec.decode(type(message), codec.encode(message))
            statuses.append(out.target.status)
            assert flight.controller.failed_parts() == ("estimator failed",)
        assert statuses == ["predicting"] * (FAILURES_TO_ERROR - 1) + ["lost"] * 3
        named = [(lv, text) for _, lv, text in flight.events[begin:] if "estimator" in text]
        assert [level for level, _ in named] == ["warning", "error"]
        assert all("'own'" in text and "\n" not in text for _, text in named)

        estimator.replaced = {}
        flight.step()
        assert flight.controller.failed_parts() == ()
        assert flight.step().outputs.target.status == "tracking"  # type: ignore[union-attr]


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("kind", FAILURES)
def test_result_that_cannot_be_used_is_a_failure(kind: str) -> None:
    mission = scenario()
    flight = SyntheticFlight(mission, navigation("lab"), 2, seed=3)
    guarded = make_estimator("own", mission)
    for wrong in ({}, {}, FAILURES[kind]):
        MADE[-1].replaced = wrong
        flight.step()
        found = guarded.update(flight.inputs())
    assert guarded.failed
    assert (found.target.status, found.chasers, len(found.events)) == ("predicting", (), 1)


CALLS: dict[str, Any] = {
    "estimate_at": lambda time_ns: no_estimate(time_ns + 1),
    "shape": lambda: "a sphere",
    "disturbed_motion": lambda _: np.zeros(3),
    "without_drift": raises,
    "disturb": raises,
    "change_body": raises,
}


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("call", CALLS)
def test_every_call_of_an_estimator_is_guarded(call: str) -> None:
    guarded = make_estimator("own", scenario())
    MADE[-1].replaced = {call: CALLS[call]}
    inputs = EstimatorInputs(0, 0.1, ())
    guarded.update(inputs)
    results: dict[str, Callable[[], Any]] = {
        "estimate_at": lambda: guarded.estimate_at(10**8).status,
        "shape": lambda: guarded.shape,
        "disturbed_motion": lambda: guarded.disturbed_motion(0),
        "without_drift": lambda: guarded.without_drift(odometry()) == odometry(),
        "disturb": lambda: guarded.disturb(Shock(0.1, 0.1)),
        "change_body": lambda: guarded.change_body(cast(Any, None), np.eye(9)),
    }
    assert results[call]() == {"estimate_at": "none", "without_drift": True}.get(call)
    events = guarded.update(replace(inputs, time_ns=10**8)).events
    assert [e.level for e in events if e.text.startswith(f"estimator failed: 'own': {call}: ")] == [
        "warning"
    ]
    assert guarded.failed


class Scripted:
    """Returns the states that it is given, and then fails."""

    def __init__(self, state: TargetState) -> None:
        self.state: TargetState | None = state

    def update(self, inputs: EstimatorInputs) -> Any:
        return Estimate(cast(TargetState, self.state))


def test_continued_estimate_moves_at_constant_rates_with_its_covariance() -> None:
    """Against the motion of the states a small error apart."""
    root = 0.1 * RNG.normal(size=(12, 12))
    q = rotations.normalize(RNG.normal(size=4))
    p, v, w = RNG.normal(size=(3, 3))
    state = TargetState(2 * 10**9, p, v, q, w, root @ root.T, "tracking", 1, ())
    estimator = Scripted(state)
    guarded = GuardedEstimator("own", estimator, 1)
    guarded.update(EstimatorInputs(2 * 10**9, 0.1, ()))
    estimator.state = None
    found = guarded.update(EstimatorInputs(27 * 10**8, 0.1, ())).target
    assert (found.status, found.time_ns) == ("predicting", 27 * 10**8)
    np.testing.assert_allclose(found.position_m, p + 0.7 * v)
    np.testing.assert_allclose(found.q_wxyz, rotations.integrate(q, w, 0.7))

    step, columns = 1e-6, []
    for k in range(12):
        e = step * np.eye(12)[k]
        q_e = rotations.integrate(rotations.multiply(q, rotations.exp(e[6:9])), w + e[9:], 0.7)
        turn = rotations.multiply(rotations.conjugate(found.q_wxyz), q_e)
        p_e = p + e[:3] + 0.7 * (v + e[3:6])
        columns.append([*(p_e - found.position_m), *e[3:6], *rotations.log(turn), *e[9:]])
    transition = np.array(columns).T / step
    expected = transition @ state.covariance @ transition.T
    np.testing.assert_allclose(found.covariance, expected, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_array_equal(guarded.estimate_at(29 * 10**8).position_m, p + 0.9 * v)


def test_estimator_without_a_member_is_refused_before_the_flight(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entry = EntryPoint("own", f"{__name__}:Scripted", "chaserdock.estimators")
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])
    monkeypatch.setattr(EntryPoint, "load", lambda _: Scripted)
    with pytest.raises(PluginError, match="estimator 'own' has no member estimate_at"):
        make_estimator("own", scenario())


@pytest.mark.usefixtures("installed")
def test_failed_parts_are_counted_by_tick() -> None:
    mission = parse_scenario(SCENARIO, "test")
    node = ReplayNode("controller")
    core = ControllerCore(mission, lambda: 0.0)
    process = ControllerProcess(cast(Node, node), mission, core, replaying=True)
    MADE[-1].replaced = {"update": raises}
    for tick in range(3):
        process._process(Tick(tick=tick, sim_time_ns=tick * 10**8, images=False, chasers=()))
    assert node.counts.rejected["tick:estimator failed"] == 3


PLAN = NmpcPlan(
    RNG.normal(size=(2, 3, 6)),
    RNG.normal(size=(2, 4, 13)),
    ("solved", "budget"),
    np.array([1, 2]),
    RNG.normal(size=2),
    np.zeros(2),
)


@pytest.mark.parametrize(
    "wrong",
    [
        {"status": ("solved", "fine")},
        {"status": ("solved",)},
        {"iterations": np.array([1, -1])},
        {"iterations": None},
        {"cost": np.array([1.0, np.nan])},
        {"max_violation_m": np.zeros(3)},
        {"inputs": None},
        {"coasts": {0: 1.0}},
    ],
)
def test_every_value_of_a_plan_is_checked(wrong: dict[str, Any]) -> None:
    with pytest.raises(Exception, match=next(iter(wrong))):
        checked_plan(replace(PLAN, **wrong), 2, 3)


def test_plan_of_lists_is_taken_as_arrays() -> None:
    plan = checked_plan(replace(PLAN, inputs=PLAN.inputs.tolist(), cost=[1, 2]), 2, 3)  # type: ignore[arg-type]
    assert all(
        isinstance(getattr(plan, f.name), np.ndarray)
        for f in fields(plan)
        if f.name not in ("status", "coasts")
    )
    with pytest.raises(ValueError, match="returned NoneType"):
        checked_plan(cast(Any, None), 2, 3)
