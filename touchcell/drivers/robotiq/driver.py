"""Driver of Robotiq 2F-85 and 2F-140 grippers over Modbus RTU (USB to RS-485) or Modbus TCP (gateway).

A thread asks for the status in each cycle and sends the newest set value. The gripper has no time-to-live: it goes to
its last goal and holds there, whatever becomes of this process; it does not drop what it holds. Activation is its own
initialisation, in which the fingers move through their whole range: only ``activate`` starts it, and only if the
gripper is not activated already.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Final, Self

from pydantic import Field, model_validator

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device, Lifecycle, OperatorToken
from touchcell.drivers.core.errors import (
    CodecError,
    CommandRejected,
    ConnectError,
    CorruptMessage,
    DeviceError,
    DeviceFault,
    DeviceGone,
    FaultClass,
    LifecycleError,
    Rejection,
    Remedy,
    StaleData,
    TransportTimeout,
)
from touchcell.drivers.core.protocols import HealthSource, ReadingSource, SettingSink
from touchcell.drivers.core.samples import Stamped
from touchcell.drivers.core.spec import Capabilities, DriverConfig, DriverContext, DriverSpec
from touchcell.drivers.robotiq import codec, modbus
from touchcell.drivers.robotiq.codec import Action, ActivationStatus, ObjectStatus, Status
from touchcell.drivers.robotiq.link import ModbusLink, SerialLink, TcpLink

Positive = Annotated[float, Field(gt=0.0)]
_REPLY_S: Final = 0.05
_FIRST_STATUS_S: Final = 1.0
_ACTIVATION_S: Final = 10.0
_BAUD_RATE: Final = 115_200
_SETTINGS: Final = ("width_mm", "speed_mm_s", "force_n")


class RobotiqConfig(DriverConfig):
    """Configuration of a gripper; either ``port`` or ``host``.

    Attributes:
        port: serial port of its RS-485 adapter.
        host: address of its Modbus TCP gateway.
        tcp_port: port there.
        unit: its Modbus address.
        stroke_mm: opening between the fingertips when open: 85 or 140, or that of your fingertips.
        open_count, closed_count: positions that it reports when open and when closed.
        speed_range_mm_s: slowest and fastest closing speed.
        force_range_n: weakest and strongest grip.
        rate_hz: status requests per second.
        max_silence_s: without a status for this long it is faulted.
    """

    port: str | None = Field(default=None, min_length=1)
    host: str | None = Field(default=None, min_length=1)
    tcp_port: int = Field(default=502, gt=0, lt=65536)
    unit: int = Field(default=codec.UNIT, ge=1, le=247)
    stroke_mm: Positive = 85.0
    open_count: int = Field(default=3, ge=0, le=codec.COUNTS)
    closed_count: int = Field(default=230, ge=0, le=codec.COUNTS)
    speed_range_mm_s: tuple[Positive, Positive] = (20.0, 150.0)
    force_range_n: tuple[Positive, Positive] = (20.0, 235.0)
    rate_hz: Annotated[float, Field(ge=5.0, le=200.0)] = 50.0
    max_silence_s: Positive = 0.3

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.port is None) == (self.host is None):
            raise ValueError("name either the port or the host of the gripper")
        if self.closed_count <= self.open_count:
            raise ValueError(f"closed_count {self.closed_count} is not above open_count {self.open_count}")
        for low, high in (self.speed_range_mm_s, self.force_range_n):
            if high <= low:
                raise ValueError(f"a range from {low:g} to {high:g} is empty")
        return self

    def emulated_address(self) -> str | None:
        """Return the key whose value leads to an emulator on this machine; None if none."""
        return "host" if self.host is not None and self.host.startswith("127.") else None

    def width_m(self, count: float) -> float:
        """Return the opening at a position count; it may be a little beyond either end."""
        share = (self.closed_count - count) / (self.closed_count - self.open_count)
        return 1e-3 * self.stroke_mm * share

    def count(self, width_mm: float) -> int:
        """Return the position count of an opening."""
        share = width_mm / self.stroke_mm
        return round(self.closed_count - share * (self.closed_count - self.open_count))


class RobotiqGripper(Device):
    """A gripper.

    Args:
        name: the device's name in the cell.
        config: checked configuration.
        clock: injected clock.
        open_port: opens the serial port; None for pyserial.
    """

    def __init__(
        self, name: str, config: RobotiqConfig, clock: Clock, open_port: Callable[[], Any] | None = None
    ) -> None:
        super().__init__(name, clock)
        self._config = config
        self._link: ModbusLink = (
            TcpLink(name, config.host, config.tcp_port, _FIRST_STATUS_S, clock)
            if config.host is not None
            else SerialLink(name, open_port or (lambda: _open_port(name, config)), clock)
        )
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._reset_state()

    def _reset_state(self) -> None:
        self._newest: Stamped[Status] | None = None
        # The newest set value that was not sent yet; written by the task, taken by the thread.
        self._wanted: Action | None = None
        self._sent: Action | None = None
        self._held_for: int | None = None
        self._dropped = 0
        self._counts = dict.fromkeys(("cycles", "missed", "corrupt", "commands"), 0)

    def read(self, max_age_s: float | None = None) -> Stamped[Mapping[str, float]]:
        """Return opening, goal, whether it moves or holds something, and current. Raises StaleData, LifecycleError."""
        sample = self._newest
        if self._thread is None or sample is None:
            raise LifecycleError(self.name, "read", self.state.value, ["connected"])
        age_s = sample.age_s(self._clock.now_ns())
        if max_age_s is not None and age_s > max_age_s:
            raise StaleData(self.name, age_s, max_age_s, sample.seq)
        return Stamped(self._named(sample.value), sample.t_ns, sample.seq)

    def _named(self, status: Status) -> dict[str, float]:
        config = self._config
        holds = status.met in (ObjectStatus.HELD_OPENING, ObjectStatus.HELD_CLOSING)
        return {
            "width_mm": 1e3 * config.width_m(status.position),
            "goal_mm": 1e3 * config.width_m(status.requested),
            "moving": float(status.going and status.met is ObjectStatus.MOVING),
            "holding": float(holds),
            "current_a": status.current_a,
        }

    def apply(self, setting: Mapping[str, float]) -> None:
        """Begin to open or close to ``width_mm``, at ``speed_mm_s`` with ``force_n`` (the smallest if left out).

        Raises:
            CommandRejected: not ACTIVE, an unknown name, or a value that is not finite or out of range.
        """
        if self.state is not Lifecycle.ACTIVE:
            raise CommandRejected(self.name, Rejection.MODE, f"the gripper is {self.state.value}")
        for name, value in setting.items():
            if name not in _SETTINGS:
                raise CommandRejected(
                    self.name, Rejection.SHAPE, f"no setting {name!r}", hint=f"known: {', '.join(_SETTINGS)}"
                )
            if not math.isfinite(value):
                raise CommandRejected(self.name, Rejection.NON_FINITE, f"{name} is {value}", value=value)
        if "width_mm" not in setting:
            raise CommandRejected(self.name, Rejection.SHAPE, "width_mm is missing")
        config = self._config
        self._within("width_mm", setting["width_mm"], (0.0, config.stroke_mm))
        speed = self._share("speed_mm_s", setting, config.speed_range_mm_s)
        force = self._share("force_n", setting, config.force_range_n)
        wanted = Action(True, True, config.count(setting["width_mm"]), speed, force)
        if wanted != self._sent:
            self._wanted = wanted

    def health(self) -> dict[str, float | int | str | bool]:
        """Return counters, the fault code, whether what was held has been lost, and the newest reading."""
        found: dict[str, float | int | str | bool] = {**self._counts, "dropped": self._dropped}
        if self._newest is not None:
            status = self._newest.value
            found |= {"fault_code": status.fault, "activation": status.activation.name.lower()}
            found |= self._named(status)
        return found

    def _share(self, name: str, setting: Mapping[str, float], limits: tuple[float, float]) -> int:
        value = self._within(name, setting.get(name, limits[0]), limits)
        return round(codec.COUNTS * (value - limits[0]) / (limits[1] - limits[0]))

    def _within(self, name: str, value: float, limits: tuple[float, float]) -> float:
        if not limits[0] <= value <= limits[1]:
            raise CommandRejected(
                self.name,
                Rejection.LIMIT,
                f"{name} {value:g} is not {limits[0]:g} to {limits[1]:g}",
                value=value,
                limit=limits,
            )
        return value

    def _open(self) -> None:
        self._reset_state()
        self._link.open()
        try:
            self._cycle()
        except DeviceError as error:
            raise ConnectError(
                self.name, "no gripper answers", [error], hint="is it powered, and is `unit` its Modbus address?"
            ) from None
        self._closing.clear()
        self._thread = threading.Thread(target=self._run, name=f"{self.name} status", daemon=True)
        self._thread.start()

    def _close(self) -> None:
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._link.close()

    def _present_fault(self) -> DeviceError | None:
        found = self._fault_of(self._status())
        return found if found is not None and found.needs is Remedy.RECOVER else None

    def _configure(self) -> None:
        if (found := self._fault_of(self._status())) is not None:
            raise found

    def _activate(self) -> None:
        status = self._status()
        if not status.activated or status.activation is not ActivationStatus.ACTIVATED:
            self._wanted = Action(activate=True)
            self._await_activation()
        else:
            # It stays where it is, and keeps what it holds.
            self._sent = None

    def _recover(self, token: OperatorToken) -> None:
        if isinstance(self.fault, DeviceGone):
            self._close()
            self._open()
        code = codec.FAULTS.get(self._status().fault)
        if code is not None and code.needs is Remedy.RECOVER:
            self._wanted = Action(activate=False)
            self._await(lambda status: not status.activated, _FIRST_STATUS_S, "reset")
        before = self._newest
        self._await(lambda _: self._newest is not before, _FIRST_STATUS_S, "status")
        if (found := self._fault_of(self._status())) is not None:
            raise found

    def _await_activation(self) -> None:
        self._await(lambda status: status.activation is ActivationStatus.ACTIVATED, _ACTIVATION_S, "activation")

    def _await(self, reached: Callable[[Status], bool], timeout_s: float, what: str) -> None:
        deadline_ns = self._clock.now_ns() + round(1e9 * timeout_s)
        while not reached(self._status()):
            found = self._fault_of(self._status())
            if found is not None and what == "activation":
                raise found
            if self._clock.now_ns() > deadline_ns:
                raise TransportTimeout(self.name, what, timeout_s)
            self._clock.sleep_until_ns(self._clock.now_ns() + 5_000_000)

    def _status(self) -> Status:
        sample = self._newest
        if sample is None:
            raise LifecycleError(self.name, "read", self.state.value, ["connected"])
        return sample.value

    def _run(self) -> None:
        period_ns = round(1e9 / self._config.rate_hz)
        next_ns = self._clock.now_ns()
        while not self._closing.is_set():
            try:
                self._cycle()
            except (TransportTimeout, CodecError):
                self._counts["missed"] += 1
            except CorruptMessage:
                self._counts["corrupt"] += 1
            except DeviceGone as error:
                self._to_faulted(error)
                return
            self._watch()
            next_ns = max(next_ns + period_ns, self._clock.now_ns())
            self._clock.sleep_until_ns(next_ns)

    def _cycle(self) -> None:
        unit = self._config.unit
        self._counts["cycles"] += 1
        if (wanted := self._wanted) is not None:
            reply = self._link.ask(modbus.write(unit, codec.OUTPUT, codec.encode_action(wanted)), _REPLY_S)
            modbus.decode_written(reply, codec.OUTPUT, codec.REGISTERS)
            self._sent = wanted
            self._counts["commands"] += 1
            if self._wanted is wanted:
                self._wanted = None
        asked_ns = self._clock.now_ns()
        reply = self._link.ask(modbus.read(unit, codec.INPUT, codec.REGISTERS), _REPLY_S)
        status = codec.decode_status(modbus.decode_registers(reply, codec.REGISTERS))
        number = self._newest.seq + 1 if self._newest is not None else 1
        self._newest = Stamped(status, asked_ns, number)

    def _watch(self) -> None:
        assert self._newest is not None
        status = self._newest.value
        silent_s = self._newest.age_s(self._clock.now_ns())
        holds = status.met in (ObjectStatus.HELD_OPENING, ObjectStatus.HELD_CLOSING)
        # Fingers that go on to the same goal have lost what they held.
        if holds:
            self._held_for = status.requested
        elif self._held_for is not None:
            self._dropped += status.requested == self._held_for and status.activated
            self._held_for = None
        if self.state is Lifecycle.FAULTED:
            return
        if silent_s > self._config.max_silence_s:
            self._to_faulted(TransportTimeout(self.name, "status", self._config.max_silence_s, hint="check its cable"))
        elif (found := self._fault_of(status)) is not None:
            self._to_faulted(found)
        elif self.state is Lifecycle.ACTIVE and status.activation is not ActivationStatus.ACTIVATED:
            self._to_faulted(
                DeviceFault(
                    self.name,
                    "it is no longer activated: it lost power, or another program has reset it",
                    fault_class=FaultClass.ELECTRICAL,
                    needs=Remedy.RECOVER,
                    hint="support what it holds, then recover and activate",
                )
            )

    def _fault_of(self, status: Status) -> DeviceFault | None:
        if status.fault == 0 or status.fault in codec.PENDING:
            return None
        code = codec.FAULTS.get(status.fault)
        return DeviceFault(
            self.name,
            code.name if code is not None else f"undocumented fault {status.fault:#04x}",
            vendor_code=status.fault,
            fault_class=code.fault_class if code is not None else FaultClass.INTERNAL,
            needs=code.needs if code is not None else Remedy.SERVICE,
            hint=code.hint if code is not None else "ask Robotiq",
        )


def _open_port(device: str, config: RobotiqConfig) -> Any:
    import serial

    assert config.port is not None
    try:
        return serial.Serial(config.port, _BAUD_RATE, timeout=0, write_timeout=config.max_silence_s, exclusive=True)
    except (serial.SerialException, OSError, ValueError) as error:
        raise ConnectError(
            device,
            f"cannot open {config.port}: {error}",
            hint="is it plugged in, are you in the group dialout, and is the port not in use elsewhere?",
        ) from None


def _build(name: str, config: RobotiqConfig, context: DriverContext) -> RobotiqGripper:
    return RobotiqGripper(name, config, context.clock)


SPEC: DriverSpec[Any, Device] = DriverSpec(
    name="robotiq",
    summary="Robotiq 2F-85 or 2F-140 gripper over Modbus RTU or TCP",
    config=RobotiqConfig,
    capabilities=Capabilities(
        kind="gripper",
        provides=frozenset({ReadingSource, SettingSink, HealthSource}),
        state_rate_hz=50.0,
    ),
    build=_build,
)
