"""Labelled tactile images on disk, in the layout of the public TacTip releases.

``ROOT/SPLIT/processed_images/*.png`` and ``ROOT/SPLIT/targets_images.csv`` (or ``targets.csv``), SPLIT one of train,
val, test. The six labels are found by column name; other columns, and images without a row, are ignored.
"""

from __future__ import annotations

import csv
import io
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
IMAGE_COLUMN = "sensor_image"
REST_IMAGE = "rest.png"
"""File beside the splits, if present: the image out of contact."""
LABEL_COLUMNS = ("shear_x", "shear_y", "pose_z", "pose_Rx", "pose_Ry", "shear_Rz")
"""Columns that hold x, y, z, alpha, beta, gamma of ``T_f_s``, mm and degrees."""


@dataclass(frozen=True)
class Split:
    """One split of a data set; images are not read yet.

    Attributes:
        folder: folder of the split.
        images: n image files in the order of the label file.
        contact_mm_deg: (n, 6) labels x, y, z, alpha, beta, gamma of ``T_f_s``, mm and degrees.
        unlabelled: images in the folder that have no row.
    """

    folder: Path
    images: tuple[Path, ...]
    contact_mm_deg: Array
    unlabelled: int

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
            is not a finite number; two rows name one image.
    """
    folder = root / split
    if not folder.is_dir():
        found = sorted(path.name for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
        hint = f"splits there: {', '.join(found)}" if found else "give the folder that holds train, val and test"
        raise DataError(folder, "no such folder", hint=hint)
    table = next((folder / name for name in LABEL_FILES if (folder / name).is_file()), None)
    if table is None:
        raise DataError(folder, f"no label file {' or '.join(LABEL_FILES)}")
    image_folder = folder / IMAGE_FOLDER
    if not image_folder.is_dir():
        raise DataError(image_folder, "no such folder", hint="this folder holds the images of a split")
    present = {path.name for path in image_folder.iterdir() if path.suffix.lower() == ".png"}

    names: list[str] = []
    labels: list[list[float]] = []
    seen: set[str] = set()
    with _open_table(table) as stream:
        rows = csv.DictReader(stream, skipinitialspace=True)
        for column in (IMAGE_COLUMN, *LABEL_COLUMNS):
            if column not in (rows.fieldnames or ()):
                raise DataError(table, "missing column", row=1, column=column)
        for row in rows:
            name = row[IMAGE_COLUMN] or ""
            if name not in present:
                raise DataError(
                    table, f"image {name!r} is not in {image_folder}", row=rows.line_num, column=IMAGE_COLUMN
                )
            if name in seen:
                raise DataError(table, f"image {name!r} has two rows", row=rows.line_num, column=IMAGE_COLUMN)
            seen.add(name)
            names.append(name)
            labels.append([_number(row[column], table, rows.line_num, column) for column in LABEL_COLUMNS])
    if not names:
        raise DataError(table, "no rows", hint="the split is empty")
    return Split(
        folder=folder,
        images=tuple(image_folder / name for name in names),
        contact_mm_deg=np.array(labels, dtype=np.float64),
        unlabelled=len(present - seen),
    )


def read_rest(root: Path) -> ImageArray | None:
    """Read the image out of contact, uint8 grey (height, width); None if the data set has none. Raises DataError."""
    path = root / REST_IMAGE
    return read_image(path) if path.exists() else None


def read_image(path: Path) -> ImageArray:
    """Read a PNG as uint8 grey (height, width).

    Raises:
        DataError: the file is missing, not an image, or truncated.
    """
    import cv2

    try:
        encoded = path.read_bytes()
    except OSError as error:
        raise DataError(path, f"cannot be read: {error.strerror}") from error
    # OpenCV decodes the part of a truncated PNG that exists and leaves the rest black, so the end is checked first.
    if not encoded.startswith(b"\x89PNG\r\n\x1a\n") or encoded[-8:-4] != b"IEND":
        raise DataError(path, "not a complete PNG image", hint="copy the data set again")
    image = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    width, height = struct.unpack(">II", encoded[16:24])
    if image is None or image.shape != (height, width):
        raise DataError(path, "corrupt PNG image", hint="copy the data set again")
    return cast(ImageArray, image)


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
    return value


FRAME_SIZE = (640, 480)


PUBLIC_CROP = (105, 20, 550, 460)
"""(left, top, right, bottom) px of the public images within the 640x480 frame."""
