from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.helpers.tactile_samples import SIZE, contacts, draw, labelled, preprocessing, write_split
from touchcell.drivers.replay.dataset import read_image, read_split
from touchcell.errors import DataError
from touchcell.perception.errors import ImageError, TrainingError
from touchcell.perception.models.labels import contact_from_xi, xi_from_contact
from touchcell.perception.networks import dataset
from touchcell.perception.networks.dataset import LabelledImages, label_range, load_reduced


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_split(tmp_path / "data", "train", n=6, seed=1)
    return tmp_path / "data"


def edit(table: Path, change: Callable[[list[list[str]]], None]) -> None:
    with table.open(newline="") as stream:
        rows = list(csv.reader(stream))
    change(rows)
    with table.open("w", newline="") as stream:
        csv.writer(stream).writerows(rows)


def set_cell(table: Path, row: int, column: str, value: str) -> None:
    def change(rows: list[list[str]]) -> None:
        rows[row][rows[0].index(column)] = value

    edit(table, change)


def test_reads_labels_by_column_name_and_images_in_order(root: Path) -> None:
    split = read_split(root, "train")
    np.testing.assert_allclose(split.contact_mm_deg, contacts(6, seed=1), rtol=1e-12)
    assert [path.name for path in split.images] == [f"image_{i}.png" for i in range(1, 7)]
    for image, contact in zip(split.read(), contacts(6, seed=1), strict=True):
        np.testing.assert_array_equal(image, draw(contact))


def test_label_is_the_logarithm_of_the_surface_in_the_sensor() -> None:
    # A shear of +2 mm and a depth of 3 mm alone: T_s_f is the opposite translation.
    np.testing.assert_allclose(
        xi_from_contact(np.array([2.0, 0.0, 3.0, 0.0, 0.0, 0.0])), [-2e-3, 0.0, -3e-3, 0.0, 0.0, 0.0], atol=1e-15
    )
    # A twist of the sensor about z alone.
    np.testing.assert_allclose(
        xi_from_contact(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 5.0])), [0, 0, 0, 0, 0, -np.radians(5.0)], atol=1e-15
    )
    drawn = contacts(50, seed=9)
    np.testing.assert_allclose(contact_from_xi(xi_from_contact(drawn)), drawn, atol=1e-10)


def test_other_name_of_label_file_and_images_without_a_row(root: Path) -> None:
    folder = root / "train"
    (folder / "targets_images.csv").rename(folder / "targets.csv")
    cv2.imwrite(str(folder / "processed_images" / "spare.png"), np.zeros((9, 9), np.uint8))
    split = read_split(root, "train")
    assert len(split.images) == 6
    assert split.unlabelled == 1


@pytest.mark.parametrize(
    ("column", "value", "reported"),
    [
        ("pose_z", "nan", "pose_z"),
        ("shear_Rz", "inf", "shear_Rz"),
        ("pose_Rx", "", "pose_Rx"),
        ("shear_x", "1,5", "shear_x"),
        ("sensor_image", "image_99.png", "sensor_image"),
        ("sensor_image", "image_1.png", "sensor_image"),
        ("sensor_image", "", "sensor_image"),
    ],
)
def test_bad_cell_is_reported_with_file_row_and_column(root: Path, column: str, value: str, reported: str) -> None:
    table = root / "train" / "targets_images.csv"
    set_cell(table, 3, column, value)
    with pytest.raises(DataError) as caught:
        read_split(root, "train")
    assert (caught.value.file, caught.value.row, caught.value.column) == (table, 4, reported)


def test_row_that_ends_early(root: Path) -> None:
    edit(root / "train" / "targets_images.csv", lambda rows: rows[2].__delitem__(slice(2, None)))
    with pytest.raises(DataError) as caught:
        read_split(root, "train")
    assert caught.value.row == 3


@pytest.mark.parametrize("column", ["sensor_image", "pose_Ry"])
def test_missing_column(root: Path, column: str) -> None:
    table = root / "train" / "targets_images.csv"
    set_cell(table, 0, column, "something_else")
    with pytest.raises(DataError) as caught:
        read_split(root, "train")
    assert (caught.value.file, caught.value.column) == (table, column)


def test_empty_split(root: Path) -> None:
    edit(root / "train" / "targets_images.csv", lambda rows: rows.__delitem__(slice(1, None)))
    with pytest.raises(DataError, match="no rows"):
        read_split(root, "train")


def test_label_file_that_is_empty_or_no_text(root: Path) -> None:
    table = root / "train" / "targets_images.csv"
    table.write_bytes(b"")
    with pytest.raises(DataError) as caught:
        read_split(root, "train")
    assert caught.value.column == "sensor_image"
    table.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(DataError, match="cannot be read"):
        read_split(root, "train")


def test_missing_folder_split_table_and_images(root: Path) -> None:
    with pytest.raises(DataError) as caught:
        read_split(root, "val")
    assert caught.value.file == root / "val"
    assert "train" in caught.value.hint
    with pytest.raises(DataError):
        read_split(root / "nowhere", "train")
    (root / "val").mkdir()
    with pytest.raises(DataError, match="no label file"):
        read_split(root, "val")
    (root / "val" / "targets.csv").write_text("sensor_image\n")
    with pytest.raises(DataError) as caught:
        read_split(root, "val")
    assert caught.value.file == root / "val" / "processed_images"


@pytest.mark.parametrize("damage", ["truncate", "no image", "corrupt", "empty", "delete"])
def test_unreadable_image_is_named(root: Path, damage: str) -> None:
    split = read_split(root, "train")
    victim = split.images[4]
    good = victim.read_bytes()
    match damage:
        case "truncate":
            victim.write_bytes(good[: len(good) // 2])
        case "no image":
            victim.write_text("not a picture")
        case "corrupt":
            victim.write_bytes(good[:60] + bytes(40) + good[100:])
        case "empty":
            victim.write_bytes(b"")
        case "delete":
            victim.unlink()
    with pytest.raises(DataError) as caught:
        list(split.read())
    assert caught.value.file == victim


def test_images_of_different_sizes(root: Path) -> None:
    split = read_split(root, "train")
    cv2.imwrite(str(split.images[2]), np.zeros((SIZE[0], SIZE[1] + 1), np.uint8))
    with pytest.raises(DataError) as caught:
        load_reduced(split, preprocessing())
    assert caught.value.file == split.images[2]


def test_images_of_another_size_than_the_preprocessing(root: Path) -> None:
    split = read_split(root, "train")
    for path in split.images:
        cv2.imwrite(str(path), np.zeros((30, 30), np.uint8))
    with pytest.raises(ImageError) as caught:
        load_reduced(split, preprocessing())
    assert (caught.value.attribute, caught.value.found) == ("size", (30, 30))


def test_cache_gives_the_same_images_without_decoding(root: Path, tmp_path: Path) -> None:
    split = read_split(root, "train")
    cache = tmp_path / "cache"
    calls: list[tuple[int, int]] = []
    first = load_reduced(split, preprocessing(), cache=cache, progress=lambda done, n: calls.append((done, n)))
    assert calls == [(i, 6) for i in range(1, 7)]
    second = load_reduced(split, preprocessing(), cache=cache, progress=lambda done, n: calls.append((done, n)))
    assert len(calls) == 6
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first[3], preprocessing().reduce(read_image(split.images[3])))

    cv2.imwrite(str(split.images[0]), np.full(SIZE, 255, np.uint8))
    assert load_reduced(split, preprocessing(), cache=cache)[0].min() == 255
    assert load_reduced(split, preprocessing(16), cache=cache).shape == (6, 16, 16)


def test_damaged_cache_is_made_again_and_interruption_leaves_none(root: Path, tmp_path: Path) -> None:
    split = read_split(root, "train")
    cache = tmp_path / "cache"

    def interrupt(done: int, _n: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        load_reduced(split, preprocessing(), cache=cache, progress=interrupt)
    assert not cache.exists()
    expected = load_reduced(split, preprocessing(), cache=cache)
    (kept,) = cache.iterdir()
    kept.write_bytes(kept.read_bytes()[:500])
    np.testing.assert_array_equal(load_reduced(split, preprocessing(), cache=cache), expected)


def test_default_cache_follows_xdg(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert dataset.default_cache() == tmp_path / "touchcell" / "images"


def test_digest_depends_on_the_content() -> None:
    data = labelled(4, seed=1)
    same = LabelledImages(data.images.copy(), data.xi + 1e-15)
    other_image = LabelledImages(data.images.copy(), data.xi)
    other_image.images[0, 0, 0] += 1
    other_label = LabelledImages(data.images, data.xi + 1e-6)
    assert data.digest() == same.digest()
    assert len({data.digest(), other_image.digest(), other_label.digest()}) == 3


def test_labels_in_metres_or_radians_are_refused() -> None:
    contacts = np.random.default_rng(0).uniform([-4, -4, 1, -20, -20, -4], [4, 4, 5, 20, 20, 4], (20, 6))
    label_range(xi_from_contact(contacts), xi_from_contact(contacts))
    for scale in ([1e-3] * 3 + [1.0] * 3, [1.0] * 3 + [np.pi / 180] * 3):
        small = xi_from_contact(contacts * scale)
        with pytest.raises(TrainingError, match="mm and degrees"):
            label_range(small, small)
