from pathlib import Path

import cv2
import numpy as np
import pytest

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.errors import (
    ConnectError,
    CorruptMessage,
    DeviceGone,
    EndOfStream,
    LifecycleError,
    StaleData,
    TransportTimeout,
)
from touchcell.drivers.core.protocols import FrameSource, HealthSource
from touchcell.drivers.core.spec import DRIVERS, DriverContext
from touchcell.drivers.replay.camera import ReplayCamera, ReplayCameraConfig
from touchcell.drivers.replay.dataset import IMAGE_COLUMN, IMAGE_FOLDER, LABEL_COLUMNS


def write(folder: Path, name: str, level: int, shape: tuple[int, ...] = (12, 16)) -> Path:
    file = folder / name
    assert cv2.imwrite(str(file), np.full(shape, level, np.uint8))
    return file


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twelve images as in the public data, whose grey level is their number."""
    images = tmp_path / "processed_images"
    images.mkdir()
    for number in range(1, 13):
        write(images, f"image_{number}.png", number)
    (images / "targets.csv").write_text("not an image")
    return images


def play(folder: Path, clock: VirtualClock, rate_hz: float = 10.0) -> ReplayCamera:
    camera = DRIVERS.load("replay_camera").build(
        "camera", ReplayCameraConfig(data=folder, rate_hz=rate_hz), DriverContext(clock)
    )
    assert isinstance(camera, ReplayCamera)
    return camera


def test_it_is_a_frame_source(folder: Path) -> None:
    camera = play(folder, VirtualClock())
    assert isinstance(camera, FrameSource)
    assert isinstance(camera, HealthSource)
    assert DRIVERS.load("replay_camera").capabilities.provides == {FrameSource, HealthSource}
    with pytest.raises(LifecycleError):
        camera.latest()


def test_images_come_in_natural_order_on_the_clock_and_then_end(folder: Path) -> None:
    clock = VirtualClock(1_000_000_000)
    with play(folder, clock) as camera:
        for seq in range(12):
            frame = camera.next(seq - 1, timeout_s=1.0)
            assert frame.seq == seq
            assert frame.value.image[0, 0] == seq + 1
            assert frame.t_ns == clock.now_ns() == 1_000_000_000 + seq * 100_000_000
        with pytest.raises(EndOfStream):
            camera.next(11, timeout_s=1.0)


def test_images_not_read_in_time_are_lost_and_not_opened(folder: Path) -> None:
    clock = VirtualClock()
    with play(folder, clock) as camera:
        clock.advance_s(0.55)
        frame = camera.latest()
        assert camera.latest() is frame
        assert frame.value.image[0, 0] == 6
        assert camera.next(0, 1.0) is frame
        assert camera.health() == {"images": 12, "images_read": 1}
        with pytest.raises(StaleData):
            camera.latest(max_age_s=0.01)
        clock.advance_s(1.0)
        with pytest.raises(EndOfStream):
            camera.latest()


def test_a_frame_that_comes_too_late_is_a_timeout(folder: Path) -> None:
    clock = VirtualClock()
    with play(folder, clock) as camera:
        with pytest.raises(TransportTimeout):
            camera.next(0, timeout_s=0.05)
        assert clock.now_ns() == 50_000_000


def test_a_missing_or_empty_folder_does_not_connect(tmp_path: Path) -> None:
    for folder in (tmp_path / "nowhere", tmp_path):
        camera = play(folder, VirtualClock())
        with pytest.raises(ConnectError) as caught:
            camera.connect()
        assert str(folder) in str(caught.value)


@pytest.mark.parametrize("keep", [0, 10, 0.5, -1])
def test_truncated_images_are_not_shown_half(folder: Path, keep: float) -> None:
    file = folder / "image_1.png"
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * keep) if isinstance(keep, float) else int(keep)])
    with play(folder, VirtualClock()) as camera, pytest.raises(CorruptMessage) as caught:
        camera.latest()
    assert "image_1.png" in str(caught.value)


def test_a_truncated_jpeg_is_not_shown_half(tmp_path: Path) -> None:
    file = write(tmp_path, "image_1.jpg", 90, (64, 64, 3))
    with play(tmp_path, VirtualClock()) as camera:
        assert camera.latest().value.image.shape == (64, 64, 3)
    file.write_bytes(file.read_bytes()[:-40])
    with play(tmp_path, VirtualClock()) as camera, pytest.raises(CorruptMessage):
        camera.latest()


def test_something_else_with_the_name_of_an_image_is_refused(folder: Path) -> None:
    (folder / "image_1.png").write_bytes(b"hello IEND\xaeB`\x82")
    with play(folder, VirtualClock()) as camera, pytest.raises(CorruptMessage):
        camera.latest()


def test_a_change_of_size_is_refused(folder: Path) -> None:
    write(folder, "image_2.png", 2, (16, 12))
    with play(folder, VirtualClock()) as camera:
        camera.next(-1, 1.0)
        with pytest.raises(CorruptMessage, match="image_2"):
            camera.next(0, 1.0)


def test_a_deleted_image_raises_device_gone(folder: Path) -> None:
    with play(folder, VirtualClock()) as camera:
        (folder / "image_1.png").unlink()
        with pytest.raises(DeviceGone):
            camera.latest()


def as_split(folder: Path, split: Path, names: list[str]) -> Path:
    """Move images into a split whose labels have these images, and return its data set."""
    split.mkdir(parents=True)
    folder.rename(split / IMAGE_FOLDER)
    rows = [",".join([IMAGE_COLUMN, *LABEL_COLUMNS]), *(f"{name},1,2,3,4,5,6" for name in names)]
    (split / "targets_images.csv").write_text("\n".join(rows) + "\n")
    return split.parent


def test_of_a_labelled_split_only_images_with_a_label_are_played_as_the_arm_has_no_pose_for_others(
    folder: Path, tmp_path: Path
) -> None:
    root = as_split(folder, tmp_path / "set" / "val_data", ["image_12.png", "image_2.png", "image_3.png"])
    config = ReplayCameraConfig(data=root, split="val", rate_hz=10.0)
    with ReplayCamera("camera", config, VirtualClock()) as camera:
        assert [camera.next(seq - 1, 1.0).value.image[0, 0] for seq in range(3)] == [2, 3, 12]
        with pytest.raises(EndOfStream):
            camera.next(2, 1.0)


def test_damaged_labels_of_a_split_do_not_connect(folder: Path) -> None:
    root = as_split(folder, folder.parent / "set" / "val", ["image_99.png"])
    camera = ReplayCamera("camera", ReplayCameraConfig(data=root, split="val", rate_hz=10.0), VirtualClock())
    with pytest.raises(ConnectError, match=r"image_99\.png"):
        camera.connect()


def test_a_labelled_split_is_played_in_grey_as_it_was_trained_on(folder: Path) -> None:
    write(folder, "image_1.png", 77, (12, 16, 3))
    root = as_split(folder, folder.parent / "set" / "val", ["image_1.png"])
    config = ReplayCameraConfig(data=root, split="val", rate_hz=10.0)
    with ReplayCamera("camera", config, VirtualClock()) as camera:
        assert camera.latest().value.image.shape == (12, 16)


def test_unscaled_values_of_a_twelve_bit_camera_are_refused(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "image_1.png"), np.full((12, 16), 4000, np.uint16))
    with play(tmp_path, VirtualClock()) as camera, pytest.raises(CorruptMessage, match="16 bits"):
        camera.latest()
