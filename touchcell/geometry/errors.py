"""What can go wrong in geometry, as a type with attributes."""

from __future__ import annotations

from touchcell.errors import TouchcellError


class GeometryError(TouchcellError, ValueError):
    """An argument of a geometric function has the wrong shape, is not finite, or is no rigid transform.

    Attributes:
        function: the function that refused.
        argument: the name of the offending argument.
    """

    def __init__(self, function: str, argument: str, reason: str, *, hint: str = "") -> None:
        super().__init__(f"{function}: {argument} {reason}", hint=hint)
        self.function = function
        self.argument = argument
