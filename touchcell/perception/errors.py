"""Errors of data sets, images, models and trainings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from touchcell.errors import TouchcellError


class ImageError(TouchcellError, ValueError):
    """An image does not match the preprocessing.

    Attributes:
        attribute: "size", "channels", "dtype" or "type".
        expected: value that the preprocessing requires.
        found: value of the image.
    """

    def __init__(self, attribute: str, expected: Any, found: Any, *, hint: str = "") -> None:
        super().__init__(f"image {attribute} is {found}, expected {expected}", hint=hint)
        self.attribute = attribute
        self.expected = expected
        self.found = found


class ArrayError(TouchcellError, ValueError):
    """An array does not meet the requirements of a compiled kernel.

    Attributes:
        function: name of the kernel.
        argument: name of the offending argument.
    """

    def __init__(self, function: str, argument: str, reason: str, *, hint: str = "") -> None:
        super().__init__(f"{function}: {argument} {reason}", hint=hint)
        self.function = function
        self.argument = argument


class KernelsMissing(TouchcellError):
    """The C extension for marker detection and matching was not built."""

    def __init__(self) -> None:
        super().__init__(
            "perception's C extension was not built",
            hint="install a C compiler and install touchcell again; models of kind gdn and cnn work without it",
        )


class ModelError(TouchcellError, ValueError):
    """A model file cannot be used.

    Attributes:
        file: the file.
        key: the header field or tensor concerned, or "".
    """

    def __init__(self, file: Path, reason: str, *, key: str = "", hint: str = "") -> None:
        super().__init__(f"{file}: {key + ': ' if key else ''}{reason}", hint=hint)
        self.file = file
        self.key = key


class CameraError(TouchcellError):
    """A sensor's camera does not show what the model's own camera would, and no calibration can undo it.

    Attributes:
        sensor: name of the sensor.
        reason: what differs.
    """

    def __init__(self, sensor: str, reason: str, *, hint: str = "") -> None:
        super().__init__(f"sensor {sensor}: {reason}", hint=hint)
        self.sensor = sensor
        self.reason = reason


class TrainingError(TouchcellError):
    """A training cannot start or continue; no model was written.

    Attributes:
        epoch: the epoch (1-based) in which it stopped, or 0 when it never started.
    """

    def __init__(self, reason: str, *, epoch: int = 0, hint: str = "") -> None:
        super().__init__(f"epoch {epoch}: {reason}" if epoch else reason, hint=hint)
        self.epoch = epoch
