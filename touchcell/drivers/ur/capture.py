"""Recorded real-time traffic of a UR controller: its states, and what contradicts our codec and emulator.

A capture is what tcpdump or Wireshark writes of port 30004 (see ``pcap``), of any client. No I/O but the reading of
that file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Final

import numpy as np

from touchcell.drivers.core.difference import Difference
from touchcell.drivers.core.errors import CorruptMessage
from touchcell.drivers.kinematics.chain import SerialChain
from touchcell.drivers.ur import codec
from touchcell.drivers.ur.codec import IN_USE, NOT_FOUND, PacketType, Recipe, Value
from touchcell.drivers.ur.modes import RobotMode, RuntimeState, SafetyMode
from touchcell.drivers.ur.pcap import Connection, Segment, connections
from touchcell.errors import ConfigError
from touchcell.geometry import se3

_POSE_TOLERANCE_M: Final = 0.01
_ONE_TURN_RAD: Final = 2.0 * math.pi + 0.1
_MODES: Final[Mapping[str, type[IntEnum]]] = {
    "robot_mode": RobotMode,
    "safety_mode": SafetyMode,
    "runtime_state": RuntimeState,
}
_LONGEST_GAP_S: Final = 0.1


@dataclass(frozen=True, slots=True)
class RecordedState:
    """One state packet: number of its frame, time of its arrival in s, values by name."""

    frame: int
    t_s: float
    values: Mapping[str, Value]


@dataclass(slots=True)
class Capture:
    """What a capture knows of a controller.

    Attributes:
        version: its software, None if no client asked.
        types: data types of its state variables; ``NOT_FOUND`` for those that it does not have.
        states: state packets in order.
        differences: what contradicts codec and emulator.
    """

    version: tuple[int, int, int, int] | None = None
    types: dict[str, str] = field(default_factory=dict)
    states: list[RecordedState] = field(default_factory=list)
    differences: list[Difference] = field(default_factory=list)


def read(path: Path, type_of: Callable[[str], str], chain: SerialChain | None = None) -> Capture:
    """Read and judge a capture.

    Args:
        path: pcap or pcapng file.
        type_of: data type that the emulator gives a state variable, ``NOT_FOUND`` for one that it does not have.
        chain: the arm, without a tool; poses are compared with its own where the packets have joints and tool offset.

    Raises:
        ConfigError: the file is no capture, or has no real-time connection.
    """
    capture = Capture()
    for connection in connections(path, codec.PORT):
        _judge(connection, capture, type_of, chain)
    if not capture.states and capture.version is None and not capture.types:
        raise ConfigError(
            f"has no connection to port {codec.PORT} from its beginning on",
            file=str(path),
            hint="begin to record before the client connects",
        )
    capture.states.sort(key=lambda state: state.t_s)
    return capture


def describe(capture: Capture) -> Iterator[str]:
    """Yield lines about the controller and its packets."""
    version = "unknown" if capture.version is None else ".".join(map(str, capture.version))
    yield f"controller {version}: {len(capture.types)} state variables, {len(capture.states)} state packets"
    arrivals = np.diff([state.t_s for state in capture.states])
    if arrivals.size:
        yield f"a packet every {1e3 * float(np.median(arrivals)):.2f} ms, at most {1e3 * float(arrivals.max()):.1f} ms"


def _packets(stream: list[Segment]) -> Iterator[tuple[Segment, codec.Packet]]:
    """Yield each packet with the segment that completed it. Raises CorruptMessage."""
    rest = b""
    for segment in stream:
        packets, rest = codec.split(rest + segment.data)
        for packet in packets:
            yield segment, packet


def _judge(connection: Connection, capture: Capture, type_of: Callable[[str], str], chain: SerialChain | None) -> None:
    asked: list[tuple[str, ...]] = []
    claimed: list[tuple[str, ...]] = []
    try:
        for _, packet in _packets(connection.client):
            if packet.kind is PacketType.SETUP_OUTPUTS:
                asked.append(codec.parse_setup_outputs(packet.payload)[1])
            elif packet.kind is PacketType.SETUP_INPUTS:
                claimed.append(codec.parse_names(packet.payload))
    except CorruptMessage as error:
        first = connection.client[0]
        capture.differences.append(Difference(first.t_s, first.frame, "client", "RTDE requests", str(error)))
        return
    recipes: dict[int, Recipe] = {}
    previous: RecordedState | None = None
    segment = connection.server[0] if connection.server else Segment(0, 0.0, b"")
    try:
        for segment, packet in _packets(connection.server):
            if packet.kind is PacketType.GET_URCONTROL_VERSION:
                capture.version = codec.parse_controller_version(packet.payload)
            elif packet.kind is PacketType.SETUP_OUTPUTS and asked:
                _take_types(asked.pop(0), packet.payload, segment, capture, recipes, type_of)
            elif packet.kind is PacketType.DATA and packet.payload:
                recipe = recipes.get(packet.payload[0])
                if recipe is not None:
                    state = RecordedState(segment.frame, segment.t_s, recipe.unpack(packet.payload))
                    capture.states.append(state)
                    capture.differences += _judge_state(state, previous, chain)
                    previous = state
    except CorruptMessage as error:
        capture.differences.append(Difference(segment.t_s, segment.frame, "controller", "RTDE packets", str(error)))


def _take_types(
    names: tuple[str, ...],
    payload: bytes,
    segment: Segment,
    capture: Capture,
    recipes: dict[int, Recipe],
    type_of: Callable[[str], str],
) -> None:
    number, types = payload[0], payload[1:].decode(errors="replace").split(",")
    if len(types) != len(names):
        found = f"{len(types)} types"
        capture.differences.append(Difference(segment.t_s, segment.frame, "recipe", f"{len(names)} types", found))
        return
    for name, seen in zip(names, types, strict=True):
        capture.types[name] = seen
        assumed = type_of(name)
        if seen != assumed and seen != IN_USE:
            capture.differences.append(Difference(segment.t_s, segment.frame, f"type of {name}", assumed, seen))
    if NOT_FOUND not in types and IN_USE not in types:
        recipes[number or 1] = Recipe(number or 1, names, tuple(types))


def _judge_state(
    state: RecordedState, previous: RecordedState | None, chain: SerialChain | None
) -> Iterator[Difference]:
    values = state.values

    def differs(name: str, expected: str, seen: object) -> Difference:
        return Difference(state.t_s, state.frame, name, expected, str(seen))

    for name, value in values.items():
        numbers = value if isinstance(value, tuple) else (value,)
        if not all(math.isfinite(number) for number in numbers):
            yield differs(name, "finite numbers", value)
    for name, kind in _MODES.items():
        if name in values and values[name] not in [int(mode) for mode in kind]:
            yield differs(name, f"a {kind.__name__}", values[name])
    for name in ("speed_scaling", "target_speed_fraction"):
        value = values.get(name, 0.0)
        if not isinstance(value, tuple) and not 0.0 <= value <= 1.0:
            yield differs(name, "0 to 1", value)
    q = values.get("actual_q")
    if isinstance(q, tuple) and max(map(abs, q)) > _ONE_TURN_RAD:
        yield differs("actual_q", "joints within one turn", q)
    yield from _judge_time(state, previous)
    if chain is not None:
        yield from _judge_pose(state, chain)


def _judge_time(state: RecordedState, previous: RecordedState | None) -> Iterator[Difference]:
    if previous is None or "timestamp" not in state.values:
        return
    now, before = state.values["timestamp"], previous.values.get("timestamp")
    if isinstance(now, tuple) or before is None or isinstance(before, tuple):
        return
    if not before < now:
        yield Difference(state.t_s, state.frame, "timestamp", f"later than {before} s", f"{now} s")
    elif now - before > _LONGEST_GAP_S:
        expected = f"within {_LONGEST_GAP_S} s of the one before"
        yield Difference(state.t_s, state.frame, "timestamp", expected, f"{now - before:.3f} s later")


def _judge_pose(state: RecordedState, chain: SerialChain) -> Iterator[Difference]:
    q, pose, tool = (state.values.get(name) for name in ("actual_q", "actual_TCP_pose", "tcp_offset"))
    if not (isinstance(q, tuple) and isinstance(pose, tuple) and isinstance(tool, tuple)):
        return
    T_flange_tcp = np.asarray(se3.exp(np.array([0.0, 0.0, 0.0, *tool[3:]])))
    T_flange_tcp[:3, 3] = tool[:3]
    expected = (chain.forward(np.array(q)) @ T_flange_tcp)[:3, 3]
    # An arm's own calibration moves its tool by millimetres.
    if float(np.linalg.norm(expected - np.array(pose[:3]))) > _POSE_TOLERANCE_M:
        name = f"actual_TCP_pose of a {chain.description.name}"
        yield Difference(
            state.t_s, state.frame, name, f"{np.round(expected, 4).tolist()} m", f"{np.round(pose[:3], 4).tolist()} m"
        )
