"""Servos that answer as recorded ones did: a record of a serial line is played back to a client."""

from __future__ import annotations

import sys
from typing import Any, ClassVar

from touchcell.drivers.feetech import codec
from touchcell.drivers.feetech.capture import Capture, RecordedServo, Request
from touchcell.drivers.feetech.codec import Instruction, Packet
from touchcell.errors import ConfigError
from touchcell.testing.emulation.base import Emulator
from touchcell.testing.emulation.playback import Playback
from touchcell.testing.emulation.serial_line import SerialLine


class RecordedServos(Emulator):
    """Servos of a capture. Each request is answered by the next recorded reply to the same, the last one for ever.

    A read of registers that were never read together is answered by the first value seen of each; writes are
    acknowledged where the servo acknowledged any. Nothing moves.

    Args:
        line: the adapter and its line.
        capture: recorded traffic.

    Raises:
        ConfigError: no servo in the capture replied.
    """

    faults: ClassVar = {"pause": "no servo replies", "again": "begin the capture again"}

    def __init__(self, line: SerialLine, capture: Capture) -> None:
        super().__init__()
        self._servos = {number: servo for number, servo in capture.servos.items() if servo.replies}
        if not self._servos:
            raise ConfigError("no servo in the capture replied", hint="record while a client uses the arm")
        self._acknowledge = {
            number: any(request.code == Instruction.WRITE for request in servo.replies)
            for number, servo in self._servos.items()
        }
        self._line = line
        self._buffer = b""
        self._playback = Playback()
        self._unknown: set[Request] = set()
        self._answered = 0

    async def start(self) -> None:
        """Open the line."""
        self._line.plug_in(self._on_bytes)

    async def stop(self) -> None:
        """Close the line."""
        self._line.unplug()

    def state(self) -> dict[str, Any]:
        """Return counters, and the requests for which the capture has no answer."""
        return {
            "answered": self._answered,
            "unknown": sorted(
                f"servo {asked.servo}: instruction {asked.code}, register {asked.register}, {asked.length} bytes"
                for asked in self._unknown
            ),
            "faults": sorted(self.active),
        }

    def on_fault(self, fault: str, value: Any) -> None:
        """Begin again at once."""
        if fault == "again":
            self._playback.begin_again()
            del self.active[fault]

    def _on_bytes(self, heard: bytes) -> None:
        found = codec.split(self._buffer + heard)
        self._buffer = found.rest
        for packet in found.packets:
            if "pause" not in self.active:
                self._on_packet(packet)

    def _on_packet(self, packet: Packet) -> None:
        data = packet.data
        if packet.code == Instruction.SYNC_READ and len(data) > 2:
            for number in data[2:]:
                self._answer(Request(number, Instruction.READ, data[0], data[1]))
        elif packet.code == Instruction.PING and packet.servo == codec.BROADCAST_ID:
            for number in sorted(self._servos):
                self._line.write(codec.encode(Packet(number, 0)))
        elif packet.servo == codec.BROADCAST_ID:
            return
        elif packet.code == Instruction.READ and len(data) == 2:
            self._answer(Request(packet.servo, Instruction.READ, data[0], data[1]))
        elif packet.code in (Instruction.WRITE, Instruction.REG_WRITE) and data:
            self._answer(Request(packet.servo, packet.code, data[0], len(data) - 1))
        else:
            self._answer(Request(packet.servo, packet.code))

    def _answer(self, request: Request) -> None:
        servo = self._servos.get(request.servo)
        if servo is None:
            return
        reply = self._recorded(servo, request)
        if reply is not None:
            self._answered += 1
            self._line.write(codec.encode(reply))
        elif request not in self._unknown and request.code in (Instruction.READ, Instruction.PING):
            self._unknown.add(request)
            print(
                f"the capture has no answer of servo {request.servo} to instruction {request.code}, register "
                f"{request.register}, {request.length} bytes",
                file=sys.stderr,
            )

    def _recorded(self, servo: RecordedServo, request: Request) -> Packet | None:
        replies = servo.replies.get(request)
        if replies:
            return self._playback.next_of(request, replies)
        if request.code == Instruction.READ:
            known = [servo.registers.get(request.register + i) for i in range(request.length)]
            values = [value for value in known if value is not None]
            return Packet(request.servo, 0, bytes(values)) if len(values) == len(known) else None
        acknowledges = request.code == Instruction.PING or self._acknowledge[request.servo]
        return Packet(request.servo, 0) if acknowledges else None
