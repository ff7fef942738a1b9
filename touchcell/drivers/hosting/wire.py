"""Typed errors and requests between processes as JSON: type and attributes, no text to match, no pickle."""

from __future__ import annotations

import json
import math
import socket
from enum import Enum
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell import errors as base_errors
from touchcell.drivers.core import errors
from touchcell.drivers.core.errors import CorruptMessage, DeviceError, FaultClass, Rejection, Remedy
from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.errors import TouchcellError

MAX_MESSAGE_BYTES: Final = 1 << 17

_ERRORS: Final[dict[str, type[TouchcellError]]] = {
    name: found
    for name, found in {**vars(base_errors), **vars(errors)}.items()
    if isinstance(found, type) and issubclass(found, TouchcellError)
}
_ENUMS: Final[dict[str, type[Enum]]] = {each.__name__: each for each in (Rejection, FaultClass, Remedy)}


def encode_error(error: BaseException) -> dict[str, Any]:
    """Encode ``error`` as plain data: the nearest type of the tree that every process knows, and all attributes."""
    known = next((kind.__name__ for kind in type(error).__mro__ if kind.__name__ in _ERRORS), "")
    if not known or not isinstance(error, TouchcellError):
        return {"type": "DeviceError", "attributes": {"message": f"{type(error).__name__}: {error}", "hint": ""}}
    return {"type": known, "attributes": {name: _plain(value) for name, value in vars(error).items()}}


def decode_error(data: dict[str, Any], device: str) -> TouchcellError:
    """Decode an error, with ``device`` in place of a missing name."""
    kind = _ERRORS.get(data["type"], DeviceError)
    error = kind.__new__(kind)
    attributes = {name: _decoded_value(value) for name, value in data["attributes"].items()}
    Exception.__init__(error, attributes.get("message", ""))
    # Restored verbatim: a constructor would compose its message again.
    error.__dict__.update({"device": device, **attributes} if issubclass(kind, DeviceError) else attributes)
    return error


def encode_adjustments(adjustments: tuple[Adjustment, ...]) -> bytes:
    """Encode the adjustments of a command; empty for none."""
    return json.dumps([[a.limit, a.requested, a.allowed] for a in adjustments]).encode() if adjustments else b""


def decode_adjustments(note: bytes) -> tuple[Adjustment, ...]:
    """Decode adjustments."""
    return tuple(Adjustment(*each) for each in json.loads(note)) if note else ()


def error_note(error: BaseException, longest: int) -> bytes:
    """Encode ``error`` in at most ``longest`` bytes; if too long it loses its values, then its message."""
    data = encode_error(error)
    for shorten in (None, "value", "limit", "causes", "message"):
        if shorten is not None and shorten in data["attributes"]:
            data["attributes"][shorten] = str(data["attributes"][shorten])[: longest // 4]
        note = json.dumps(data).encode()
        if len(note) <= longest:
            return note
    return json.dumps({"type": data["type"], "attributes": {"message": "too long", "hint": ""}}).encode()


def decode_note(note: bytes, device: str) -> TouchcellError:
    """Decode the error of ``error_note``."""
    return decode_error(json.loads(note), device)


def send(connection: socket.socket, message: dict[str, Any]) -> None:
    """Send one message over a SOCK_SEQPACKET socket. Raises OSError if the other side has closed."""
    connection.sendall(json.dumps(message).encode())


def receive(connection: socket.socket) -> dict[str, Any] | None:
    """Return the next message; None when the other side has closed. Raises CorruptMessage, TimeoutError."""
    try:
        data = connection.recv(MAX_MESSAGE_BYTES)
    except ConnectionError:
        return None
    if not data:
        return None
    try:
        message: dict[str, Any] = json.loads(data)
    except ValueError:
        raise CorruptMessage("process", "corrupt message between processes") from None
    return message


def _plain(value: Any) -> Any:
    match value:
        case Enum():
            return {"enum": type(value).__name__, "name": value.name}
        case BaseException():
            return {"error": encode_error(value)}
        case np.ndarray():
            return {"array": _plain(value.tolist())}
        case np.generic():
            return _plain(value.item())
        case tuple():
            return {"tuple": [_plain(each) for each in value]}
        case list():
            return [_plain(each) for each in value]
        case Path():
            return {"path": str(value)}
        case float() if not math.isfinite(value):
            return {"float": repr(value)}
        case None | bool() | int() | float() | str():
            return value
    return str(value)


def _decoded_value(value: Any) -> Any:
    if isinstance(value, list):
        return [_decoded_value(each) for each in value]
    if not isinstance(value, dict):
        return value
    (kind, content) = next(iter(value.items()))
    match kind:
        case "enum" if content in _ENUMS:
            return _ENUMS[content][value["name"]]
        case "enum":
            return value["name"]
        case "error":
            return decode_error(content, "")
        case "array":
            return np.array(_decoded_value(content))
        case "tuple":
            return tuple(_decoded_value(each) for each in content)
        case "path":
            return Path(content)
        case "float":
            return float(content)
    return value
