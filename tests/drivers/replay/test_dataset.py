from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchcell.drivers.replay.dataset import IMAGE_COLUMN, LABEL_COLUMNS, read_image, read_split
from touchcell.errors import DataError


def _write_split(folder: Path, names: list[str], image: np.ndarray) -> None:
    (folder / "processed_images").mkdir(parents=True)
    with (folder / "targets_images.csv").open("w", newline="") as stream:
        table = csv.DictWriter(stream, [IMAGE_COLUMN, *LABEL_COLUMNS])
        table.writeheader()
        for name in names:
            cv2.imwrite(str(folder / "processed_images" / name), image)
            table.writerow({IMAGE_COLUMN: name, **dict.fromkeys(LABEL_COLUMNS, 1.0)})


def test_folders_with_data_in_their_name_jpeg_images_and_the_recorded_crop_are_read(tmp_path: Path) -> None:
    image = np.full((40, 30), 90, np.uint8)
    _write_split(tmp_path / "train_data", ["image_1.png", "image_2.jpg"], image)
    box = {"bbox": [115, 10, 145, 50]}
    (tmp_path / "train_data" / "processed_image_params.json").write_text(json.dumps(box))
    split = read_split(tmp_path, "train")
    assert [each.shape for each in split.read()] == [(40, 30)] * 2
    assert split.crop == (115, 10, 145, 50)


def test_split_without_recorded_crop_has_none_and_a_damaged_record_is_refused(tmp_path: Path) -> None:
    _write_split(tmp_path / "val", ["image_1.png"], np.zeros((4, 4), np.uint8))
    assert read_split(tmp_path, "val").crop is None
    (tmp_path / "process_image_params.json").write_text('{"bbox": [5, 5, 2, 9]}')
    with pytest.raises(DataError, match="bbox"):
        read_split(tmp_path, "val")


def test_sixteen_bit_image_keeps_its_upper_byte_and_twelve_bit_values_are_refused(tmp_path: Path) -> None:
    full = np.linspace(0, 65535, 64).astype(np.uint16).reshape(8, 8)
    cv2.imwrite(str(tmp_path / "full.png"), full)
    np.testing.assert_array_equal(read_image(tmp_path / "full.png"), (full >> 8).astype(np.uint8))
    cv2.imwrite(str(tmp_path / "dim.png"), full >> 4)
    with pytest.raises(DataError, match="up to 4095"):
        read_image(tmp_path / "dim.png")


def test_truncated_jpeg_is_refused(tmp_path: Path) -> None:
    encoded = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (40, 40), dtype=np.uint8))[1].tobytes()
    (tmp_path / "cut.jpg").write_bytes(encoded[:-100])
    with pytest.raises(DataError, match="not a complete"):
        read_image(tmp_path / "cut.jpg")


def test_video_stands_for_its_last_frame(tmp_path: Path) -> None:
    path = tmp_path / "contact.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    if not writer.isOpened():
        pytest.skip("this build of OpenCV writes no video")
    for level in (10, 100, 200):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    image = read_image(path)
    assert image.shape == (48, 64)
    assert abs(int(image.mean()) - 200) < 4


def test_file_that_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.mp4").write_bytes(b"")
    with pytest.raises(DataError, match="not a video"):
        read_image(tmp_path / "empty.mp4")
