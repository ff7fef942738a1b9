"""Small data sets for tests: rings of dots that move like a tip's markers, with the contact that moved them."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np

from touchcell.drivers.replay.dataset import IMAGE_COLUMN, LABEL_COLUMNS
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.models.labels import xi_from_contact
from touchcell.perception.models.model_file import load_model
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.networks.dataset import LabelledImages

SIZE = (44, 48)
HALF_RANGES = np.array([5.0, 5.0, 2.75, 20.0, 20.0, 5.0])
CENTRE = np.array([0.0, 0.0, 3.25, 0.0, 0.0, 0.0])


def contacts(n: int, seed: int) -> Array:
    """Return (n, 6) contacts, mm and degrees, uniformly distributed."""
    return CENTRE + HALF_RANGES * np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 6))


def draw(contact: Array, size: tuple[int, int] = SIZE) -> ImageArray:
    """Draw an image of 19 dots that the contact shifts, spreads, tilts and rotates."""
    x, y, z, alpha, beta, gamma = (contact - CENTRE) / HALF_RANGES
    image = np.zeros(size, dtype=np.uint8)
    for ring in range(3):
        for k in range(max(1, 6 * ring)):
            angle = 2.0 * np.pi * k / max(1, 6 * ring) + 0.35 * gamma
            radius = ring * (6.5 + z)
            u, v = radius * np.cos(angle), radius * np.sin(angle)
            column = size[1] / 2 + u * (1.0 + 0.02 * beta * u) + 3.0 * x
            row = size[0] / 2 + v * (1.0 + 0.02 * alpha * v) + 3.0 * y
            centre = (round(column * 16), round(row * 16))
            cv2.circle(image, centre, round(2.2 * 16), 255, cv2.FILLED, cv2.LINE_AA, shift=4)
    return image


def preprocessing(output: int = 32) -> Preprocessing:
    return Preprocessing(input_size=SIZE, output_size=(output, output))


def labelled(n: int, seed: int) -> LabelledImages:
    """Return n preprocessed images with their labels."""
    drawn = contacts(n, seed)
    steps = preprocessing()
    return LabelledImages(np.stack([steps.reduce(draw(contact)) for contact in drawn]), xi_from_contact(drawn))


def write_split(root: Path, split: str, n: int, seed: int) -> Path:
    """Write a split in the public layout with shuffled columns; return its folder."""
    folder = root / split
    images = folder / "processed_images"
    images.mkdir(parents=True)
    columns = [*LABEL_COLUMNS[3:], "pose_x", IMAGE_COLUMN, *LABEL_COLUMNS[:3], "shear_z"]
    with (folder / "targets_images.csv").open("w", newline="") as stream:
        table = csv.DictWriter(stream, columns)
        table.writeheader()
        for i, contact in enumerate(contacts(n, seed)):
            name = f"image_{i + 1}.png"
            cv2.imwrite(str(images / name), draw(contact))
            values = dict(zip(LABEL_COLUMNS, contact.tolist(), strict=True))
            table.writerow({IMAGE_COLUMN: name, "pose_x": 0, "shear_z": 0, **values})
    return folder


def taught(path: Path) -> tuple[dict[str, object], dict[str, bytes]]:
    """Return the contents of a model file, without the training time."""
    model = load_model(path)
    header = model.header.model_dump()
    assert header["training"].pop("epochs_cpu_s") >= 0.0
    return header, {name: tensor.tobytes() for name, tensor in model.tensors.items()}
