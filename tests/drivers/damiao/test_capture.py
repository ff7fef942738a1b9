"""Captures of a CAN bus: a session is recorded, judged, and played back to the driver; what is wrong is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest

from tests.helpers.bus_arms import activate, pause
from touchcell.drivers.core import bus_arm
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.damiao import codec, emulator
from touchcell.drivers.damiao.capture import assign, describe, judge, read_frames
from touchcell.drivers.damiao.driver import DamiaoCanArm
from touchcell.drivers.damiao.rig import config, rig_in_step
from touchcell.errors import ConfigError
from touchcell.testing.emulation.lockstep import Lockstep, emulator_in_step
from touchcell.testing.emulation.process import EmulatorProcess

REGISTERS = emulator.Motor(1, 0x11, emulator.MODELS["4310"]).registers


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """What ``candump -L`` writes of a connection, an activation and a second of holding; and the joints then."""
    folder = tmp_path_factory.mktemp("session")
    fixture = rig_in_step(folder, 1)
    assert fixture.start is not None
    path = folder / "session.log"
    with fixture.world as world, can.CanutilsLogWriter(path) as log:
        assert isinstance(world, Lockstep)
        arms = fixture.start()
        monitor = can.Bus(interface="touchcell_hub", channel=str(folder / "can-1"))
        done = world.threading.Event()

        def record() -> None:
            while not done.is_set():
                if (message := monitor.recv(0.01)) is not None:
                    message.timestamp = 1e-9 * world.now_ns()
                    log.on_message_received(message)

        recorder = world.threading.Thread(target=record)
        recorder.start()
        arm = DamiaoCanArm("arm", config(folder / "can-1"), world)
        activate(arm)
        pause(1.0)
        q = arm.joints().value.q
        done.set()
        recorder.join()
        arm.disconnect()
        monitor.shutdown()
        arms.stop()
    return path, q


def judged(path: Path) -> list[str]:
    return list(judge(assign(read_frames(path)), REGISTERS))


def changed(path: Path, folder: Path, change: Callable[[can.Message], can.Message | None]) -> Path:
    """Write the capture again with each frame changed, or left out."""
    other = folder / "changed.log"
    with can.CanutilsLogWriter(other) as log, can.LogReader(path) as frames:
        for message in frames:
            if (kept := change(message)) is not None:
                log.on_message_received(kept)
    return other


def test_a_session_contradicts_nothing_and_each_motor_is_described(session: tuple[Path, np.ndarray]) -> None:
    path, _ = session
    assert judged(path) == []
    lines = list(describe(assign(read_frames(path))))
    assert len(lines) == 6
    assert lines[0].startswith("motor 1: replies on 0x11, ")


def test_the_driver_runs_on_a_session_as_on_its_motors(session: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    path, q = session
    hub = tmp_path / "can"
    with Lockstep([bus_arm]) as world:
        played = emulator_in_step(world, "damiao", str(hub), "--from", str(path)).start()
        arm = DamiaoCanArm("arm", config(hub), world)
        activate(arm)
        pause(1.0)
        assert arm.state is Lifecycle.ACTIVE
        np.testing.assert_allclose(arm.joints(0.1).value.q, q, atol=2e-3)
        assert played.state()["unknown"] == []
        arm.disconnect()
        played.stop()


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("status", "motor 2: 1 replies: status 0xf, which is not documented"),
        ("foreign", "frames with id 0x123 belong to no request and no motor"),
        ("silent", "motor 3 never replied"),
        ("short", "belong to no request and no motor"),
        ("nan", "is not finite"),
        ("late", "longer than the driver waits"),
    ],
)
def test_what_contradicts_codec_or_emulator_is_named(
    what: str, says: str, session: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    left = [1]

    def change(message: can.Message) -> can.Message | None:
        is_reply = message.arbitration_id == 0x12
        if what == "silent" and message.arbitration_id == 0x13:
            return None
        if what == "late":
            message.timestamp += 0.2 if 0x11 <= message.arbitration_id <= 0x16 else 0.0
        if not left[0] or not is_reply:
            return message
        register = codec.is_register_reply(bytes(message.data), 2)
        if what == "status" and not register:
            message.data[0] = 0xF2
        elif what == "nan" and register and message.data[3] == codec.Register.PMAX:
            message.data[4:] = b"\x00\x00\xc0\x7f"
        elif what == "foreign":
            message.arbitration_id = 0x123
        elif what == "short":
            message.data, message.dlc = message.data[:5], 5
        else:
            return message
        left[0] -= 1
        return message

    found = judged(changed(session[0], tmp_path, change))
    assert any(says in line for line in found), found


def test_a_file_that_is_no_capture_is_named(tmp_path: Path) -> None:
    path = tmp_path / "session.log"
    path.write_text("Hello, this is dog\n")
    with pytest.raises(ConfigError, match="no capture of a CAN bus") as caught:
        list(read_frames(path))
    assert caught.value.file == str(path)
    path.write_text("")
    assert "none of 0 frames" in judged(path)[0]


def test_the_command_line_plays_a_capture(session: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    hub = tmp_path / "can"
    with EmulatorProcess("damiao", str(hub), "--from", str(session[0])) as played:
        bus = can.Bus(interface="touchcell_hub", channel=str(hub))
        bus.send(can.Message(arbitration_id=0x7FF, is_extended_id=False, data=codec.read_register(4, 21)))
        reply = bus.recv(10.0)
        assert reply is not None
        found = codec.decode_register_reply(bytes(reply.data), 4, 21)
        assert found is not None
        assert found.value == 12.5
        assert played.state()["answered"] == 1
        bus.shutdown()
