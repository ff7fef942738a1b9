"""Emulator of Feetech STS3215 servos on a pseudo-terminal: registers, position control, protection, faults.

Each servo turns towards its goal at a speed proportional to the remaining angle, up to its goal speed. Loads and
gravity
are not modelled, and a servo without torque stays where it is: this tests protocol and fault handling, not dynamics. A
real brown-out lets an arm sink.
"""

from __future__ import annotations

import asyncio
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from touchcell.drivers.core.difference import report
from touchcell.drivers.feetech import capture, codec
from touchcell.drivers.feetech.capture_emulator import RecordedServos
from touchcell.drivers.feetech.codec import Instruction, Packet, Register
from touchcell.drivers.kinematics.chain import ChainDescription, SerialChain, Tool
from touchcell.testing.emulation.base import CommandOnset, Emulator
from touchcell.testing.emulation.serial_line import PtyLine, SerialLine

_TICK_S = 5e-3
_RESPONSE_S = 0.03
_FASTEST_TICKS_S = 3073.0
_STANDSTILL_TICKS_S = 1.0
_FACTORY_TORQUE = 1000
_MIDDLE = 2048
_CALIBRATE_HERE = 128
_LOG_LENGTH = 64
_WHEEL_MODE = 1
_ALL = -1
_STRAY = b"\x00"
# Register 6, by its value (Feetech, "SMS/STS series memory table").
_BAUD_RATES = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
_EEPROM_LENGTH = 40
_TABLE_LENGTH = 128
_GOAL_SPEED = 46
_OVERLOAD = 1 << 5
_LATCHED = _OVERLOAD | 1 << 3
_CHANGES_POWER_MODE_OR_ZERO = frozenset(
    {
        Register.ID,
        Register.BAUD_RATE,
        Register.HOMING_OFFSET,
        Register.HOMING_OFFSET + 1,
        Register.MODE,
        Register.TORQUE_ENABLE,
    }
)


class Servo:
    """Registers and mechanics of one servo.

    Args:
        number: its id.
        ticks: encoder reading, within one turn.
    """

    def __init__(self, number: int, ticks: float) -> None:
        self.encoder = ticks
        self.velocity = 0.0
        self.blocked = False
        self.reported_turns = 0
        self._strained_s = 0.0
        self.prepared: tuple[int, bytes] | None = None
        self._table = bytearray(_TABLE_LENGTH)
        self._table[Register.FIRMWARE : Register.FIRMWARE + 2] = bytes([3, 10])
        self.put(Register.MODEL, codec.word(codec.STS3215))
        self._table[Register.ID] = number
        self._table[Register.RESPONSE_LEVEL] = 1
        self.put(Register.MAX_TICKS, codec.word(codec.TICKS_PER_TURN - 1))
        self.put(Register.MAX_TORQUE, codec.word(_FACTORY_TORQUE))
        self._table[Register.PHASE] = 0x0C
        self._table[Register.PROTECTION_TIME] = 200
        self._table[Register.OVERLOAD_TORQUE] = 80
        self._saved = bytes(self._table[:_EEPROM_LENGTH])
        self.power_up()

    def power_up(self) -> None:
        """Reset to the state after switching on: saved registers, no torque, factory goals and limits."""
        self._table[:_EEPROM_LENGTH] = self._saved
        self._table[_EEPROM_LENGTH:] = bytes(_TABLE_LENGTH - _EEPROM_LENGTH)
        self._table[Register.LOCK] = 1
        self.put(Register.TORQUE_LIMIT, self.get(Register.MAX_TORQUE, 2))
        self._table[Register.VOLTAGE] = 121
        self._table[Register.TEMPERATURE] = 31
        self._strained_s = 0.0
        self._measure()

    @property
    def number(self) -> int:
        """Id of the servo."""
        return self._table[Register.ID]

    @property
    def torque(self) -> bool:
        """True if torque is enabled."""
        return self._table[Register.TORQUE_ENABLE] == codec.TORQUE_ON

    @property
    def status(self) -> int:
        """Status register, which is also the error byte of every reply."""
        return self._table[Register.STATUS]

    @status.setter
    def status(self, bits: int) -> None:
        self._table[Register.STATUS] = bits

    @property
    def goal(self) -> int:
        """Goal register, in ticks."""
        return codec.from_signed_word(self.get(Register.GOAL_POSITION, 2))

    @property
    def position(self) -> float:
        """Exact position in ticks, before quantisation."""
        offset = codec.from_signed_word(self.get(Register.HOMING_OFFSET, 2), 11)
        return (self.encoder - offset) % codec.TICKS_PER_TURN

    @property
    def acknowledges(self) -> bool:
        """True if the servo replies to writes."""
        return self._table[Register.RESPONSE_LEVEL] != 0

    @property
    def return_delay_s(self) -> float:
        """Delay before a reply, s."""
        return self._table[Register.RETURN_DELAY] * 2e-6

    def get(self, register: int, length: int) -> bytes:
        """Return registers as visible on the bus."""
        return bytes(self._table[register : register + length]).ljust(length, b"\0")

    def put(self, register: int, data: bytes) -> None:
        """Overwrite registers, including read-only ones."""
        self._table[register : register + len(data)] = data

    def write(self, register: int, data: bytes) -> None:
        """Write from the bus: measured values stay unchanged."""
        if register + len(data) > Register.POSITION:
            return
        was_on = self.torque
        self.put(register, data)
        if self._table[Register.LOCK] == 0:
            self._saved = bytes(self._table[:_EEPROM_LENGTH])
        command = self._table[Register.TORQUE_ENABLE]
        if command == _CALIBRATE_HERE:
            offset = round(self.encoder) - _MIDDLE
            self.put(Register.HOMING_OFFSET, codec.signed_word(offset, 11))
            self._saved = bytes(self._table[:_EEPROM_LENGTH])
            self._table[Register.TORQUE_ENABLE] = codec.TORQUE_ON if was_on else codec.TORQUE_OFF
        if register <= Register.TORQUE_ENABLE < register + len(data) and command == codec.TORQUE_OFF:
            self.status &= ~_LATCHED
            self._strained_s = 0.0

    def step(self, dt_s: float) -> None:
        """Advance by ``dt_s``."""
        if self._table[Register.MODE] == _WHEEL_MODE:
            self._turn_freely(dt_s)
            return
        lowest, highest = (int.from_bytes(self.get(r, 2), "little") for r in (Register.MIN_TICKS, Register.MAX_TICKS))
        left = min(max(self.goal, lowest), highest) - self.position
        speed = codec.from_signed_word(self.get(_GOAL_SPEED, 2)) or _FASTEST_TICKS_S
        pushes = self.torque and not self.status & _OVERLOAD and any(self.get(Register.TORQUE_LIMIT, 2))
        wanted = float(np.clip(left / _RESPONSE_S, -speed, speed)) if pushes else 0.0
        self.velocity = 0.0 if self.blocked else wanted
        self.encoder += self.velocity * dt_s
        strained = pushes and self.blocked and abs(left) > 1.0
        self._strained_s = self._strained_s + dt_s if strained else 0.0
        self.put(Register.LOAD, codec.signed_word(round(np.sign(left) * 950) if strained else 0, 10))
        if self._strained_s > self._table[Register.PROTECTION_TIME] * 0.01:
            self.status |= _OVERLOAD
        self._measure()

    def _turn_freely(self, dt_s: float) -> None:
        """Advance in wheel mode, in which the goal speed is signed and the goal position is ignored."""
        speed = codec.from_signed_word(self.get(_GOAL_SPEED, 2))
        turns = self.torque and not self.status & _OVERLOAD and not self.blocked
        self.velocity = float(np.clip(speed, -_FASTEST_TICKS_S, _FASTEST_TICKS_S)) if turns else 0.0
        self.encoder += self.velocity * dt_s
        self._measure()

    def _measure(self) -> None:
        ticks = round(self.position) % codec.TICKS_PER_TURN + self.reported_turns * codec.TICKS_PER_TURN
        self.put(Register.POSITION, codec.signed_word(ticks))
        self.put(Register.SPEED, codec.signed_word(round(self.velocity)))


class FeetechArm(Emulator):
    """Emulator of an arm; joint i is at zero at 2048 ticks of servo i, unless ``zero_ticks`` says otherwise.

    Args:
        line: the adapter and its line.
        chain: kinematic chain, for the tool's true position.
        start_deg: initial angles.
        zero_ticks: ticks of each servo at joint angle zero.
        direction: 1 or -1 per servo.
        echo: the adapter echoes transmitted bytes.
        protection_time_s: time of overload before a servo disables itself.
    """

    faults: ClassVar[Mapping[str, str]] = {
        "pause": "no servo receives or replies",
        "silent": "this servo (index from 0) neither receives nor replies",
        "drop": "lose this many replies",
        "delay": "replies arrive this many seconds late",
        "corrupt": "one bit of this many replies is wrong",
        "short": "this many replies lack their last bytes",
        "wild": "this many replies contain an impossible position, with a valid checksum",
        "jump": "this many replies contain a position half a turn away, with a valid checksum",
        "out_of_order": "this many replies are overtaken by the same servo's next one",
        "foreign": "this many replies carry an id that was not requested",
        "unplug": "the adapter vanishes",
        "noise": "this many replies are preceded by a stray byte",
        "id_clash": "[servo index, other index]: the second servo has the id of the first; their replies collide",
        "baud": "[servo index, code of register 6]: it listens at that baud rate only; index -1 for all",
        "voltage": "[servo index, V]: measured voltage",
        "temperature": "[servo index, degrees Celsius]: measured temperature",
        "busy": "another program holds the port",
        "adapter_echo": "the adapter echoes transmitted bytes",
        "fault_bits": "[servo index, status bits]: the servo reports them; bits 3 and 5 until its torque is off",
        "turn_off": "this servo (index) reports its position one turn lower, below 0, as after a homing offset",
        "block": "this servo (index) cannot turn",
        "carry": "[servo index, ticks]: turn that servo's shaft by hand by so much at once",
        "registers": "[servo index, address, hexadecimal bytes]: overwrite that servo's registers",
        "restart": "the servos lose power for a moment; or only that one, if the value is an index",
        "reset": "return to the state at the start of the emulator",
    }

    def __init__(
        self,
        line: SerialLine,
        chain: SerialChain,
        start_deg: Sequence[float],
        zero_ticks: Sequence[int],
        direction: Sequence[int],
        *,
        echo: bool = False,
        protection_time_s: float = 2.0,
    ) -> None:
        super().__init__()
        self._line = line
        self._chain = chain
        self._zero = np.array(zero_ticks, dtype=np.float64)
        self._direction = np.array(direction, dtype=np.float64)
        start = np.deg2rad(np.array(start_deg, dtype=np.float64))
        self._start_ticks = self._zero + self._direction * start / codec.RAD_PER_TICK
        self._echo = echo
        self._protection_time_s = protection_time_s
        self._ticker: asyncio.Task[None] | None = None
        self._reset()

    def _reset(self) -> None:
        self.active.clear()
        self.servos = [Servo(number, ticks) for number, ticks in enumerate(self._start_ticks, start=1)]
        for servo in self.servos:
            servo.put(Register.PROTECTION_TIME, bytes([round(self._protection_time_s * 100)]))
        self._buffer = b""
        self._held_back: dict[int, bytes] = {}
        self._rivals: dict[int, Servo] = {}
        self._stepped_s: float | None = None
        self._energising = 0
        self._commands = 0
        self._onset = CommandOnset()
        self._requests = 0
        self._last_command_s: float | None = None
        self._log: deque[str] = deque(maxlen=_LOG_LENGTH)

    async def start(self) -> None:
        """Open the pseudo-terminal and start the simulated time."""
        self._line.plug_in(self._on_bytes)
        self.publish_joints(self._q())
        self._ticker = asyncio.create_task(self._tick())

    async def stop(self) -> None:
        """Close the pseudo-terminal."""
        if self._ticker is not None:
            self._ticker.cancel()
        self._line.unplug()

    def state(self) -> dict[str, Any]:
        """Return the ground truth: angles, tool position, enabled servos, received packets."""
        self._integrate()
        q = self._q()
        T_base_tcp = self._chain.forward(q)
        return {
            "q_rad": q.tolist(),
            "position_m": T_base_tcp[:3, 3].tolist(),
            "T_base_tcp": T_base_tcp.tolist(),
            "ticks": [round(servo.position) for servo in self.servos],
            "still": all(abs(servo.velocity) < _STANDSTILL_TICKS_S for servo in self.servos),
            "energised": any(servo.torque for servo in self.servos),
            "enabled": sum(servo.torque for servo in self.servos),
            "torque": [servo.torque for servo in self.servos],
            "status": [servo.status for servo in self.servos],
            "goals": [servo.goal for servo in self.servos],
            "energising": self._energising,
            "watchdog_s": None,
            "commands": self._commands,
            "command_onset_ns": self._onset.t_ns,
            "requests": self._requests,
            "last_command_age_s": None if self._last_command_s is None else self._now_s() - self._last_command_s,
            "log": list(self._log),
            "faults": sorted(self.active),
        }

    def on_fault(self, fault: str, value: Any) -> None:
        """Apply faults that act at once."""
        if fault == "unplug":
            self._line.unplug()
        elif fault == "busy" and isinstance(self._line, PtyLine):
            self._line.hold()
        elif fault == "voltage":
            index, volts = value
            self.servos[index].put(Register.VOLTAGE, bytes([round(10.0 * volts)]))
        elif fault == "temperature":
            index, celsius = value
            self.servos[index].put(Register.TEMPERATURE, bytes([round(celsius)]))
        elif fault == "fault_bits":
            index, bits = value
            self.servos[index].status |= bits
        elif fault == "turn_off":
            self.servos[value].reported_turns = -1
        elif fault == "block":
            self.servos[value].blocked = True
        elif fault == "carry":
            index, ticks = value
            self.servos[index].encoder += ticks
            del self.active[fault]
        elif fault == "registers":
            index, register, data = value
            self.servos[index].put(register, bytes.fromhex(data))
            del self.active[fault]
        elif fault == "restart":
            for servo in self.servos if value is True else [self.servos[value]]:
                servo.power_up()
            del self.active[fault]
        elif fault == "reset":
            self._line.unplug()
            self._reset()
            self._line.plug_in(self._on_bytes)

    def on_clear(self, fault: str) -> None:
        """Reconnect the adapter, unblock the servos, and end the faults that are not latched."""
        if fault == "unplug" and not self._line.plugged:
            self._line.plug_in(self._on_bytes)
        elif fault == "busy" and isinstance(self._line, PtyLine):
            self._line.release()
        elif fault == "block":
            for servo in self.servos:
                servo.blocked = False
        elif fault == "turn_off":
            for servo in self.servos:
                servo.reported_turns = 0
        elif fault == "fault_bits":
            for servo in self.servos:
                servo.status &= _LATCHED

    def _hears(self, index: int) -> bool:
        servo, rate = self.active.get("baud", (None, 0))
        if self.active.get("silent") == index:
            return False
        if servo not in (index, _ALL):
            rate = self.servos[index].get(Register.BAUD_RATE, 1)[0]
        return rate < len(_BAUD_RATES) and _BAUD_RATES[rate] == self._line.baud_rate()

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()

    def _q(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        ticks = np.array([servo.encoder for servo in self.servos])
        q: np.ndarray[Any, np.dtype[np.float64]] = self._direction * (ticks - self._zero) * codec.RAD_PER_TICK
        return q

    async def _tick(self) -> None:
        while True:
            await asyncio.sleep(_TICK_S)
            self._integrate()
            self.publish_joints(self._q())

    def _integrate(self) -> None:
        now_s = self._now_s()
        before_s = now_s if self._stepped_s is None else self._stepped_s
        while before_s < now_s:
            dt_s = min(_TICK_S, now_s - before_s)
            for servo in self.servos:
                servo.step(dt_s)
            before_s += dt_s
        self._stepped_s = now_s

    def _on_bytes(self, heard: bytes) -> None:
        if self._echo or "adapter_echo" in self.active:
            self._line.write(heard)
        found = codec.split(self._buffer + heard)
        self._buffer = found.rest
        for packet in found.packets:
            self._requests += 1
            if "pause" not in self.active:
                self._integrate()
                self._on_packet(packet)

    def _on_packet(self, packet: Packet) -> None:
        data = packet.data
        hearing = [servo for index, servo in enumerate(self.servos) if self._hears(index)]
        listening = {servo.number: servo for servo in hearing}
        # Servos that were given one id both obey, and reply at once.
        self._rivals = {s.number: r for s in hearing for r in hearing if r is not s and r.number == s.number}
        if "id_clash" in self.active:
            first, second = (self.servos[index] for index in self.active["id_clash"])
            listening.pop(second.number, None)
            if first.number in listening:
                listening[first.number] = first
                self._rivals[first.number] = second
        addressed = [s for n, s in listening.items() if packet.servo in (n, codec.BROADCAST_ID)]
        alone = packet.servo != codec.BROADCAST_ID
        if packet.code == Instruction.PING:
            self._answer([(servo, b"") for servo in addressed])
        elif packet.code == Instruction.READ and alone and len(data) == 2:
            self._answer([(servo, servo.get(data[0], data[1])) for servo in addressed])
        elif packet.code in (Instruction.WRITE, Instruction.REG_WRITE) and data:
            for servo in addressed:
                if packet.code == Instruction.WRITE:
                    for twin in [each for each in hearing if each.number == servo.number]:
                        self._write(twin, data[0], data[1:])
                else:
                    servo.prepared = (data[0], data[1:])
            self._answer([(servo, b"") for servo in addressed if alone and servo.acknowledges])
        elif packet.code == Instruction.ACTION:
            for servo in addressed:
                if servo.prepared is not None:
                    self._write(servo, *servo.prepared)
                    servo.prepared = None
            self._answer([(servo, b"") for servo in addressed if alone and servo.acknowledges])
        elif packet.code == Instruction.SYNC_READ and len(data) > 2:
            addressed = [listening[number] for number in data[2:] if number in listening]
            self._answer([(servo, servo.get(data[0], data[1])) for servo in addressed])
        elif packet.code == Instruction.SYNC_WRITE and len(data) > 2:
            size = data[1] + 1
            for at in range(2, len(data), size):
                if data[at] in listening:
                    self._write(listening[data[at]], data[0], data[at + 1 : at + size])

    def _write(self, servo: Servo, register: int, data: bytes) -> None:
        registers = set(range(register, register + len(data)))
        if servo.get(register, len(data)) != data:
            self._log.append(f"{servo.number}:{register}={data.hex()}")
        # Some servos enable their torque when they receive a goal.
        may_switch_on = Register.GOAL_POSITION in registers and not servo.torque
        self._energising += may_switch_on or bool(registers & _CHANGES_POWER_MODE_OR_ZERO)
        if Register.GOAL_POSITION in registers:
            self._commands += 1
            self._onset.note(servo.number, data)
            self._last_command_s = self._now_s()
        servo.write(register, data)
        held = self.active.get("fault_bits")
        if held is not None and self.servos[held[0]] is servo:
            servo.status |= held[1]

    def _answer(self, answers: Sequence[tuple[Servo, bytes]]) -> None:
        later_s = float(self.active.get("delay", 0.0))
        for servo, data in answers:
            later_s += servo.return_delay_s
            if self.spend("drop"):
                continue
            packet = codec.encode(self._spoilt(Packet(servo.number, servo.status, data)))
            if servo.number in self._rivals:
                packet = self._collided(servo, self._rivals[servo.number], packet, data)
            if self.spend("noise"):
                packet = _STRAY + packet
            if self.spend("corrupt"):
                packet = packet[:-2] + bytes([packet[-2] ^ 0x10]) + packet[-1:]
            elif self.spend("short"):
                packet = packet[: len(packet) // 2]
            if servo.number not in self._held_back and self.spend("out_of_order"):
                self._held_back[servo.number] = packet
                continue
            packet += self._held_back.pop(servo.number, b"")
            if later_s > 0.0:
                asyncio.get_running_loop().call_later(later_s, self._line.write, packet)
            else:
                self._line.write(packet)

    @staticmethod
    def _collided(servo: Servo, rival: Servo, packet: bytes, data: bytes) -> bytes:
        """Return what the host hears when the other servo of the same id replies at once: its zeros pull the line."""
        # Another servo stands elsewhere, and its oscillator is never quite in step.
        other = codec.encode(Packet(servo.number, rival.status, bytes(~byte & 0xFF for byte in data)))
        return bytes(a & b for a, b in zip(packet, other[1:] + other[:1], strict=True))

    def _spoilt(self, packet: Packet) -> Packet:
        end = Register.CURRENT + 2
        at = len(packet.data) - (end - Register.POSITION)
        ticks = codec.from_signed_word(packet.data[at : at + 2]) if at >= 0 else 0
        if at >= 0 and self.spend("wild"):
            ticks += 2 * codec.TICKS_PER_TURN
        elif at >= 0 and self.spend("jump"):
            ticks = (ticks + codec.TICKS_PER_TURN // 2) % codec.TICKS_PER_TURN
        elif self.spend("foreign"):
            return Packet(packet.servo + 100, packet.code, packet.data)
        else:
            return packet
        return Packet(packet.servo, packet.code, packet.data[:at] + codec.signed_word(ticks) + packet.data[at + 2 :])


def add_arguments(parser: Any) -> None:
    """Add the command-line arguments of ``touchcell emulate feetech``."""
    parser.add_argument("--link", type=Path, required=True, help="symbolic link to make; clients open it as a port")
    parser.add_argument("--chain", default="so101_5r", help="shipped chain description, or a YAML or URDF file")
    parser.add_argument("--tool", help="tool as JSON, e.g. '{\"origin_mm\": [0, 0, 40]}'")
    parser.add_argument("--start-deg", type=float, nargs="+", default=[0.0, 10.0, 90.0, 80.0, 0.0])
    parser.add_argument("--zero-ticks", type=int, nargs="+", help="ticks of each servo at joint angle zero")
    parser.add_argument("--direction", type=int, nargs="+", help="1 or -1 per servo")
    parser.add_argument(
        "--from",
        dest="capture",
        type=Path,
        metavar="CAPTURE",
        help="answer as the servos in this record did (socat -x), after a report of what in it is not as expected",
    )
    parser.add_argument("--echo", action="store_true", help="the adapter echoes transmitted bytes")
    parser.add_argument("--protection-time-s", type=float, default=2.0, help="overload time of a servo, up to 2.5 s")


def build(arguments: Any) -> Emulator:
    """Build the emulator from its command-line arguments. Raises ConfigError."""
    return build_on(PtyLine(arguments.link), arguments)


def build_on(line: SerialLine, arguments: Any) -> Emulator:
    """Build the emulator on ``line`` from its other command-line arguments. Raises ConfigError."""
    if arguments.capture is not None:
        recorded = capture.judge(capture.read_chunks(arguments.capture))
        found = list(report(recorded.differences)) or ["nothing contradicts codec or emulator"]
        for text in [*capture.describe(recorded), *found]:
            print(text, file=sys.stderr)
        return RecordedServos(line, recorded)
    tool = Tool.model_validate_json(arguments.tool) if arguments.tool else None
    chain = SerialChain(ChainDescription.named(arguments.chain), tool)
    n = chain.joint_count
    return FeetechArm(
        line,
        chain,
        arguments.start_deg,
        arguments.zero_ticks or [_MIDDLE] * n,
        arguments.direction or [1] * n,
        echo=arguments.echo,
        protection_time_s=arguments.protection_time_s,
    )
