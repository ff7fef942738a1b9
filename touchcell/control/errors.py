"""What can go wrong in control, as types with attributes."""

from __future__ import annotations

from typing import Any

from touchcell.errors import TouchcellError


class ControlError(TouchcellError, ValueError):
    """A controller was given something that it must not work with; nothing was changed in it.

    Attributes:
        argument: name of the offending argument.
        value: what it was.
    """

    def __init__(self, argument: str, reason: str, value: Any, *, hint: str = "") -> None:
        super().__init__(f"{argument} {reason}", hint=hint)
        self.argument = argument
        self.value = value
