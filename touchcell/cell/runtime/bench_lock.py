"""A lock on the devices of a bench, so that two people or two CI jobs cannot have one bench at once.

Each device is locked by its address (host, port, bus, camera), so that two cell files that share an arm exclude each
other. The kernel gives a lock back when its process ends, for whatever reason. It holds on one machine only.
"""

from __future__ import annotations

import fcntl
import getpass
import hashlib
import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TextIO

from touchcell.cell.config.addresses import address_of
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.errors import TouchcellError


class BenchTaken(TouchcellError):
    """Another process uses a device of the bench.

    Attributes:
        device: its name in the cell.
        address: where it is.
        holder: who has it, since when, by which process.
    """

    def __init__(self, device: str, address: str, holder: str) -> None:
        super().__init__(f"the bench is taken: {device} at {address} is in use by {holder or 'another process'}")
        self.device = device
        self.address = address
        self.holder = holder


def addresses(plan: CellPlan) -> Mapping[str, str]:
    """Return the address of each device that the plan builds, by name; a device without one has none."""
    return {name: address for name, device in plan.built.items() if (address := address_of(device))}


@contextmanager
def bench_lock(plan: CellPlan, folder: Path | None = None) -> Iterator[None]:
    """Hold the devices of a cell within the context.

    Args:
        plan: the cell.
        folder: where locks are kept; None for the machine's own, which all its users share.

    Raises:
        BenchTaken: another process holds one of them.
    """
    folder = folder or Path(tempfile.gettempdir()) / "touchcell-bench"
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o1777)  # the mode of mkdir is subject to the umask
    with ExitStack() as held:
        # Arms may share a bus.
        holders = {address: name for name, address in sorted(addresses(plan).items(), reverse=True)}
        for address, name in sorted(holders.items(), key=lambda each: each[1]):
            digest = hashlib.sha256(address.encode()).hexdigest()[:16]
            held.enter_context(_locked(folder / f"{digest}.lock", name, address))
        yield


@contextmanager
def _locked(path: Path, device: str, address: str) -> Iterator[None]:
    with _opened(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BenchTaken(device, address, file.read().strip()) from None
        file.seek(0)
        file.truncate()
        file.write(f"{getpass.getuser()}, process {os.getpid()}, since {time.strftime('%Y-%m-%d %H:%M:%S')}\n")
        file.flush()
        yield


def _opened(path: Path) -> TextIO:
    """Open a lock that belongs to the user who came first, and that all users may take."""
    try:
        # Without O_CREAT: Linux refuses it for another user's file in a sticky folder (fs.protected_regular).
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC)
        os.fchmod(descriptor, 0o666)
    return os.fdopen(descriptor, "r+")
