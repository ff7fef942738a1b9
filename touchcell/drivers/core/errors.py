"""What can go wrong with configuration and devices, as types with attributes."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Any

from touchcell.errors import TouchcellError


class CodecError(TouchcellError, ValueError):
    """A value cannot be put on the wire, or bytes are no message of the expected kind.

    Attributes:
        field: the offending field.
        value: what it was.
    """

    def __init__(self, field: str, value: object, reason: str) -> None:
        super().__init__(f"{field} {value!r} {reason}")
        self.field = field
        self.value = value


class DeviceError(TouchcellError):
    """Something about one device; ``device`` is its name in the cell."""

    def __init__(self, device: str, message: str, *, hint: str = "") -> None:
        super().__init__(f"{device}: {message}", hint=hint)
        self.device = device


class LifecycleError(DeviceError):
    """An operation was asked for in a lifecycle state that does not allow it."""

    def __init__(self, device: str, operation: str, state: str, allowed: Sequence[str], *, hint: str = "") -> None:
        super().__init__(device, f"cannot {operation} while {state}, only while {' or '.join(allowed)}", hint=hint)
        self.operation = operation
        self.state = state
        self.allowed = tuple(allowed)


class ConnectError(DeviceError):
    """The device could not be reached; ``causes`` are the errors of its parts."""

    def __init__(self, device: str, message: str, causes: Sequence[Exception] = (), *, hint: str = "") -> None:
        tree = "".join(f"\n  - {cause}" for cause in causes)
        super().__init__(device, message + tree, hint=hint)
        self.causes = tuple(causes)


class TransportError(DeviceError):
    """A message was lost or damaged. Transient by nature: drivers count them and fail when a budget is spent."""


class TransportTimeout(TransportError):
    """No answer in time."""

    def __init__(self, device: str, what: str, timeout_s: float, *, hint: str = "") -> None:
        super().__init__(device, f"no {what} within {timeout_s:g} s", hint=hint)
        self.timeout_s = timeout_s


class CorruptMessage(TransportError):
    """A message failed its length, checksum or range check."""


class DeviceGone(TransportError):
    """The device or the link to it has disappeared. Not transient."""


class EndOfStream(DeviceError):
    """A recorded source has no more samples."""


class StaleData(DeviceError):
    """The newest sample is older than the caller accepts."""

    def __init__(self, device: str, age_s: float, limit_s: float, seq: int, *, hint: str = "") -> None:
        super().__init__(device, f"newest sample {seq} is {age_s:.4f} s old, limit {limit_s:g} s", hint=hint)
        self.age_s = age_s
        self.limit_s = limit_s
        self.seq = seq


class Rejection(Enum):
    """Why a command was refused, in the order in which the checks are made."""

    NON_FINITE = "non-finite"
    SHAPE = "shape"
    FRAME = "frame"
    LEASE = "lease"
    MODE = "mode"
    EXPIRED = "expired"
    LIMIT = "limit"


class CommandRejected(DeviceError):
    """A command was refused and nothing was sent."""

    def __init__(
        self,
        device: str,
        reason: Rejection,
        message: str,
        *,
        value: Any = None,
        limit: Any = None,
        hint: str = "",
    ) -> None:
        super().__init__(device, f"command rejected ({reason.value}): {message}", hint=hint)
        self.reason = reason
        self.value = value
        self.limit = limit


class FaultClass(Enum):
    """What kind of trouble a device reports."""

    COMMUNICATION = "communication"
    ELECTRICAL = "electrical"
    THERMAL = "thermal"
    OVERLOAD = "overload"
    MOTION = "motion"
    CONTACT = "contact"
    SAFETY_STOP = "safety stop"
    CONFIGURATION = "configuration"
    INTERNAL = "internal"


class Remedy(Enum):
    """What a fault needs before the device may be used again."""

    NOTHING = "nothing"
    RECOVER = "recover"
    OPERATOR = "operator at the device"
    POWER_CYCLE = "power cycle"
    SERVICE = "service"


class DeviceFault(DeviceError):
    """The device reports a fault, by its vendor's code and by our class and remedy."""

    def __init__(
        self,
        device: str,
        name: str,
        *,
        vendor_code: int | str | None = None,
        fault_class: FaultClass = FaultClass.INTERNAL,
        needs: Remedy = Remedy.RECOVER,
        hint: str = "",
    ) -> None:
        code = "" if vendor_code is None else f" [{vendor_code}]"
        super().__init__(device, f"fault{code} {name}, needs {needs.value}", hint=hint)
        self.name = name
        self.vendor_code = vendor_code
        self.fault_class = fault_class
        self.needs = needs
