"""``touchcell bench zoo``: public bug reports of arms and cameras, each tried on our driver beside its emulator.

The rows are data (``zoo.yaml``): source, failure, injection, expected reaction. All results are of emulators.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict

from touchcell.cell.bench.provenance import provenance
from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.camera import Camera
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import Device, Lifecycle
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.protocols import HealthSource
from touchcell.errors import ConfigError
from touchcell.testing.emulation.rig import RIGS, DeviceFixture, Emulated

_ROWS = Path(__file__).with_name("zoo.yaml")
_CALM_S = 0.5
_NOTICED_S = 4.0
_STEP_S = 0.01
_SLOW_M_S = 0.002
_TTL_S = 0.2
_FIRST_ADDRESS = 20_000


class ZooRow(BaseModel):
    """One public report.

    Attributes:
        source: project and number, or manual.
        failure: what happened to the people who reported it.
        driver: which of ours it is tried on.
        when: injected before the connection, or while the device is active.
        inject: faults of the emulator, by name, with their values.
        expect: reaction that is right; see ``zoo.yaml``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: str
    failure: str
    driver: str
    when: Literal["before", "active"]
    inject: dict[str, Any]
    expect: Literal["refused", "fault", "counted", "harmless"]


def rows() -> list[ZooRow]:
    """Return all reports."""
    return [ZooRow.model_validate(row) for row in yaml.safe_load(_ROWS.read_text())]


def try_row(row: ZooRow, fixture: DeviceFixture) -> tuple[str, str]:
    """Inject one report; return the reaction, in the words of ``ZooRow.expect`` or "not noticed", and its message."""
    assert fixture.start is not None
    emulated = fixture.start()
    device = fixture.build(fixture.clock())
    try:
        if row.when == "before":
            return _before(row, device, emulated)
        return _active(row, device, emulated)
    finally:
        with suppress(DeviceError):
            device.disconnect()
        emulated.stop()


def run(arguments: Sequence[str], out: Path) -> None:
    """Print one line for each report; writes ``zoo.json`` into ``out``."""
    parser = argparse.ArgumentParser(prog="touchcell bench zoo", description=__doc__.partition("\n")[0])
    parser.add_argument("drivers", nargs="*", metavar="driver", help="only reports of these drivers")
    wanted = parser.parse_args(arguments).drivers
    known = sorted({row.driver for row in rows()})
    for name in wanted:
        if name not in known:
            raise ConfigError(f"no report is of {name!r}", key="driver", value=name, hint=f"known: {', '.join(known)}")
    results = []
    for number, row in enumerate(rows()):
        if wanted and row.driver not in wanted:
            continue
        with tempfile.TemporaryDirectory(prefix="touchcell-zoo-") as folder:
            found, message = try_row(row, RIGS.load(row.driver)(Path(folder), _FIRST_ADDRESS + number))
        handled = found == row.expect
        results.append({**row.model_dump(), "found": found, "handled": handled, "message": message})
        verdict = "handled" if handled else f"NOT HANDLED ({row.expect} expected, {found})"
        print(f"{row.driver:<15}{row.source:<36}{row.failure:<48}{verdict}", flush=True)
        if message:
            print(f"{'':<15}{message.splitlines()[0]}")
    print(f"\n{sum(bool(result['handled']) for result in results)} of {len(results)} handled, on emulators")
    out.mkdir(parents=True, exist_ok=True)
    (out / "zoo.json").write_text(json.dumps({"provenance": provenance(), "rows": results}, indent=1) + "\n")


def _before(row: ZooRow, device: Device, emulated: Emulated) -> tuple[str, str]:
    for fault, value in row.inject.items():
        emulated.fault(fault, value)
    try:
        _activate(device)
    except DeviceError as error:
        return "refused", str(device.fault or error)
    except ConfigError as error:
        return "refused", str(error)
    lease = _lease(device)
    if _until(lambda: _faulted(device, lease), _CALM_S):
        return "fault", str(device.fault)
    return "harmless", ""


def _active(row: ZooRow, device: Device, emulated: Emulated) -> tuple[str, str]:
    _activate(device)
    lease = _lease(device)
    _until(lambda: _faulted(device, lease), _CALM_S)
    before = _counts(device)
    for fault, value in row.inject.items():
        emulated.fault(fault, value)
    if _until(lambda: _faulted(device, lease), _NOTICED_S if row.expect == "fault" else 2 * _CALM_S):
        return "fault", str(device.fault)
    grown = [name for name, count in _counts(device).items() if count > before.get(name, 0) and _is_trouble(name)]
    return ("counted", f"health: {', '.join(grown)}") if grown else ("not noticed", "")


def _activate(device: Device) -> None:
    device.connect()
    device.configure()
    device.activate()


def _lease(device: Device) -> Lease | None:
    return device.acquire("zoo") if isinstance(device, Arm) else None


def _faulted(device: Device, lease: Lease | None) -> bool:
    """Use the device as a task does; return whether it is FAULTED."""
    with suppress(DeviceError):
        if isinstance(device, Camera):
            device.latest()
        elif isinstance(device, Arm) and lease is not None:
            twist = np.array([0.0, 0.0, _SLOW_M_S, 0.0, 0.0, 0.0])
            device.tcp()
            device.send_twist(TwistCommand(twist, TwistFrame.BASE, time.monotonic_ns(), _TTL_S), lease)
    return device.state is Lifecycle.FAULTED


def _counts(device: Device) -> dict[str, float]:
    if not isinstance(device, HealthSource):
        return {}
    return {name: value for name, value in device.health().items() if isinstance(value, int | float)}


def _is_trouble(name: str) -> bool:
    words = ("bad", "lost", "corrupt", "error", "missed", "not_sent", "not_received", "implausible", "late", "out_of")
    return any(word in name for word in words) and not name.startswith("latest")


def _until(condition: Callable[[], bool], seconds: float) -> bool:
    deadline_s = time.monotonic() + seconds
    while time.monotonic() < deadline_s:
        if condition():
            return True
        time.sleep(_STEP_S)
    return False
