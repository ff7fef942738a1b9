"""What can go wrong while a cell runs, beyond its devices and its safety."""

from __future__ import annotations

from pathlib import Path

from touchcell.errors import TouchcellError


class RecordingError(TouchcellError):
    """The recording could not be written or read; what was written before stays readable.

    Attributes:
        file: the recording.
    """

    def __init__(self, file: Path, reason: str, *, hint: str = "") -> None:
        super().__init__(f"{file}: {reason}", hint=hint)
        self.file = file
