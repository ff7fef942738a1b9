"""Exit codes of ``touchcell``."""

from __future__ import annotations

from typing import Final

EXIT_OK: Final = 0
EXIT_TASK_FAILED: Final = 1
EXIT_BAD_INPUT: Final = 2
EXIT_TRIPPED: Final = 3
EXIT_DEVICE_LOST: Final = 4
EXIT_INTERRUPTED: Final = 130

MEANING: Final = {
    EXIT_OK: "done, or stopped on request",
    EXIT_TASK_FAILED: "the task failed, recordings differ, or doctor found a fault",
    EXIT_BAD_INPUT: "bad input: a command, a file or a setting; nothing has moved",
    EXIT_TRIPPED: "an interlock tripped",
    EXIT_DEVICE_LOST: "a device or a process was lost, or did not answer",
}
"""One line each, for ``touchcell --help``."""
