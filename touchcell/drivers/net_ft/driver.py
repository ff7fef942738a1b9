"""Driver of ATI Net F/T force-torque sensors (Net Box, and boxes of others that speak Raw Data Transfer).

Each sample is requested by itself. A free-running stream fills the socket's buffer when it is faster than its reader,
and then delivers old samples (kuka-isir/ati_sensor 2, gbartyzel/ros2_net_ft_driver 3); a sample that was asked for is
no older than its request. Records do not identify their request, so a socket has one request at a time: one that is not
answered keeps its socket, and the next is sent from another.

The driver changes no setting of the box: neither its zero nor its rate.
"""

from __future__ import annotations

import select
import socket
import threading
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from touchcell.drivers.core.clock import Clock, wait_readable
from touchcell.drivers.core.device import Device, OperatorToken
from touchcell.drivers.core.errors import (
    CodecError,
    ConnectError,
    DeviceFault,
    FaultClass,
    LifecycleError,
    Remedy,
    StaleData,
    TransportTimeout,
)
from touchcell.drivers.core.protocols import HealthSource, ReadingSource
from touchcell.drivers.core.samples import Stamped
from touchcell.drivers.core.spec import Capabilities, DriverConfig, DriverContext, DriverSpec
from touchcell.drivers.net_ft import codec
from touchcell.geometry.types import Array

Positive = Annotated[float, Field(gt=0.0)]

_AXES = ("force_x_n", "force_y_n", "force_z_n", "torque_x_nm", "torque_y_nm", "torque_z_nm")
_FIRST_SAMPLE_S = 1.0
_LONGEST = 2048


class NetFtConfig(DriverConfig):
    """Configuration of a Net F/T box.

    Attributes:
        host: its address.
        rate_hz: samples requested per second.
        max_silence_s: without a new sample for this long the sensor is faulted.
        connect_timeout_s: timeout of the calibration, which is read over TCP.
    """

    host: str = Field(min_length=1)
    rate_hz: Annotated[float, Field(ge=10.0, le=1000.0)] = 200.0
    max_silence_s: Positive = 0.1
    connect_timeout_s: Positive = 2.0

    def emulated_address(self) -> str | None:
        """Return the key whose value leads to an emulator on this machine; None if none."""
        return "host" if self.host.startswith("127.") or self.host == "localhost" else None


class NetFt(Device):
    """A force-torque sensor behind a Net F/T box.

    Args:
        name: the device's name in the cell.
        config: checked configuration.
        clock: injected clock.
    """

    def __init__(self, name: str, config: NetFtConfig, clock: Clock) -> None:
        super().__init__(name, clock)
        self._config = config
        self._sockets: _Sockets | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._reset_state()

    def _reset_state(self) -> None:
        self._calibration = codec.Calibration(1.0, 1.0)
        self._newest: Stamped[Array] | None = None
        self._number: int | None = None
        self._advanced_ns = self._clock.now_ns()
        self._status = 0
        self._counts = dict.fromkeys(("requests", "samples", "missed", "corrupt", "out_of_order"), 0)

    def read(self, max_age_s: float | None = None) -> Stamped[Mapping[str, float]]:
        """Return force and torque on the sensor along its axes, and their norms. Raises StaleData, LifecycleError."""
        sample = self._newest
        if self._sockets is None or sample is None:
            raise LifecycleError(self.name, "read", self.state.value, ["connected"])
        age_s = sample.age_s(self._clock.now_ns())
        if max_age_s is not None and age_s > max_age_s:
            raise StaleData(self.name, age_s, max_age_s, sample.seq)
        return Stamped(_named(sample.value), sample.t_ns, sample.seq)

    def health(self) -> dict[str, float | int | str | bool]:
        """Return counters, the box's status code, and the newest force and torque, which interlocks can limit."""
        readings: dict[str, float | int | str | bool] = {**self._counts, "status": self._status}
        if self._newest is not None:
            readings |= _named(self._newest.value)
        return readings

    def _open(self) -> None:
        self._reset_state()
        self._calibration = self._read_calibration()
        self._sockets = _Sockets((self._config.host, codec.RDT_PORT))
        self._closing.clear()
        self._thread = threading.Thread(target=self._run, name=f"{self.name} samples", daemon=True)
        self._thread.start()
        deadline_ns = self._clock.now_ns() + round(1e9 * _FIRST_SAMPLE_S)
        while self._newest is None:
            if self._status:
                raise self._status_fault()
            if self._clock.now_ns() > deadline_ns:
                raise ConnectError(
                    self.name,
                    f"{self._config.host} sends no sample within {_FIRST_SAMPLE_S:g} s",
                    hint="is RDT enabled on the box's page Communications, and is UDP port 49152 free of a firewall?",
                )
            self._clock.sleep_until_ns(self._clock.now_ns() + 1_000_000)

    def _close(self) -> None:
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._sockets is not None:
            self._sockets.close()
            self._sockets = None

    def _configure(self) -> None:
        if self._status:
            raise self._status_fault()

    def _recover(self, token: OperatorToken) -> None:
        answered_ns = self._clock.now_ns()
        deadline_ns = answered_ns + round(1e9 * _FIRST_SAMPLE_S)
        while self._newest is None or self._newest.t_ns < answered_ns:
            if self._status:
                raise self._status_fault()
            if self._clock.now_ns() > deadline_ns:
                raise TransportTimeout(self.name, "sample", _FIRST_SAMPLE_S)
            self._clock.sleep_until_ns(self._clock.now_ns() + 1_000_000)

    def _read_calibration(self) -> codec.Calibration:
        where = (self._config.host, codec.CALIBRATION_PORT)
        try:
            with socket.create_connection(where, self._config.connect_timeout_s) as connection:
                connection.sendall(codec.calibration_request())
                connection.setblocking(False)
                deadline_ns = self._clock.now_ns() + round(1e9 * self._config.connect_timeout_s)
                data = b""
                while len(data) < codec.CALIBRATION_LENGTH:
                    if not wait_readable(self._clock, connection.fileno(), deadline_ns):
                        raise TimeoutError("no calibration")
                    if not (piece := connection.recv(codec.CALIBRATION_LENGTH - len(data))):
                        raise ConnectionError("closed by the box")
                    data += piece
            return codec.decode_calibration(data)
        except (OSError, CodecError) as error:
            raise ConnectError(
                self.name,
                f"no calibration from {where[0]}:{where[1]}",
                [error],
                hint=f"is {where[0]} the Net F/T box, powered and reachable?",
            ) from error

    def _run(self) -> None:
        period_ns = round(1e9 / self._config.rate_hz)
        next_ns = self._clock.now_ns()
        while not self._closing.is_set():
            try:
                self._cycle(next_ns, period_ns)
            except OSError:
                # Nobody serves the port now: the silence is what counts.
                self._counts["missed"] += 1
            self._check_silence()
            next_ns = max(next_ns + period_ns, self._clock.now_ns())
            self._clock.sleep_until_ns(next_ns)

    def _cycle(self, now_ns: int, period_ns: int) -> None:
        sockets = self._sockets
        assert sockets is not None
        asked_ns = self._clock.now_ns()
        sockets.forget(asked_ns - round(1e9 * self._config.max_silence_s))
        self._counts["requests"] += 1
        sockets.send(codec.request(), asked_ns)
        until_ns = now_ns + period_ns * 3 // 4
        while sockets.asked and wait_readable(self._clock, sockets.fileno(), until_ns):
            for data, requested_ns in sockets.receive():
                self._take(data, requested_ns)
        self._counts["missed"] += bool(sockets.asked)

    def _take(self, data: bytes, requested_ns: int) -> None:
        try:
            record = codec.decode_record(data)
        except CodecError:
            self._counts["corrupt"] += 1
            return
        self._status = record.status
        if record.status:
            self._to_faulted(self._status_fault())
            return
        if self._number is not None and codec.step(self._number, record.number) <= 0:
            self._counts["out_of_order"] += 1
            return
        self._number, self._advanced_ns = record.number, self._clock.now_ns()
        self._counts["samples"] += 1
        scale = np.repeat([self._calibration.force_n, self._calibration.torque_nm], 3)
        self._newest = Stamped(record.counts * scale, requested_ns, self._counts["samples"])

    def _check_silence(self) -> None:
        silent_s = (self._clock.now_ns() - self._advanced_ns) * 1e-9
        if self._newest is not None and silent_s > self._config.max_silence_s:
            self._to_faulted(
                TransportTimeout(self.name, "new sample", self._config.max_silence_s, hint="check its cable and supply")
            )

    def _status_fault(self) -> DeviceFault:
        return DeviceFault(
            self.name,
            f"the box reports status {self._status:#010x}",
            vendor_code=self._status,
            fault_class=FaultClass.ELECTRICAL,
            needs=Remedy.OPERATOR,
            hint="overloaded, too hot, or its transducer is unplugged: see System Status Code on the box's pages",
        )


class _Sockets:
    """UDP sockets to one box, each with one request at most.

    Attributes:
        asked: by file descriptor the sockets that await a record, and since when.
    """

    def __init__(self, box: tuple[str, int]) -> None:
        self._box = box
        self._poller = select.epoll()
        self._idle: list[socket.socket] = []
        self.asked: dict[int, tuple[socket.socket, int]] = {}

    def fileno(self) -> int:
        """Return a file descriptor that can be read when a record has arrived."""
        return self._poller.fileno()

    def send(self, data: bytes, now_ns: int) -> None:
        """Send from a socket without a request. Raises OSError."""
        used = self._idle.pop() if self._idle else self._opened()
        self.asked[used.fileno()] = used, now_ns
        used.send(data)

    def receive(self) -> list[tuple[bytes, int]]:
        """Return the records that have arrived, each with the time of its request."""
        found = []
        for fd, _ in self._poller.poll(0.0):
            used, asked_ns = self.asked.pop(fd)
            try:
                found.append((used.recv(_LONGEST), asked_ns))
                self._idle.append(used)
            except OSError:
                # Nobody serves the port now.
                self._discard(used)
        return found

    def forget(self, before_ns: int) -> None:
        """Close the sockets whose request is older: what still comes is heard by none."""
        for fd, (used, asked_ns) in list(self.asked.items()):
            if asked_ns < before_ns:
                del self.asked[fd]
                self._discard(used)

    def close(self) -> None:
        """Close all."""
        for used in [*self._idle, *(used for used, _ in self.asked.values())]:
            self._discard(used)
        self._poller.close()

    def _opened(self) -> socket.socket:
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.setblocking(False)
        # Connected: only this box is heard.
        opened.connect(self._box)
        self._poller.register(opened, select.EPOLLIN)
        return opened

    def _discard(self, used: socket.socket) -> None:
        self._poller.unregister(used)
        used.close()


def _named(wrench: Array) -> dict[str, float]:
    force_n, torque_nm = float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
    return {**dict(zip(_AXES, wrench.tolist(), strict=True)), "force_n": force_n, "torque_nm": torque_nm}


def _build(name: str, config: NetFtConfig, context: DriverContext) -> NetFt:
    return NetFt(name, config, context.clock)


SPEC: DriverSpec[Any, Device] = DriverSpec(
    name="net_ft",
    summary="force-torque sensor behind an ATI Net F/T box (Raw Data Transfer on UDP)",
    config=NetFtConfig,
    capabilities=Capabilities(
        kind="force-torque sensor",
        provides=frozenset({ReadingSource, HealthSource}),
        state_rate_hz=200.0,
    ),
    build=_build,
)
