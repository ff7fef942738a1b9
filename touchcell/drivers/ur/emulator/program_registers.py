"""Registers through which the control program and its client exchange commands and answers."""

from __future__ import annotations

from collections.abc import MutableMapping

import numpy as np

from touchcell.drivers.ur.codec import Value
from touchcell.geometry.types import Array


class ProgramRegisters:
    """Input and output registers from ``offset`` on.

    Args:
        inputs, outputs: values by the names of RTDE.
        offset: 0, or 24 if the client requested the upper range of registers.
    """

    def __init__(self, inputs: MutableMapping[str, Value], outputs: MutableMapping[str, Value], offset: int) -> None:
        self._inputs = inputs
        self._outputs = outputs
        self._offset = offset

    def integer(self, number: int) -> int:
        """Return an input integer."""
        return int(self._scalar(f"input_int_register_{number + self._offset}"))

    def double(self, number: int) -> float:
        """Return an input double."""
        return float(self._scalar(f"input_double_register_{number + self._offset}"))

    def vector(self, first: int) -> Array:
        """Return six input doubles."""
        return np.array([self.double(first + i) for i in range(6)])

    def answer(self, word: int, register: int = 0) -> None:
        """Write an output integer."""
        self._outputs[f"output_int_register_{register + self._offset}"] = word

    def decide(self, answer: int) -> None:
        """Answer a question for a number, or for yes or no."""
        self.answer(int(answer), register=1)

    def reply(self, values: Array) -> None:
        """Write output doubles, from the first one on."""
        for i, value in enumerate(values.tolist()):
            self._outputs[f"output_double_register_{i + self._offset}"] = value

    def _scalar(self, register: str) -> float:
        value = self._inputs.get(register, 0)
        assert not isinstance(value, tuple), "registers hold one number each"
        return value
