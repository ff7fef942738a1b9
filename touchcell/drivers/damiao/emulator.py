"""Emulator of an arm of Damiao motors on a CAN bus: registers, every control mode, in-motor timeout, faults.

Each motor is a second-order system (inertia, viscous friction, the weight of the arm from its chain description)
integrated in steps of 0.5 ms. Inertias are constant and uncoupled: this tests protocol and fault handling, not
dynamics. Until a motor is first enabled the arm rests on its stand; afterwards a disabled joint sinks against friction.
"""

from __future__ import annotations

import argparse
import asyncio
import errno
import math
import struct
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import can
import numpy as np

from touchcell.drivers.core import can_errors
from touchcell.drivers.core.errors import CodecError
from touchcell.drivers.damiao import capture, codec
from touchcell.drivers.damiao.capture_emulator import RecordedArm
from touchcell.drivers.kinematics.chain import ChainDescription, SerialChain, Tool
from touchcell.geometry.types import Array
from touchcell.testing.emulation.base import CommandOnset, Emulator
from touchcell.testing.emulation.can_hub import Hub

_STEP_S = 0.5e-3
_TICK_S = 2e-3
_GRAVITY_EVERY = 8
_ROOM_TEMPERATURE_C = 35.0
_OVER_TEMPERATURE_C = 100.0
# Loops within the motor, of this emulator: rad/s per rad and N m per rad/s. Their integrators are ideal: they carry the
# weight.
_POSITION_GAIN, _SPEED_GAIN = 20.0, 20.0
_STORE, _READ, _WRITE, _STATE = 0xAA, 0x33, 0x55, 0xCC
# Details in an error frame (linux/can/error.h).
_NO_ACKNOWLEDGEMENT, _PASSIVE_BOTH = 0x020, 0x30

MODELS: Mapping[str, codec.Ranges] = {
    "4310": codec.Ranges(12.5, 30.0, 10.0),
    "4340": codec.Ranges(12.5, 10.0, 28.0),
    "8009": codec.Ranges(12.5, 45.0, 54.0),
}
"""Full scales as published by damiao-motor and i2rt."""

FACTORY_TIMEOUT_TICKS = 8000


class Motor:
    """Registers and status of one motor; its mechanics are integrated by the arm.

    Args:
        esc_id: CAN id of its commands.
        mst_id: CAN id of its replies.
        ranges: full scales.
    """

    def __init__(self, esc_id: int, mst_id: int, ranges: codec.Ranges) -> None:
        self.esc_id = esc_id
        self.mst_id = mst_id
        self.ranges = ranges
        self.rotor_c = _ROOM_TEMPERATURE_C
        self.registers: dict[int, float | int] = {
            codec.Register.MST_ID: mst_id,
            codec.Register.ESC_ID: esc_id,
            codec.Register.TIMEOUT: FACTORY_TIMEOUT_TICKS,
            codec.Register.CTRL_MODE: codec.MIT_MODE,
            14: 5017,
            35: 4,
            codec.Register.PMAX: ranges.position_rad,
            codec.Register.VMAX: ranges.velocity_rad_s,
            codec.Register.TMAX: ranges.torque_n_m,
        }
        self._factory = dict(self.registers)
        self.store()
        self.power_up()

    def store(self) -> None:
        """Keep the registers beyond the next loss of power."""
        self._stored = dict(self.registers)

    def reset(self) -> None:
        """Return to the state in which it was made."""
        self.registers = dict(self._factory)
        self.store()
        self.power_up()

    def power_up(self) -> None:
        """Reset to the state after switching on: disabled, saved registers."""
        self.status = codec.DISABLED
        self.command = codec.MitCommand(0.0, 0.0, 0.0, 0.0, 0.0)
        self.heard_s = -math.inf
        self.goal: codec.LoopCommand | None = None
        self.registers = dict(self._stored)

    @property
    def mode(self) -> int:
        """Control mode, a value of ``codec.Register.CTRL_MODE``."""
        return int(self.registers[codec.Register.CTRL_MODE])

    @property
    def scale(self) -> codec.Ranges:
        """Full scales of its frames, from its registers."""
        registers = self.registers
        return codec.Ranges(
            float(registers[codec.Register.PMAX]),
            float(registers[codec.Register.VMAX]),
            float(registers[codec.Register.TMAX]),
        )

    @property
    def timeout_s(self) -> float:
        """Longest silence while enabled, s; 0 is off."""
        return float(self.registers[codec.Register.TIMEOUT]) * codec.TIMEOUT_TICK_S


class DamiaoArm(Emulator):
    """Emulator of an arm; ``q`` of motor i is joint i of the chain, without offset.

    Args:
        path: socket of the hub.
        chain: kinematic chain, for its weight, its mechanical stops and the tool's true position.
        models: motor model per joint, a key of ``MODELS``.
        start_deg: angles on the stand.
        first_id: ``esc_id`` of the first motor; master ids are 0x10 higher.
        inertia: (n,) kg m^2 at the output shafts.
        friction: (n,) N m s/rad; also brakes a disabled joint.
    """

    faults: ClassVar[Mapping[str, str]] = {
        "pause": "no motor receives or replies",
        "silent": "this motor (index from 0) neither receives nor replies",
        "drop": "lose this many replies",
        "delay": "replies arrive this many seconds late",
        "corrupt": "invert every bit of this many replies, as a broken adapter might",
        "foreign": "this many replies carry another motor's id in their data",
        "out_of_order": "this many replies are overtaken by the same motor's next one",
        "unplug": "the adapter vanishes",
        "bus_off": "the controller goes bus-off and passes nothing",
        "error_frames": "report this many bus errors",
        "fault_bits": "[motor index, status nibble]: the motor reports it and disables itself",
        "hot": "[motor index, degrees Celsius] of the winding; at 100 the motor disables itself",
        "tx_full": "the adapter's transmit queue refuses this many frames of the host",
        "push": "[motor index, N m]: external torque on that joint",
        "refuse": "this motor (index from 0) does not enable",
        "enobufs": "the interface's queue is full (ENOBUFS) for this many frames of the host",
        "net_down": "the interface is down for this many seconds (ENETDOWN)",
        "id_clash": "[motor index, other index]: the second motor has the ids of the first; their replies collide",
        "wrong_rate": "the motors listen at another bit rate: nothing is acknowledged",
        "registers": "[motor index, register, value]: overwrite a register of that motor",
        "deaf": "[motor index, count]: it ignores this many commands to enable",
        "error_passive": "the controller is error-passive, with [transmit, receive] error counters",
        "chatter": "another node sends this many frames every 2 ms",
        "echo": "the adapter returns the host's own frames",
        "stray_registers": "this many replies are preceded by one to another host's register write",
        "disable": "another host disables this motor (index)",
        "spike": "this many replies have a position at the end of the scale",
        "turn_off": "[motor index, turns]: the motor powered up with its angle that many whole turns off",
        "nan": "the full-scale registers read as NaN",
        "restart": "the motors lose power for a moment",
        "reset": "return to the state at the start of the emulator",
    }

    def __init__(
        self,
        path: Path,
        chain: SerialChain,
        models: list[str],
        start_deg: list[float],
        first_id: int = 1,
        inertia: Array | None = None,
        friction: Array | None = None,
    ) -> None:
        super().__init__()
        self._chain = chain
        self._hub = Hub(path, self._on_frame)
        self.motors = [Motor(first_id + i, first_id + i + 0x10, MODELS[model]) for i, model in enumerate(models)]
        n = len(self.motors)
        self._start_q = np.deg2rad(np.array(start_deg, dtype=np.float64))
        self._inertia = np.geomspace(0.25, 0.02, n) if inertia is None else inertia
        self._friction = np.geomspace(0.6, 0.1, n) if friction is None else friction
        self._steps = 0
        self._start_s = 0.0
        self._ticker: asyncio.Task[None] | None = None
        self._under_way: set[asyncio.TimerHandle] = set()
        self._reset()

    def _reset(self) -> None:
        for handle in self._under_way:
            handle.cancel()
        self._under_way.clear()
        for motor in self.motors:
            motor.reset()
            motor.rotor_c = _ROOM_TEMPERATURE_C
        self._q = self._start_q.copy()
        self._dq = np.zeros_like(self._q)
        self._tau = np.zeros_like(self._q)
        self._weight = self._chain.gravity_torques(self._q)
        self._on_stand = True
        self._held_back: dict[int, can.Message] = {}
        self._energising = 0
        self._commands = 0
        self._onset = CommandOnset()
        self._last_command_s: float | None = None
        self._let_go_position: list[float] | None = None

    async def start(self) -> None:
        """Open the hub and start the simulated time."""
        self._start_s = self._now_s()
        self._hub.open()
        self.publish_joints(self._q)
        self._ticker = asyncio.create_task(self._tick())

    async def stop(self) -> None:
        """Close the hub."""
        if self._ticker is not None:
            self._ticker.cancel()
        self._hub.close()

    def state(self) -> dict[str, Any]:
        """Return the ground truth: angles, tool position, enabled motors, received frames."""
        self._hub.drain()
        self._integrate()
        T_base_tcp = self._chain.forward(self._q)
        return {
            "q_rad": self._q.tolist(),
            "dq_rad_s": self._dq.tolist(),
            "tau_n_m": self._tau.tolist(),
            "position_m": T_base_tcp[:3, 3].tolist(),
            "T_base_tcp": T_base_tcp.tolist(),
            "still": bool((np.abs(self._dq) < 5e-3).all()),
            "energised": any(motor.status == codec.ENABLED for motor in self.motors),
            "enabled": sum(motor.status == codec.ENABLED for motor in self.motors),
            "status": [motor.status for motor in self.motors],
            "energising": self._energising,
            "watchdog_s": [motor.timeout_s for motor in self.motors],
            "kp": [motor.command.kp for motor in self.motors],
            "target_rad": [motor.command.q for motor in self.motors],
            "commands": self._commands,
            "command_onset_ns": self._onset.t_ns,
            "last_command_age_s": None if self._last_command_s is None else self._now_s() - self._last_command_s,
            "let_go_position_m": self._let_go_position,
            "clients": self._hub.client_count,
            "faults": sorted(self.active),
        }

    def on_fault(self, fault: str, value: Any) -> None:
        """Apply faults that act at once."""
        if fault == "unplug":
            self._hub.close()
        elif fault == "bus_off":
            self._hub.send(_error_frame(can_errors.BUS_OFF))
        elif fault == "error_frames":
            while self.spend(fault):
                self._hub.send(_error_frame(can_errors.BUS_ERROR))
        elif fault == "tx_full":
            self._hub.fill_transmit_queues(int(value))
            del self.active[fault]
        elif fault == "enobufs":
            self._hub.fill_transmit_queues(int(value), errno.ENOBUFS)
            del self.active[fault]
        elif fault == "net_down":
            self._hub.take_down(float(value))
            del self.active[fault]
        elif fault == "registers":
            index, register, number = value
            self.motors[index].registers[register] = number
            del self.active[fault]
        elif fault == "disable":
            self.motors[int(value)].status = codec.DISABLED
            del self.active[fault]
        elif fault == "error_passive":
            self._hub.send(_error_frame(can_errors.CONTROLLER | can_errors.COUNTERS_CHANGED, passive=value))
        elif fault == "fault_bits":
            index, status = value
            self._let_go(self.motors[index], status)
        elif fault == "hot":
            index, celsius = value
            self.motors[index].rotor_c = float(celsius)
            if celsius >= _OVER_TEMPERATURE_C:
                self._let_go(self.motors[index], 0xC)
        elif fault == "restart":
            for motor in self.motors:
                motor.power_up()
            del self.active[fault]
        elif fault == "reset":
            for name in list(self.active):
                self.end(name)
            self._reset()

    def on_clear(self, fault: str) -> None:
        """Reconnect the adapter; leave bus-off."""
        if fault == "unplug":
            self._hub.open()
        elif fault == "bus_off":
            self._hub.send(_error_frame(can_errors.RESTARTED))

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()

    async def _tick(self) -> None:
        while True:
            await asyncio.sleep(_TICK_S)
            # A late emulator must not mistake its own lateness for silence of the host.
            self._hub.drain()
            self._check_timeouts()
            self._integrate()
            for _ in range(int(self.active.get("chatter", 0))):
                self._hub.send(can.Message(arbitration_id=0x7FF, is_extended_id=False, data=bytes(8)))
            self.publish_joints(self._q)

    def _check_timeouts(self) -> None:
        now_s = self._now_s()
        for motor in self.motors:
            overdue = motor.timeout_s > 0.0 and now_s - motor.heard_s > motor.timeout_s
            if motor.status == codec.ENABLED and overdue:
                self._let_go(motor, codec.LOST_COMMUNICATION)

    def _let_go(self, motor: Motor, status: int) -> None:
        if self._let_go_position is None:
            self._let_go_position = self._chain.forward(self._q)[:3, 3].tolist()
        motor.status = status

    def _integrate(self) -> None:
        due = int((self._now_s() - self._start_s) / _STEP_S)
        if self._on_stand:
            self._steps = due
            return
        enabled = np.array([motor.status == codec.ENABLED for motor in self.motors])
        commands = [motor.command for motor in self.motors]
        q_set, dq_set, kp, kd, feed = np.array([[c.q, c.dq, c.kp, c.kd, c.tau] for c in commands]).T
        strongest = np.array([motor.ranges.torque_n_m for motor in self.motors])
        lowest, highest = self._chain.lower - 0.05, self._chain.upper + 0.05
        pushed = np.zeros(len(self.motors))
        if "push" in self.active:
            index, pushed_n_m = self.active["push"]
            pushed[index] = pushed_n_m
        while self._steps < due:
            if self._steps % _GRAVITY_EVERY == 0:
                self._weight = self._chain.gravity_torques(self._q)
            wanted = kp * (q_set - self._q) + kd * (dq_set - self._dq) + feed
            for i, motor in enumerate(self.motors):
                if motor.goal is not None:
                    wanted[i] = self._loop_torque(motor.goal, i)
            self._tau = np.where(enabled, np.clip(wanted, -strongest, strongest), 0.0)
            acceleration = (self._tau + pushed - self._weight - self._friction * self._dq) / self._inertia
            self._dq = self._dq + _STEP_S * acceleration
            self._q = self._q + _STEP_S * self._dq
            stopped = (self._q < lowest) | (self._q > highest)
            self._dq = np.where(stopped, 0.0, self._dq)
            self._q = np.clip(self._q, lowest, highest)
            self._steps += 1

    def _loop_torque(self, goal: codec.LoopCommand, index: int) -> float:
        """Return the torque of a motor that closes the loop itself."""
        speed = goal.dq
        if not math.isnan(goal.q):
            speed = float(np.clip(_POSITION_GAIN * (goal.q - self._q[index]), -abs(goal.dq), abs(goal.dq)))
        wanted = _SPEED_GAIN * (speed - self._dq[index]) + self._weight[index]
        return _within(wanted, goal.torque_share * self.motors[index].ranges.torque_n_m)

    def _on_frame(self, message: can.Message) -> None:
        if "bus_off" in self.active or message.is_error_frame or message.is_extended_id:
            return
        if "wrong_rate" in self.active:
            self._hub.send(_error_frame(can_errors.BUS_ERROR | _NO_ACKNOWLEDGEMENT))
            return
        if "echo" in self.active:
            self._hub.send(message)
        if "pause" in self.active or message.is_remote_frame or len(message.data) != 8:
            return
        data = bytes(message.data)
        number = message.arbitration_id
        parameter = number == codec.PARAMETER_ID
        if parameter:
            number = codec.decode_parameter_request(data)[0]
        first, second = self.active.get("id_clash", (-1, -1))
        for index, motor in enumerate(self.motors):
            if index in (first, second):
                if number == self.motors[first].esc_id and index == first:
                    # Both reply with one id and different data: bit errors, until both controllers are off the bus.
                    self._hub.send(_error_frame(can_errors.BUS_ERROR))
                continue
            mode, esc_id = divmod(number, codec.MODE_ID_STEP) if not parameter else (0, number)
            if esc_id == self._esc_id(motor) and mode < codec.FORCE_MODE and self.active.get("silent") != index:
                self._integrate()
                motor.heard_s = self._now_s()
                answer = self._on_parameter(index, data) if parameter else self._on_command(index, mode + 1, data)
                if answer is not None:
                    self._reply(index, answer, message)

    @staticmethod
    def _esc_id(motor: Motor) -> int:
        return int(motor.registers[codec.Register.ESC_ID])

    def _on_command(self, index: int, mode: int, data: bytes) -> bytes | None:
        """Obey a command that came on the id of ``mode``; a motor in another mode hears only special commands there."""
        motor = self.motors[index]
        is_special = data[:7] == codec.ENABLE[:7] and data[7] >= codec.CLEAR_ERROR[7]
        if motor.mode != mode and not (is_special and mode == codec.MIT_MODE):
            return None
        self._last_command_s = self._now_s()
        self._commands += 1
        if is_special:
            self._energising += 1
            self._on_special(index, data)
        elif motor.status == codec.ENABLED:
            if mode == codec.MIT_MODE:
                command = codec.decode_mit(data, motor.scale)
                motor.command = replace(command, q=command.q - self._turned(index))
            else:
                with suppress(CodecError):
                    goal = codec.decode_loop(data, mode)
                    motor.goal = replace(goal, q=goal.q - self._turned(index))
            self._onset.note(index, data[:5])
        return self._feedback(index)

    def _on_special(self, index: int, data: bytes) -> None:
        motor = self.motors[index]
        if data == codec.ENABLE and self.active.get("refuse") == index:
            return
        deaf, left = self.active.get("deaf", (-1, 0))
        if data == codec.ENABLE and deaf == index and left > 0:
            self.active["deaf"] = [index, left - 1]
            return
        if data == codec.ENABLE and motor.status in (codec.DISABLED, codec.ENABLED):
            motor.status = codec.ENABLED
            motor.command, motor.goal = codec.MitCommand(0.0, 0.0, 0.0, 0.0, 0.0), None
            self._on_stand = False
        elif data == codec.DISABLE:
            motor.status = codec.DISABLED if motor.status == codec.ENABLED else motor.status
        elif data == codec.CLEAR_ERROR and not self._cause_remains(index):
            motor.status = codec.ENABLED if motor.status == codec.ENABLED else codec.DISABLED
        elif data == codec.SET_ZERO:
            self._q[index] = 0.0

    def _cause_remains(self, index: int) -> bool:
        held = self.active.get("fault_bits", (-1, 0))
        return bool(held[0] == index or self.motors[index].rotor_c >= _OVER_TEMPERATURE_C)

    def _on_parameter(self, index: int, data: bytes) -> bytes | None:
        motor = self.motors[index]
        _, operation, register, raw = codec.decode_parameter_request(data)
        if operation == _STATE:
            return self._feedback(index)
        if operation == _STORE:
            motor.store()
            return data[:4] + bytes(4)
        if operation not in (_READ, _WRITE) or register not in motor.registers:
            return None
        if operation == _WRITE:
            is_float = isinstance(motor.registers[register], float)
            motor.registers[register] = struct.unpack("<f" if is_float else "<I", raw)[0]
            if register == codec.Register.CTRL_MODE:
                self._energising += 1
                motor.command, motor.goal = codec.MitCommand(0.0, 0.0, 0.0, 0.0, 0.0), None
        value = motor.registers[register]
        if "nan" in self.active and isinstance(value, float):
            value = math.nan
        return codec.encode_register_reply(motor.esc_id, register, value, write=operation == _WRITE)

    def _feedback(self, index: int) -> bytes:
        motor, ranges = self.motors[index], self.motors[index].scale
        shown = codec.Feedback(
            motor=motor.esc_id & 0xF,
            status=motor.status,
            q=ranges.position_rad
            if self.spend("spike")
            else _within(self._q[index] + self._turned(index), ranges.position_rad),
            dq=_within(self._dq[index], ranges.velocity_rad_s),
            tau=_within(self._tau[index], ranges.torque_n_m),
            mos_c=33,
            rotor_c=round(motor.rotor_c),
        )
        return codec.encode_feedback(shown, ranges)

    def _turned(self, index: int) -> float:
        motor, turns = self.active.get("turn_off", (-1, 0))
        return 2.0 * math.pi * turns if motor == index else 0.0

    def _reply(self, index: int, data: bytes, request: can.Message) -> None:
        if self.spend("drop"):
            return
        if self.spend("corrupt"):
            data = bytes(byte ^ 0xFF for byte in data)
        elif self.spend("foreign"):
            data = bytes([data[0] & 0xF0 | (data[0] + 1) & 0xF]) + data[1:]
        if self.spend("stray_registers"):
            esc_id = self.motors[index].esc_id
            self._hub.send(
                can.Message(
                    arbitration_id=self.motors[index].mst_id,
                    is_extended_id=False,
                    data=codec.encode_register_reply(esc_id, codec.Register.CTRL_MODE, codec.MIT_MODE, write=True),
                )
            )
        answer = can.Message(
            arbitration_id=int(self.motors[index].registers[codec.Register.MST_ID]),
            is_extended_id=False,
            data=data,
            is_fd=request.is_fd,
            bitrate_switch=request.bitrate_switch,
        )
        delay_s = float(self.active.get("delay", 0.0))
        if index not in self._held_back and self.spend("out_of_order"):
            self._held_back[index] = answer
            return
        overtaken = self._held_back.pop(index, None)
        for message in (answer, overtaken):
            if message is not None and delay_s > 0.0:
                self._under_way.add(asyncio.get_running_loop().call_later(delay_s, self._hub.send, message))
            elif message is not None:
                self._hub.send(message)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of ``touchcell emulate damiao``."""
    parser.add_argument("path", type=Path, help="socket of the hub; clients use it as python-can channel")
    parser.add_argument("--chain", default="generic_6r", help="shipped chain description, or a YAML or URDF file")
    parser.add_argument("--tool", help='tool as JSON, e.g. \'{"origin_mm": [0, 0, 80], "mass_kg": 0.2}\'')
    parser.add_argument("--models", nargs="+", choices=sorted(MODELS), help="motor model per joint")
    parser.add_argument("--start-deg", type=float, nargs="+", default=[0.0, 40.0, 90.0, 0.0, 50.0, 0.0])
    parser.add_argument("--first-id", type=int, default=1)
    parser.add_argument(
        "--from",
        dest="capture",
        type=Path,
        metavar="CAPTURE",
        help="answer as the motors in this capture did (candump -L), after a report of what in it is not as expected",
    )


def build(arguments: argparse.Namespace) -> Emulator:
    """Build the emulator from its command-line arguments. Raises ConfigError."""
    if arguments.capture is not None:
        recorded = capture.assign(capture.read_frames(arguments.capture))
        judged = list(capture.judge(recorded, Motor(1, 2, MODELS["4310"]).registers))
        for line in [*capture.describe(recorded), *(judged or ["nothing contradicts codec or emulator"])]:
            print(line, file=sys.stderr)
        return RecordedArm(arguments.path, recorded)
    tool = Tool.model_validate_json(arguments.tool) if arguments.tool else None
    chain = SerialChain(ChainDescription.named(arguments.chain), tool)
    n = chain.joint_count
    models = arguments.models or ["4340"] * min(3, n) + ["4310"] * max(0, n - 3)
    return DamiaoArm(arguments.path, chain, models, arguments.start_deg, arguments.first_id)


def _within(value: float, limit: float) -> float:
    return min(max(float(value), -limit), limit)


def _error_frame(error_class: int, passive: Sequence[int] | None = None) -> can.Message:
    data = bytes(8) if passive is None else bytes([0, _PASSIVE_BOTH, 0, 0, 0, 0, *passive])
    return can.Message(arbitration_id=error_class, is_error_frame=True, is_extended_id=False, dlc=8, data=data)
