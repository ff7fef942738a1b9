"""Registry of the installed tasks, without importing any of them."""

from __future__ import annotations

from importlib.metadata import EntryPoint

from touchcell import registry as entry_points
from touchcell.tasks.interface import TaskSpec

GROUP = "touchcell.tasks"


def installed() -> dict[str, EntryPoint]:
    """Return the entry points of all installed tasks by name; nothing is imported."""
    return entry_points.installed(GROUP)


def spec(name: str) -> TaskSpec:
    """Return the spec of task ``name``. Raises ConfigError with a suggestion for an unknown one."""
    return entry_points.load(GROUP, "task", name, TaskSpec)
