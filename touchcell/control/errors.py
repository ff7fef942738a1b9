"""Errors of the controllers."""

from __future__ import annotations

from typing import Any

from touchcell.errors import TouchcellError


class ControlError(TouchcellError, ValueError):
    """A controller was given an invalid argument; its state is unchanged.

    Attributes:
        argument: name of the offending argument.
        value: its value.
    """

    def __init__(self, argument: str, reason: str, value: Any, *, hint: str = "") -> None:
        super().__init__(f"{argument} {reason}", hint=hint)
        self.argument = argument
        self.value = value
