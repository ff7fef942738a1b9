"""Errors of the geometry package."""

from __future__ import annotations

from touchcell.errors import TouchcellError


class GeometryError(TouchcellError, ValueError):
    """An argument of a geometric function has the wrong shape, is not finite, or is not a rigid transform.

    Attributes:
        function: name of the function that raised.
        argument: name of the offending argument.
    """

    def __init__(self, function: str, argument: str, reason: str, *, hint: str = "") -> None:
        super().__init__(f"{function}: {argument} {reason}", hint=hint)
        self.function = function
        self.argument = argument
