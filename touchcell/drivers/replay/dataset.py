"""Labelled tactile images on disk, in the layouts of the public TacTip releases.

``ROOT/SPLIT/processed_images/*`` and ``ROOT/SPLIT/targets_images.csv`` (or ``targets.csv``). SPLIT is one of train, val
and test, or the same with ``_data`` at its end. Older releases name the folder images or videos, the image column
sensor_video, and number the labels. Images are PNG or JPEG; a video stands for its last frame. The six labels are found
by column name; other columns, and images without a row, are ignored. Where the images were cropped from the camera's
frame, a JSON file beside them holds the rectangle.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from touchcell.errors import DataError
from touchcell.geometry.types import Array, ImageArray

LABEL_FILES = ("targets_images.csv", "targets.csv")
IMAGE_FOLDER = "processed_images"
IMAGE_FOLDERS = (IMAGE_FOLDER, "images", "sensor_images", "videos")
"""Folders of a split that may hold its images; the first that exists does."""
PARAMETER_FILES = ("processed_image_params.json", "process_image_params.json")
"""Files beside the labels, or beside the splits, that hold ``bbox``: left, top, right, bottom of the crop, px."""
VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", *VIDEO_SUFFIXES)
IMAGE_COLUMN = "sensor_image"
REST_IMAGE = "rest.png"
"""File beside the splits, if present: the image out of contact."""
LABEL_COLUMNS = ("shear_x", "shear_y", "pose_z", "pose_Rx", "pose_Ry", "shear_Rz")
"""Columns that hold x, y, z, alpha, beta, gamma of ``T_f_s``, mm and degrees."""
_OTHER_IMAGE_COLUMNS = ("sensor_video",)
_OTHER_LABEL_COLUMNS = ("shear_1", "shear_2", "pose_3", "pose_4", "pose_5", "shear_6")
_BOX = re.compile(r"bbox\W*?\[([^\]]*)\]")

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_LEAST_OF_16_BITS = 4096
_MOST_MM_DEG = 180.0


@dataclass(frozen=True)
class Split:
    """One split of a data set; images are not read yet.

    Attributes:
        folder: folder of the split.
        images: n image files in the order of the label file.
        contact_mm_deg: (n, 6) labels x, y, z, alpha, beta, gamma of ``T_f_s``, mm and degrees.
        unlabelled: images in the folder that have no row.
        crop: (left, top, right, bottom) px of the images in the camera's frame; None where it is not recorded.
    """

    folder: Path
    images: tuple[Path, ...]
    contact_mm_deg: Array
    unlabelled: int
    crop: tuple[int, int, int, int] | None = None

    def read(self) -> Iterator[ImageArray]:
        """Yield the images in order, decoded one by one, uint8 grey (height, width).

        Raises:
            DataError: an image is unreadable or truncated, or its size differs from the first one's.
        """
        size: tuple[int, ...] | None = None
        for path in self.images:
            image = read_image(path)
            if size is None:
                size = image.shape
            if image.shape != size:
                raise DataError(
                    path,
                    f"image of {image.shape[1]}x{image.shape[0]} among images of {size[1]}x{size[0]}",
                    hint="all images of a data set have one size; collect or crop these again",
                )
            yield image

    def in_order(self) -> Split:
        """Return this split in the natural order of the images' names, in which a data set is replayed."""
        order = sorted(range(len(self.images)), key=lambda i: natural_order(self.images[i]))
        return replace(self, images=tuple(self.images[i] for i in order), contact_mm_deg=self.contact_mm_deg[order])

    def deeper_than(self, depth_mm: float) -> Split:
        """Return the contacts of this split with a larger indentation. Raises DataError if there are none."""
        kept = np.flatnonzero(self.contact_mm_deg[:, 2] > depth_mm)
        if not len(kept):
            raise DataError(self.folder, f"contains no contact deeper than {depth_mm:g} mm")
        return replace(self, images=tuple(self.images[i] for i in kept), contact_mm_deg=self.contact_mm_deg[kept])


def read_split(root: Path, split: str) -> Split:
    """Read the labels of one split and the names of its images.

    Raises:
        DataError: the folder, the split, the label file, a column or an image is missing; the split is empty; a label
            is not a finite number or beyond 180 mm or degrees; two rows name one image; a row has more or fewer values.
    """
    folder = split_folder(root, split)
    if not folder.is_dir():
        found = sorted(path.name for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
        hint = f"splits there: {', '.join(found)}" if found else "give the folder that holds train, val and test"
        raise DataError(folder, "no such folder", hint=hint)
    table = label_file_of(folder)
    if table is None:
        raise DataError(folder, f"no label file {' or '.join(LABEL_FILES)}")
    image_folder = image_folder_of(folder)
    if not image_folder.is_dir():
        raise DataError(image_folder, "no such folder", hint="this folder holds the images of a split")
    present = {path.name for path in image_folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES}

    names: list[str] = []
    labels: list[list[float]] = []
    seen: set[str] = set()
    with _open_table(table) as stream:
        rows = csv.DictReader(stream, skipinitialspace=True)
        image_column, columns = _columns(table, rows)
        for row in rows:
            if not any(cell for cell in row.values() if isinstance(cell, str) and cell.strip()):
                continue
            if None in row or None in row.values():
                raise DataError(table, "more or fewer values than columns", row=rows.line_num)
            name = row[image_column].strip()
            if name not in present:
                known = f"is none of {', '.join(IMAGE_SUFFIXES)}"
                reason = known if name and (image_folder / name).is_file() else f"is not in {image_folder}"
                raise DataError(table, f"image {name!r} {reason}", row=rows.line_num, column=image_column)
            if name in seen:
                raise DataError(table, f"image {name!r} has two rows", row=rows.line_num, column=image_column)
            seen.add(name)
            names.append(name)
            labels.append([_number(row[column], table, rows.line_num, column) for column in columns])
    if not names:
        raise DataError(table, "no rows", hint="the split is empty")
    return Split(
        folder=folder,
        images=tuple(image_folder / name for name in names),
        contact_mm_deg=np.array(labels, dtype=np.float64),
        unlabelled=len(present - seen),
        crop=_crop(folder),
    )


def split_folder(root: Path, split: str) -> Path:
    """Return the folder of a split: ``ROOT/SPLIT``, or ``ROOT/SPLIT_data`` where only that exists."""
    folder, other = root / split, root / f"{split}_data"
    return other if other.is_dir() and not folder.is_dir() else folder


def image_folder_of(folder: Path) -> Path:
    """Return the folder of a split's images, whether or not there is one."""
    found = (folder / name for name in IMAGE_FOLDERS if (folder / name).is_dir())
    return next(found, folder / IMAGE_FOLDER)


def label_file_of(folder: Path) -> Path | None:
    """Return the label file of a split; None where it has none."""
    return next((folder / name for name in LABEL_FILES if (folder / name).is_file()), None)


def _columns(table: Path, rows: csv.DictReader[str]) -> tuple[str, tuple[str, ...]]:
    """Return the columns of the image and of the six labels. Raises DataError where one is missing or stands twice."""
    names = [name.strip() for name in rows.fieldnames or ()]
    rows.fieldnames = names
    image = next((name for name in (IMAGE_COLUMN, *_OTHER_IMAGE_COLUMNS) if name in names), IMAGE_COLUMN)
    numbered = not any(name in names for name in LABEL_COLUMNS) and _OTHER_LABEL_COLUMNS[0] in names
    columns = _OTHER_LABEL_COLUMNS if numbered else LABEL_COLUMNS
    for name in (image, *columns):
        if name not in names:
            raise DataError(table, "missing column", row=1, column=name, hint=f"columns there: {', '.join(names)}")
        if names.count(name) > 1:
            raise DataError(table, "two columns of this name", row=1, column=name)
    return image, columns


def _crop(folder: Path) -> tuple[int, int, int, int] | None:
    """Return the crop that a split's parameter file records. Raises DataError where it is not a rectangle."""
    files = [place / name for place in (folder, folder.parent) for name in PARAMETER_FILES]
    file = next((each for each in files if each.is_file()), None)
    if file is None:
        return None
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(file, f"cannot be read: {error}") from error
    try:
        fields = json.loads(text)
        box = fields.get("bbox") if isinstance(fields, dict) else None
    except ValueError:
        # Some published files have a bracket too many or a quote too few, which is no reason to refuse their images.
        numbers = _BOX.search(text)
        box = [int(each) for each in re.findall(r"-?\d+", numbers[1])] if numbers else None
    if box is None:
        return None
    whole = isinstance(box, list) and len(box) == 4 and all(type(each) is int for each in box)
    if not whole or not (0 <= box[0] < box[2] and 0 <= box[1] < box[3]):
        raise DataError(file, f"bbox {box} is not [left, top, right, bottom] in whole pixels", column="bbox")
    left, top, right, bottom = box
    return left, top, right, bottom


def read_rest(root: Path) -> ImageArray | None:
    """Read the image out of contact, uint8 grey (height, width); None if the data set has none. Raises DataError."""
    path = root / REST_IMAGE
    return read_image(path) if path.exists() else None


def read_image(path: Path, *, colour: bool = False) -> ImageArray:
    """Read a PNG or JPEG image, or the last frame of a video, as uint8 grey (height, width).

    With ``colour``, images in colour stay as they are: uint8 (height, width, 3), blue first.

    Of 16 bits per pixel the upper eight are kept, which hold nothing where a camera of 10 or 12 bits wrote its values
    unscaled: such an image is refused.

    Raises:
        DataError: the file is missing, not an image, truncated, or of 16 bits with unscaled values.
    """
    import cv2

    if path.suffix.lower() in VIDEO_SUFFIXES:
        return _last_frame(path, colour)
    try:
        encoded = path.read_bytes()
    except OSError as error:
        raise DataError(path, f"cannot be read: {error.strerror}") from error
    # OpenCV decodes the part of a truncated image that exists and leaves the rest black, so the end is checked first.
    png = encoded.startswith(_PNG) and encoded[-8:-4] == b"IEND"
    jpeg = encoded.startswith(_JPEG) and encoded.rstrip(b"\0").endswith(b"\xff\xd9")
    if not (png or jpeg):
        raise DataError(path, "not a complete PNG or JPEG image", hint="copy the data set again")
    flags = (cv2.IMREAD_ANYCOLOR if colour else cv2.IMREAD_GRAYSCALE) | cv2.IMREAD_ANYDEPTH
    image = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), flags)
    if image is None or (png and image.shape[:2] != struct.unpack(">II", encoded[16:24])[::-1]):
        raise DataError(path, "corrupt image", hint="copy the data set again")
    if image.dtype == np.uint16:
        if 0 < image.max() < _LEAST_OF_16_BITS:
            raise DataError(
                path,
                f"16 bits per pixel with values up to {image.max()} only",
                hint="values of a 10 or 12 bit camera: multiply them by 64 or 16, or save 8 bits",
            )
        return cast(ImageArray, (image >> 8).astype(np.uint8))
    return cast(ImageArray, image)


def _last_frame(path: Path, colour: bool) -> ImageArray:
    if not path.is_file():
        raise DataError(path, "cannot be read: no such file")
    import cv2

    video, last = cv2.VideoCapture(str(path)), None
    try:
        while (step := video.read())[0]:
            last = step[1]
    finally:
        video.release()
    if last is None:
        raise DataError(path, "not a video that can be decoded", hint="copy the data set again, or save images")
    return cast(ImageArray, cv2.cvtColor(last, cv2.COLOR_BGR2GRAY) if last.ndim == 3 and not colour else last)


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that orders numbers within names numerically: image_2 before image_10."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def _open_table(table: Path) -> io.StringIO:
    try:
        return io.StringIO(table.read_text(encoding="utf-8-sig"), newline="")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(table, f"cannot be read: {error}") from error


def _number(text: str | None, table: Path, row: int, column: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(table, f"{text!r} is not a finite number", row=row, column=column)
    if abs(value) > _MOST_MM_DEG:
        raise DataError(
            table,
            f"{value:g} is no contact of such a sensor",
            row=row,
            column=column,
            hint="labels are in mm and degrees, about the surface that is touched",
        )
    return value


FRAME_SIZE = (640, 480)


PUBLIC_CROP = (105, 20, 550, 460)
"""(left, top, right, bottom) px of the public images within the 640x480 frame."""
