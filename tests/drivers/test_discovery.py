"""Finding devices, in a copy of the parts of /dev and /sys that matter."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from touchcell.cell.cli import discovery
from touchcell.drivers.v4l2.shim import ShimCalls
from touchcell.testing.emulation.process import EmulatorProcess


@pytest.fixture(scope="module")
def sockets(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("camera")
    with EmulatorProcess("v4l2", "--folder", str(folder), "--minor", "2"):
        yield folder


def test_a_camera_is_listed_by_its_stable_name(tmp_path: Path, sockets: Path) -> None:
    (tmp_path / "video2").touch()
    links = tmp_path / "v4l" / "by-id"
    links.mkdir(parents=True)
    (links / "usb-TacTip-index0").symlink_to("../../video2")
    assert discovery.cameras(tmp_path, ShimCalls(sockets)) == [
        discovery.Found(
            kind="camera",
            address=str(links / "usb-TacTip-index0"),
            node=str(tmp_path / "video2"),
            description="TacTip emulated on usb-0000:00:14.0-3: MJPG, YUYV, GREY",
        )
    ]


def test_a_camera_without_a_stable_name_is_warned_about(tmp_path: Path, sockets: Path) -> None:
    (tmp_path / "video2").touch()
    (found,) = discovery.cameras(tmp_path, ShimCalls(sockets))
    assert found.address == str(tmp_path / "video2")
    assert "by-id" in found.needs[0]


def test_a_node_that_does_not_answer_is_listed_with_the_reason(tmp_path: Path, sockets: Path) -> None:
    (tmp_path / "video9").touch()
    (found,) = discovery.cameras(tmp_path, ShimCalls(sockets))
    assert any("No such device" in need or "No such file" in need for need in found.needs)


def test_nodes_are_sorted_by_number(tmp_path: Path, sockets: Path) -> None:
    for number in (10, 9, 0):
        (tmp_path / f"video{number}").touch()
    nodes = [found.node for found in discovery.cameras(tmp_path, ShimCalls(sockets))]
    assert nodes == [str(tmp_path / f"video{number}") for number in (0, 9, 10)]


def test_a_missing_permission_names_the_group(tmp_path: Path, sockets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "video2").touch()
    # Root may open everything, so the refusal itself has to be staged.
    monkeypatch.setattr(discovery.os, "access", lambda path, mode: False)
    (found,) = discovery.cameras(tmp_path, ShimCalls(sockets))
    assert found.needs[0].startswith("may not be opened: sudo usermod -aG ")
    assert found.description == "camera"


def _interface(sys: Path, name: str, kind: int, flags: str, queue: int) -> None:
    folder = sys / "class" / "net" / name
    folder.mkdir(parents=True)
    (folder / "type").write_text(f"{kind}\n")
    (folder / "flags").write_text(f"{flags}\n")
    (folder / "tx_queue_len").write_text(f"{queue}\n")


def test_can_interfaces_are_recognised_and_report_missing_settings(tmp_path: Path) -> None:
    _interface(tmp_path, "eth0", 1, "0x1003", 1000)
    _interface(tmp_path, "can0", 280, "0x40080", 10)
    _interface(tmp_path, "vcan0", 280, "0x40081", 1000)
    down, ready = discovery.can_interfaces(tmp_path)
    assert (down.address, ready.address) == ("can0", "vcan0")
    assert [need.split(":")[0] for need in down.needs] == ["is down", "has a short queue"]
    assert ready.needs == ()


def test_serial_ports_without_hardware_are_left_out_and_slow_ones_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from serial.tools import list_ports
    from serial.tools.list_ports_common import ListPortInfo

    empty, adapter = ListPortInfo("/dev/ttyS0"), ListPortInfo("/dev/ttyUSB3")
    adapter.description, adapter.hwid = "U2D2", "USB VID:PID=0403:6014"
    monkeypatch.setattr(list_ports, "comports", lambda: [adapter, empty])
    timer = tmp_path / "bus" / "usb-serial" / "devices" / "ttyUSB3" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    (tmp_path / "ttyUSB3").touch()
    (found,) = discovery.serial_ports(tmp_path, tmp_path)
    assert found.node == str(tmp_path / "ttyUSB3")
    assert found.needs == (f"answers 16 ms late: echo 1 | sudo tee {timer}",)
