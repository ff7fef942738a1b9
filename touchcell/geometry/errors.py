"""The root of touchcell's one error tree, and the geometric branch of it."""

from __future__ import annotations


class TouchcellError(Exception):
    """Anything touchcell raises on purpose.

    Subclasses carry their facts as attributes, so that callers never match on text.

    Args:
        message: one sentence that says what is wrong.
        hint: one sentence that says what to do about it; may be empty.
    """

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.message} ({self.hint})" if self.hint else self.message


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
