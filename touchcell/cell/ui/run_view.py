"""What the operator's page shows of a run at one moment, from its recording alone.

A run that is in progress is followed from here: its recording is read as it grows, so nothing that happens to a page,
a browser or this process reaches the control cycle.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from touchcell.cell.analysis.contact_images import contact_pictures
from touchcell.cell.analysis.frame_poses import frame_poses
from touchcell.cell.analysis.limits import WatchedQuantity, watched_quantities
from touchcell.cell.analysis.run_data import Run, Series, load_run, run_of
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.recording.mcap import RECORDING, Message, follow, read
from touchcell.cell.recording.messages import COMPONENTS
from touchcell.cell.recording.recorded_images import is_image
from touchcell.cell.runtime.black_box import MESSAGES, RING, read_left_ring
from touchcell.cell.runtime.operator_channel import is_waiting
from touchcell.cell.runtime.operator_input import is_running
from touchcell.cell.scene.description import SceneDescription, describe_scene
from touchcell.errors import TouchcellError
from touchcell.geometry.types import Array

WINDOW_S: Final = 3.0
"""How much of a run in progress is kept; the recording has all of it."""
_ROWS: Final = 30
"""Newest messages of a topic that a moment is made of: a health reading comes once in 25 cycles."""
_PICTURE_NS: Final = 100_000_000
"""Time between two pictures."""
_MOST_PICTURES: Final = 3000
_POLL_S: Final = 0.05
_EVENTS: Final = 12
_NEAR_MM: Final = 50.0
"""Distance from a wall at which its bar begins to fill."""


@dataclass(frozen=True, slots=True)
class Bar:
    """A quantity on its way to the limit of an interlock.

    Attributes:
        interlock: name in the cell file.
        subject: role of the arm or sensor.
        text: quantity, value and limit.
        fraction: 0 at rest, 1 at the limit; None where the recording does not have the quantity.
    """

    interlock: str
    subject: str
    text: str
    fraction: float | None


@dataclass(frozen=True, slots=True)
class ContactRow:
    """A sensor's contact: components in mm and degrees with their standard deviations; empty without contact."""

    sensor: str
    in_contact: bool
    values: tuple[tuple[str, float, float], ...]


@dataclass(frozen=True)
class Moment:
    """A run at one moment.

    Attributes:
        t_s: since its first message.
        state: of its task.
        bars: of all interlocks of the cell file.
        contacts: of all sensors.
        health: readings of each device.
        events: newest last.
        poses: (4, 4) in the world, by frame.
    """

    t_s: float
    state: str = ""
    bars: tuple[Bar, ...] = ()
    contacts: tuple[ContactRow, ...] = ()
    health: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    events: tuple[str, ...] = ()
    poses: Mapping[str, Array] = field(default_factory=dict)


def sources(folder: Path) -> list[str]:
    """Return the files of a run that can be shown: its recording, its black boxes, and the ring that a crash leaves."""
    boxes = [*sorted(folder.glob("blackbox-*.mcap")), folder / MESSAGES]
    if not is_running(folder):
        boxes.append(folder / RING)
    return [path.name for path in (folder / RECORDING, *boxes) if path.is_file()]


class RunView:
    """A run's folder as the page shows it; read in a thread of its own from ``start`` to ``close``.

    Args:
        folder: the run folder.
        source: one of ``sources``; only a recording is followed as it grows.

    Attributes:
        plan: its cell.
        scene: what the cell looks like; None where that cannot be drawn.
        problem: why the recording cannot be shown, for people; empty while it can.

    Raises:
        ConfigError: the folder holds no readable cell file.
    """

    def __init__(self, folder: Path, source: str = RECORDING) -> None:
        self.folder = folder
        self.source = source
        self.plan: CellPlan = plan_cell(folder / "cell.yaml", to_run=False)
        self.scene: SceneDescription | None = None
        self.problem = ""
        try:
            self.scene = describe_scene(self.plan)
        except Exception:
            # A scene of a plug-in that cannot be drawn; the rest of the page can.
            self.scene = None
        self._lock = threading.Lock()
        self._window: deque[Message] = deque()
        self._events: deque[Message] = deque(maxlen=_EVENTS)
        self._start_ns: int | None = None
        self._run: Run | None = None
        self._pictures: dict[str, tuple[list[float], list[bytes]]] = {}
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self.read, name=f"view {folder.name}", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """Read no more."""
        self._closed.set()

    @property
    def running(self) -> bool:
        """Whether the run is in progress."""
        return is_running(self.folder)

    @property
    def waiting(self) -> bool:
        """Whether it has tripped and waits for its operator."""
        return is_waiting(self.folder)

    @property
    def end_s(self) -> float | None:
        """Length of a recording that has been read to its end; None before."""
        run = self._run
        return None if run is None else _end_s(run)

    def moment(self, t_s: float | None = None) -> Moment | None:
        """Return the run at a time since its start, or its newest moment; None before anything has been read."""
        run = self._run
        if run is not None:
            return _moment(run, self.plan, self.scene, _end_s(run) if t_s is None else t_s, 0.0, run.events)
        with self._lock:
            window, events, start_ns = tuple(self._window), tuple(self._events), self._start_ns
        if not window or start_ns is None:
            return None
        live = run_of(window)
        return _moment(live, self.plan, self.scene, _end_s(live), (live.start_ns - start_ns) * 1e-9, events)

    def picture(self, sensor: str, t_s: float | None = None) -> bytes | None:
        """Return the newest JPEG of a sensor's image with its displacements, up to a time; None where there is none."""
        with self._lock:
            times, pictures = self._pictures.get(sensor, ([], []))
            at = len(times) if t_s is None else bisect_right(times, t_s)
            return pictures[at - 1] if at else None

    def read(self) -> None:
        """Read the recording to its end, as it grows."""
        path = self.folder / self.source
        try:
            if self.source == RING:
                self._run = run_of(read_left_ring(self.folder)[1])
                return
            if self.running and self.source == RECORDING:
                self._take_pictures(self._kept(follow(path, self._wait)))
            if not self._closed.is_set():
                self._run = run = load_run(path)
                with self._lock:
                    missing = not self._pictures
                if missing:
                    self._start_ns = run.start_ns
                    self._take_pictures(read(path, []))
        except TouchcellError as error:
            self.problem = str(error)
        except Exception as error:
            # Whatever is wrong with a file, the page says so.
            self.problem = f"the recording cannot be shown: {error!r}"

    def _wait(self) -> bool:
        """Whether more may come; waits a moment for it."""
        if self._closed.is_set():
            return False
        going = self.running
        time.sleep(_POLL_S)
        return going

    def _kept(self, messages: Iterable[Message]) -> Iterator[Message]:
        """Pass messages on, and keep the latest."""
        for message in messages:
            with self._lock:
                if self._start_ns is None:
                    self._start_ns = message.t_ns
                if message.topic == "/events":
                    self._events.append(message)
                elif not is_image(message.topic):
                    self._window.append(message)
                    while self._window[0].t_ns < message.t_ns - WINDOW_S * 1e9:
                        self._window.popleft()
            yield message

    def _take_pictures(self, messages: Iterable[Message]) -> None:
        drawn_ns: dict[str, int] = {}
        # Markers are followed from each image to the next; fewer pictures are drawn than anybody could tell apart.
        for picture in contact_pictures(messages):
            if self._closed.is_set():
                return
            if picture.t_ns - drawn_ns.get(picture.role, -_PICTURE_NS) < _PICTURE_NS:
                continue
            drawn_ns[picture.role] = picture.t_ns
            data = cv2.imencode(".jpg", picture.drawn())[1].tobytes()
            with self._lock:
                times, pictures = self._pictures.setdefault(picture.role, ([], []))
                times.append((picture.t_ns - (self._start_ns or 0)) * 1e-9)
                pictures.append(data)
                if len(pictures) > _MOST_PICTURES:
                    del times[0], pictures[0]


def _end_s(run: Run) -> float:
    return max((float(series.t_s[-1]) for series in run.topics.values() if len(series.t_s)), default=0.0)


def _until(run: Run, t_s: float) -> Run:
    """Return the newest messages of each topic up to a time."""
    topics = {}
    for topic, series in run.topics.items():
        end = int(np.searchsorted(series.t_s, t_s + 1e-6, side="right"))
        if end:
            topics[topic] = Series(series.t_s[max(end - _ROWS, 0) : end], series.rows[max(end - _ROWS, 0) : end])
    return Run(topics, run.events, run.start_ns)


def _moment(
    run: Run, plan: CellPlan, scene: SceneDescription | None, t_s: float, offset_s: float, events: Iterable[Message]
) -> Moment:
    """Return the moment ``t_s`` of a run whose own time begins ``offset_s`` after its start."""
    now = _until(run, t_s)
    task = now.series("/task")
    zero_ns = run.start_ns - offset_s * 1e9
    shown = [event for event in events if (event.t_ns - run.start_ns) * 1e-9 <= t_s + 1e-6][-_EVENTS:]
    poses = {} if scene is None else frame_poses(now, scene, np.array([t_s]))
    return Moment(
        t_s + offset_s,
        "" if task is None else str(task.rows[-1].get("state", "")),
        tuple(_bars(now, plan)),
        tuple(_contacts(now)),
        {
            topic.removeprefix("/health/"): {key: value for key, value in series.rows[-1].items() if key != "seq"}
            for topic, series in now.topics.items()
            if topic.startswith("/health/")
        },
        tuple(_line(event, zero_ns) for event in shown),
        {name: along[-1] for name, along in poses.items()},
    )


def _bars(run: Run, plan: CellPlan) -> Iterator[Bar]:
    found = list(watched_quantities(run, plan))
    series = run.series("/interlocks")
    levels = [] if series is None else list(_levels(series.rows[-1]))
    for name, entry in plan.cell.interlocks.items():
        mine = [_bar(each) for each in found if each.interlock == name]
        mine = mine or [_level_bar(*each, entry.kind) for each in levels if each[0] == name]
        if mine:
            yield from mine
        elif series is not None and (limit_ms := getattr(entry, "limit_ms", None)) is not None:
            # A timer that does not run.
            yield Bar(name, "", f"{entry.kind.replace('_', ' ')} 0 of {limit_ms:.4g} ms", 0.0)
        else:
            yield Bar(name, "", f"{entry.kind.replace('_', ' ')}: armed; nothing of it is recorded", None)


def _levels(row: Mapping[str, Any]) -> Iterator[tuple[str, str, float, float, str]]:
    """Yield interlock, subject, value, limit and unit."""
    lists = [row.get(key) or [] for key in ("interlock", "subject", "value", "limit", "unit")]
    for name, subject, value, limit, unit in zip(*lists, strict=False):
        yield str(name), str(subject), _number(value), _number(limit), str(unit)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _level_bar(name: str, subject: str, value: float, limit: float, unit: str, kind: str) -> Bar:
    text = f"{kind.replace('_', ' ')} {value:.3g} of {limit:.4g} {unit}".rstrip()
    fraction = value / limit if limit > 0.0 and np.isfinite(value) else 0.0
    return Bar(name, subject, text, float(np.clip(fraction, 0.0, 1.0)))


def _bar(quantity: WatchedQuantity) -> Bar:
    value = float(quantity.values[-1]) if len(quantity.values) else float("nan")
    unit = f" {quantity.unit}" if quantity.unit else ""
    if not np.isfinite(value):
        text = f"{quantity.title}: none now, limit {quantity.limit:.4g}{unit}"
        return Bar(quantity.interlock, quantity.subject, text, 0.0)
    if quantity.distance:
        # Negative inside: the bar fills over the last centimetres before the wall.
        text = f"{abs(value):.1f}{unit} {'beyond' if value > 0.0 else 'inside'} the workspace"
        return Bar(quantity.interlock, quantity.subject, text, float(np.clip(1.0 + value / _NEAR_MM, 0.0, 1.0)))
    text = f"{quantity.title} {value:.3g} of {quantity.limit:.4g}{unit}"
    return Bar(quantity.interlock, quantity.subject, text, float(np.clip(value / quantity.limit, 0.0, 1.0)))


def _contacts(run: Run) -> Iterator[ContactRow]:
    for role in run.roles("sensors", "contact"):
        series = run.series(f"/sensors/{role}/contact")
        row = {} if series is None else series.rows[-1]
        touching = bool(row.get("in_contact"))
        values = tuple(
            (name, float(row[name]), float(row[f"sigma_{name}"]))
            for name in COMPONENTS
            if touching and isinstance(row.get(name), float) and isinstance(row.get(f"sigma_{name}"), float)
        )
        yield ContactRow(role, touching, values)


def _line(event: Message, zero_ns: float) -> str:
    data = event.data
    change = f" {data.get('from')} → {data.get('to')}" if data.get("from") and data.get("to") else ""
    reason = f": {data['reason']}" if data.get("reason") else ""
    return f"{(event.t_ns - zero_ns) * 1e-9:8.2f} s  {data.get('event')}{change}{reason}"
