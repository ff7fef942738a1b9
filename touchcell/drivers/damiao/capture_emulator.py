"""Motors that answer as recorded ones did: a capture of a CAN bus is played back to a client."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, ClassVar

import can

from touchcell.drivers.damiao import codec
from touchcell.drivers.damiao.capture import Capture, RecordedMotor, Request
from touchcell.errors import ConfigError
from touchcell.testing.emulation.base import Emulator
from touchcell.testing.emulation.can_hub import Hub
from touchcell.testing.emulation.playback import Playback

_OPERATIONS = {0x33: "read", 0x55: "write", 0xCC: "state"}
_STATES = ("state", "mit", "command")


class RecordedArm(Emulator):
    """Motors of a capture. Each request is answered by the next recorded answer to the same request, the last for ever.

    A request for a state takes the next recorded state, whatever asked for it then. Commands move nothing.

    Args:
        path: socket of the hub.
        capture: recorded traffic.

    Raises:
        ConfigError: no motor in the capture replied.
    """

    faults: ClassVar = {"pause": "no motor replies", "again": "begin the capture again"}

    def __init__(self, path: Path, capture: Capture) -> None:
        super().__init__()
        self._motors = {esc_id: motor for esc_id, motor in capture.motors.items() if motor.mst_id is not None}
        if not self._motors:
            raise ConfigError("no motor in the capture replied", hint="record while a client uses the arm")
        self._hub = Hub(path, self._on_frame)
        self._playback = Playback()
        self._unknown: set[tuple[int, Request]] = set()
        self._answered = 0

    async def start(self) -> None:
        """Open the hub."""
        self._hub.open()

    async def stop(self) -> None:
        """Close the hub."""
        self._hub.close()

    def state(self) -> dict[str, Any]:
        """Return counters, and the requests for which the capture has no answer."""
        return {
            "answered": self._answered,
            "unknown": sorted(f"motor {motor}: {kind} {key}" for motor, (kind, key) in self._unknown),
            "clients": self._hub.client_count,
            "faults": sorted(self.active),
        }

    def on_fault(self, fault: str, value: Any) -> None:
        """Begin again at once."""
        if fault == "again":
            self._playback.begin_again()
            del self.active[fault]

    def _on_frame(self, message: can.Message) -> None:
        data = bytes(message.data)
        if "pause" in self.active or message.is_extended_id or len(data) != 8:
            return
        esc_id = message.arbitration_id
        request: Request = ("mit", 0)
        if esc_id == codec.PARAMETER_ID:
            esc_id, operation, register, _ = codec.decode_parameter_request(data)
            kind = _OPERATIONS.get(operation, "")
            request = (kind, 0 if kind == "state" else register)
        elif data[:7] == codec.ENABLE[:7] and data[7] >= codec.CLEAR_ERROR[7]:
            request = ("command", data[7])
        motor = self._motors.get(esc_id)
        if motor is None:
            return
        answer = self._answer(motor, request)
        if answer is None:
            if (esc_id, request) not in self._unknown:
                self._unknown.add((esc_id, request))
                print(f"the capture has no answer of motor {esc_id} to {request[0]} {request[1]}", file=sys.stderr)
            return
        self._answered += 1
        assert motor.mst_id is not None
        self._hub.send(
            can.Message(
                arbitration_id=motor.mst_id,
                is_extended_id=False,
                data=answer,
                is_fd=message.is_fd,
                bitrate_switch=message.bitrate_switch,
            )
        )

    def _answer(self, motor: RecordedMotor, request: Request) -> bytes | None:
        kind, key = request
        found = motor.replies.get(request)
        if found is None and kind in _STATES:
            # A client that asks otherwise gets the states that this one got.
            alike = [each for each in motor.replies if each[0] in _STATES]
            if not alike:
                return None
            kind, key = max(alike, key=lambda each: len(motor.replies[each]))
            found = motor.replies[kind, key]
        if not found:
            return None
        return self._playback.next_of((motor.esc_id, kind, key), found)
