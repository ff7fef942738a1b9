"""What this process and its children use of the cores, and what others do: for figures on a shared machine."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Usage:
    """Times since some moment.

    Attributes:
        wall_s: time.perf_counter().
        ours_s: CPU time of this process and all below it, ended ones that were waited for included.
        busy_s: time in which the machine's cores were not idle, stolen time included.
    """

    wall_s: float
    ours_s: float
    busy_s: float

    @classmethod
    def now(cls) -> Usage:
        """Return the present times."""
        return cls(time.perf_counter(), cpu_s_of(os.getpid()), _busy_s())

    def __sub__(self, earlier: Usage) -> Usage:
        return Usage(self.wall_s - earlier.wall_s, self.ours_s - earlier.ours_s, self.busy_s - earlier.busy_s)

    @property
    def others_cores(self) -> float:
        """Cores that others used."""
        return (self.busy_s - self.ours_s) / self.wall_s

    @property
    def left_s(self) -> float:
        """Time of the cores that others left, used or not."""
        return self.wall_s * (os.cpu_count() or 1) - (self.busy_s - self.ours_s)


def cpu_s_of(root: int) -> float:
    """Return the CPU time of a process and of its descendants."""
    tick_s = 1.0 / os.sysconf("SC_CLK_TCK")
    parents: dict[int, int] = {}
    used: dict[int, float] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue  # It has ended meanwhile.
        pid = int(path.parent.name)
        parents[pid] = int(fields[1])
        used[pid] = tick_s * sum(map(int, fields[11:15]))
    ours = {root}
    while more := {pid for pid, parent in parents.items() if parent in ours} - ours:
        ours |= more
    return sum(used.get(pid, 0.0) for pid in ours)


def _busy_s() -> float:
    fields = [int(each) for each in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    idle, waiting = fields[3], fields[4]
    return (sum(fields) - idle - waiting) / os.sysconf("SC_CLK_TCK")
