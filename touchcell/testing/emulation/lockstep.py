"""Drivers and emulators in one process on one simulated time: deterministic, and faster than real time.

Every thread of a ``Lockstep`` world is a task, of which exactly one runs at a time. A task runs until it waits: for a
time, a file, a lock, or another task. When all of them wait, the time advances at once to the first deadline. What a
busy machine does to its threads therefore changes nothing, neither the order of events nor their times.

The world is the clock of the drivers in it, also for their waits on files (``touchcell.drivers.core.clock``), and the
time of the emulators' event loops. Threads and locks of a driver's module take part when it is named.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import contextvars
import math
import select
import selectors
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from types import ModuleType, TracebackType
from typing import Any, Self, TypeVar
from unittest.mock import patch

from touchcell.drivers.core.errors import ConnectError, TransportTimeout
from touchcell.drivers.core.paced_clock import share_clock
from touchcell.errors import TouchcellError
from touchcell.geometry.types import Array
from touchcell.testing.emulation.base import Emulator
from touchcell.testing.emulation.launcher import EMULATORS

T = TypeVar("T")

_START_NS = 1_000_000_000_000
# Reading the clock takes time, as on a machine: two samples never have one stamp.
_READING_NS = 100
_REPLY_S = 10.0
_OUTSIDE_S = 20e-6
_ASKING_NS = 50_000


class StuckError(TouchcellError):
    """Every task of a world waits for another one, without a deadline."""


def _never() -> bool:
    return False


def _always() -> bool:
    return True


@dataclass(eq=False, slots=True)
class _Task:
    name: str
    go: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    is_ready: Callable[[], bool] = _always
    until_ns: int | None = None
    suspended: bool = False
    is_outside: bool = False


class Lockstep:
    """A world: clock and scheduler of the threads in it. The thread that enters it is its first task.

    Args:
        modules: modules of drivers that start threads or hold locks while they wait; within the world their name
            ``threading`` stands for the world's threads, locks and events.
    """

    def __init__(self, modules: Sequence[ModuleType] = ()) -> None:
        self._modules = modules
        self._now_ns = _START_NS
        self._main = _Task("main")
        self._tasks = [self._main]
        self._of_thread: dict[int, _Task] = {}
        self._stuck = False
        self._entered = contextlib.ExitStack()
        self.threading = _Threading(self)

    def __enter__(self) -> Self:
        self._of_thread[threading.get_ident()] = self._main
        self._entered.enter_context(share_clock(self))
        self._outside = self._entered.enter_context(ThreadPoolExecutor(1, "outside"))
        for module in self._modules:
            self._entered.enter_context(patch.object(module, "threading", self.threading))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._entered.close()

    def now_ns(self) -> int:
        """Return the simulated time in ns."""
        self._now_ns += _READING_NS
        return self._now_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Let the other tasks run until ``t_ns``."""
        self.wait(_never, t_ns)

    def wait_readable(self, fd: int, until_ns: int) -> bool:
        """Let the other tasks run until ``fd`` can be read or ``t_ns``; return whether it can."""
        poller = select.poll()
        poller.register(fd, select.POLLIN)
        return self.wait(lambda: bool(poller.poll(0)), until_ns)

    def wait(self, is_ready: Callable[[], bool], until_ns: int | None = None) -> bool:
        """Let the other tasks run until ``is_ready()`` or ``until_ns``; return whether it was ready.

        Raises:
            StuckError: all tasks wait for each other.
        """
        if is_ready():
            return True
        if until_ns is not None and until_ns <= self._now_ns:
            return False
        task = self._of_thread[threading.get_ident()]
        task.is_ready, task.until_ns = is_ready, until_ns
        following = self._next(self._tasks.index(task) + 1)
        if following is not task:
            following.go.release()
            task.go.acquire()
        if self._stuck:
            raise StuckError(f"all wait for each other: {', '.join(other.name for other in self._tasks)}")
        return is_ready()

    def outside(self, call: Callable[[], T]) -> T:
        """Return ``call()``, which blocks until another task answers; the time stands still meanwhile."""
        task = self._of_thread[threading.get_ident()]
        future = self._outside.submit(call)
        task.is_outside = True
        try:
            self.wait(future.done)
        finally:
            task.is_outside = False
        return future.result()

    def add(self, name: str) -> _Task:
        """Add a task, which runs once the running one waits."""
        task = _Task(name)
        self._tasks.append(task)
        return task

    def began(self, task: _Task) -> None:
        """Wait for the first turn of a task, in its own thread."""
        self._of_thread[threading.get_ident()] = task
        task.go.acquire()

    def ended(self, task: _Task) -> None:
        """Remove a task, in its own thread, and let another one run."""
        at = self._tasks.index(task)
        del self._tasks[at], self._of_thread[threading.get_ident()]
        self._next(at).go.release()

    def is_present(self, task: _Task) -> bool:
        """Return whether a task has not ended."""
        return task in self._tasks

    def _next(self, at: int) -> _Task:
        """Return the task whose turn it is, beginning with number ``at``; advance the time if none is ready."""
        tasks = [task for task in self._tasks[at:] + self._tasks[:at] if not task.suspended]
        while True:
            for task in tasks:
                if (task.until_ns is not None and task.until_ns <= self._now_ns) or task.is_ready():
                    return task
            if any(task.is_outside for task in tasks):
                time.sleep(_OUTSIDE_S)
                continue
            deadlines = [task.until_ns for task in tasks if task.until_ns is not None]
            if not deadlines:
                self._stuck = True
                return self._main
            self._now_ns = max(self._now_ns, min(deadlines))


class _Threading:
    """The part of the module ``threading`` that drivers use, for the tasks of a world."""

    def __init__(self, world: Lockstep) -> None:
        self._world = world

    def Thread(self, target: Callable[[], None], name: str = "task", daemon: bool = True) -> _Thread:  # noqa: N802
        return _Thread(self._world, target, name)

    def RLock(self) -> _Lock:  # noqa: N802
        return _Lock(self._world)

    def Lock(self) -> _Lock:  # noqa: N802
        return _Lock(self._world)

    def Event(self) -> _Event:  # noqa: N802
        return _Event(self._world)


class _Thread(threading.Thread):
    def __init__(self, world: Lockstep, target: Callable[[], None], name: str) -> None:
        super().__init__(target=contextvars.copy_context().run, args=(target,), name=name, daemon=True)
        self._world = world
        self.task: _Task | None = None

    def start(self) -> None:
        self.task = self._world.add(self.name)
        super().start()

    def run(self) -> None:
        assert self.task is not None
        self._world.began(self.task)
        try:
            super().run()
        finally:
            self._world.ended(self.task)

    def is_alive(self) -> bool:
        return self.task is not None and self._world.is_present(self.task)

    def join(self, timeout: float | None = None) -> None:
        if self._world.wait(lambda: not self.is_alive(), _deadline_ns(self._world, timeout)):
            super().join()


class _Lock:
    """A lock, which its owner may take again."""

    def __init__(self, world: Lockstep) -> None:
        self._world = world
        self._owner = 0
        self._depth = 0

    def acquire(self, blocking: bool = True, timeout: float = -1.0) -> bool:
        me = threading.get_ident()
        if self._owner not in (0, me):
            until_ns = self._world.now_ns() if not blocking else _deadline_ns(self._world, timeout)
            if not self._world.wait(lambda: self._owner == 0, until_ns):
                return False
        self._owner = me
        self._depth += 1
        return True

    def release(self) -> None:
        self._depth -= 1
        if self._depth == 0:
            self._owner = 0

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()


class _Event:
    def __init__(self, world: Lockstep) -> None:
        self._world = world
        self._set = False

    def is_set(self) -> bool:
        return self._set

    def set(self) -> None:
        self._set = True

    def clear(self) -> None:
        self._set = False

    def wait(self, timeout: float | None = None) -> bool:
        return self._world.wait(lambda: self._set, _deadline_ns(self._world, timeout))


def _deadline_ns(world: Lockstep, timeout_s: float | None) -> int | None:
    return None if timeout_s is None or timeout_s < 0.0 else world.now_ns() + round(timeout_s * 1e9)


class _WorldSelector(selectors.EpollSelector):
    def __init__(self, world: Lockstep) -> None:
        super().__init__()
        self._world = world

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        found = super().select(0)
        if found or (timeout is not None and timeout <= 0.0):
            return found
        until_ns = None if timeout is None else self._world.now_ns() + math.ceil(timeout * 1e9)
        poller = select.poll()
        poller.register(self.fileno(), select.POLLIN)
        self._world.wait(lambda: bool(poller.poll(0)), until_ns)
        return super().select(0)


class _WorldLoop(asyncio.SelectorEventLoop):
    """Event loop whose ``time``, sleeps and timers are those of the world."""

    def __init__(self, world: Lockstep) -> None:
        self._world = world
        super().__init__(_WorldSelector(world))

    def time(self) -> float:
        return 1e-9 * self._world.now_ns()


def emulator_in_step(
    world: Lockstep, name: str, *arguments: str, build: Callable[[Any], Emulator] | None = None
) -> EmulatorInStep:
    """Return the emulator ``name`` with the arguments of its command line; it is not started yet.

    Args:
        world: the world.
        name: of the emulator, as for ``touchcell emulate``.
        arguments: its command line.
        build: builds the emulator from these arguments, if not as the module does.
    """
    module = EMULATORS.load(name)
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)
    options = parser.parse_args(arguments)
    return EmulatorInStep(world, name, lambda: (build or module.build)(options))


class EmulatorInStep:
    """An emulator in a task of a world, with the operations of ``EmulatorProcess``.

    Args:
        world: the world; also an attribute.
        name: for errors.
        build: builds the emulator; called within the world.
    """

    def __init__(self, world: Lockstep, name: str, build: Callable[[], Emulator]) -> None:
        self.world = world
        self._name = name
        self._build = build
        self._thread: _Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._done: asyncio.Event | None = None
        self._emulator: Emulator | None = None
        self._failure: BaseException | None = None

    def start(self) -> Self:
        """Start and wait until it is ready. Raises ConnectError."""
        self._emulator = self._failure = None
        self._thread = self.world.threading.Thread(target=self._run, name=self._name)
        self._thread.start()
        self.world.wait(lambda: self._emulator is not None or self._failure is not None)
        if self._failure is not None:
            raise ConnectError(self._name, f"emulator did not start: {self._failure}")
        return self

    def _run(self) -> None:
        try:
            with asyncio.Runner(loop_factory=lambda: _WorldLoop(self.world)) as runner:
                runner.run(self._serve())
        except OSError as error:
            self._failure = error

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._done = asyncio.Event()
        emulator = self._build()
        await emulator.start()
        self._emulator = emulator
        await self._done.wait()
        await emulator.stop()

    def fault(self, name: str, value: Any = True) -> dict[str, Any]:
        """Inject a fault; return the emulator's state."""
        self._ask(lambda emulator: emulator.begin(name, value))
        return self.state()

    def clear(self, name: str) -> dict[str, Any]:
        """End a fault; return the emulator's state."""
        self._ask(lambda emulator: emulator.end(name))
        return self.state()

    def state(self) -> dict[str, Any]:
        """Return the ground truth of the emulator."""
        return self._ask(lambda emulator: emulator.state())

    def joints(self) -> Array:
        """Return the true joint angles (n,) rad of an arm."""
        import numpy as np

        return np.array(self.state()["q_rad"], dtype=np.float64)

    def wait_for(self, **wanted: Any) -> dict[str, Any]:
        """Poll ``state`` until every named entry has the given value. Raises TransportTimeout."""
        until_ns = self.world.now_ns() + round(_REPLY_S * 1e9)
        while self.world.now_ns() < until_ns:
            state = self.state()
            if all(state.get(key) == value for key, value in wanted.items()):
                return state
            self.world.sleep_until_ns(self.world.now_ns() + 5_000_000)
        raise TransportTimeout(self._name, f"state {wanted}", _REPLY_S)

    def freeze(self) -> None:
        """Stop giving it turns: the device hangs but its connections stay open."""
        self._task.suspended = True

    def thaw(self) -> None:
        """Give it turns again."""
        self._task.suspended = False

    def kill(self) -> None:
        """Close its connections: the device vanishes."""
        self.stop()

    def stop(self) -> None:
        """Stop it; does nothing when it has ended."""
        if self._thread is None or self._loop is None or self._done is None or not self._thread.is_alive():
            return
        self.thaw()
        self._loop.call_soon_threadsafe(self._done.set)
        self._thread.join()

    @property
    def _task(self) -> _Task:
        assert self._thread is not None
        assert self._thread.task is not None
        return self._thread.task

    def _ask(self, question: Callable[[Emulator], T]) -> T:
        emulator, loop = self._emulator, self._loop
        assert emulator is not None, "start the emulator first"
        assert loop is not None
        answers: list[T] = []
        failures: list[Exception] = []

        def answer() -> None:
            try:
                answers.append(question(emulator))
            except (TouchcellError, ValueError, TypeError) as error:
                failures.append(error)

        if not self.world.is_present(self._task):
            raise ConnectError(self._name, "the emulator has ended")
        loop.call_soon_threadsafe(answer)
        until_ns = self.world.now_ns() + round(_REPLY_S * 1e9)
        if not self.world.wait(lambda: bool(answers or failures), until_ns):
            raise TransportTimeout(self._name, "reply of the emulator", _REPLY_S)
        # As long as asking another process takes: whoever asks again and again sees the time pass.
        self.world.sleep_until_ns(self.world.now_ns() + _ASKING_NS)
        if failures:
            raise ConnectError(self._name, str(failures[0]))
        return answers[0]
