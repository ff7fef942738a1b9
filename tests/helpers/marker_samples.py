"""Simulated tactile images with known marker positions."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from touchcell.drivers.replay.dataset import IMAGE_COLUMN, LABEL_COLUMNS, PUBLIC_CROP
from touchcell.geometry import se3
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.contact_poses import random_poses
from touchcell.simulation.contact import ContactLaw, contact_at
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.tip import Tip

SIZE = (PUBLIC_CROP[3] - PUBLIC_CROP[1], PUBLIC_CROP[2] - PUBLIC_CROP[0])
CORNER = np.array(PUBLIC_CROP[:2], dtype=np.float64)
TIP = Tip()
REST = TIP.project(TIP.rest_positions) - CORNER


@dataclass(frozen=True)
class Simulated:
    """Images of the public kind with their contacts and markers.

    Attributes:
        images: black and white (440, 445).
        T_f_s: (n, 4, 4).
        pixels: (n, 331, 2) px of the markers in the images.
    """

    images: list[ImageArray]
    T_f_s: Array
    pixels: Array


def simulated(n: int, seed: int, depth_mm: tuple[float, float] = (0.5, 6.0)) -> Simulated:
    """Simulate n random contacts of the default sensor over the ranges of the public data, with 0.3 px marker noise."""
    rng = np.random.default_rng(seed)
    law = ContactLaw()
    T_f_s = np.stack([contact_at(pose, law).T_f_s for pose in random_poses(n, rng, depth_mm)])
    pixels = TIP.pixels(T_f_s) + rng.normal(0.0, 0.3, (n, 331, 2))
    renderer = FrameRenderer(seed=seed)
    return Simulated([renderer.processed(each) for each in pixels], T_f_s, pixels - CORNER)


def write_split(root: Path, split: str, n: int, seed: int) -> None:
    """Write simulated images in the layout of the public data."""
    sample = simulated(n, seed)
    folder = root / split
    (folder / "processed_images").mkdir(parents=True)
    with (folder / "targets_images.csv").open("w", newline="") as stream:
        table = csv.DictWriter(stream, [IMAGE_COLUMN, *LABEL_COLUMNS])
        table.writeheader()
        for i, (image, contact) in enumerate(zip(sample.images, se3.to_euler_mm_deg(sample.T_f_s), strict=True)):
            name = f"image_{i + 1}.png"
            cv2.imwrite(str(folder / "processed_images" / name), image)
            table.writerow({IMAGE_COLUMN: name, **dict(zip(LABEL_COLUMNS, contact.tolist(), strict=True))})
