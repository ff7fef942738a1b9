"""Exit codes of ``touchcell``."""

EXIT_OK = 0


EXIT_TASK_FAILED = 1


EXIT_BAD_INPUT = 2


EXIT_TRIPPED = 3
