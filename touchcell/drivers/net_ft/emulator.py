"""Emulator of an ATI Net F/T box: records on UDP 49152, calibration on TCP 49151. Its address has to be its own.

Streams are sent at 1 kHz; the sensor has no noise, drift or temperature.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from touchcell.drivers.core.errors import CodecError
from touchcell.drivers.net_ft import codec
from touchcell.testing.emulation.base import Emulator

_SAMPLES_PER_S = 7000
_STREAM_S = 1e-3
_COUNTS_PER_UNIT = 1_000_000
_NEWTON, _NEWTON_METRE = 2, 3
_START = 2


class NetFtBox(Emulator, asyncio.DatagramProtocol):
    """Emulator of one box.

    Args:
        host: loopback address to listen on; the ports are fixed.
    """

    faults: ClassVar[Mapping[str, str]] = {
        "wrench": "[fx fy fz tx ty tz] N and N m on the sensor, along its axes",
        "pause": "nothing is answered",
        "drop": "this many records are lost",
        "delay": "records arrive this many seconds late",
        "short": "this many records are cut short",
        "out_of_order": "this many records have the number of the first one",
        "stuck": "every record is the one before",
        "status": "system status code, such as 0x80020000 for an overload",
        "unplug": "the cable is unplugged",
        "bad_calibration": "the calibration has no scale",
    }

    def __init__(self, host: str) -> None:
        super().__init__()
        self._host = host
        self._transport: asyncio.DatagramTransport | None = None
        self._server: asyncio.Server | None = None
        self._streams: dict[Any, asyncio.Task[None]] = {}
        self._requests = 0
        self._sent = 0
        self._number = 0
        self._start_s = 0.0

    async def start(self) -> None:
        """Open both ports."""
        self._start_s = asyncio.get_running_loop().time()
        await self._plug_in()

    async def stop(self) -> None:
        """Close both ports."""
        self._unplug()

    def state(self) -> dict[str, Any]:
        """Return the true wrench, counters, and clients with a stream."""
        return {
            "wrench": self._wrench().tolist(),
            "requests": self._requests,
            "sent": self._sent,
            "streams": len(self._streams),
            "energising": 0,
            "energised": False,
            "faults": sorted(self.active),
        }

    def on_fault(self, fault: str, value: Any) -> None:
        """Unplug at once."""
        if fault == "unplug":
            self._unplug()

    def on_clear(self, fault: str) -> None:
        """Plug in again."""
        if fault == "unplug":
            self._plugging = asyncio.get_running_loop().create_task(self._plug_in())

    async def _plug_in(self) -> None:
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=(self._host, codec.RDT_PORT))
        self._server = await asyncio.start_server(self._calibrate, self._host, codec.CALIBRATION_PORT)

    def _unplug(self) -> None:
        for stream in self._streams.values():
            stream.cancel()
        self._streams.clear()
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        if self._server is not None:
            self._server.close()
            self._server = None

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Answer a request."""
        self._requests += 1
        if "pause" in self.active:
            return
        try:
            command, count = codec.decode_request(data)
        except CodecError:
            return
        if (stream := self._streams.pop(addr, None)) is not None:
            stream.cancel()
        if command == _START and count == 1:
            self._send(addr, 1)
        elif command == _START:
            self._streams[addr] = asyncio.get_running_loop().create_task(self._stream(addr, count))

    async def _stream(self, addr: Any, count: int) -> None:
        number = 0
        while count == 0 or number < count:
            number += 1
            if "pause" not in self.active:
                self._send(addr, number)
            await asyncio.sleep(_STREAM_S)
        self._streams.pop(addr, None)

    def _wrench(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        return np.array(self.active.get("wrench", np.zeros(6)), dtype=np.float64).reshape(6)

    def _send(self, addr: Any, rdt_number: int) -> None:
        if self.spend("drop"):
            return
        if "stuck" not in self.active:
            self._number = int((asyncio.get_running_loop().time() - self._start_s) * _SAMPLES_PER_S) + 1
        number = 1 if self.spend("out_of_order") else self._number
        record = codec.Record(
            number % 2**32, int(self.active.get("status", 0)), np.round(self._wrench() * _COUNTS_PER_UNIT)
        )
        data = codec.encode_record(record, rdt_number)
        if self.spend("short"):
            data = data[:20]
        delay_s = float(self.active.get("delay", 0.0))
        if delay_s > 0.0:
            asyncio.get_running_loop().call_later(delay_s, self._put, data, addr)
        else:
            self._put(data, addr)

    def _put(self, data: bytes, addr: Any) -> None:
        if self._transport is not None:
            self._sent += 1
            self._transport.sendto(data, addr)

    async def _calibrate(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            while await reader.readexactly(len(codec.calibration_request())):
                if "pause" not in self.active:
                    counts = 0 if "bad_calibration" in self.active else _COUNTS_PER_UNIT
                    writer.write(codec.encode_calibration(_NEWTON, _NEWTON_METRE, counts, counts))
                    await writer.drain()
        writer.close()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of ``touchcell emulate net_ft``."""
    parser.add_argument("--host", default="127.0.0.1", help="loopback address to listen on; the ports are fixed")


def build(arguments: argparse.Namespace) -> NetFtBox:
    """Build the emulator from its command-line arguments."""
    return NetFtBox(arguments.host)
