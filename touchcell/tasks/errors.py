"""Errors of the tasks."""

from __future__ import annotations

from collections.abc import Sequence

from touchcell.errors import TouchcellError


class TaskDefinitionError(TouchcellError, ValueError):
    """A task's table is invalid; raised when the task is built, before anything moves.

    Attributes:
        task: name of the task.
        problems: all problems found, one sentence each.
    """

    def __init__(self, task: str, problems: Sequence[str]) -> None:
        super().__init__(f"task {task!r}:" + "".join(f"\n  - {problem}" for problem in problems))
        self.task = task
        self.problems = tuple(problems)
