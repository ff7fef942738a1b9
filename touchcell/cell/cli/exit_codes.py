"""Exit codes of ``touchcell``."""

from typing import Final

EXIT_OK: Final = 0
"""Done, or ended by the operator."""
EXIT_TASK_FAILED: Final = 1
"""The task or the command failed."""
EXIT_BAD_INPUT: Final = 2
"""A file, a key or an argument is wrong; nothing has moved."""
EXIT_TRIPPED: Final = 3
"""An interlock tripped."""
EXIT_LOST: Final = 4
"""A device or a process was lost: unplugged, not reachable, killed."""
