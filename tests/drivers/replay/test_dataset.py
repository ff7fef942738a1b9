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


def _table(folder: Path, text: str, names: tuple[str, ...] = ("a.png", "b.png")) -> Path:
    (folder / "val" / "images").mkdir(parents=True)
    for name in names:
        cv2.imwrite(str(folder / "val" / "images" / name), np.zeros((4, 4), np.uint8))
    (folder / "val" / "targets.csv").write_text(text)
    return folder


OTHERS = "pose_1,pose_2,pose_3,pose_4,pose_5,pose_6,shear_1,shear_2,shear_3,shear_4,shear_5,shear_6"
HEADER = ",".join([IMAGE_COLUMN, *LABEL_COLUMNS])


def test_numbered_labels_in_a_folder_of_another_name_are_read(tmp_path: Path) -> None:
    text = f"sensor_video,{OTHERS}\na.png,0,0,3,4,5,0,1,2,0,0,0,6\n"
    split = read_split(_table(tmp_path, text), "val")
    np.testing.assert_array_equal(split.contact_mm_deg, [[1, 2, 3, 4, 5, 6]])
    assert split.unlabelled == 1


def test_spaces_around_names_and_blank_lines_are_ignored(tmp_path: Path) -> None:
    text = HEADER.replace(",", " , ") + "\n\na.png ,1,2,3,4,5,6\n,,,,,,\n b.png,1,2,3,4,5,7\n"
    split = read_split(_table(tmp_path, text), "val")
    assert [path.name for path in split.images] == ["a.png", "b.png"]
    np.testing.assert_array_equal(split.contact_mm_deg[:, 5], [6, 7])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (f"{HEADER}\na.png,1,2,3,4,5\n", "line 2: more or fewer values than columns"),
        (f"{HEADER}\na.png,1,2,3,4,5,6,7\n", "line 2: more or fewer values than columns"),
        (f"{HEADER}\na.png,1,2,nan,4,5,6\n", "column pose_z: 'nan' is not a finite number"),
        (f"{HEADER}\na.png,1,2,,4,5,6\n", "column pose_z: '' is not a finite number"),
        (f"{HEADER},pose_z\na.png,1,2,3,4,5,6,7\n", "column pose_z: two columns of this name"),
        (HEADER.replace("pose_z", "depth") + "\na.png,1,2,3,4,5,6\n", "columns there: sensor_image, shear_x"),
        (HEADER.replace(",", ";") + "\na.png;1;2;3;4;5;6\n", "missing column"),
    ],
)
def test_damaged_rows_are_named(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(DataError) as caught:
        read_split(_table(tmp_path, text), "val")
    assert says in str(caught.value)


def test_crop_is_read_from_a_file_that_is_not_quite_json_and_such_a_file_without_it_is_ignored(tmp_path: Path) -> None:
    data = _table(tmp_path, f"{HEADER}\na.png,1,2,3,4,5,6\n")
    params = tmp_path / "processed_image_params.json"
    params.write_text('{"source": 0, bbox": [115, 10, 535, 430], "thresh": [61, 5]]}')
    assert read_split(data, "val").crop == (115, 10, 535, 430)
    params.write_text('{"source": 0, "thresh": [61, 5]]}')
    assert read_split(data, "val").crop is None
    params.write_text('{"bbox": [115, 10, 535], "thresh": [61, 5]]}')
    with pytest.raises(DataError, match="bbox"):
        read_split(data, "val")


def test_natural_order_takes_images_and_labels_along(tmp_path: Path) -> None:
    rows = "".join(f"{name},0,0,{depth},0,0,0\n" for name, depth in (("i_10.png", 3), ("i_2.png", 1)))
    split = read_split(_table(tmp_path, f"{HEADER}\n{rows}", ("i_2.png", "i_10.png")), "val").in_order()
    assert [path.name for path in split.images] == ["i_2.png", "i_10.png"]
    np.testing.assert_array_equal(split.contact_mm_deg[:, 2], [1, 3])


def test_image_of_another_kind_is_told_from_a_missing_one(tmp_path: Path) -> None:
    data = _table(tmp_path, f"{HEADER}\na.tif,1,2,3,4,5,6\n", ("a.tif",))
    with pytest.raises(DataError, match=r"'a\.tif' is none of \.png"):
        read_split(data, "val")
    (data / "val" / "images" / "a.tif").unlink()
    with pytest.raises(DataError, match=r"'a\.tif' is not in"):
        read_split(data, "val")
