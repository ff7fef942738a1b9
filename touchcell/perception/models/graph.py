"""ONNX graph of a model, built from its header and tensors. Needs neither PyTorch nor the ``onnx`` package."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from touchcell.perception.models import onnx_wire
from touchcell.perception.models.architecture import CHECK, Architecture
from touchcell.perception.models.model_file import Model

IMAGES = "images"
OUTPUTS = "outputs"


def onnx_model(model: Model, *, after_first_block: bool = False) -> bytes:
    """Return a serialised ONNX model: float32 (n, 1, height, width) in [0, 1] to float32 (n, outputs).

    The same function as ``networks.ContactNetwork`` in evaluation, softbound included. ``after_first_block`` leaves out
    the first block, of which the input is the result: float32 (n, features, height / 2, width / 2).

    Raises:
        TypeError: the model is not an image network.
    """
    architecture = model.header.architecture
    if not isinstance(architecture, Architecture):
        raise TypeError(f"a model of kind {architecture.kind} has no graph")
    return network_graph(architecture, model.tensors, first=int(after_first_block))


def network_graph(architecture: Architecture, tensors: Mapping[str, NDArray[np.float32]], *, first: int = 0) -> bytes:
    """Return the serialised ONNX model of a network with these tensors, from its block ``first`` on."""
    before = tuple(f"conv{i}." for i in range(first))
    constants = {name: each for name, each in tensors.items() if not name.startswith((CHECK, *before))}
    nodes: list[bytes] = []
    last = IMAGES

    def add(operator: str, *others: str, output: str = "", before: str = "", **attributes: int | Sequence[int]) -> None:
        nonlocal last
        result = output or f"value{len(nodes)}"
        first = (before, last) if before else (last,)
        nodes.append(onnx_wire.node(operator, [*first, *others], result, attributes))
        last = result

    for i in range(first, len(architecture.channels)):
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
        # exp overflows to infinity far below, and its inverse is zero: the bounds hold over the whole range of float32.
        add("Sub", before="low")
        add("Exp")
        add("Add", "c")
        add("Div", before="rest")
        add("Add", "one")
        add("Log")
        add("Add", "low")
        add("Min", "high", output=OUTPUTS)
    height, width = (side >> first for side in architecture.input_size)
    features = architecture.channels[first - 1] if first else 1
    return onnx_wire.model(
        nodes, constants, {IMAGES: ("n", features, height, width)}, {OUTPUTS: ("n", architecture.outputs)}
    )
