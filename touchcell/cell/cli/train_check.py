"""``touchcell train-check``: learn the check of an image network again, or for a model file that has none."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchcell.drivers.replay.dataset import read_split
from touchcell.geometry.types import ImageArray
from touchcell.perception.errors import ModelError, TrainingError
from touchcell.perception.models.architecture import CHECK, Architecture
from touchcell.perception.models.model_file import load_model, save_model
from touchcell.perception.networks.dataset import default_cache, load_reduced
from touchcell.perception.networks.image_check import LEAST_IMAGES, learn_image_check
from touchcell.perception.networks.progress import Display
from touchcell.perception.runtime.inference import ContactModel


def train_check(model: Path, out: Path, *, data: Path | None, samples: int, seed: int = 0) -> None:
    """Write the model file ``out`` with a check of images; the network stays as it is.

    Args:
        model: file of an image network.
        out: ``NAME.safetensors``.
        data: data set that it was trained on; None draws simulated images as ``train-sim`` does.
        samples: how many are drawn.
        seed: of everything random.

    Raises:
        ModelError: the file is not one of an image network.
        DataError: the data set is damaged.
        TrainingError: too few images, or the markers cannot be followed through them.
    """
    stored = load_model(model)
    architecture = stored.header.architecture
    if not isinstance(architecture, Architecture):
        raise ModelError(model, f"a model of kind {architecture.kind} checks its images already", key="architecture")
    network = ContactModel(stored)

    def means_of(images: ImageArray) -> NDArray[np.float32]:
        return np.stack([network.infer(each)[:6] for each in images])

    with Display() as display:
        if data is None:
            from touchcell.cell.cli.train_sim import draw

            images = draw(samples, seed, "train", display).images
        else:
            progress = partial(display.images, "train")
            preprocessing = stored.header.preprocessing
            split = read_split(data, "train")
            images = load_reduced(split, preprocessing, cache=default_cache(), progress=progress)
        if images.shape[1:] != stored.header.preprocessing.output_size:
            raise ModelError(model, f"takes images of {stored.header.preprocessing.output_size}", key="preprocessing")
        learned = learn_image_check(
            images,
            means_of,
            stored.header.preprocessing,
            rest=stored.reference,
            seed=seed,
            progress=partial(display.images, "check"),
        )
    if learned is None:
        raise TrainingError(
            "the markers cannot be followed from contact to contact",
            hint=f"give {LEAST_IMAGES} images or more of a tip with markers, those that the model was trained on",
        )
    check, tensors = learned
    header = stored.header.model_copy(update={"architecture": architecture.model_copy(update={"check": check})})
    others = {name: each for name, each in stored.tensors.items() if not name.startswith(CHECK)}
    save_model(replace(stored, header=header, tensors=others | tensors), out)
