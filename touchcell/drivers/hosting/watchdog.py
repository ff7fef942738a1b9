"""Watchdog process: monitors the heartbeats of task and device hosts, and stops all arms when one is missing.

``HeartbeatMonitor`` contains all decisions, as a function of given times; ``main`` is the loop around it.
"""

from __future__ import annotations

import json
import os
import select
import socket
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from touchcell.drivers.hosting.layouts import (
    ARM,
    HOST,
    TASK,
    WATCH,
    Cause,
    Reason,
    RecordReader,
    RecordWriter,
    write_cause,
)
from touchcell.drivers.hosting.realtime import request_realtime
from touchcell.drivers.hosting.wire import receive, send

MISSED_BEATS: Final = 2.5
"""Control periods of silence that count as two missed heartbeats."""

SLOW_PERIODS: Final = 1.5
"""A period of the task is late when it takes this many control periods."""

_WINDOW_NS: Final = 1_000_000_000
_LATE_SHARE: Final = 0.01
_LATE_COUNT: Final = 2
_REPORT_AFTER_S: Final = 3.0
_LINGER_S: Final = 10.0


def silence_s(period_s: float) -> float:
    """Return the longest silence that is allowed to task, hosts and watchdog."""
    return MISSED_BEATS * period_s


@dataclass(frozen=True, slots=True)
class Beat:
    """Newest heartbeat of a process.

    Attributes:
        count: number of heartbeats so far.
        t_ns: time of this one.
        latched: for a host: whether it has stopped its arms.
        late: for the task: number of late periods, since two heartbeats may fall between two polls of the watchdog.
        late_ns: duration of the newest late period.
    """

    count: int
    t_ns: int
    latched: bool = False
    late: int = 0
    late_ns: int = 0


class HeartbeatMonitor:
    """Decide whether all arms have to be stopped. Holds no clock.

    Args:
        period_s: control period of the task.
    """

    def __init__(self, period_s: float) -> None:
        self._period_ns = round(1e9 * period_s)
        self._silence_ns = round(1e9 * silence_s(period_s))
        self.begin(0)

    def begin(self, now_ns: int) -> None:
        """Reset: only events from now on count."""
        self._begun_ns = now_ns
        self._beats: deque[Beat] = deque()

    def update(self, now_ns: int, task: Beat, hosts: Sequence[Beat]) -> Cause | None:
        """Return the first cause to stop, or None; call several times per control period."""
        if (silent_ns := now_ns - max(task.t_ns, self._begun_ns)) > self._silence_ns:
            return Cause(Reason.TASK_SILENT, now_ns, silent_ns * 1e-9, self._silence_ns * 1e-9)
        for number, host in enumerate(hosts):
            if host.latched:
                return Cause(Reason.HOST_LATCHED, now_ns, host=number)
            if (silent_ns := now_ns - max(host.t_ns, self._begun_ns)) > self._silence_ns:
                return Cause(Reason.HOST_SILENT, now_ns, silent_ns * 1e-9, self._silence_ns * 1e-9, number)
        return self._too_slow(now_ns, task)

    def _too_slow(self, now_ns: int, task: Beat) -> Cause | None:
        beats = self._beats
        if not beats or task.count > beats[-1].count:
            beats.append(task)
        while len(beats) > 1 and beats[1].t_ns < now_ns - _WINDOW_NS:
            beats.popleft()
        if now_ns - self._begun_ns < _WINDOW_NS:
            return None
        late, periods = task.late - beats[0].late, task.count - beats[0].count
        if late < _LATE_COUNT or late <= _LATE_SHARE * periods:
            return None
        return Cause(Reason.TASK_SLOW, now_ns, task.late_ns * 1e-9, SLOW_PERIODS * self._period_ns * 1e-9)


class _Watchdog:
    def __init__(self, spec: dict[str, Any]) -> None:
        fds = spec["fds"]
        self._period_s: float = spec["period_s"]
        self._lifeline = socket.socket(fileno=fds["socket"])
        self._task = RecordReader(fds["task"], TASK)
        self._hosts = [RecordReader(fd, HOST) for fd in fds["hosts"]]
        self._arms = {name: RecordReader(fd, ARM) for name, fd in fds["arms"].items()}
        self._wakes: list[int] = fds["wakes"]
        self._watch = RecordWriter(fds["watch"], WATCH)
        self._monitor = HeartbeatMonitor(self._period_s)
        self._guarding = False
        self._cause: Cause | None = None
        self._notes: Path | None = None
        self._noted = False
        self._task_gone_ns: int | None = None

    def run(self) -> None:
        step_s = self._period_s / 4
        while not self._over():
            # No reply is sent: the lifeline is polled only when there is time.
            waiting = [] if self._task_gone_ns else [self._lifeline]
            if select.select(waiting, [], [], step_s)[0]:
                self._receive()
            self._poll(time.monotonic_ns())

    def _poll(self, now_ns: int) -> None:
        task = self._task.read()
        wanted = bool(task["guard"]) and self._task_gone_ns is None
        if wanted and not self._guarding:
            self._monitor.begin(now_ns)
        if self._guarding and self._cause is None:
            if self._task_gone_ns is not None:
                self._cause = Cause(Reason.TASK_GONE, now_ns)
            elif wanted:
                self._cause = self._monitor.update(
                    now_ns, _task_beat(task), [_host_beat(host.read()) for host in self._hosts]
                )
        self._guarding = wanted
        self._publish(now_ns)
        if self._notes is not None and not self._noted and self._cause is not None and self._settled(now_ns):
            self._write_notes(self._notes, self._cause)
            self._noted = True

    def _publish(self, now_ns: int) -> None:
        value = self._watch.value
        reported = bool(value["stop"])
        value["count"] += 1
        value["t_ns"] = now_ns
        value["guarding"] = self._guarding
        value["stop"] = self._cause is not None
        write_cause(value, self._cause or Cause(Reason.NONE, 0))
        self._watch.publish()
        if self._cause is not None and not reported:
            for wake in self._wakes:
                os.eventfd_write(wake, 1)

    def _receive(self) -> None:
        message = receive(self._lifeline)
        if message is None or message["call"] == "end":
            self._task_gone_ns = time.monotonic_ns()
            return
        if message["call"] == "notes":
            self._notes = Path(message["path"])
        elif message["call"] == "clear" and not self._guarding:
            self._cause = None
            self._noted = False
            self._publish(time.monotonic_ns())
        with suppress(OSError):
            send(self._lifeline, {"ok": self._cause is None, "number": message["number"]})

    def _settled(self, now_ns: int) -> bool:
        """Return whether all arms are at rest, or their time to stop has passed."""
        assert self._cause is not None
        if now_ns - self._cause.t_ns > _REPORT_AFTER_S * 1e9:
            return True
        return all(arm.read()["rest_ns"] >= arm.read()["stop_ns"] > 0 for arm in self._arms.values())

    def _write_notes(self, path: Path, cause: Cause) -> None:
        record = {
            "reason": cause.reason.name,
            "words": cause.reason.description,
            "t_ns": cause.t_ns,
            "value_s": cause.value_s,
            "limit_s": cause.limit_s,
            "host": cause.host,
            "arms": {name: stop_record(arm.read()) for name, arm in self._arms.items()},
        }
        # The arms are at rest; a full disk does not change that.
        with suppress(OSError):
            path.write_text(json.dumps(record, indent=1) + "\n")

    def _over(self) -> bool:
        if self._task_gone_ns is None:
            return False
        if time.monotonic_ns() - self._task_gone_ns > _LINGER_S * 1e9:
            return True
        return self._notes is None or self._noted or self._cause is None


def stop_record(arm: Any) -> dict[str, Any]:
    """Return a host's record of the stop of one arm, as plain data."""
    stopped, rested = int(arm["stop_ns"]), int(arm["rest_ns"])
    return {
        "stopped_ns": stopped,
        "commands_obeyed": int(arm["obeyed"]),
        "last_executed_ns": int(arm["executed_ns"]),
        "speed_m_s": float(arm["stop_speed_m_s"]),
        "time_s": (rested - stopped) * 1e-9 if rested >= stopped > 0 else None,
        "distance_m": float(arm["stop_way_m"]),
        "escalated": bool(arm["escalated"]),
    }


def _task_beat(record: Any) -> Beat:
    return Beat(int(record["count"]), int(record["t_ns"]), late=int(record["late"]), late_ns=int(record["late_ns"]))


def _host_beat(record: Any) -> Beat:
    return Beat(int(record["count"]), int(record["t_ns"]), bool(record["latched"]))


def main() -> None:
    """Run as ``python -m touchcell.drivers.hosting.watchdog SPEC``, with the descriptors named in SPEC inherited."""
    watchdog = _Watchdog(json.loads(sys.argv[1]))
    send(watchdog._lifeline, {"ok": True, "number": 0, "realtime": request_realtime()})
    watchdog.run()


if __name__ == "__main__":
    main()
