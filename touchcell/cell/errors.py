"""What can go wrong while a cell runs, beyond its devices and its safety."""

from __future__ import annotations

import traceback
from pathlib import Path

from touchcell.errors import TouchcellError, described


class RecordingError(TouchcellError):
    """The recording could not be written or read; what was written before stays readable.

    Attributes:
        file: the recording.
    """

    def __init__(self, file: Path, reason: str, *, hint: str = "") -> None:
        super().__init__(f"{file}: {reason}", hint=hint)
        self.file = file


class UnexpectedError(TouchcellError):
    """Code raised what it does not document: a mistake in touchcell or in a plug-in.

    Attributes:
        cause: what was raised.
    """

    def __init__(self, cause: BaseException) -> None:
        frames = traceback.extract_tb(cause.__traceback__)
        where = f"{frames[-1].filename}:{frames[-1].lineno}: " if frames else ""
        super().__init__(f"{where}{described(cause)}", hint="this is a mistake in the code, not in the cell")
        self.cause = cause
