# SPDX-License-Identifier: Apache-2.0
"""Layers of the network, and its ONNX file."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from onnx_perception import SIDE

LANDMARKS, HIDDEN = 12, 256
FILTERS = ((5, 1, 12), (3, 12, 24), (3, 24, 48), (3, 48, 64))
"""Side, inputs and outputs of each convolution of stride 2."""


def network(weights, facts):
    """Return the ONNX model of weights, with ``facts`` as metadata."""
    nodes, constants, name = [], [], "image"

    def constant(key, value):
        constants.append(numpy_helper.from_array(np.array(value, dtype=np.float32), key))
        return key

    *filters, hidden, last = weights
    for k, (w, b) in enumerate(filters):
        side = w.shape[2] // 2
        inputs = [name, constant(f"w{k}", w), constant(f"b{k}", b)]
        nodes.append(helper.make_node("Conv", inputs, [f"c{k}"], strides=[2, 2], pads=[side] * 4))
        name = f"r{k}"
        nodes.append(helper.make_node("Relu", [f"c{k}"], [name]))
    nodes.append(helper.make_node("Flatten", [name], ["flat"]))
    nodes.append(
        helper.make_node(
            "Gemm", ["flat", constant("wh", hidden[0]), constant("bh", hidden[1])], ["h"]
        )
    )
    nodes.append(helper.make_node("Relu", ["h"], ["a"]))
    nodes.append(
        helper.make_node(
            "Gemm", ["a", constant("wl", last[0]), constant("bl", last[1])], ["places"]
        )
    )
    graph = helper.make_graph(
        nodes,
        "landmarks",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n", 1, SIDE, SIDE])],
        [helper.make_tensor_value_info("places", TensorProto.FLOAT, ["n", last[0].shape[1]])],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, facts)
    onnx.checker.check_model(model)
    return model
