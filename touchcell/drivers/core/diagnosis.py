"""What is wrong with a connected device, or unwise about it, as ``touchcell doctor`` reports it. Reads only."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from touchcell.drivers.core.errors import DeviceError
from touchcell.errors import TouchcellError


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong or unwise.

    Attributes:
        what: description.
        remedy: what to do.
        reports: public reports of people who had it, "project number"; empty where none is known.
        is_fault: True if the device cannot be used like this; False for advice.
    """

    what: str
    remedy: str = ""
    reports: tuple[str, ...] = ()
    is_fault: bool = True


@runtime_checkable
class Diagnosable(Protocol):
    """A device that can be asked what is wrong with it while it is PASSIVE."""

    def diagnose(self) -> Iterator[Finding]:
        """Yield what is wrong or unwise; changes nothing. Raises DeviceError where it cannot be asked."""
        ...


def finding_of(error: TouchcellError, *reports: str) -> Finding:
    """Return an error as a finding."""
    what = error.message
    if isinstance(error, DeviceError):
        what = what.removeprefix(f"{error.device}: ")
    return Finding(what, error.hint, reports)
