"""The ONNX graph of a model, built from its header and tensors. Needs no PyTorch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from perception.architecture import Architecture
from perception.model_file import Model

IMAGES = "images"
OUTPUTS = "outputs"

_OPSET = 17
_IR_VERSION = 9


def onnx_model(model: Model) -> bytes:
    """A serialised ONNX model: float32 (n, 1, height, width) in [0, 1] to float32 (n, outputs).

    The same function as ``networks.ContactNetwork`` in evaluation, softbound included.

    Raises:
        TypeError: the model is no image network.
    """
    from onnx import NodeProto, TensorProto, helper, numpy_helper

    architecture = model.header.architecture
    if not isinstance(architecture, Architecture):
        raise TypeError(f"a model of kind {architecture.kind} has no graph")
    constants: dict[str, NDArray[np.generic]] = dict(model.tensors)
    nodes: list[NodeProto] = []
    last = IMAGES

    def add(operator: str, *others: str, output: str = "", **attributes: object) -> None:
        nonlocal last
        result = output or f"value{len(nodes)}"
        nodes.append(helper.make_node(operator, [last, *others], [result], **attributes))
        last = result

    for i in range(len(architecture.channels)):
        add("Conv", f"conv{i}.weight", f"conv{i}.bias", kernel_shape=[3, 3], pads=[1, 1, 1, 1])
        add("Relu")
        add("MaxPool", kernel_shape=[2, 2], strides=[2, 2])
    add("Flatten", axis=1)
    add("Gemm", "hidden.weight", "hidden.bias", transB=1)
    add("Relu")
    add("Gemm", "output.weight", "output.bias", output="" if architecture.bounds else OUTPUTS, transB=1)
    if architecture.bounds:
        low, high = (np.array(bound, dtype=np.float32) for bound in architecture.bounds)
        c = np.exp(low - high)
        constants |= {"low": low, "high": high, "c": c, "rest": np.float32(1) - c, "one": np.array(1, np.float32)}
        constants |= {"floor": low - np.float32(40), "ceiling": high + np.float32(40)}
        add("Max", "floor")
        add("Min", "ceiling")
        nodes.append(helper.make_node("Sub", ["low", last], ["below"]))
        last = "below"
        add("Exp")
        add("Add", "c")
        nodes.append(helper.make_node("Div", ["rest", last], ["share"]))
        last = "share"
        add("Add", "one")
        add("Log")
        add("Add", "low")
        add("Max", "low")
        add("Min", "high", output=OUTPUTS)

    height, width = architecture.input_size
    graph = helper.make_graph(
        nodes,
        "touchcell",
        [helper.make_tensor_value_info(IMAGES, TensorProto.FLOAT, ["n", 1, height, width])],
        [helper.make_tensor_value_info(OUTPUTS, TensorProto.FLOAT, ["n", architecture.outputs])],
        [numpy_helper.from_array(np.asarray(array), name) for name, array in constants.items()],
    )
    serialised: bytes = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION
    ).SerializeToString()
    return serialised
