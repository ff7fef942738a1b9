"""The trainers that ship. They need the extra ``train`` (PyTorch), which is imported when one begins."""

from __future__ import annotations

from typing import Final

from pydantic import Field, PositiveInt

from touchcell.perception.networks.trainer import TrainerSpec, TrainingJob
from touchcell.plugin_section import Section


class ImageNetworkTraining(Section):
    """Settings of a network that sees whole images.

    Attributes:
        epochs: passes over the images.
        short_side_px: smallest short side of its input, made by averaging whole pixels; 70 is twice as fast.
    """

    epochs: PositiveInt = 24
    short_side_px: int = Field(default=100, ge=32)


class MarkerTraining(Section):
    """Settings of a marker estimator.

    Attributes:
        epochs: passes over the images.
        networks: trained side by side; their mixture is the estimate.
        rings: of the sensor's marker lattice around its centre; ring k holds 6 k markers;
            None counts them in the images.
    """

    epochs: PositiveInt = 80
    rings: PositiveInt | None = None
    networks: PositiveInt = 2


def _train_gdn(settings: ImageNetworkTraining, job: TrainingJob) -> None:
    from touchcell.perception.networks.training import train_on_images

    train_on_images(job, kind="gdn", epochs=settings.epochs, short_side_px=settings.short_side_px)


def _train_cnn(settings: ImageNetworkTraining, job: TrainingJob) -> None:
    from touchcell.perception.networks.training import train_on_images

    train_on_images(job, kind="cnn", epochs=settings.epochs, short_side_px=settings.short_side_px)


def _train_markers(settings: MarkerTraining, job: TrainingJob) -> None:
    from touchcell.perception.networks.marker_training import MarkerSettings, train_markers

    chosen = MarkerSettings(seed=job.seed, epochs=settings.epochs, networks=settings.networks, rings=settings.rings)
    train_markers(job.data, job.out, settings=chosen, resume=job.resume, cache=job.cache, observer=job.observer)


GDN: Final = TrainerSpec("gdn", "Gaussian-density network on whole images", ImageNetworkTraining, _train_gdn)
CNN: Final = TrainerSpec("cnn", "regression network on whole images", ImageNetworkTraining, _train_cnn)
MARKERS: Final = TrainerSpec("markers", "mixture of networks on marker displacements", MarkerTraining, _train_markers)
