"""A run's recording as arrays: one series per topic."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchcell.cell.recording.mcap import Damage, Message, read
from touchcell.cell.recording.messages import COMPONENTS
from touchcell.cell.recording.recorded_images import is_image
from touchcell.geometry import se3
from touchcell.geometry.types import Array

Times = NDArray[np.int64]


STAGES = (
    "read_arms",
    "read_frame",
    "preprocess",
    "infer",
    "filter",
    "task_and_control",
    "supervisor",
    "gate_and_send",
    "cycle",
)
"""Stages of a control cycle as recorded under /timing, in the order of execution, and the whole."""


@dataclass(frozen=True, slots=True)
class Series:
    """One topic over time: ``t_s`` (n,) and columns of the same length; missing values are NaN."""

    t_s: Array
    rows: tuple[dict[str, Any], ...]

    def column(self, name: str) -> Array:
        """Return the (n,) values of one key."""
        return np.array([_number(row.get(name)) for row in self.rows])

    def poses(self) -> Array:
        """Return (n, 6) Euler components in mm and degrees."""
        return np.stack([self.column(name) for name in COMPONENTS], axis=1)


@dataclass(frozen=True)
class Run:
    """A recording, by topic, with the task's states, and what could not be read of it."""

    topics: dict[str, Series]
    events: tuple[Message, ...]
    start_ns: int
    damage: tuple[Damage, ...] = ()

    def series(self, topic: str) -> Series | None:
        """Return the topic's series, or None where nothing was recorded."""
        return self.topics.get(topic)

    def roles(self, kind: str, leaf: str) -> list[str]:
        """Return the roles with a topic ``/kind/ROLE/leaf``."""
        parts = [topic.split("/") for topic in self.topics]
        return sorted(p[2] for p in parts if len(p) == 4 and p[1] == kind and p[3] == leaf)

    def during(self, t_s: Array, state: str) -> NDArray[np.bool_]:
        """Return a mask of the times ``t_s`` at which the task was in ``state``."""
        task = self.topics.get("/task")
        if task is None or not len(task.t_s):
            return np.zeros(len(t_s), dtype=bool)
        inside = np.array([row.get("state") == state for row in task.rows])
        index = np.clip(np.searchsorted(task.t_s, t_s, side="right") - 1, 0, len(inside) - 1)
        found: NDArray[np.bool_] = inside[index]
        return found


def load_run(path: Path) -> Run:
    """Read a recording; images are left out. Raises RecordingError."""
    damage: list[Damage] = []
    messages = [message for message in read(path, damage) if not is_image(message.topic)]
    return run_of(messages, damage)


def run_of(messages: Iterable[Message], damage: Iterable[Damage] = ()) -> Run:
    """Messages as a run."""
    grouped: dict[str, list[Message]] = {}
    for message in messages:
        grouped.setdefault(message.topic, []).append(message)
    events = tuple(grouped.pop("/events", []))
    start_ns = min((found[0].t_ns for found in grouped.values()), default=0)
    topics = {
        topic: Series(
            np.array([(message.t_ns - start_ns) * 1e-9 for message in found]),
            tuple(message.data for message in found),
        )
        for topic, found in grouped.items()
    }
    return Run(topics, events, start_ns, tuple(damage))


def tip_points(series: Series) -> Array:
    """Return the (n, 4, 4) poses of a pose series."""
    return se3.from_euler_mm_deg(series.poses())


def _number(value: Any) -> float:
    try:
        return float(value) if isinstance(value, int | float) else float("nan")
    except OverflowError:
        return float("nan")
