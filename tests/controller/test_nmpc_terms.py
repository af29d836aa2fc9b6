# SPDX-License-Identifier: Apache-2.0
"""Terms of the NMPC: the same in C and in CasADi, and no setting that nothing reads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from chaserdock_controller.nmpc.casadi_problem import cost_function, stage_weights
from chaserdock_controller.nmpc.kernels import plan_cost
from chaserdock_controller.nmpc.problem import check_input, native_problem, settings_of, terms_of
from chaserdock_controller.parameters import nmpc_settings
from chaserdock_models import rotations
from chaserdock_protocol.scenario.schema import Controller, Limits
from nmpc_cases import PARAMS, far_start, with_settings


class WithUnreadWeight(Controller):
    """A key that a scenario may set and no term has."""

    weight_x: float = 1.0


def test_a_key_that_no_term_reads_is_an_error() -> None:
    with pytest.raises(ValueError, match="no term of the NMPC reads weight_x"):
        nmpc_settings(WithUnreadWeight(), Limits())


def test_a_setting_that_no_key_states_is_an_error() -> None:
    settings = settings_of(PARAMS.terms)
    del settings["weight_force"]
    with pytest.raises(ValueError, match="the NMPC needs weight_force"):
        terms_of(settings)


@pytest.mark.parametrize("name", sorted(settings_of(PARAMS.terms)))
def test_every_setting_changes_the_problem(name: str) -> None:
    """As C sees it: a weight, or a number of `Problem`."""
    problem_at, states = far_start(1)
    problem = check_input(problem_at(states, 0.0), PARAMS, 1)
    changed = with_settings(PARAMS, **{name: 1.0 + 2.0 * settings_of(PARAMS.terms)[name]})
    weights = [
        np.array_equal(a, b) for a, b in zip(*map(stage_weights, (PARAMS, changed)), strict=True)
    ]
    outer = {native_problem(problem, params).outer for params in (PARAMS, changed)}
    assert not all(weights) or len(outer) == 2


def test_the_cost_in_c_equals_the_terms_in_casadi() -> None:
    rng = np.random.default_rng(4)
    params = replace(PARAMS, falloff=0.5)
    problem_at, states = far_start(2)
    problem = check_input(problem_at(states, 0.0), params, 2)
    x, u = rng.normal(size=(2, 31, 13)), rng.normal(size=(2, 30, 6))
    x[..., 6:10] = rotations.normalize(x[..., 6:10])
    u_ref = np.concatenate([problem.u_ref, np.zeros((2, 1, 6))], axis=1)
    inputs = np.concatenate([u, np.zeros((2, 1, 6))], axis=1)
    cost, weights = cost_function(params), stage_weights(params)
    expected = [
        sum(
            float(cost(x[i, k], problem.references[i, k], problem.target_positions[k],
                       inputs[i, k], u_ref[i, k], weights[k]))
            for k in range(31)
        )
        for i in range(2)
    ]  # fmt: skip
    np.testing.assert_allclose(plan_cost(native_problem(problem, params), x, u), expected)
