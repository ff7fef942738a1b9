"""An emulated UR controller (CB3, e-Series or PolyScope X) on its real ports: RTDE, dashboard and script.

The ports are fixed on the robot and in its clients, so each emulator needs a loopback address of its own. The arm is
kinematic: it follows commands exactly, without mass or contact. ``docs/devices/ur.md`` lists the sources.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import sys
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from touchcell.drivers.core.difference import report
from touchcell.drivers.core.errors import CorruptMessage
from touchcell.drivers.kinematics.chain import ChainDescription, SerialChain
from touchcell.drivers.ur import capture
from touchcell.drivers.ur import codec as ur_codec
from touchcell.drivers.ur.capture import Capture
from touchcell.drivers.ur.codec import IN_USE, NOT_FOUND, Packet, PacketType, Recipe, Value
from touchcell.drivers.ur.emulator import kinematics as ur_model
from touchcell.drivers.ur.emulator.controller import HOME_Q, Controller
from touchcell.drivers.ur.emulator.generation import GENERATIONS
from touchcell.drivers.ur.emulator.recorded import RecordedController
from touchcell.drivers.ur.modes import RobotMode, RuntimeState, SafetyMode
from touchcell.errors import ConfigError
from touchcell.testing.emulation.base import Emulator

DASHBOARD_PORT = 29999
SCRIPT_PORTS = (30001, 30002, 30003)
_POLYSCOPE_X = 10
_MAX_LATE_S = 0.5
_MAX_BUFFER_BYTES = 1 << 20

_OUTPUT_TYPES = {
    **dict.fromkeys(
        [
            "target_q",
            "target_qd",
            "target_qdd",
            "target_current",
            "target_moment",
            "actual_q",
            "actual_qd",
            "actual_current",
            "joint_control_output",
            "actual_TCP_pose",
            "actual_TCP_speed",
            "actual_TCP_force",
            "target_TCP_pose",
            "target_TCP_speed",
            "joint_temperatures",
            "actual_joint_voltage",
            "ft_raw_wrench",
            "payload_inertia",
            "tcp_offset",
        ],
        "VECTOR6D",
    ),
    **dict.fromkeys(["actual_tool_accelerometer", "payload_cog"], "VECTOR3D"),
    **dict.fromkeys(["actual_digital_input_bits", "actual_digital_output_bits"], "UINT64"),
    **dict.fromkeys(["robot_mode", "safety_mode", "safety_status"], "INT32"),
    **dict.fromkeys(
        [
            "runtime_state",
            "robot_status_bits",
            "safety_status_bits",
            "output_bit_registers0_to_31",
            "output_bit_registers32_to_63",
        ],
        "UINT32",
    ),
    **dict.fromkeys(
        [
            "timestamp",
            "actual_execution_time",
            "speed_scaling",
            "target_speed_fraction",
            "actual_momentum",
            "actual_main_voltage",
            "actual_robot_voltage",
            "actual_robot_current",
            "standard_analog_input0",
            "standard_analog_input1",
            "standard_analog_output0",
            "standard_analog_output1",
            "payload",
        ],
        "DOUBLE",
    ),
    "joint_mode": "VECTOR6INT32",
}

_INPUT_TYPES = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
}

_ZERO: dict[str, Value] = {
    "VECTOR6D": (0.0,) * 6,
    "VECTOR3D": (0.0,) * 3,
    "VECTOR6INT32": (0,) * 6,
    "DOUBLE": 0.0,
    "BOOL": False,
}


class _RtdeClient:
    """One connection to port 30004."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self.writer = writer
        self.outputs: Recipe | None = None
        self.every = 1
        self.inputs: dict[int, Recipe] = {}
        self.claimed: set[str] = set()
        self.started = False


class UrEmulator(Emulator):
    """RTDE, dashboard and script servers around one ``Controller``.

    Args:
        host: loopback address.
        unlock_after_s: time after a protective stop before it can be unlocked.
        start_deg: joint angles at which it begins.
        generation: name of its generation.
        model: arm; None for the usual one of the generation.
        version: its software; None for the usual one of the generation.
        recorded: recorded traffic that it reports instead of its own state.

    Raises:
        ConfigError: the generation does not drive that arm.
    """

    faults: ClassVar[Mapping[str, str]] = {
        "pause": "the network side hangs: sockets stay open, nothing is read or written; the arm keeps moving",
        "drop": "the next N state packets are not sent",
        "delay": "state packets arrive this many seconds late",
        "corrupt": "the next N state packets carry implausible numbers",
        "nan": "the next N state packets carry NaN for joints and pose",
        "out_of_order": "the next N state packets repeat an older one",
        "unplug": "the cable is unplugged: all connections are cut and none accepted until it is cleared",
        "restart": "the controller restarts: connections cut, clock at 0, arm powered off",
        "protective_stop": "the arm hit something",
        "emergency_stop": "the button on the pendant",
        "fault_bits": "enter the safety mode of this number",
        "local_control": "the pendant is in local mode",
        "program_stop": "the program is stopped from the pendant",
        "other_program": "a foreign program is running",
        "registers_in_use": "a fieldbus owns the input registers",
        "power_off": "the arm is powered off",
        "speed_slider": "the speed slider is at this fraction",
        "program_pause": "the program is paused from the pendant",
        "cut_rtde": "the connections to the real-time interface are cut, and accepted again",
        "no_dashboard": "nothing serves the dashboard, as on PolyScope X",
        "version": "[major, minor, bugfix, build] of the controller's software",
        "missing_variable": "the controller does not know this state variable",
        "temperature": "degrees Celsius of the joints",
        "voltage": "V of the robot's supply",
        "pendant_tool": "[x y z rx ry rz] m and rotation vector: tool set on the pendant",
        "wrench": "[fx fy fz tx ty tz] N and N m act on the tool",
    }

    def __init__(
        self,
        host: str,
        unlock_after_s: float = 5.0,
        start_deg: Sequence[float] | None = None,
        *,
        generation: str = "e",
        model: str | None = None,
        version: Sequence[int] | None = None,
        recorded: Capture | None = None,
    ) -> None:
        super().__init__()
        self._recorded_types = {} if recorded is None else recorded.types
        self._generation = GENERATIONS[generation]
        self._model = model = model or self._generation.models[0]
        if model not in self._generation.models:
            known = ", ".join(self._generation.models)
            raise ConfigError(f"generation {generation} has no such arm", key="model", value=model, hint=known)
        self._default_version = tuple(version or self._generation.version)
        self._host = host
        self._unlock_after_s = unlock_after_s
        self._controller = (
            RecordedController(recorded)
            if recorded is not None
            else Controller(
                unlock_after_s,
                HOME_Q if start_deg is None else np.radians(start_deg),
                ur_model.MODELS[model],
                self._generation.period_s,
            )
        )
        self._servers: list[asyncio.Server] = []
        self._clients: list[_RtdeClient] = []
        self._writers: set[asyncio.StreamWriter] = set()
        self._awake = asyncio.Event()
        self._awake.set()
        self._clock: asyncio.Task[None] | None = None
        self._background: set[asyncio.Task[None]] = set()
        self._steps = 0
        self._previous: dict[str, Value] = {}

    @property
    def _version(self) -> tuple[int, ...]:
        return tuple(self.active.get("version", self._default_version))

    @property
    def _has_dashboard(self) -> bool:
        is_old = self._generation.has_dashboard and self._version[0] < _POLYSCOPE_X
        return is_old and "no_dashboard" not in self.active

    async def start(self) -> None:
        await self._listen()
        self.publish_joints(self._controller.arm.q)
        self._clock = asyncio.create_task(self._run())

    async def stop(self) -> None:
        if self._clock is not None:
            self._clock.cancel()
        self._hang_up()

    def state(self) -> dict[str, Any]:
        controller = self._controller
        arm = controller.arm
        return {
            "t_s": controller.t_s,
            "position_m": arm.T_base_tcp[:3, 3].tolist(),
            "pose": ur_model.pose_vector(arm.T_base_tcp).tolist(),
            "T_base_tcp": arm.T_base_tcp.tolist(),
            "flange_to_tcp": ur_model.pose_vector(arm.T_flange_tcp).tolist(),
            "q": arm.q.tolist(),
            "qd": arm.qd.tolist(),
            "twist": arm.twist.tolist(),
            "speed_m_s": float(np.linalg.norm(arm.twist[:3])),
            "moving": bool(arm.qd.any()),
            "travel_m": arm.travel_m,
            "energised": controller.energised,
            "energising": controller.energising,
            "robot_mode": controller.robot_mode.name,
            "safety_mode": controller.safety_mode.name,
            "runtime_state": controller.runtime_state.name,
            "watchdog_hz": controller.watchdog_hz,
            "watchdog_trips": controller.watchdog_trips,
            "commands": dict(controller.commands),
            "command_onset_ns": controller.onset.t_ns,
            "last_command_age_s": controller.last_input_age_s,
            "travel_since_command_m": controller.travel_since_input_m,
            "clients": len(self._clients),
            "messages": list(controller.messages),
        }

    def on_fault(self, fault: str, value: Any) -> None:
        controller = self._controller
        if fault == "pause":
            self._awake.clear()
        elif fault == "unplug":
            self._hang_up()
        elif fault == "restart":
            self._hang_up()
            controller.restart()
            self._spawn(self._listen())
        elif fault == "protective_stop":
            controller.protective_stop()
        elif fault == "emergency_stop":
            controller.stop_by_safety(SafetyMode.ROBOT_EMERGENCY_STOP)
        elif fault == "fault_bits":
            controller.stop_by_safety(SafetyMode(int(value)))
        elif fault == "local_control":
            if not self._generation.has_remote_control:
                raise ConfigError("this generation has no local control to switch to", key="fault", value=fault)
            controller.remote_control = False
        elif fault == "program_stop":
            controller.stop_program()
        elif fault == "other_program":
            controller.play_foreign_program()
        elif fault == "power_off":
            controller.power(RobotMode.POWER_OFF)
        elif fault == "program_pause":
            controller.pause()
        elif fault == "cut_rtde":
            for client in self._clients:
                client.writer.transport.abort()
            self._clients.clear()
            del self.active[fault]
        elif fault == "no_dashboard" or (fault == "version" and self._version[0] >= _POLYSCOPE_X):
            self._close_dashboard()
        elif fault == "temperature":
            controller.temperature_c = float(value)
        elif fault == "voltage":
            controller.voltage_v = float(value)
        elif fault == "pendant_tool":
            controller.arm.T_flange_tcp = ur_model.from_pose_vector(np.array(value, dtype=np.float64).reshape(6))
            controller.arm.refresh()
        elif fault == "speed_slider":
            controller.speed_slider = float(value)
        elif fault == "wrench":
            controller.wrench = np.array(value, dtype=np.float64).reshape(6)

    def on_clear(self, fault: str) -> None:
        controller = self._controller
        if fault == "pause":
            self._awake.set()
        elif fault == "unplug":
            self._spawn(self._listen())
        elif fault in ("no_dashboard", "version"):
            self._hang_up()
            self._spawn(self._listen())
        elif fault in ("emergency_stop", "fault_bits"):
            controller.stop_by_safety(SafetyMode.NORMAL)
        elif fault == "local_control":
            controller.remote_control = True
        elif fault == "other_program":
            controller.stop_program()
        elif fault == "speed_slider":
            controller.speed_slider = 1.0
        elif fault == "wrench":
            controller.wrench = np.zeros(6)

    async def _listen(self) -> None:
        services = [(ur_codec.PORT, self._serve_rtde)]
        if self._has_dashboard:
            services.append((DASHBOARD_PORT, self._serve_dashboard))
        services += [(port, self._serve_script) for port in SCRIPT_PORTS]
        for port, service in services:
            self._servers.append(
                await asyncio.start_server(self._guarded(service), self._host, port, reuse_address=True)
            )

    def _close_dashboard(self) -> None:
        for server in self._servers:
            if server.sockets and server.sockets[0].getsockname()[1] == DASHBOARD_PORT:
                server.close()

    def _hang_up(self) -> None:
        for server in self._servers:
            server.close()
        self._servers.clear()
        for writer in self._writers:
            writer.transport.abort()
        self._clients.clear()

    def _spawn(self, work: Any) -> None:
        task = asyncio.create_task(work)
        self._background.add(task)
        task.add_done_callback(self._background.discard)

    def _guarded(
        self, service: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
    ) -> Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self._writers.add(writer)
            try:
                with contextlib.suppress(ConnectionError, CorruptMessage):
                    await service(reader, writer)
            finally:
                self._writers.discard(writer)
                writer.close()

        return serve

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            # A late process catches up, because a controller's clock does not slow down, but reads its inputs between
            # any two steps; one that was suspended skips the lost time.
            due_s = max(due_s + self._generation.period_s, loop.time() - _MAX_LATE_S)
            await asyncio.sleep(max(0.0, due_s - loop.time()))
            self._controller.step()
            self.publish_joints(self._controller.arm.q)
            self._steps += 1
            self._stream()

    def _stream(self) -> None:
        clients = [client for client in self._clients if client.started and self._steps % client.every == 0]
        if not clients or "pause" in self.active:
            return
        values = self._controller.values()
        fresh = values
        if self.spend("drop"):
            return
        if self.spend("nan"):
            values = values | dict.fromkeys(("actual_q", "actual_TCP_pose", "actual_TCP_speed"), (math.nan,) * 6)
        if self.spend("corrupt"):
            values = values | {"actual_TCP_pose": (1e30,) * 6, "actual_qd": (-7e8,) * 6, "robot_mode": 1 << 20}
        if self._previous and self.spend("out_of_order"):
            values = self._previous
        else:
            self._previous = fresh
        delay_s = float(self.active.get("delay", 0.0))
        for client in clients:
            if client.outputs is None or client.writer.transport.get_write_buffer_size() > _MAX_BUFFER_BYTES:
                continue
            packet = Packet(PacketType.DATA, client.outputs.pack(self._complete(client.outputs, values)))
            if delay_s > 0.0:
                asyncio.get_running_loop().call_later(delay_s, self._send, client.writer, packet)
            else:
                self._send(client.writer, packet)

    def _complete(self, recipe: Recipe, values: dict[str, Value]) -> dict[str, Value]:
        outputs = self._controller.outputs
        return {
            name: values.get(name, outputs.get(name, _ZERO.get(kind, 0)))
            for name, kind in zip(recipe.names, recipe.types, strict=True)
        }

    def _send(self, writer: asyncio.StreamWriter, packet: Packet) -> None:
        if not writer.is_closing():
            writer.write(ur_codec.encode(packet))

    async def _serve_rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = _RtdeClient(writer)
        self._clients.append(client)
        stream = b""
        try:
            while piece := await reader.read(65536):
                await self._awake.wait()
                packets, stream = ur_codec.split(stream + piece)
                for packet in packets:
                    self._obey(client, packet)
                await writer.drain()
        except CorruptMessage as error:
            self._controller.log(f"connection closed: {error}")
            raise
        finally:
            if client in self._clients:
                self._clients.remove(client)

    def _obey(self, client: _RtdeClient, packet: Packet) -> None:
        kind, payload = packet.kind, packet.payload
        if kind is PacketType.REQUEST_PROTOCOL_VERSION:
            known = ur_codec.parse_version_request(payload) == ur_codec.PROTOCOL_VERSION
            self._send(client.writer, ur_codec.accepted(kind, known))
        elif kind is PacketType.GET_URCONTROL_VERSION:
            self._send(client.writer, ur_codec.controller_version(*self._version))
        elif kind is PacketType.SETUP_OUTPUTS:
            self._setup_outputs(client, payload)
        elif kind is PacketType.SETUP_INPUTS:
            self._setup_inputs(client, payload)
        elif kind in (PacketType.START, PacketType.PAUSE):
            client.started = kind is PacketType.START
            self._send(client.writer, ur_codec.accepted(kind, True))
        elif kind is PacketType.DATA and payload and payload[0] in client.inputs:
            self._controller.write_inputs(client.inputs[payload[0]].unpack(payload))

    def _setup_outputs(self, client: _RtdeClient, payload: bytes) -> None:
        rate_hz, names = ur_codec.parse_setup_outputs(payload)
        missing = self.active.get("missing_variable")
        unknown = self._generation.unknown_outputs | ({str(missing)} if missing else set())
        types = [
            NOT_FOUND if name in unknown else self._recorded_types.get(name) or _output_type(name) for name in names
        ]
        if NOT_FOUND not in types:
            client.outputs = Recipe(1, names, tuple(types))
            client.every = max(1, round(1.0 / (rate_hz * self._generation.period_s)))
        self._send(client.writer, ur_codec.recipe_answer(PacketType.SETUP_OUTPUTS, 1, types))

    def _setup_inputs(self, client: _RtdeClient, payload: bytes) -> None:
        names = ur_codec.parse_names(payload)
        taken = set().union(*(other.claimed for other in self._clients if other is not client))
        if "registers_in_use" in self.active:
            taken |= {name for name in names if "register" in name}
        types = [IN_USE if name in taken else _input_type(name) for name in names]
        number = 0
        if not {IN_USE, NOT_FOUND} & set(types):
            number = len(client.inputs) + 1
            client.inputs[number] = Recipe(number, names, tuple(types))
            client.claimed.update(names)
        self._send(client.writer, ur_codec.recipe_answer(PacketType.SETUP_INPUTS, number, types))

    async def _serve_script(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        text = b""
        while piece := await reader.read(65536):
            await self._awake.wait()
            programs, text = _split_programs(text + piece)
            for program in programs:
                self._controller.start_program(program)

    async def _serve_dashboard(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        while line := await reader.readline():
            await self._awake.wait()
            request = line.decode(errors="replace").strip()
            writer.write(self._dashboard(request).encode() + b"\n")
            await writer.drain()
            if request == "quit":
                return

    def _dashboard(self, request: str) -> str:
        controller = self._controller
        playing = controller.runtime_state is RuntimeState.PLAYING
        questions = {
            "polyscopeversion": f"URSoftware {'.'.join(map(str, self._version))} (Nov 11 2021)",
            "version": ".".join(map(str, self._version[:3])),
            "get serial number": "20225500001",
            "get robot model": self._model.removesuffix("e").upper(),
            "get loaded program": "No program loaded",
            "isprogramsaved": "true",
            "is in remote control": str(controller.remote_control).lower(),
            "robotmode": f"Robotmode: {controller.robot_mode.name}",
            "safetymode": f"Safetymode: {controller.safety_mode.name}",
            "safetystatus": f"Safetystatus: {controller.safety_mode.name}",
            "running": f"Program running: {str(playing).lower()}",
            "programstate": f"{controller.runtime_state.name} rtde_control",
            "get operational mode": "NONE",
            "close popup": "closing popup",
            "close safety popup": "closing safety popup",
            "quit": "Disconnected",
        }
        word = request.lower()
        if word in self._generation.unknown_commands:
            return f"could not understand: '{word}'"
        if word in questions:
            return questions[word]
        if word.startswith("popup "):
            return "showing popup"
        if word.startswith("addtolog "):
            controller.log(request.partition(" ")[2])
            return "Added log message"
        if not controller.remote_control:
            return "Command is not allowed in local control"
        return self._command(word)

    def _command(self, word: str) -> str:
        controller = self._controller
        if word == "stop":
            controller.stop_program()
            return "Stopped"
        if word == "pause":
            return "Pausing program" if controller.pause() else "Failed to execute: pause"
        if word.startswith("load "):
            return f"File not found: {word.removeprefix('load ')}"
        if word == "play":
            return "Starting program" if controller.play() else "Failed to execute: play"
        if word == "unlock protective stop":
            if controller.unlock_protective_stop():
                return "Protective stop releasing"
            return "Cannot unlock protective stop until 5s after occurrence"
        if word == "restart safety":
            controller.restart_safety()
            return "Restarting safety"
        for command, mode, answer in (
            ("power on", RobotMode.IDLE, "Powering on"),
            ("brake release", RobotMode.RUNNING, "Brake releasing"),
            ("power off", RobotMode.POWER_OFF, "Powering off"),
        ):
            if word == command:
                controller.power(mode)
                return answer
        return f"could not understand: '{word}'"


def _split_programs(stream: bytes) -> tuple[list[str], bytes]:
    """Return the complete programs in ``stream`` and the rest: each is one line, or ends with an ``end`` of its own."""
    programs: list[str] = []
    while stream:
        line, newline, rest = stream.partition(b"\n")
        if not newline:
            break
        if line.startswith((b"def ", b"sec ")):
            body, found, after = stream.partition(b"\nend\n")
            if not found:
                break
            programs.append((body + b"\nend\n").decode(errors="replace"))
            rest = after
        elif line.strip():
            programs.append(line.decode(errors="replace"))
        stream = rest
    return programs, stream


def _output_type(name: str) -> str:
    for prefix, kind in (
        ("output_int_register_", "INT32"),
        ("output_double_register_", "DOUBLE"),
        ("output_bit_register_", "BOOL"),
    ):
        if _is_register(name, prefix):
            return kind
    return _OUTPUT_TYPES.get(name, NOT_FOUND)


def _input_type(name: str) -> str:
    for prefix, kind in (
        ("input_int_register_", "INT32"),
        ("input_double_register_", "DOUBLE"),
        ("input_bit_register_", "BOOL"),
    ):
        if _is_register(name, prefix):
            return kind
    return _INPUT_TYPES.get(name, NOT_FOUND)


def _is_register(name: str, prefix: str) -> bool:
    number = name.removeprefix(prefix)
    return name.startswith(prefix) and number.isdigit() and int(number) < (128 if "_bit_" in prefix else 48)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments."""
    parser.add_argument("--host", default="127.0.0.1", help="loopback address to listen on")
    parser.add_argument(
        "--unlock-after", type=float, default=5.0, metavar="S", help="seconds before a protective stop can be unlocked"
    )
    parser.add_argument("--start-deg", type=float, nargs=6, metavar="DEG", help="joint angles at which it begins")
    parser.add_argument(
        "--generation", choices=sorted(GENERATIONS), default="e", help="CB3, e-Series, or e-Series with PolyScope X"
    )
    parser.add_argument(
        "--from",
        dest="capture",
        type=Path,
        metavar="CAPTURE",
        help="report the states in this capture (pcap of port 30004), after what in it is not as expected",
    )
    parser.add_argument("--model", choices=sorted(ur_model.MODELS), help="model of the arm")
    parser.add_argument(
        "--version",
        type=int,
        nargs=4,
        metavar=("MAJOR", "MINOR", "BUGFIX", "BUILD"),
        help="software of the controller; from 10 on (PolyScope X) there is no dashboard",
    )


def build(arguments: argparse.Namespace) -> UrEmulator:
    """Build the emulator. Raises ConfigError."""
    recorded, version = None, arguments.version
    if arguments.capture is not None:
        chain = SerialChain(ChainDescription.shipped(arguments.model)) if arguments.model else None
        recorded = capture.read(arguments.capture, _output_type, chain)
        version = version or recorded.version
        found = list(report(recorded.differences)) or ["nothing contradicts codec or emulator"]
        for line in [*capture.describe(recorded), *found]:
            print(line, file=sys.stderr)
    return UrEmulator(
        arguments.host,
        arguments.unlock_after,
        arguments.start_deg,
        generation=arguments.generation,
        model=arguments.model,
        version=version,
        recorded=recorded,
    )
