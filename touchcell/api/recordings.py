"""A run folder as NumPy arrays, with the unit of every column."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchcell.cell.analysis.run_data import Series, load_run
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.recording.mcap import RECORDING
from touchcell.errors import suggest
from touchcell.geometry.types import Array
from touchcell.units import unit_of


@dataclass(frozen=True)
class Topic(Mapping[str, NDArray[Any]]):
    """One topic of a recording: its columns by name.

    Attributes:
        name: such as "/arms/arm/tcp".
        t_s: (n,) time of each row since the start of the recording.
        columns: (n,) numbers, NaN where none was recorded; (n, k) for lists; strings and ragged lists as objects.
        units: unit by column, "" for what has none.
    """

    name: str
    t_s: Array
    columns: Mapping[str, NDArray[Any]]
    units: Mapping[str, str]

    def __getitem__(self, column: str) -> NDArray[Any]:
        if column not in self.columns:
            raise KeyError(f"{self.name} has no column {column!r} ({suggest(column, self.columns)})")
        return self.columns[column]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def __repr__(self) -> str:
        columns = ", ".join(f"{name} [{unit}]" if (unit := self.units[name]) else name for name in self.columns)
        return f"<Topic {self.name!r}: {len(self.t_s)} rows; {columns}>"


@dataclass(frozen=True)
class RunRecording(Mapping[str, Topic]):
    """What a run left behind, by topic; images are left out.

    Attributes:
        folder: the run folder.
        topics: by name.
        events: changes of state, in order, as they were recorded, with ``t_s``.
        result: how it ended, from result.json; empty where it was killed.
    """

    folder: Path
    topics: Mapping[str, Topic]
    events: tuple[Mapping[str, Any], ...]
    result: Mapping[str, Any]

    def __getitem__(self, topic: str) -> Topic:
        if topic not in self.topics:
            raise KeyError(f"{self.folder} has no topic {topic!r} ({suggest(topic, self.topics)})")
        return self.topics[topic]

    def __iter__(self) -> Iterator[str]:
        return iter(self.topics)

    def __len__(self) -> int:
        return len(self.topics)

    def __repr__(self) -> str:
        duration_s = max((topic.t_s[-1] for topic in self.topics.values() if len(topic.t_s)), default=0.0)
        outcome = self.result.get("outcome", "no result")
        return f"<RunRecording {str(self.folder)!r}: {outcome}, {len(self.topics)} topics, {duration_s:.2f} s>"


def read_run(folder: str | PathLike[str]) -> RunRecording:
    """Read a run folder into arrays.

        run = tc.read_run("runs/surface_follow_sim-20250102-030405")
        plt.plot(run["/arms/arm/tcp"].t_s, run["/arms/arm/tcp"]["z_mm"])

    Args:
        folder: run folder.

    Raises:
        RecordingError: it holds no recording.
    """
    path = Path(folder)
    run = load_run(path / RECORDING)
    return RunRecording(
        path,
        {name: _topic(name, series) for name, series in sorted(run.topics.items())},
        tuple({"t_s": (event.t_ns - run.start_ns) * 1e-9, **event.data} for event in run.events),
        RunFolder(path).result,
    )


def _topic(name: str, series: Series) -> Topic:
    names = list(dict.fromkeys(key for row in series.rows for key in row))
    columns = {key: _column([row.get(key) for row in series.rows]) for key in names}
    return Topic(name, series.t_s, columns, {key: unit_of(key) for key in names})


def _column(values: list[Any]) -> NDArray[Any]:
    present = [value for value in values if value is not None]
    if present and all(isinstance(value, bool) for value in present) and len(present) == len(values):
        return np.array(values, dtype=bool)
    if all(isinstance(value, int | float) for value in present):
        return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    if all(isinstance(value, list) and len(value) == len(present[0]) for value in present):
        width = len(present[0])
        rows = [[None] * width if value is None else value for value in values]
        if width and all(item is None or isinstance(item, int | float) for row in rows for item in row):
            return np.array(rows, dtype=np.float64)
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column
