"""``touchcell doctor``: connect a cell's devices in PASSIVE and name every known fault, with its remedy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchcell.cell.cli.devices import look_at_devices
from touchcell.cell.config.worlds import WorldName
from touchcell.drivers.core.device import Device, Lifecycle
from touchcell.drivers.core.diagnosis import Diagnosable, Finding, finding_of
from touchcell.drivers.core.errors import DeviceError
from touchcell.errors import TouchcellError


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What was found about one device.

    Attributes:
        name, driver: of the device.
        answers: whether it could be connected.
        findings: what is wrong or unwise.
    """

    name: str
    driver: str
    answers: bool
    findings: tuple[Finding, ...]

    @property
    def is_healthy(self) -> bool:
        """Whether nothing is wrong with it; advice does not count."""
        return self.answers and not any(finding.is_fault for finding in self.findings)


def diagnose_cell(
    path: Path, settings: Mapping[str, Any] | None = None, world: WorldName | None = None
) -> list[Diagnosis]:
    """Connect every device of a cell file one after the other, in PASSIVE only, and look for known faults.

    Args:
        path: the cell file.
        settings: values in place of the file's own, by dotted key.
        world: where; None as the file is written.

    Raises:
        ConfigError: the cell file is not valid.
    """
    return look_at_devices(diagnose, path, settings, world)


def diagnose(device: Device, driver: str) -> Diagnosis:
    """Connect one device, look for known faults, and disconnect it; nothing is energised or changed."""
    findings: list[Finding] = []
    try:
        with device:
            if device.state is Lifecycle.FAULTED and device.fault is not None:
                fault = finding_of(device.fault)
                remedy = "; ".join(filter(None, (fault.remedy, "`touchcell recover CELL` clears it, after asking you")))
                findings.append(Finding(fault.what, remedy))
            if isinstance(device, Diagnosable):
                findings += _asked(device)
    except DeviceError as error:
        return Diagnosis(device.name, driver, False, (finding_of(error), *findings))
    except TouchcellError as error:
        findings.append(finding_of(error))
    return Diagnosis(device.name, driver, True, _each_once(findings))


def _asked(device: Diagnosable) -> list[Finding]:
    found: list[Finding] = []
    try:
        found.extend(device.diagnose())
    except TouchcellError as error:
        # It answered when it was connected: what stops it from being asked is part of the diagnosis.
        found.append(finding_of(error))
    return found


def _each_once(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    return tuple({finding.what: finding for finding in reversed(findings)}.values())[::-1]


def print_diagnoses(diagnoses: Sequence[Diagnosis]) -> None:
    """Print what was found about each device."""
    for diagnosis in diagnoses:
        state = "DOES NOT ANSWER" if not diagnosis.answers else "no known fault" if diagnosis.is_healthy else "FAULTY"
        print(f"{diagnosis.name} ({diagnosis.driver}): {state}")
        for finding in diagnosis.findings:
            print(f"  {'fault ' if finding.is_fault else 'advice'}  {finding.what}")
            if finding.remedy:
                print(f"          {finding.remedy}")
            if finding.reports:
                print(f"          reported in {', '.join(finding.reports)}")
