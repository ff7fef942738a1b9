"""The root of touchcell's one error tree, and errors about configuration and data, which any layer may raise."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import Any


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


def described(error: BaseException) -> str:
    """Return what ``repr`` says of an exception, or its type's name if that raises itself."""
    try:
        return repr(error)
    except Exception:
        return f"{type(error).__name__}()"


def suggest(word: str, known: Iterable[str], *, otherwise: str = "known") -> str:
    """A hint for an unknown ``word``: "did you mean" one of ``known``, or all of them after ``otherwise``."""
    names = sorted(known)
    if not names:
        return "there is none"
    near = difflib.get_close_matches(word, names, n=1)
    return f"did you mean {near[0]!r}?" if near else f"{otherwise}: {', '.join(names)}"


class ConfigError(TouchcellError, ValueError):
    """A configuration value is unknown, missing or out of range.

    Attributes:
        file: the file it stands in, or "" when it came from code.
        line: its line (1-based), or 0 when unknown.
        key: dotted path of the key.
        value: what was found.
    """

    def __init__(
        self, reason: str, *, file: str = "", line: int = 0, key: str = "", value: Any = None, hint: str = ""
    ) -> None:
        where = f"{file}:{line}: " if line else f"{file}: " if file else ""
        super().__init__(f"{where}{key + ': ' if key else ''}{reason}", hint=hint)
        self.reason = reason
        self.file = file
        self.line = line
        self.key = key
        self.value = value


class DataError(TouchcellError, ValueError):
    """A data set is incomplete or damaged.

    Attributes:
        file: the file or folder concerned.
        row: line of the label file (1 is the header), or 0.
        column: column of the label file, or "".
    """

    def __init__(self, file: Path, reason: str, *, row: int = 0, column: str = "", hint: str = "") -> None:
        where = f"{file}" + (f", line {row}" if row else "") + (f", column {column}" if column else "")
        super().__init__(f"{where}: {reason}", hint=hint)
        self.file = file
        self.row = row
        self.column = column
