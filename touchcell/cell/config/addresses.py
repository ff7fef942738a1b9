"""Where the devices of a cell are: hosts, ports, buses, cameras."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import Any, Final

from touchcell.cell.config.cell_plan import DevicePlan

_KEYS: Final = ("host", "port", "channel", "device")
"""Keys of drivers that say where a device is."""
_SHARED: Final = "channel"
"""A bus, which several arms may share if no two of their motors answer to one number."""


def address_of(device: DevicePlan) -> str:
    """Return the driver and the address of a device, links of this machine followed; empty for one without address."""
    parts = [_followed(value) for key in _KEYS if (value := getattr(device.config, key, None)) is not None]
    return f"{device.spec.name}:{','.join(parts)}" if parts else ""


def clashes(devices: Mapping[str, DevicePlan]) -> Iterator[tuple[str, str, str]]:
    """Return (device, key, other) for each device that is where another one is, which comes before it."""
    for name, device in devices.items():
        for other, before in devices.items():
            if other == name:
                break
            if (where := address_of(device)) and where == address_of(before) and _cannot_share(device, before):
                yield name, next(key for key in _KEYS if getattr(device.config, key, None) is not None), other


def _cannot_share(one: DevicePlan, other: DevicePlan) -> bool:
    if getattr(one.config, _SHARED, None) is None:
        return True
    return bool(_numbers(one) & _numbers(other))


def _numbers(device: DevicePlan) -> set[int]:
    motors: Any = getattr(device.config, "motors", ())
    return {number for motor in motors for number in (motor.esc_id, motor.mst_id)}


def _followed(value: object) -> str:
    text = str(value)
    return os.path.realpath(text) if text.startswith("/dev/") else text
