"""Writer for labelled frames, in the layout that ``touchcell.drivers.replay.dataset`` reads.

Each sample is an image and then a row, so that an interrupted run leaves complete samples, and the next run continues.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2

from touchcell.cell.errors import RecordingError
from touchcell.drivers.replay.dataset import IMAGE_COLUMN, IMAGE_FOLDER, LABEL_COLUMNS, LABEL_FILES, REST_IMAGE
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array, ImageArray

_ABOUT = "collection.json"
_HEADER = (IMAGE_COLUMN, *LABEL_COLUMNS)


class Collection:
    """A data set that is extended by each run.

    Args:
        root: its folder; created if missing.
        shares: number of samples per cycle that go to each split, in turn ("train": 3, "val": 1).
        about: how it is taken; a collection with other settings is not continued.
        defaults: of settings that a collection begun by an earlier version does not name.

    Raises:
        ConfigError: the folder holds a collection with other settings, or something else.
        RecordingError: the folder cannot be written.
    """

    def __init__(
        self,
        root: Path,
        shares: Mapping[str, int],
        about: Mapping[str, Any],
        defaults: Mapping[str, Any] | None = None,
    ) -> None:
        self.root = root
        self._turn = [split for split, count in shares.items() for _ in range(count)]
        try:
            root.mkdir(parents=True, exist_ok=True)
            self._begin({"shares": dict(shares), **about}, defaults or {})
            self.kept = sum(self._whole_rows(split) for split in shares)
            self._has_rest = (root / REST_IMAGE).exists()
        except OSError as error:
            raise RecordingError(root, f"cannot be written: {error.strerror}") from None

    def keep(self, image: ImageArray, T_f_s: Array) -> None:
        """Add a frame and the contact (4, 4) that it shows. Raises RecordingError."""
        split = self._turn[self.kept % len(self._turn)]
        name = f"image_{self.kept + 1}.png"
        labels = dict(zip(LABEL_COLUMNS, se3.to_euler_mm_deg(T_f_s).tolist(), strict=True))
        row = io.StringIO()
        csv.DictWriter(row, _HEADER, lineterminator="\n").writerow({IMAGE_COLUMN: name, **labels})
        try:
            (self.root / split / IMAGE_FOLDER / name).write_bytes(cv2.imencode(".png", image)[1].tobytes())
            with self._table(split).open("a") as table:
                table.write(row.getvalue())
        except OSError as error:
            raise RecordingError(
                self.root, f"cannot be written: {error.strerror}", hint="free some space and run it again: it continues"
            ) from None
        self.kept += 1

    def keep_rest(self, image: ImageArray) -> None:
        """Store the sensor's image out of contact, if there is none yet. Raises RecordingError."""
        if self._has_rest:
            return
        path = self.root / REST_IMAGE
        try:
            path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
        except OSError as error:
            raise RecordingError(path, f"cannot be written: {error.strerror}") from None
        self._has_rest = True

    def _begin(self, about: Mapping[str, Any], defaults: Mapping[str, Any]) -> None:
        file = self.root / _ABOUT
        # Round trip through JSON, so that tuples equal the lists that they become.
        about = json.loads(json.dumps(about))
        if not file.exists():
            if any(self.root.iterdir()):
                raise ConfigError(
                    "the folder is not empty", key="collect.data", value=str(self.root), hint="name a new one"
                )
            file.write_text(json.dumps(about, indent=1) + "\n")
        elif {**json.loads(json.dumps(defaults)), **json.loads(file.read_text())} != about:
            raise ConfigError(
                "the folder holds samples taken with other settings",
                key="collect.data",
                value=str(self.root),
                hint=f"compare {file}, or name a new folder",
            )

    def _whole_rows(self, split: str) -> int:
        """Return the number of rows of a split's table, after removing an incomplete last one."""
        table = self._table(split)
        (table.parent / IMAGE_FOLDER).mkdir(parents=True, exist_ok=True)
        text = table.read_text() if table.exists() else ",".join(_HEADER) + "\n"
        whole = text[: text.rfind("\n") + 1]
        if whole != text or not table.exists():
            table.write_text(whole)
        return whole.count("\n") - 1

    def _table(self, split: str) -> Path:
        return self.root / split / LABEL_FILES[0]
