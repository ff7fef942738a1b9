"""A dask cluster whose two workers share neither network nor files with this machine but a wire to its scheduler.

Each worker has a network namespace of its own, joined to this one by a veth pair, and cannot see a folder that is
named (a mount namespace hides it). Needs root and the programs ip and mount.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

_PORT = 18786
_WAIT_S = 60.0
_WORKER = 'mount -t tmpfs none "$1"; cd "$2"; shift 2; exec "$@"'


@contextmanager
def separate_workers(hidden: Path, home: Path, count: int = 2) -> Iterator[str]:
    """Start a scheduler here and workers in namespaces; yield the scheduler's address.

    Args:
        hidden: folder that no worker can see.
        home: for the folders in which the workers stand.
        count: of workers, at most 9.

    Raises:
        subprocess.CalledProcessError: a namespace or a link could not be made.
    """
    address = f"tcp://10.213.1.1:{_PORT}"
    with ExitStack() as stack:
        for number in range(1, count + 1):
            stack.enter_context(_namespace(number))
        scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", str(_PORT), "--no-dashboard"]
        stack.enter_context(_process(scheduler))
        for number in range(1, count + 1):
            place = home / f"worker{number}"
            place.mkdir(parents=True)
            worker = [sys.executable, "-m", "distributed.cli.dask_worker", f"tcp://10.213.{number}.1:{_PORT}"]
            options = ["--nthreads", "1", "--no-dashboard", "--no-nanny", "--local-directory", str(place)]
            apart = ["ip", "netns", "exec", _name(number), "sh", "-c", _WORKER, "sh", str(hidden), str(place)]
            stack.enter_context(_process([*apart, *worker, *options]))
        _await_workers(address, count)
        yield address


def _name(number: int) -> str:
    return f"touchcell{number}"


@contextmanager
def _namespace(number: int) -> Iterator[None]:
    name, here, there = _name(number), f"tcell{number}", f"tcworker{number}"
    _ip("netns", "add", name)
    try:
        _ip("link", "add", here, "type", "veth", "peer", "name", there, "netns", name)
        _ip("addr", "add", f"10.213.{number}.1/24", "dev", here)
        _ip("link", "set", here, "up")
        _ip("-n", name, "addr", "add", f"10.213.{number}.2/24", "dev", there)
        _ip("-n", name, "link", "set", there, "up")
        _ip("-n", name, "link", "set", "lo", "up")
        yield
    finally:
        _ip("netns", "del", name)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


@contextmanager
def _process(command: list[str]) -> Iterator[None]:
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def _await_workers(address: str, count: int) -> None:
    from distributed import Client

    deadline = time.monotonic() + _WAIT_S
    while True:
        try:
            with Client(address, timeout=_WAIT_S) as client:
                client.wait_for_workers(count, timeout=_WAIT_S)
            return
        except OSError:
            if time.monotonic() > deadline:
                raise
