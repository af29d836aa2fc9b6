# SPDX-License-Identifier: Apache-2.0
"""Estimators by name, refused parameters, and what the modules of estimation may import."""

from __future__ import annotations

import ast
import math
from pathlib import Path

import pytest
from chaserdock_controller import estimation
from chaserdock_controller.estimation.estimators import make_estimator
from chaserdock_controller.estimation.joint import JointEstimator
from chaserdock_controller.estimation.joint.parameters import TargetParameters
from chaserdock_controller.estimation.paper import PaperEstimator
from chaserdock_protocol.plugins import PluginError
from chaserdock_protocol.scenario import ESTIMATORS
from flight_cases import scenario


def test_every_estimator_of_the_schema_can_be_made() -> None:
    made = [type(make_estimator(name, scenario())) for name in ESTIMATORS]
    assert made == [JointEstimator, PaperEstimator]
    with pytest.raises(PluginError, match="built in: joint, paper"):
        make_estimator("ukf", scenario())


@pytest.mark.parametrize(
    "wrong",
    [
        {"motion_model": "spline"},
        {"buffer_s": -1.0},
        {"initial_omega_rad_s": math.nan},
        {"single_marker_scale": 0.5},
        {"inertia_ratios": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 3.0))},
        {"inertia_ratios": ((1.0, 0.5, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))},
    ],
)
def test_wrong_parameters_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong)).replace("motion_model", "motion model")):
        TargetParameters(**wrong)


def test_no_clock_and_no_global_randomness() -> None:
    allowed = {
        "__future__",
        "bisect",
        "chaserdock_controller",
        "chaserdock_models",
        "chaserdock_protocol",
        "collections",
        "ctypes",
        "dataclasses",
        "functools",
    }
    allowed |= {
        "chaserdock_controller",
        "itertools",
        "math",
        "msgspec",
        "numpy",
        "threadpoolctl",
        "typing",
    }
    files = sorted(Path(estimation.__file__).parent.rglob("*.py"))
    assert len(files) >= 14
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                assert {a.name.split(".")[0] for a in node.names} <= allowed, file
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                assert (node.module or "").split(".")[0] in allowed, (file, node.module)
            elif isinstance(node, ast.Attribute):
                assert node.attr != "random", file
