"""What is plugged in: cameras, serial ports and CAN interfaces, with what is still missing before each can be used."""

from __future__ import annotations

import grp
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from touchcell.drivers.core.errors import ConnectError, TransportError
from touchcell.drivers.v4l2.node import KernelCalls, SystemCalls, VideoNode

_ARPHRD_CAN = 280
_IFF_UP = 1
_CAN_QUEUE = 100


@dataclass(frozen=True, slots=True)
class Found:
    """A device that a driver could use.

    Attributes:
        kind: "camera", "serial" or "can".
        address: what to write in the cell file; a name that survives a restart where there is one.
        node: the node or interface behind it now.
        description: what it calls itself.
        needs: what to do before it can be used, one sentence each; empty when it is ready.
    """

    kind: Literal["camera", "serial", "can"]
    address: str
    node: str
    description: str
    needs: tuple[str, ...] = ()


def cameras(dev: Path = Path("/dev"), calls: SystemCalls | None = None) -> list[Found]:
    """Cameras, each by its by-id name where udev made one. Nodes that only carry metadata are left out.

    Opens each node for a moment; changes nothing.
    """
    found = []
    for node in sorted(dev.glob("video*"), key=_natural):
        address = _stable(node, [dev / "v4l" / "by-id", dev / "v4l" / "by-path"])
        needs = _permission(node)
        description = "camera"
        if not needs:
            try:
                description = _describe_camera(node, calls or KernelCalls())
            except ConnectError as error:
                if not error.causes:
                    continue
                needs.append(error.message)
            except TransportError as error:
                needs.append(error.message)
        if address == str(node):
            needs.append("has no by-id name: after a restart it may be another camera")
        found.append(Found("camera", address, str(node), description, tuple(needs)))
    return found


def serial_ports(dev: Path = Path("/dev"), sys: Path = Path("/sys")) -> list[Found]:
    """Serial ports with hardware behind them, each by its by-id name where udev made one."""
    from serial.tools import list_ports

    found = []
    for port in sorted(list_ports.comports(), key=lambda port: _natural(Path(port.device))):
        if port.hwid == "n/a":
            continue
        node = dev / Path(port.device).name
        address = _stable(node, [dev / "serial" / "by-id", dev / "serial" / "by-path"])
        needs = [*_permission(node), *_latency(sys / "bus" / "usb-serial" / "devices" / node.name / "latency_timer")]
        found.append(Found("serial", address, str(node), f"{port.description} ({port.hwid})", tuple(needs)))
    return found


def can_interfaces(sys: Path = Path("/sys")) -> list[Found]:
    """SocketCAN interfaces, and whether they are up."""
    found = []
    for interface in sorted((sys / "class" / "net").glob("*"), key=_natural):
        if _read_number(interface / "type") != _ARPHRD_CAN:
            continue
        name = interface.name
        needs = []
        if not _read_number(interface / "flags") & _IFF_UP:
            needs.append(f"is down: sudo ip link set {name} up type can bitrate 1000000")
        if _read_number(interface / "tx_queue_len") < _CAN_QUEUE:
            needs.append(f"has a short queue: sudo ip link set {name} txqueuelen {_CAN_QUEUE}")
        driver = interface / "device" / "driver"
        description = driver.resolve().name if driver.exists() else "virtual"
        found.append(Found("can", name, name, description, tuple(needs)))
    return found


def _describe_camera(node: Path, calls: SystemCalls) -> str:
    camera = VideoNode(str(node), str(node), calls)
    try:
        return f"{camera.card} on {camera.bus}: {', '.join(camera.pixel_formats())}"
    finally:
        camera.close()


def _permission(node: Path) -> list[str]:
    if os.access(node, os.R_OK | os.W_OK):
        return []
    try:
        group = grp.getgrgid(node.stat().st_gid).gr_name
    except (KeyError, OSError):
        group = "that owns it"
    return [f"may not be opened: sudo usermod -aG {group} $USER, then log in again"]


def _latency(timer: Path) -> list[str]:
    latency_ms = _read_number(timer)
    return [f"answers {latency_ms} ms late: echo 1 | sudo tee {timer}"] if latency_ms > 1 else []


def _stable(node: Path, folders: Sequence[Path]) -> str:
    target = node.resolve()
    for folder in folders:
        for link in sorted(folder.glob("*")):
            if link.resolve() == target:
                return str(link)
    return str(node)


def _read_number(path: Path) -> int:
    try:
        return int(path.read_text().strip(), 0)
    except (OSError, ValueError):
        return 0


def _natural(path: Path) -> tuple[str, int]:
    stem = path.name.rstrip("0123456789")
    digits = path.name[len(stem) :]
    return stem, int(digits) if digits else -1
