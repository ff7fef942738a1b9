"""Captures of a controller's real-time port: read, judged, and what differs named."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers import pcap_file
from touchcell.drivers.core.difference import report
from touchcell.drivers.kinematics.chain import ChainDescription, SerialChain
from touchcell.drivers.ur import capture, codec
from touchcell.drivers.ur.codec import NOT_FOUND, PacketType, Recipe, Value
from touchcell.drivers.ur.emulator.controller import Controller
from touchcell.drivers.ur.emulator.recorded import RecordedController
from touchcell.drivers.ur.emulator.server import _output_type
from touchcell.drivers.ur.pcap import connections
from touchcell.errors import ConfigError

NAMES = ("timestamp", "actual_q", "actual_TCP_pose", "tcp_offset", "robot_mode", "speed_scaling")
CHAIN = SerialChain(ChainDescription.shipped("ur5e"))


def conversation(
    change: Callable[[int, dict[str, Value]], dict[str, Value]] = lambda _, values: values, types: Any = None
) -> Iterator[tuple[float, bool, bytes]]:
    """Yield what a client and an emulated controller say: version, recipe, and 20 states."""
    kinds = types or tuple(_output_type(name) for name in NAMES)
    yield 1.0, True, codec.encode(codec.setup_outputs(125.0, NAMES))
    yield 1.01, False, codec.encode(codec.controller_version(5, 11, 1, 0))
    yield 1.02, False, codec.encode(codec.recipe_answer(PacketType.SETUP_OUTPUTS, 1, kinds))
    if NOT_FOUND in kinds:
        return
    controller, recipe = Controller(), Recipe(1, NAMES, tuple(_output_type(name) for name in NAMES))
    for k in range(20):
        for _ in range(4):
            controller.step()
        values = change(k, {name: controller.values()[name] for name in NAMES})
        yield 1.1 + 0.008 * k, False, codec.encode(codec.Packet(PacketType.DATA, recipe.pack(values)))


def judged(path: Path, pieces: Iterator[tuple[float, bool, bytes]]) -> capture.Capture:
    pcap_file.write(path, pieces, codec.PORT)
    return capture.read(path, _output_type, CHAIN)


def test_what_the_emulator_says_contradicts_nothing(tmp_path: Path) -> None:
    found = judged(tmp_path / "s.pcap", conversation())
    assert list(report(found.differences)) == []
    assert found.version == (5, 11, 1, 0)
    assert len(found.states) == 20
    assert list(capture.describe(found))[1].startswith("a packet every 8.00 ms")


def only(number: int, **changed: Value) -> Callable[[int, dict[str, Value]], dict[str, Value]]:
    return lambda k, values: values | changed if k == number else values


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"robot_mode": 42}, "robot_mode: expected a RobotMode, seen 42"),
        ({"speed_scaling": 1.5}, "speed_scaling: expected 0 to 1, seen 1.5"),
        ({"timestamp": 0.001}, "timestamp: expected later than"),
        ({"actual_q": (7.0,) * 6}, "actual_q: expected joints within one turn"),
        ({"actual_TCP_pose": (0.1,) * 6}, "actual_TCP_pose of a ur5e: expected ["),
        ({"tcp_offset": (float("nan"), *[0.0] * 5)}, "tcp_offset: expected finite numbers"),
    ],
)
def test_what_differs_is_named_by_frame_time_and_field(changed: dict[str, Value], says: str, tmp_path: Path) -> None:
    found = list(report(judged(tmp_path / "s.pcap", conversation(only(5, **changed))).differences))
    assert any(line.startswith("frame 11 at 1.140000 s: ") and says in line for line in found), found


def test_another_type_and_an_unknown_variable_are_named(tmp_path: Path) -> None:
    kinds = ("DOUBLE", "VECTOR6D", "VECTOR6D", NOT_FOUND, "UINT32", "DOUBLE")
    found = list(report(judged(tmp_path / "s.pcap", conversation(types=kinds)).differences))
    assert [line.partition("s: ")[2] for line in found] == [
        "type of tcp_offset: expected VECTOR6D, seen NOT_FOUND",
        "type of robot_mode: expected INT32, seen UINT32",
    ]


def test_segments_that_are_late_repeated_or_overlap_are_put_in_order(tmp_path: Path) -> None:
    path = tmp_path / "s.pcap"
    pieces = list(conversation())
    pcap_file.write(path, pieces, codec.PORT)
    whole = path.read_bytes()
    (expected,) = connections(path, codec.PORT)
    frames = [
        pcap_file.segment(2.0, 2000 + 5, False, b"ABCDE", 30004),
        pcap_file.segment(2.1, 2000, False, b"12345678", 30004),
    ]
    path.write_bytes(whole[:24] + b"".join(reversed(frames)) + frames[0])
    (found,) = connections(path, codec.PORT)
    assert b"".join(segment.data for segment in found.server) == b"12345678DE"
    assert b"".join(segment.data for segment in expected.server) == b"".join(data for _, end, data in pieces if not end)


def test_a_recorded_controller_reports_what_was_recorded_at_its_pace(tmp_path: Path) -> None:
    moved = (0.5, -1.0, -1.0, -1.0, 1.0, 0.0)
    found = judged(
        tmp_path / "s.pcap", conversation(lambda k, values: values | {"actual_q": moved} if k >= 10 else values)
    )
    controller = RecordedController(found)
    first = controller.values()["actual_q"]
    for _ in range(50):
        controller.step()
    assert controller.values()["actual_q"] == moved
    assert first != moved
    assert controller.values()["timestamp"] == pytest.approx(0.1)
    np.testing.assert_allclose(controller.values()["target_q"], np.array(first))


@pytest.mark.parametrize("data", [b"", b"Hello, this is dog", b"\x0a\x0d\x0d\x0a" + bytes(20)])
def test_a_file_that_is_no_capture_is_named(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "s.pcap"
    path.write_bytes(data)
    with pytest.raises(ConfigError) as caught:
        capture.read(path, _output_type)
    assert caught.value.file == str(path)


def test_a_capture_that_begins_too_late_is_named(tmp_path: Path) -> None:
    path = tmp_path / "s.pcap"
    pcap_file.write(path, list(conversation())[3:], codec.PORT)
    with pytest.raises(ConfigError, match="from its beginning on"):
        capture.read(path, _output_type)
