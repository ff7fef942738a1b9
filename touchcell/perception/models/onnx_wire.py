"""Minimal ONNX serialisation: the few messages of onnx.proto that a contact network needs.

Importing the ``onnx`` package for this would cost a serving process 0.1 s and 7 MB or more. Source: onnx.proto (IR
version 8) and the protocol-buffer wire format; ``tests/perception/models/test_onnx_wire.py`` compares the bytes with
that package.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

_OPSET = 17
_IR_VERSION = 8
_FLOAT = 1
_ATTRIBUTE_INT, _ATTRIBUTE_INTS = 2, 7


def node(operator: str, inputs: Sequence[str], output: str, attributes: Mapping[str, int | Sequence[int]]) -> bytes:
    """Return a NodeProto with one output, and integers or lists of them as attributes."""
    parts = [_text(1, name) for name in inputs]
    parts += [_text(2, output), _text(4, operator)]
    for name, value in attributes.items():
        if isinstance(value, int):
            encoded = _number(3, value) + _number(20, _ATTRIBUTE_INT)
        else:
            encoded = b"".join(_number(8, item) for item in value) + _number(20, _ATTRIBUTE_INTS)
        parts.append(_block(5, _text(1, name) + encoded))
    return b"".join(parts)


def model(
    nodes: Sequence[bytes],
    constants: Mapping[str, NDArray[np.float32]],
    inputs: Mapping[str, Sequence[int | str]],
    outputs: Mapping[str, Sequence[int | str]],
) -> bytes:
    """Return a ModelProto of float32 tensors.

    Args:
        nodes: in an order in which they can be computed.
        constants: by the name that nodes use.
        inputs: shape by name; a string stands for an unknown size.
        outputs: likewise.
    """
    graph = [_block(1, encoded) for encoded in nodes]
    graph.append(_text(2, "touchcell"))
    graph += [_block(5, _tensor(name, array)) for name, array in constants.items()]
    graph += [_block(11, _value(name, shape)) for name, shape in inputs.items()]
    graph += [_block(12, _value(name, shape)) for name, shape in outputs.items()]
    return _number(1, _IR_VERSION) + _block(7, b"".join(graph)) + _block(8, _text(1, "") + _number(2, _OPSET))


def _tensor(name: str, array: NDArray[np.float32]) -> bytes:
    if array.dtype != np.float32:
        raise TypeError(f"{name} is {array.dtype}, not float32")
    dimensions = b"".join(_number(1, size) for size in array.shape)
    content = np.ascontiguousarray(array, dtype="<f4").tobytes()
    return dimensions + _number(2, _FLOAT) + _text(8, name) + _block(9, content)


def _value(name: str, shape: Sequence[int | str]) -> bytes:
    dimensions = [_text(2, size) if isinstance(size, str) else _number(1, size) for size in shape]
    tensor_type = _number(1, _FLOAT) + _block(2, b"".join(_block(1, dimension) for dimension in dimensions))
    return _text(1, name) + _block(2, _block(1, tensor_type))


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _text(field: int, value: str) -> bytes:
    return _block(field, value.encode())


def _block(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    """Encode a non-negative integer: seven bits a byte, lowest first."""
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)
