"""The V4L2 driver beside its emulator, on one simulated time."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.bus_arms import CLOCK, in_step, pause
from touchcell.drivers.core.camera import UnsupportedSetting
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.device import Lifecycle, OperatorToken
from touchcell.drivers.core.errors import (
    ConnectError,
    CorruptMessage,
    DeviceFault,
    DeviceGone,
    FaultClass,
    LifecycleError,
    StaleData,
    TransportTimeout,
)
from touchcell.drivers.core.protocols import FrameSource, HealthSource
from touchcell.drivers.core.samples import Frame, Quality, Stamped
from touchcell.drivers.core.spec import DRIVERS
from touchcell.drivers.v4l2.codec import Arrival
from touchcell.drivers.v4l2.driver import SPEC, V4l2Camera, V4l2Config
from touchcell.drivers.v4l2.emulator import picture
from touchcell.drivers.v4l2.rig import CallsInStep, rig_in_step
from touchcell.errors import ConfigError
from touchcell.testing.emulation.lockstep import EmulatorInStep, emulator_in_step

TOKEN = OperatorToken("test", 0)
DEADLINE_S = 5.0
DEADLINE_NS = 5_000_000_000
NODE = "/dev/video7"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("camera")


@pytest.fixture(scope="module")
def process(folder: Path) -> Iterator[EmulatorInStep]:
    yield from in_step(rig_in_step(folder, 7))


@pytest.fixture
def emulator(process: EmulatorInStep) -> Iterator[EmulatorInStep]:
    yield process
    for fault in process.state()["faults"]:
        process.clear(fault)


@pytest.fixture
def make(folder: Path, emulator: EmulatorInStep) -> Iterator[Callable[..., V4l2Camera]]:
    made: list[V4l2Camera] = []

    def build(**settings: object) -> V4l2Camera:
        config = V4l2Config.model_validate({"device": NODE, "rate_hz": 60, "gain": 10, "exposure_us": 15700} | settings)
        made.append(V4l2Camera("tip", CLOCK, config, CallsInStep(folder)))
        return made[-1]

    yield build
    for camera in made:
        camera.disconnect()


@pytest.fixture
def camera(make: Callable[..., V4l2Camera]) -> V4l2Camera:
    return ready(make())


def ready(camera: V4l2Camera) -> V4l2Camera:
    camera.connect()
    camera.configure()
    return camera


def read(camera: V4l2Camera, frames: int) -> list[Stamped[Frame]]:
    got = [camera.latest()]
    while len(got) < frames:
        got.append(camera.next(got[-1].seq, 1.0))
    return got


def read_until(camera: V4l2Camera, reading: str, at_least: float) -> None:
    deadline_ns = CLOCK.now_ns() + DEADLINE_NS
    seq = -1
    while CLOCK.now_ns() < deadline_ns:
        seq = camera.next(seq, 1.0).seq
        value = camera.health().get(reading, 0)
        assert isinstance(value, int | float)
        if value >= at_least:
            return
    pytest.fail(f"{reading} did not reach {at_least}: {camera.health()}")


def test_the_driver_is_found_by_name_and_has_its_declared_capabilities(camera: V4l2Camera) -> None:
    assert DRIVERS.load("v4l2") is SPEC
    assert SPEC.capabilities.provides == {FrameSource, HealthSource}
    assert isinstance(camera, FrameSource)
    assert isinstance(camera, HealthSource)


def test_connecting_changes_nothing_and_configuring_moves_nothing(
    make: Callable[..., V4l2Camera], emulator: EmulatorInStep
) -> None:
    before = emulator.state()
    camera = make()
    camera.connect()
    after = emulator.wait_for(clients=1)
    assert camera.state is Lifecycle.PASSIVE
    assert after["settings_changed"] == before["settings_changed"]
    assert after["streaming"] is False
    with pytest.raises(LifecycleError):
        camera.latest()
    camera.configure()
    camera.activate()
    assert emulator.state()["energising"] == 0
    camera.deactivate()
    assert camera.state is Lifecycle.READY
    camera.disconnect()
    state = emulator.wait_for(clients=0, streaming=False)
    assert state["buffers"] == 0


def test_frames_are_stamped_numbered_and_show_the_sensors_image(
    make: Callable[..., V4l2Camera], emulator: EmulatorInStep
) -> None:
    began_ns = CLOCK.now_ns()
    frames = read(ready(make(pixel_format="GREY")), 20)
    ended_ns = CLOCK.now_ns()
    for frame in frames:
        assert_number_is_true(frame)
        assert frame.quality is Quality.GOOD
        assert (frame.value.exposure, frame.value.gain) == (0.0157, 10.0)
    stamps = np.array([began_ns, *(frame.t_ns for frame in frames), ended_ns])
    assert (np.diff(stamps) > 0).all()


@pytest.mark.parametrize(
    ("pixel_format", "color", "shape", "tolerance"),
    [
        ("MJPG", "grey", (480, 640), 3.0),
        ("MJPG", "bgr", (480, 640, 3), 3.0),
        ("YUYV", "grey", (480, 640), 0.0),
        ("YUYV", "bgr", (480, 640, 3), 20.0),
        ("GREY", "bgr", (480, 640, 3), 0.0),
    ],
)
def test_every_format_decodes_to_the_picture(
    make: Callable[..., V4l2Camera], pixel_format: str, color: str, shape: tuple[int, ...], tolerance: float
) -> None:
    frame = ready(make(pixel_format=pixel_format, color=color)).latest()
    expected = picture.brightened(picture.synthetic(frame.seq % picture.PICTURES, 640, 480), 1.2).astype(float)
    image = frame.value.image.astype(float)
    assert image.shape == shape
    difference = np.abs((image if image.ndim == 2 else image.mean(axis=2)) - expected)
    # YUYV carries brightness 16..235 where BGR has 0..255; JPEG loses a little.
    assert difference.mean() <= tolerance


def test_settings_read_back_in_health(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    health = camera.health()
    assert (health["exposure_us"], health["gain"]) == (15700, 10)
    assert health["kernel_stamps"] is True
    assert health["stamp_marks"] == "start of exposure"
    controls = emulator.state()["controls"]
    assert (controls["Auto Exposure"], controls["Exposure Time, Absolute"], controls["Gain"]) == (1, 157, 10)


@pytest.mark.parametrize(
    ("settings", "setting", "given"),
    [
        ({"width_px": 700}, "width_px", 640),
        ({"rate_hz": 47.0}, "rate_hz", 60.0),
        ({"gain": 200}, "gain", 100),
    ],
)
def test_a_setting_that_the_camera_changes_is_refused(
    make: Callable[..., V4l2Camera], settings: dict[str, object], setting: str, given: float
) -> None:
    camera = make(**settings)
    camera.connect()
    with pytest.raises(UnsupportedSetting) as caught:
        camera.configure()
    assert caught.value.setting == setting
    assert caught.value.requested == settings[setting]
    assert caught.value.given == given
    assert str(given) in str(caught.value)
    assert camera.state is Lifecycle.PASSIVE


def test_a_control_that_silently_keeps_its_value_is_refused(
    make: Callable[..., V4l2Camera], emulator: EmulatorInStep
) -> None:
    ready(make(gain=20)).disconnect()
    emulator.fault("stuck_controls")
    camera = make(gain=30)
    camera.connect()
    with pytest.raises(UnsupportedSetting) as caught:
        camera.configure()
    assert (caught.value.setting, caught.value.requested, caught.value.given) == ("gain", 30, 20)
    emulator.clear("stuck_controls")
    camera.configure()
    assert camera.latest().value.gain == 30.0


@pytest.mark.parametrize(
    "settings",
    [
        {"rate_hz": float("nan")},
        {"exposure_us": 150},
        {"exposure_us": 40_000},
        {"width_px": 0},
        {"gane": 3},
        {"stall_s": 0.05},
    ],
)
def test_nonsense_is_refused_before_any_device_is_touched(settings: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(settings))):
        V4l2Config.model_validate({"device": NODE} | settings)


def test_latest_never_returns_the_same_frame_as_new_and_next_waits(camera: V4l2Camera) -> None:
    first = camera.latest()
    later = camera.next(first.seq, 1.0)
    assert later.seq > first.seq
    assert later.t_ns > first.t_ns
    with pytest.raises(TransportTimeout):
        camera.next(later.seq + 1000, 0.02)
    assert camera.state is Lifecycle.READY


def test_after_a_long_pause_the_newest_frame_is_read_and_the_gap_is_the_readers(
    make: Callable[..., V4l2Camera], emulator: EmulatorInStep
) -> None:
    camera = ready(make(rate_hz=30))
    before = camera.latest()
    buffers = int(camera.health()["buffers"])
    overruns = emulator.state()["overruns"]
    deadline_ns = CLOCK.now_ns() + DEADLINE_NS
    while emulator.state()["overruns"] < overruns + 5:
        assert CLOCK.now_ns() < deadline_ns
    filled = CLOCK.now_ns()
    # Only a machine too busy to produce a frame within four periods gives another result, and it is correct too.
    with contextlib.suppress(StaleData):
        frame = camera.latest(max_age_s=0.25)
        assert frame.t_ns > filled
        assert frame.seq > before.seq + buffers
    camera.next(before.seq + buffers, DEADLINE_S)
    health = camera.health()
    assert int(health["frames_unread"]) >= 5
    assert health["frames_lost"] == 0


def assert_number_is_true(frame: Stamped[Frame]) -> None:
    # Gain 10 is 1.2 times the light, exposure 15.7 ms is the emulated camera's nominal one.
    expected = picture.brightened(picture.synthetic(frame.seq % picture.PICTURES, 640, 480), 1.2)
    np.testing.assert_array_equal(frame.value.image, expected)


def test_lost_frames_are_counted_and_leave_a_gap_in_the_numbers(
    make: Callable[..., V4l2Camera], emulator: EmulatorInStep
) -> None:
    camera = ready(make(pixel_format="GREY"))
    assert_number_is_true(camera.latest())
    emulator.fault("drop", 3)
    read_until(camera, "frames_lost", 3)
    assert_number_is_true(camera.latest())
    assert camera.health()["frames_lost"] == 3
    assert camera.health()["frames_unread"] == 0


@pytest.mark.parametrize(
    ("fault", "reading"),
    [
        ("corrupt", "frames_bad_damaged"),
        ("error_flag", "frames_bad_marked_damaged"),
        ("out_of_order", "frames_bad_out_of_order"),
    ],
)
@pytest.mark.parametrize("pixel_format", ["MJPG", "YUYV"])
def test_a_few_bad_frames_are_refused_counted_and_survived(
    make: Callable[..., V4l2Camera], emulator: EmulatorInStep, fault: str, reading: str, pixel_format: str
) -> None:
    camera = ready(make(pixel_format=pixel_format))
    emulator.fault(fault, 3)
    read_until(camera, reading, 3)
    frames = read(camera, 5)
    assert camera.health()[reading] == 3
    assert camera.health()["frames_bad"] == 3
    assert (np.diff([frame.seq for frame in frames]) > 0).all()
    assert (np.diff([frame.t_ns for frame in frames]) > 0).all()
    assert camera.state is Lifecycle.READY


@pytest.mark.parametrize(
    ("sequence", "stamp_ahead_ns", "reading"),
    [
        (1, -900_000, "frames_bad_out_of_order"),
        (0, -900_000, "frames_bad_out_of_order"),
        (2, -1_000_000, "frames_bad_out_of_order"),
        (2, 10_000_000_000, "frames_bad_from_the_future"),
        (2, -900_000, "frames_good"),
    ],
)
def test_a_number_or_a_stamp_alone_can_make_a_frame_bad(sequence: int, stamp_ahead_ns: int, reading: str) -> None:
    camera = V4l2Camera("tip", CLOCK, V4l2Config(device=NODE, pixel_format="GREY"))
    now_ns = CLOCK.now_ns()
    data = bytes(640 * 480)
    camera._examine(_arrival(1, now_ns - 1_000_000), data)
    before = camera.health()
    camera._examine(_arrival(sequence, now_ns + stamp_ahead_ns), data)
    after = camera.health()
    changed = {key for key in after if key.startswith("frames_") and after[key] != before.get(key, 0)}
    assert reading in changed
    assert ("frames_good" in changed) == (reading == "frames_good")


def _arrival(sequence: int, stamp_ns: int) -> Arrival:
    return Arrival(
        index=0,
        bytes_used=640 * 480,
        sequence=sequence,
        stamp_ns=stamp_ns,
        monotonic=True,
        start_of_exposure=True,
        damaged=False,
    )


def test_too_many_bad_frames_are_a_fault(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    emulator.fault("error_flag", 11)
    with pytest.raises(CorruptMessage):
        read(camera, 100)
    assert camera.state is Lifecycle.FAULTED
    assert isinstance(camera.fault, CorruptMessage)
    camera.recover(TOKEN)
    assert camera.state is Lifecycle.READY
    assert len(read(camera, 3)) == 3


def test_late_frames_are_stale_by_their_true_stamp(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    read(camera, 2)
    emulator.fault("delay", 0.2)
    deadline_ns = CLOCK.now_ns() + DEADLINE_NS

    def read_on() -> None:
        while CLOCK.now_ns() < deadline_ns:
            camera.latest(max_age_s=0.1)
            pause(0.002)

    with pytest.raises(StaleData) as caught:
        read_on()
    assert caught.value.age_s > 0.1
    assert caught.value.limit_s == 0.1
    late = camera.next(caught.value.seq, 1.0)
    late = camera.next(late.seq, 1.0)
    assert late.age_s(CLOCK.now_ns()) >= 0.2
    assert camera.state is Lifecycle.READY


def test_a_sensor_that_hangs_is_stale_first_and_then_a_fault(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    emulator.fault("pause")
    seen: list[type[Exception]] = []
    deadline_ns = CLOCK.now_ns() + DEADLINE_NS
    while camera.state is Lifecycle.READY and CLOCK.now_ns() < deadline_ns:
        try:
            camera.latest(max_age_s=0.1)
        except (StaleData, TransportTimeout) as error:
            seen.append(type(error))
        pause(0.002)
    assert seen[0] is StaleData
    assert seen[-1] is TransportTimeout
    assert isinstance(camera.fault, TransportTimeout)
    with pytest.raises(LifecycleError):
        camera.latest()
    emulator.clear("pause")
    camera.recover(TOKEN)
    assert camera.latest().seq > 0


def test_a_frozen_picture_is_reported(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    read(camera, 5)
    assert camera.health()["frames_frozen"] == 0
    emulator.fault("freeze_frame")
    read_until(camera, "frozen_run", 5)
    emulator.clear("freeze_frame")
    deadline_ns = CLOCK.now_ns() + DEADLINE_NS
    while camera.health()["frozen_run"] != 0:
        assert CLOCK.now_ns() < deadline_ns
        read(camera, 2)


def test_exposure_drift_is_reported(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    read(camera, 80)
    assert abs(float(camera.health()["brightness_drift"])) < 0.02
    emulator.fault("exposure_drift", 1.0)
    read_until(camera, "brightness_drift", 0.2)


def test_stamps_of_an_unknown_clock_make_frames_suspect(
    make: Callable[..., V4l2Camera], emulator: EmulatorInStep
) -> None:
    emulator.fault("no_monotonic")
    camera = ready(make())
    frame = camera.next(camera.latest().seq, 1.0)
    assert frame.quality is Quality.SUSPECT
    assert frame.t_device_ns is not None
    # The emulated camera's foreign clock is 1000 s ahead; the stamp given is never later than the true one.
    assert frame.t_ns <= frame.t_device_ns - 1_000_000_000_000
    assert camera.health()["kernel_stamps"] is False


def test_an_unplugged_camera_is_a_fault_that_only_a_person_clears(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    last = read(camera, 3)[-1]
    emulator.fault("unplug")
    with pytest.raises(DeviceGone):
        read(camera, 100)
    assert camera.state is Lifecycle.FAULTED
    assert isinstance(camera.fault, DeviceGone)
    with pytest.raises(ConnectError):
        camera.recover(TOKEN)
    assert camera.state is Lifecycle.FAULTED
    emulator.clear("unplug")
    camera.recover(TOKEN)
    assert camera.state is Lifecycle.READY
    assert camera.fault is None
    assert camera.latest().seq > last.seq


def test_a_camera_that_restarts_by_itself_stays_faulted(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    emulator.fault("restart", 0.05)
    with pytest.raises(DeviceGone):
        read(camera, 100)
    emulator.wait_for(plugged=True)
    with pytest.raises(LifecycleError):
        camera.latest()
    camera.recover(TOKEN)
    assert camera.latest().quality is Quality.GOOD


def test_health_alone_detects_a_disconnected_camera(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    emulator.fault("unplug")
    assert camera.health()["state"] == "faulted"
    assert isinstance(camera.fault, DeviceGone)


def test_a_second_program_is_refused_without_disturbing_the_first(
    make: Callable[..., V4l2Camera], camera: V4l2Camera
) -> None:
    second = make()
    second.connect()
    with pytest.raises(ConnectError, match="busy"):
        second.configure()
    assert second.state is Lifecycle.PASSIVE
    assert len(read(camera, 5)) == 5


def test_a_missing_camera_is_named(make: Callable[..., V4l2Camera]) -> None:
    camera = make(device="/dev/v4l/by-id/usb-Nobody-video-index0")
    with pytest.raises(ConnectError, match="usb-Nobody"):
        camera.connect()
    assert camera.state is Lifecycle.DISCONNECTED


def test_a_virtual_clock_is_refused(folder: Path, emulator: EmulatorInStep) -> None:
    camera = V4l2Camera("tip", VirtualClock(), V4l2Config(device=NODE), CallsInStep(folder))
    with pytest.raises(ConnectError, match="CLOCK_MONOTONIC"):
        camera.connect()


def test_only_stable_names_go_without_a_warning(make: Callable[..., V4l2Camera]) -> None:
    bare = ready(make())
    assert "by-id" in str(bare.health()["warning"])
    bare.disconnect()
    stable = ready(make(device="/dev/v4l/by-id/usb-TacTip_0007-video-index0"))
    assert "warning" not in stable.health()


def test_nothing_leaks_over_fifty_sessions(make: Callable[..., V4l2Camera], emulator: EmulatorInStep) -> None:
    camera = make()
    ready(camera).disconnect()

    def held() -> tuple[int, int, int]:
        # The emulator's end is in this process too.
        emulator.wait_for(clients=0, streaming=False)
        maps = Path("/proc/self/maps").read_text()
        return threading.active_count(), len(os.listdir("/proc/self/fd")), maps.count("touchcell-v4l2")

    before = held()
    for _ in range(50):
        ready(camera).disconnect()
    assert held() == before
    assert before[2] == 0


def test_reading_starts_no_thread(make: Callable[..., V4l2Camera]) -> None:
    before = set(threading.enumerate())
    read(ready(make()), 3)
    assert set(threading.enumerate()) == before


def test_a_frozen_or_killed_device_never_blocks_the_reader(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    emulator.freeze()
    with pytest.raises(TransportTimeout):
        read(camera, 100)
    assert camera.state is Lifecycle.FAULTED
    emulator.thaw()
    camera.recover(TOKEN)
    emulator.kill()
    with pytest.raises(DeviceGone):
        read(camera, 1000)
    assert camera.state is Lifecycle.FAULTED
    camera.disconnect()
    emulator.start()


def test_a_folder_of_images_is_played_in_order(tmp_path: Path, emulator: EmulatorInStep) -> None:
    import cv2

    images = tmp_path / "images"
    images.mkdir()
    for number in range(3):
        cv2.imwrite(str(images / f"{number}.png"), np.full((48, 64), 50 * (number + 1), np.uint8))
    playing = emulator_in_step(emulator.world, "v4l2", "--folder", str(tmp_path), "--images", str(images)).start()
    config = V4l2Config(device="/dev/video0", pixel_format="GREY", exposure_us=15700, gain=0)
    with V4l2Camera("tip", CLOCK, config, CallsInStep(tmp_path)) as camera:
        camera.configure()
        for frame in read(camera, 4):
            assert (frame.value.image == 50 * (frame.seq % 3 + 1)).all()
    playing.stop()


def test_an_unknown_fault_is_a_typed_error(emulator: EmulatorInStep) -> None:
    with pytest.raises(ConnectError, match="unknown fault 'nan'"):
        emulator.fault("nan")


def test_a_folder_without_images_is_a_typed_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="contains no images"):
        picture.files(tmp_path)


def test_junk_after_the_end_of_a_picture_is_padding(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    emulator.fault("padding", 10**6)
    first = camera.latest().seq
    assert all(frame.quality is Quality.GOOD for frame in read(camera, 40))
    assert camera.latest().seq - first >= 39
    assert camera.health()["frames_bad"] == 0


def test_a_picture_with_a_hole_is_never_good(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    emulator.fault("hole", 5)
    read_until(camera, "frames_bad_damaged", 5)
    assert camera.health()["frames_bad"] == 5
    assert camera.state is Lifecycle.READY


def test_a_rate_that_is_not_delivered_is_a_fault(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    assert camera.state is Lifecycle.READY
    emulator.fault("true_rate", 32.5)
    with pytest.raises(DeviceFault, match="frames/s, not 60") as caught:
        read_until(camera, "frames_good", 1e9)
    assert caught.value.fault_class is FaultClass.CONFIGURATION
    assert camera.state is Lifecycle.FAULTED
    emulator.clear("true_rate")
    camera.recover(TOKEN)
    assert len(read(camera, 70)) == 70
    assert camera.health()["frame_rate_hz"] == pytest.approx(60.0, rel=0.1)


def test_automatics_are_switched_off(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    controls = emulator.state()["controls"]
    assert controls["Exposure, Dynamic Framerate"] == 0
    assert controls["White Balance, Automatic"] == 0


def test_a_camera_that_forgets_its_settings_is_refused(
    make: Callable[..., V4l2Camera], emulator: EmulatorInStep
) -> None:
    emulator.fault("forgets")
    camera = make()
    camera.connect()
    with pytest.raises(DeviceFault, match="by itself"):
        camera.configure()
    assert camera.state is Lifecycle.PASSIVE


def test_settings_that_change_later_are_a_fault(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    emulator.fault("reset_controls")
    assert camera.health()["state"] == "faulted"
    assert isinstance(camera.fault, DeviceFault)
    camera.recover(TOKEN)
    assert camera.health()["exposure_us"] == 15700


def test_an_own_exposure_longer_than_a_frame_is_refused(make: Callable[..., V4l2Camera]) -> None:
    camera = make(rate_hz=120, exposure_us=None)
    camera.connect()
    with pytest.raises(UnsupportedSetting) as caught:
        camera.configure()
    assert caught.value.setting == "exposure_us"


def test_a_camera_of_one_rate_is_used_and_measured(make: Callable[..., V4l2Camera], emulator: EmulatorInStep) -> None:
    ready(make()).disconnect()
    emulator.fault("no_s_parm")
    right = ready(make(rate_hz=60))
    assert len(read(right, 5)) == 5
    right.disconnect()
    wrong = ready(make(rate_hz=30))
    with pytest.raises(DeviceFault, match="frames/s, not 30"):
        read_until(wrong, "frames_good", 1e9)


def test_a_full_usb_bus_is_explained(make: Callable[..., V4l2Camera], emulator: EmulatorInStep) -> None:
    emulator.fault("no_bandwidth")
    camera = make()
    camera.connect()
    with pytest.raises(ConnectError, match="bandwidth"):
        camera.configure()


def test_another_camera_after_replugging_is_refused(camera: V4l2Camera, emulator: EmulatorInStep) -> None:
    emulator.fault("unplug")
    with pytest.raises(DeviceGone):
        read_until(camera, "frames_good", 1e9)
    emulator.fault("other_camera")
    emulator.clear("unplug")
    with pytest.raises(ConnectError, match="another camera"):
        camera.recover(TOKEN)
    assert camera.state is Lifecycle.FAULTED
    emulator.clear("other_camera")
    camera.recover(TOKEN)
    assert camera.state is Lifecycle.READY


def test_a_camera_at_another_bus_than_expected_is_refused(make: Callable[..., V4l2Camera]) -> None:
    make(expect_bus="usb-0000:00:14.0-8").connect()
    with pytest.raises(ConnectError, match=r"14\.0-8, not at"):
        make(expect_bus="usb-0000:00:14.0-1").connect()
