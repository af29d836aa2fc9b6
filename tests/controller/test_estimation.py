# SPDX-License-Identifier: Apache-2.0
"""Estimation interface: estimators by name, refused parameters, and what its modules may import."""

from __future__ import annotations

import ast
import math
from pathlib import Path

import pytest
from chaserdock_controller import estimation
from chaserdock_controller.estimation import (
    Mekf,
    MekfParameters,
    PaperEstimator,
    PaperParameters,
    make_estimator,
)


def test_make_estimator() -> None:
    assert isinstance(make_estimator("mekf"), Mekf)
    assert isinstance(make_estimator("paper", PaperParameters(window=3)), PaperEstimator)
    with pytest.raises(ValueError, match="known: mekf, paper"):
        make_estimator("ukf")
    with pytest.raises(TypeError, match="MekfParameters"):
        make_estimator("mekf", PaperParameters())
    with pytest.raises(TypeError, match="PaperParameters"):
        make_estimator("paper", MekfParameters())


@pytest.mark.parametrize(
    "wrong",
    [
        {"motion_model": "spline"},
        {"gate_chi_square": 0.0},
        {"bias_focal_share": -1e-3},
        {"buffer_s": -1.0},
        {"initial_omega_rad_s": math.nan},
        {"single_marker_scale": 0.5},
        {"inertia_ratios": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 3.0))},
        {"inertia_ratios": ((1.0, 0.5, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))},
    ],
)
def test_wrong_parameters_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong)).replace("motion_model", "motion model")):
        MekfParameters(**wrong)
    with pytest.raises(ValueError, match="window"):
        PaperParameters(window=0)


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
