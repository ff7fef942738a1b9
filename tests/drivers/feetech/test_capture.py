"""Records of a serial line: a session is recorded, judged, and played back to the driver; differences are named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers.bus_arms import activate, pause
from touchcell.drivers.core import bus_arm
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.difference import report
from touchcell.drivers.feetech import bus, codec, emulator
from touchcell.drivers.feetech.capture import Capture, describe, judge, read_chunks
from touchcell.drivers.feetech.codec import Packet, Register
from touchcell.drivers.feetech.rig import _arguments, arm_in_step, config
from touchcell.errors import ConfigError
from touchcell.testing.emulation.base import Emulator
from touchcell.testing.emulation.lockstep import Lockstep, emulator_in_step
from touchcell.testing.emulation.serial_line import SocketLine


class TappedLine(SocketLine):
    """A line on which everything that passes is written down."""

    def __init__(self, path: Path, baud_rate: int, world: Lockstep, log: list[str]) -> None:
        super().__init__(path, baud_rate)
        self._world = world
        self._log = log

    def plug_in(self, on_bytes: Callable[[bytes], None]) -> None:
        def tapped(data: bytes) -> None:
            self._note(">", data)
            on_bytes(data)

        super().plug_in(tapped)

    def write(self, data: bytes) -> None:
        self._note("<", data)
        super().write(data)

    def _note(self, direction: str, data: bytes) -> None:
        self._log.append(f"{1e-9 * self._world.now_ns():.6f} {direction} {data.hex(' ')}")


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """What passed in a connection, an activation and a second of holding; and the joints then."""
    folder = tmp_path_factory.mktemp("session")
    port, log = folder / "servos", list[str]()
    with Lockstep([bus_arm, bus]) as world:

        def build(arguments: Any) -> Emulator:
            return emulator.build_on(TappedLine(port, config(port).baudrate, world, log), arguments)

        servos = emulator_in_step(world, "feetech", *_arguments(port), build=build).start()
        arm = arm_in_step(port, world)
        activate(arm)
        pause(1.0)
        q = arm.joints().value.q
        arm.disconnect()
        servos.stop()
    path = folder / "session.txt"
    path.write_text("\n".join(log))
    return path, q


def judged(path: Path) -> Capture:
    return judge(read_chunks(path))


def line(t_s: float, direction: str, packet: Packet) -> str:
    return f"{t_s:.6f} {direction} {codec.encode(packet).hex(' ')}\n"


def test_a_session_contradicts_nothing_and_each_servo_is_described(session: tuple[Path, np.ndarray]) -> None:
    capture = judged(session[0])
    assert list(report(capture.differences)) == []
    lines = list(describe(capture))
    assert len(lines) == 5
    assert lines[0].startswith("servo 1: ")


def test_the_driver_runs_on_a_session_as_on_its_servos(session: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    path, q = session
    port = tmp_path / "servos"
    with Lockstep([bus_arm, bus]) as world:

        def build(arguments: Any) -> Emulator:
            return emulator.build_on(SocketLine(port, config(port).baudrate), arguments)

        played = emulator_in_step(world, "feetech", "--link", str(port), "--from", str(path), build=build).start()
        arm = arm_in_step(port, world)
        activate(arm)
        pause(1.0)
        assert arm.state is Lifecycle.ACTIVE
        np.testing.assert_allclose(arm.joints(0.1).value.q, q, atol=2e-3)
        assert played.state()["unknown"] == []
        arm.disconnect()
        played.stop()


def test_socats_record_is_read(tmp_path: Path) -> None:
    path = tmp_path / "session.txt"
    request, reply = codec.read(1, Register.POSITION, 2), codec.encode(Packet(1, 0, codec.signed_word(2000)))
    path.write_text(
        f"> 2026/11/29 16:40:00.000100  length=8 from=0 to=7\n {request.hex(' ')}\n--\n"
        f"< 2026/11/29 16:40:00.000900  length=8 from=0 to=7\n {reply.hex(' ')}\n--\n"
    )
    capture = judged(path)
    assert capture.differences == []
    assert capture.servos[1].delays_s == [pytest.approx(8e-4, abs=1e-6)]


@pytest.mark.parametrize(
    ("reply", "delay_s", "says"),
    [
        (Packet(2, 0, codec.signed_word(-320)), 1e-3, "servo 2 position, ticks: expected 0 to 4095, seen -320"),
        (Packet(2, 0x10, codec.signed_word(320)), 1e-3, "servo 2 error byte: expected documented bits, seen reserved"),
        (Packet(3, 0, codec.signed_word(320)), 1e-3, "servo 3: expected no reply, as nothing asked it, seen 2 bytes"),
        (Packet(2, 0, b"\x01"), 1e-3, "servo 2: expected no reply, as nothing asked it, seen 1 bytes"),
        (Packet(2, 0, codec.signed_word(320)), 0.05, "servo 2 reply: expected within 20 ms, seen after 50.0 ms"),
    ],
)
def test_what_differs_is_named_by_frame_time_and_field(
    reply: Packet, delay_s: float, says: str, tmp_path: Path
) -> None:
    path = tmp_path / "session.txt"
    asked = Packet(2, codec.Instruction.READ, bytes([Register.POSITION, 2]))
    path.write_text(line(1.0, ">", asked) + line(1.0 + delay_s, "<", reply))
    (found,) = report(judged(path).differences)
    assert found.startswith(f"frame 2 at {1.0 + delay_s:.6f} s: ")
    assert says in found


def test_differences_of_a_kind_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "session.txt"
    asked = line(1.0, ">", Packet(2, codec.Instruction.READ, bytes([Register.MODEL, 2])))
    path.write_text((asked + line(1.001, "<", Packet(2, 0, codec.word(1190)))) * 3)
    (found,) = report(judged(path).differences)
    assert found.endswith("servo 2 model: expected 777, seen 1190, and 2 more like it")


def test_noise_and_echo_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "session.txt"
    asked = Packet(2, codec.Instruction.PING)
    path.write_text(line(1.0, ">", asked) + line(1.0, "<", asked) + "1.001 < 00 12\n" + line(1.002, "<", Packet(2, 0)))
    found = list(report(judged(path).differences))
    assert len(found) == 1
    assert "framing" in found[0]


def test_a_file_that_is_no_record_is_named(tmp_path: Path) -> None:
    path = tmp_path / "session.txt"
    path.write_text("Hello, this is dog\n")
    with pytest.raises(ConfigError, match="no record of a serial line") as caught:
        judged(path)
    assert caught.value.file == str(path)
