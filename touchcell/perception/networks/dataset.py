"""Load labelled images from disk into training arrays."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast
from zipfile import BadZipFile

import numpy as np

from touchcell.drivers.replay.dataset import Split
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.errors import TrainingError
from touchcell.perception.models.labels import CONTACT_NAMES, contact_from_xi
from touchcell.perception.models.model_file import Labels
from touchcell.perception.models.preprocessing import Preprocessing

_SAME_MM_DEG = 1e-6
_LEAST_MM, _LEAST_DEG = 0.05, 0.8

ProgressCallback = Callable[[int, int], None]
"""Called with the number of items done and the total."""


@dataclass(frozen=True)
class LabelledImages:
    """Preprocessed images and their labels.

    Attributes:
        images: uint8 (n, height, width), as ``Preprocessing.reduce`` returns them.
        xi: (n, 6) log(T_s_f), m and rad.
    """

    images: ImageArray
    xi: Array

    def __len__(self) -> int:
        return len(self.images)

    def digest(self) -> str:
        """Return the SHA-256 of the content, the same on every machine."""
        content = hashlib.sha256(repr(self.images.shape).encode())
        content.update(np.ascontiguousarray(self.images).data)
        # To a picometre, so that the last bit of a logarithm does not change the digest.
        content.update(np.round(self.xi, 12).astype("<f8").tobytes())
        return content.hexdigest()


def load_reduced(
    split: Split, preprocessing: Preprocessing, *, cache: Path | None = None, progress: ProgressCallback | None = None
) -> ImageArray:
    """Return all images of a split after ``preprocessing.reduce``, uint8 (n, height, width).

    Decoding is done once: the result is stored in ``cache`` under a key of the paths, sizes and times of the image
    files and the preprocessing. An interrupted call leaves nothing behind.

    Args:
        split: labelled images.
        preprocessing: applied to each.
        cache: folder for the result; None stores nothing.
        progress: called per image.

    Raises:
        DataError: as ``Split.read``.
        ImageError: the images do not match the preprocessing.
    """
    kept = cache / f"{cache_key(split, preprocessing)}.npz" if cache is not None else None
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
    """Return ``$XDG_CACHE_HOME/touchcell/images``, or the same under ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "touchcell" / "images"


def cache_key(split: Split, preprocessing: Preprocessing) -> str:
    """Return a key for the result of this preprocessing on these image files."""
    key = hashlib.sha256(f"{split.folder.resolve()}\0{preprocessing.model_dump_json()}\0".encode())
    for path in split.images:
        status = path.stat()
        key.update(f"{path.name}\0{status.st_size}\0{status.st_mtime_ns}\n".encode())
    return key.hexdigest()[:32]


def label_range(training: Array, validation: Array) -> Labels:
    """Return labels that span the training set's contacts, given as xi (n, 6), m and rad.

    Raises:
        TrainingError: there are fewer than two labels in either set, they are not finite, a component never varies, or
            all are as small as metres and radians are.
    """
    for name, xi in (("training", training), ("validation", validation)):
        if xi.ndim != 2 or len(xi) < 2 or xi.shape[1] != 6 or not np.isfinite(xi).all():
            raise TrainingError(f"the {name} set needs two or more labels of six finite components")
    contacts = contact_from_xi(training)
    low, high = contacts.min(axis=0), contacts.max(axis=0)
    for name, width in zip(CONTACT_NAMES, high - low, strict=True):
        if width < _SAME_MM_DEG:
            raise TrainingError(
                f"all training labels have the same {name}", hint="collect contacts with varied values of it"
            )
    largest = np.abs(contacts).max(axis=0)
    if largest[:3].max() < _LEAST_MM or largest[3:].max() < _LEAST_DEG:
        raise TrainingError(
            f"no label is larger than {largest[:3].max():.3g} mm and {largest[3:].max():.3g} degrees",
            hint="labels are in mm and degrees, not in m or rad",
        )
    return Labels.of_contacts(tuple(low.tolist()), tuple(high.tolist()))
