# SPDX-License-Identifier: Apache-2.0
"""The ONNX file of a policy: normalization, two hidden layers, and one that passes both by."""

from __future__ import annotations

import numpy as np
from onnx import ModelProto, TensorProto, checker, helper, numpy_helper

NEAR = 8.0
"""Factor of the second copy of the normalized observation, which saturates: a policy sees 1 mm of
position as well as 1 dm.
"""


def network(weights, middle, scale, facts) -> ModelProto:
    """Return the ONNX model of the weights of train.py, from observations (n, width) to actions
    (n, k) between -1 and 1, with ``facts`` as metadata.
    """
    nodes, constants = [], []

    def add(kind, inputs, name, **attributes):
        given = []
        for k, value in enumerate(inputs):
            if isinstance(value, str):
                given.append(value)
                continue
            given.append(f"{name}_{k}")
            constants.append(numpy_helper.from_array(np.array(value, np.float32), given[-1]))
        nodes.append(helper.make_node(kind, given, [name], **attributes))
        return name

    centred = add("Sub", ["observation", middle], "centred")
    z = add("Div", [centred, scale], "normalized")
    near = add("Tanh", [add("Mul", [z, [NEAR]], "enlarged")], "near")
    x = add("Concat", [z, near], "features", axis=1)
    first, second, last, past = ((np.asarray(w), np.asarray(b)) for w, b in weights)
    h = add("Tanh", [add("Gemm", [x, *first], "layer_1")], "hidden_1")
    h = add("Tanh", [add("Gemm", [h, *second], "layer_2")], "hidden_2")
    sum_ = add("Add", [add("Gemm", [h, *last], "layer_3"), add("Gemm", [x, *past], "past")], "sum")
    add("Tanh", [sum_], "action")
    info = helper.make_tensor_value_info
    graph = helper.make_graph(
        nodes,
        "policy",
        [info("observation", TensorProto.FLOAT, ["n", len(middle)])],
        [info("action", TensorProto.FLOAT, ["n", len(last[1])])],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, facts)
    checker.check_model(model)
    return model


def weights_of(model):
    """Return weights, middle and scale of a model of ``network``."""
    found = {c.name: numpy_helper.to_array(c) for c in model.graph.initializer}
    names = ("layer_1", "layer_2", "layer_3", "past")
    weights = [(found[f"{name}_1"], found[f"{name}_2"]) for name in names]
    return weights, found["centred_1"], found["normalized_1"]
