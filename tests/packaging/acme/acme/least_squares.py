"""A trainer: least squares, for models whose contact is linear in the pixels."""

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from acme.linear import LinearConfig
from touchcell.drivers.replay.dataset import read_split
from touchcell.perception.models.labels import CONTACT_NAMES, xi_from_contact
from touchcell.perception.models.model_file import Header, Labels, Model, save_model, touchcell_version
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.networks.trainer import TrainerSpec, TrainingJob
from touchcell.plugin_section import Section


class LeastSquaresConfig(Section):
    """Settings of the trainer.

    Attributes:
        side_px: side of the square image that the model sees.
        ridge: penalty on weights.
    """

    side_px: PositiveInt = 16
    ridge: PositiveFloat = 1.0


def train(settings: LeastSquaresConfig, job: TrainingJob) -> None:
    split = read_split(job.data, "train")
    size = next(split.read()).shape
    preprocessing = Preprocessing(input_size=size, output_size=(settings.side_px, settings.side_px))
    pixels = np.stack([preprocessing.reduce(image).ravel() / 255 for image in split.read()])
    low, high = split.contact_mm_deg.min(axis=0), split.contact_mm_deg.max(axis=0)
    labels = Labels.of_contacts(tuple(low), tuple(high))
    targets = labels.targets(xi_from_contact(split.contact_mm_deg))
    centre, middle = pixels.mean(axis=0), targets.mean(axis=0)
    gram = (pixels - centre) @ (pixels - centre).T + settings.ridge * np.eye(len(pixels))
    weight = (np.linalg.solve(gram, targets - middle).T @ (pixels - centre)).astype(np.float32)
    off = targets - middle - (pixels - centre) @ weight.T
    header = Header(
        touchcell_version=touchcell_version(),
        architecture=LinearConfig(input_size=preprocessing.output_size),
        preprocessing=preprocessing,
        labels=labels,
        sigma_scale=tuple(off.std(axis=0) + 1e-6),
        training_data=str(job.data),
        training={"components": ", ".join(CONTACT_NAMES), **settings.model_dump()},
    )
    bias = (middle - weight @ centre).astype(np.float32)
    save_model(Model(header, {"weight": weight, "bias": bias}), job.out)


SPEC = TrainerSpec("acme_linear", "least squares on small images", LeastSquaresConfig, train)
