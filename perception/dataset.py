"""Data sets in the layout of the public TacTip releases: images in a folder, labels in a table beside it.

``ROOT/SPLIT/processed_images/*.png`` and ``ROOT/SPLIT/targets_images.csv`` (or ``targets.csv``), SPLIT one of train,
val, test. The six labels of SPEC part 2 are found by column name; other columns, and images without a row, are ignored.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import os
import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast
from zipfile import BadZipFile

import cv2
import numpy as np

from geometry.types import Array, ImageArray
from perception.errors import DataError
from perception.labels import xi_from_contact
from perception.preprocessing import Preprocessing

LABEL_FILES = ("targets_images.csv", "targets.csv")
IMAGE_FOLDER = "processed_images"
IMAGE_COLUMN = "sensor_image"
LABEL_COLUMNS = ("shear_x", "shear_y", "pose_z", "pose_Rx", "pose_Ry", "shear_Rz")
"""Columns that hold ``CONTACT_NAMES``, mm and degrees."""

Progress = Callable[[int, int], None]
"""Told (images done, images in all)."""


@dataclass(frozen=True)
class LabelledImages:
    """Preprocessed images and what they show.

    Attributes:
        images: uint8 (n, height, width), as ``Preprocessing.reduce`` leaves them.
        xi: (n, 6) log(T_s_f), m and rad.
    """

    images: ImageArray
    xi: Array

    def __len__(self) -> int:
        return len(self.images)

    def digest(self) -> str:
        """SHA-256 of the content, the same on every machine."""
        content = hashlib.sha256(repr(self.images.shape).encode())
        content.update(np.ascontiguousarray(self.images).data)
        # To a picometre, so that the last bit of a logarithm does not make another data set.
        content.update(np.round(self.xi, 12).astype("<f8").tobytes())
        return content.hexdigest()


@dataclass(frozen=True)
class Split:
    """One split of a data set, images not yet read.

    Attributes:
        folder: where it lies.
        images: n image files in the order of the label file.
        contact_mm_deg: (n, 6) labels, named as ``labels.CONTACT_NAMES``.
        unlabelled: images in the folder that have no row.
    """

    folder: Path
    images: tuple[Path, ...]
    contact_mm_deg: Array
    unlabelled: int

    @property
    def xi(self) -> Array:
        """(n, 6) log(T_s_f), m and rad: what networks learn."""
        return xi_from_contact(self.contact_mm_deg)

    def read(self) -> Iterator[ImageArray]:
        """Images in order, decoded one by one, uint8 grey (height, width).

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
                    hint="one data set holds images of one size; collect or crop these again",
                )
            yield image


def read_split(root: Path, split: str) -> Split:
    """The labels of one split and the files of its images.

    Raises:
        DataError: the folder, the split, the label file, a column or an image is missing; the split is empty; a label
            is no finite number; two rows name one image.
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
        raise DataError(image_folder, "no such folder", hint="the images of a split lie there")
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


def read_image(path: Path) -> ImageArray:
    """A PNG as uint8 grey (height, width).

    Raises:
        DataError: the file is missing, no image, or ends early.
    """
    try:
        encoded = path.read_bytes()
    except OSError as error:
        raise DataError(path, f"cannot be read: {error.strerror}") from error
    # OpenCV decodes what there is of a truncated PNG and leaves the rest black, so the end is looked for first.
    if not encoded.startswith(b"\x89PNG\r\n\x1a\n") or encoded[-8:-4] != b"IEND":
        raise DataError(path, "no complete PNG image", hint="copy the data set again")
    image = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    width, height = struct.unpack(">II", encoded[16:24])
    if image is None or image.shape != (height, width):
        raise DataError(path, "damaged PNG image", hint="copy the data set again")
    return cast(ImageArray, image)


def load_reduced(
    split: Split, preprocessing: Preprocessing, *, cache: Path | None = None, progress: Progress | None = None
) -> ImageArray:
    """All images of a split after ``preprocessing.reduce``, uint8 (n, height, width).

    Decoding is done once: the result is kept in ``cache`` under a key made of the paths, sizes and times of the image
    files and the preprocessing. An interrupted call leaves nothing behind.

    Args:
        cache: folder for the result; None keeps nothing.

    Raises:
        DataError: as ``Split.read``.
        ImageError: the images are not what the preprocessing was made for.
    """
    kept = cache / f"{_cache_key(split, preprocessing)}.npz" if cache is not None else None
    if kept is not None and kept.is_file():
        try:
            with np.load(kept, allow_pickle=False) as archive:
                return cast(ImageArray, archive["images"])
        except (OSError, ValueError, KeyError, BadZipFile):
            kept.unlink()
    n = len(split.images)
    reduced = np.empty((n, *preprocessing.output_size), dtype=np.uint8)
    for i, image in enumerate(split.read()):
        reduced[i] = preprocessing.reduce(image)
        if progress is not None:
            progress(i + 1, n)
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=kept.parent) as scratch:
            unfinished = Path(scratch) / "images.npz"
            np.savez(unfinished, images=reduced)
            os.replace(unfinished, kept)
    return reduced


def default_cache() -> Path:
    """``$XDG_CACHE_HOME/touchcell/images``, or the same under ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "touchcell" / "images"


def _cache_key(split: Split, preprocessing: Preprocessing) -> str:
    key = hashlib.sha256(f"{split.folder.resolve()}\0{preprocessing.model_dump_json()}\0".encode())
    for path in split.images:
        status = path.stat()
        key.update(f"{path.name}\0{status.st_size}\0{status.st_mtime_ns}\n".encode())
    return key.hexdigest()[:32]


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
        raise DataError(table, f"{text!r} is no finite number", row=row, column=column)
    return value
