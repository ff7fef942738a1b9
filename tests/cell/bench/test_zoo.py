from __future__ import annotations

import zlib
from pathlib import Path

import pytest

from touchcell.cell.bench import zoo
from touchcell.errors import ConfigError
from touchcell.testing.emulation.rig import RIGS, RIGS_IN_STEP

IN_STEP = [row for row in zoo.rows() if row.driver in RIGS_IN_STEP.names() and not row.real_time]


@pytest.mark.parametrize("row", IN_STEP, ids=lambda row: f"{row.driver} {row.failure}")
def test_every_report_is_handled(row: zoo.ZooRow, tmp_path: Path) -> None:
    # Unique among the tests of this run, which may run side by side.
    address = 30_000 + zlib.crc32(f"{row.source} {row.failure}".encode()) % 1_000_000
    fixture = RIGS_IN_STEP.load(row.driver)(tmp_path, address)
    with fixture.world:
        found, message = zoo.try_row(row, fixture)
    assert zoo.is_handled(row, found), f"{found}: {message}"


def test_every_report_is_of_a_driver_with_an_emulator_and_none_is_there_twice() -> None:
    rows = zoo.rows()
    assert {row.driver for row in rows} <= set(RIGS.names())
    assert len({(row.source, row.failure) for row in rows}) == len(rows) >= 240


def test_every_injection_is_a_fault_that_the_emulator_knows() -> None:
    from touchcell.drivers.damiao.emulator import DamiaoArm
    from touchcell.drivers.feetech.emulator import FeetechArm
    from touchcell.drivers.franka.emulator.server import FrankaEmulator
    from touchcell.drivers.net_ft.emulator import NetFtBox
    from touchcell.drivers.robotiq.emulator import RobotiqHand
    from touchcell.drivers.ur.emulator.server import UrEmulator
    from touchcell.drivers.v4l2.emulator.server import V4l2Emulator

    emulators = {
        "damiao_can": DamiaoArm,
        "feetech_serial": FeetechArm,
        "franka": FrankaEmulator,
        "net_ft": NetFtBox,
        "robotiq": RobotiqHand,
        "ur": UrEmulator,
        "v4l2": V4l2Emulator,
    }
    for row in zoo.rows():
        assert set(row.inject) <= set(emulators[row.driver].faults), row.source


def test_an_unknown_driver_is_named(tmp_path: object) -> None:
    with pytest.raises(ConfigError, match="no report is of"):
        zoo.run(["toaster"], tmp_path)  # type: ignore[arg-type]
